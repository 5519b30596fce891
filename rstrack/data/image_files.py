"""Images of a recording: decoded from files, whole or refused; a sensor's noise added; loaded ahead in a thread."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray, Float32Array
from rsgen.errors import UserError
from rsgen.files import read_bytes
from rsgen.geometry.camera import Camera
from rsgen.image_codecs import decoded, png_fault
from rsgen.inputs import MOST_PIXELS, PNG_START, image_size
from rstrack.data.rig import Frame, Image, Rig

_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
# Damaged images at the start of a recording before it is given up.
_TRIED = 10
# Repeats in a row beyond which a camera is taken to be at rest in a world without noise.
_AT_REST = 30


@dataclass(frozen=True)
class ImageFiles:
    """Decodes the images of a folder, and checks that they are as large as the cameras say.

    depth_scale: units per metre. missing: a depth in units that means, as 0 does, that nothing was measured.
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


def repeats_note(name: str, again: npt.NDArray[np.bool_]) -> tuple[str, ...]:
    """For the screen, nothing where there are none. again (n,): which images of a stream are the one before again."""
    if not again.any():
        return ()
    return (
        f"{np.count_nonzero(again)} of {len(again)} {name} images are the one before again, byte for byte: they were "
        "not taken anew, and are left out",
    )


def _same_bytes(a: Path, b: Path) -> bool:
    try:
        return a.stat().st_size == b.stat().st_size and a.read_bytes() == b.read_bytes()
    except OSError:
        return False  # reported when it is decoded


def decode_image(path: Path) -> npt.NDArray[Any]:
    """A whole PNG or JPEG of 8 or 16 bits as OpenCV returns it. Raises UserError.

    Files are checked first, because decoders complain on stderr, and some return half a picture.
    """
    data = read_bytes(path)
    fault = image_fault(data)
    image = None if fault else decoded(data)
    if image is None:
        raise UserError(f"{path}: is not a whole image ({fault or 'cannot be decoded'}): unpack the dataset again")
    if image.dtype not in (np.uint8, np.uint16):
        raise UserError(f"{path}: has pixels of type {image.dtype}, expected 8-bit colour or 16-bit depth")
    return image


def image_fault(data: bytes) -> str | None:
    """Why bytes are no whole PNG or JPEG of a size that is decoded; None where they are."""
    if data.startswith(PNG_START):
        fault = png_fault(data)
    elif data.startswith(_JPEG_START):
        fault = None if _JPEG_END in data[-64:] else "truncated"
    else:
        fault = "neither PNG nor JPEG"
    width, height = image_size(data) or (0, 0)
    return fault or (f"it claims {width}x{height} pixels" if width * height > MOST_PIXELS else None)


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


class ImageReader(Protocol):
    """Decodes the k-th image of a stream. Raises UserError naming the file."""

    def color(self, k: int) -> ByteArray:
        """RGB (h, w, 3)."""

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) in metres, 0 = missing."""


def with_noise(frame: Frame, k: int, sigma_depth: float, sigma_intensity: float, seed: int) -> Frame:
    """Frame k of a dataset with Gaussian noise, which depends on (seed, k) alone, not on what was read before.

    sigma_depth: 1/m; the standard deviation of a depth z is sigma_depth · z² metres (structured light; 1.2e-3 is a
      Kinect's). Missing depth stays missing.
    sigma_intensity: standard deviation of the grey image in [0, 1]. One noise field is added to all three channels, so
      that the grey value has that deviation whatever its weights. The sum is rounded (another 1/12 of a squared grey
      level of variance) and clipped to uint8.
    Raises UserError for deviations that are negative or not finite, and for a negative seed.
    """
    _check_noise(sigma_depth, sigma_intensity, seed)
    depth = Image(frame.depth.stamp, _noisy_depth(frame.depth.pixels, sigma_depth, seed, k))
    colors = (_noisy_color(image.pixels, sigma_intensity, seed, k, n) for n, image in enumerate(frame.colors, 1))
    return Frame(depth, tuple(Image(image.stamp, pixels) for image, pixels in zip(frame.colors, colors, strict=True)))


@dataclass(frozen=True)
class NoisyImages:
    """The images of a dataset with such noise, the k-th of each stream as in frame k."""

    images: ImageReader
    sigma_depth: float
    sigma_intensity: float
    seed: int

    def __post_init__(self) -> None:
        _check_noise(self.sigma_depth, self.sigma_intensity, self.seed)

    def color(self, k: int) -> ByteArray:
        """RGB (h, w, 3)."""
        return _noisy_color(self.images.color(k), self.sigma_intensity, self.seed, k, 1)

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) in metres, 0 = missing."""
        return _noisy_depth(self.images.depth(k), self.sigma_depth, self.seed, k)


def _check_noise(sigma_depth: float, sigma_intensity: float, seed: int) -> None:
    for name, sigma in (("depth", sigma_depth), ("intensity", sigma_intensity)):
        if not (math.isfinite(sigma) and sigma >= 0):
            raise UserError(f"noise: sigma_{name} = {sigma!r} must be a finite number, 0 or more")
    if seed < 0:
        raise UserError(f"noise: seed = {seed} must be 0 or more")


def _noisy_depth(z: Float32Array, sigma: float, seed: int, k: int) -> Float32Array:
    if not sigma:
        return z
    noise = np.random.default_rng([seed, k, 0]).standard_normal(z.shape, np.float32)
    return np.maximum(z + np.float32(sigma) * z * z * noise, np.float32(0.0))


def _noisy_color(pixels: ByteArray, sigma: float, seed: int, k: int, stream: int) -> ByteArray:
    if not sigma:
        return pixels
    noise = np.random.default_rng([seed, k, stream]).standard_normal(pixels.shape[:2], np.float32)
    levels = np.rint(np.float32(255.0 * sigma) * noise)
    field = np.clip(levels, -255, 255).astype(np.int16)  # beyond these everything clips anyway
    return np.asarray(cv2.add(pixels, cv2.merge([field] * 3), dtype=cv2.CV_8U), np.uint8)


Key = TypeVar("Key")
Value = TypeVar("Value")


def prefetched(load: Callable[[Key], Value], keys: Iterable[Key], ahead: int = 2) -> Iterator[Value]:
    """load(key) of each key, in order; up to `ahead` (at least 1) are loaded in a thread while the last one is used.

    What `load` raises is raised here, in its turn. The thread has ended once the iterator is exhausted, closed or
    dropped, or has raised.
    """
    remaining = iter(keys)
    executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch")
    try:
        waiting: deque[Future[Value]] = deque()

        def load_next() -> None:
            for key in remaining:
                waiting.append(executor.submit(load, key))
                return

        for _ in range(max(1, ahead)):
            load_next()
        while waiting:
            value = waiting.popleft().result()
            load_next()
            yield value
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
