"""Images of folders that are no rsgen sequence: 8-bit PNG or JPEG colour and 16-bit PNG depth, whole or refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray, Float32Array
from rsgen.errors import UserError
from rsgen.files import png_fault, read_bytes
from rsgen.geometry.camera import Camera
from rsgen.inputs import MOST_PIXELS, image_size
from rstrack.data.rig import Rig

_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_PNG_START = b"\x89PNG"
# Damaged images at the start of a recording before it is given up.
_TRIED = 10
# Repeats in a row beyond which a camera is taken to be at rest in a world without noise.
_AT_REST = 30


@dataclass(frozen=True)
class ImageFiles:
    """Decodes the images of a folder, and checks that they are as large as the cameras say.

    depth_scale: units per metre. missing: a depth in units that says, as 0 does, that nothing was measured.
    """

    rig: Rig
    depth_scale: float
    color_paths: tuple[Path, ...]
    depth_paths: tuple[Path, ...]
    missing: int = 0

    def color(self, k: int) -> ByteArray:
        """RGB (h, w, 3) of colour image k. Raises UserError naming the file."""
        path = self.color_paths[k]
        image = decode_color(path)
        check_size(path, image, self.rig.color_camera)
        return image

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) in metres of depth image k, 0 = missing. Raises UserError naming the file."""
        path = self.depth_paths[k]
        units = decode_depth(path)
        check_size(path, units, self.rig.depth_camera)
        z = np.asarray(units / np.float32(self.depth_scale), np.float32)
        return np.where(units == self.missing, np.float32(0), z) if self.missing else z


def first_size(paths: Sequence[Path], decode: Callable[[Path], npt.NDArray[Any]]) -> tuple[int, int]:
    """(width, height) of the first image that can be read, of the first few; raises the UserError of the first one."""
    problem: UserError | None = None
    for path in paths[:_TRIED]:
        try:
            image = decode(path)
        except UserError as error:
            problem = problem or error
        else:
            return image.shape[1], image.shape[0]
    raise problem or UserError("no image: give one at least")


def repeated(paths: Sequence[Path]) -> npt.NDArray[np.bool_]:
    """Which images (n,) are the one before again, byte for byte: the recorder asked more often than the camera gave.

    No two images of a real sensor are the same, moving or not. Many in a row, or all, are left alone: rendered.
    """
    same = np.array([False, *(_same_bytes(a, b) for a, b in pairwise(paths))], bool)[: len(paths)]
    runs = np.split(np.arange(len(same)), np.flatnonzero(~same))
    for run in runs:
        if len(run) > _AT_REST + 1 or len(run) == len(same):
            same[run] = False
    return same


def _same_bytes(a: Path, b: Path) -> bool:
    try:
        return a.stat().st_size == b.stat().st_size and a.read_bytes() == b.read_bytes()
    except OSError:
        return False  # said when it is decoded


def decode_image(path: Path) -> npt.NDArray[Any]:
    """A whole PNG or JPEG of 8 or 16 bits as OpenCV returns it. Raises UserError.

    Files are checked first, because decoders complain on stderr, and some return half a picture.
    """
    data = read_bytes(path)
    if data.startswith(_PNG_START):
        fault = png_fault(data)
    elif data.startswith(_JPEG_START):
        fault = None if _JPEG_END in data[-64:] else "truncated"
    else:
        fault = "neither PNG nor JPEG"
    width, height = image_size(data) or (0, 0)
    if fault is None and width * height > MOST_PIXELS:
        fault = f"it claims {width}x{height} pixels"
    image = None
    if fault is None:
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            fault = "cannot be decoded"
    if image is None:
        raise UserError(f"{path}: is not a whole image ({fault or 'cannot be decoded'}): unpack the dataset again")
    if image.dtype not in (np.uint8, np.uint16):
        raise UserError(f"{path}: has pixels of type {image.dtype}, expected 8-bit colour or 16-bit depth")
    return image


def decode_color(path: Path) -> ByteArray:
    """RGB (h, w, 3). Raises UserError."""
    image = decode_image(path)
    if image.dtype != np.uint8:
        raise UserError(f"{path}: is a {_kind(image)} image, expected 8-bit colour: are the listings swapped?")
    codes = {2: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    return np.asarray(cv2.cvtColor(image, codes[2 if image.ndim == 2 else image.shape[2]]), np.uint8)


def decode_depth(path: Path) -> npt.NDArray[np.uint16]:
    """Units (h, w) as stored. Raises UserError."""
    image = decode_image(path)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise UserError(f"{path}: is a {_kind(image)} image, expected 16-bit grey depth: are the listings swapped?")
    return np.asarray(image, np.uint16)


def _kind(image: npt.NDArray[np.generic]) -> str:
    return f"{8 * image.dtype.itemsize}-bit {'grey' if image.ndim == 2 else 'colour'}"


def check_size(path: Path, image: npt.NDArray[np.generic], camera: Camera) -> None:
    """Raises UserError."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        found, wanted = f"{width}x{height}", f"{camera.width}x{camera.height}"
        raise UserError(f"{path}: is {found}, but the camera is {wanted}: mend width and height in the camera file")
