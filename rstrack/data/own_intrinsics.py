"""Images whose intrinsics change from one to the next, as a phone's autofocus makes them: each taken to one camera.

    intrinsics.csv, intrinsics_depth.csv    stamp [ns],fx,fy,cx,cy of colour and of depth images, from `rstrack import`

The tracker's kernels have one camera written into them. A pixel's ray is K⁻¹ x with whatever distortion after that, so
that between two images which differ in K alone pixels are moved by x_own = K_own K⁻¹ x: a scale and a shift of columns
and of rows, the same for every lens model. K has the medians of the table; camera.yaml is about that.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import read_text
from rsgen.geometry.camera import Camera
from rsgen.sequence.format import StreamName
from rstrack.data.image_files import ImageReader

FILES: dict[StreamName, str] = {"color": "intrinsics.csv", "depth": "intrinsics_depth.csv"}
# Neighbours are of one surface if their 1/z differs by less, or goes on as beside them but for less; relative.
_ONE_SURFACE, _BEND = 0.03, 0.02
# An image, or the camera file, whose focal length differs by more from the medians is of another camera.
_MOST_APART = 0.25


@dataclass(frozen=True)
class OwnIntrinsics:
    """Of a stream's images: own (n, 4) fx fy cx cy of each, and shared (4,), those of the camera they are taken to."""

    own: FloatArray
    shared: FloatArray

    def taps(self, k: int, axis: int, size: int) -> Taps | None:
        """Where the columns (axis 0) or rows (1) of the shared camera lie in image k; None: where they are."""
        if (self.own[k] == self.shared).all():
            return None
        (f_own, c_own), (f, c) = self.own[k, axis::2], self.shared[axis::2]
        return Taps.at(f_own / f, c_own - f_own / f * c, size)


@dataclass(frozen=True)
class Taps:
    """Linear interpolation along an axis at scale · pixel + shift.

    first (n,): one neighbour, weight (n,): of the next, inside (n,): whether there is an image.
    """

    scale: float
    shift: float
    first: IntArray
    weight: Float32Array
    inside: np.ndarray

    @classmethod
    def at(cls, scale: float, shift: float, size: int) -> Taps:
        """Of an image of n pixels, outside of which is its rim."""
        positions = scale * np.arange(size) + shift
        held = np.clip(positions, 0.0, size - 1.0)
        first = np.clip(np.floor(held).astype(np.int64), 0, max(size - 2, 0))
        return cls(scale, shift, first, (held - first).astype(np.float32), positions == held)

    @property
    def second(self) -> IntArray:
        """The other neighbours (n,)."""
        return self.first + (self.weight > 0)

    @property
    def nearest(self) -> IntArray:
        """The nearer one (n,)."""
        return self.first + (self.weight > 0.5)


@dataclass(frozen=True)
class SharedImages:
    """Images as one camera for each stream would have taken them. color, depth: None where intrinsics do not change."""

    images: ImageReader
    own_color: OwnIntrinsics | None
    own_depth: OwnIntrinsics | None

    def color(self, k: int) -> ByteArray:
        """RGB (h, w, 3) of colour image k, bilinear; beyond its rim as at the rim. Raises UserError."""
        image = self.images.color(k)
        taps = _both(self.own_color, k, image.shape)
        return image if taps is None else _interpolated_color(image, *taps)

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) of depth image k in metres, 0 = missing, also beyond its rim. Raises UserError."""
        z = self.images.depth(k)
        taps = _both(self.own_depth, k, z.shape)
        return z if taps is None else _interpolated_depth(z, *taps)


def read_own_intrinsics(root: Path, stream: StreamName, stamps: FloatArray, camera: Camera) -> OwnIntrinsics | None:
    """The intrinsics of a stream's images, None where the folder does not list them.

    stamps (n,): of the images as listed, s; between those of the table it is interpolated. camera: the stream's.
    Raises UserError, one line: no such table, or one of another camera.
    """
    path = root / FILES[stream]
    if not path.exists():
        return None
    lines = [(k, line) for k, line in enumerate(read_text(path).splitlines(), 1) if line.strip() and line[0] != "#"]
    table = np.array([_row(path, number, line) for number, line in lines]).reshape(-1, 5)
    if not len(table) or (np.diff(table[:, 0]) <= 0).any():
        raise UserError(f"{path}: expected lines of rising stamps: import the recording again, or remove the file")
    shared = np.median(table[:, 1:], axis=0)
    if (np.abs(table[:, 1:3] / shared[:2] - 1.0) > _MOST_APART).any():
        raise UserError(f"{path}: focal lengths {table[:, 1].min():g} to {table[:, 1].max():g} are not of one camera")
    if (np.abs(np.array([camera.fx, camera.fy]) / shared[:2] - 1.0) > _MOST_APART).any():
        raise UserError(
            f"{path}: is about a camera with fx {shared[0]:g}, not {camera.fx:g} as the camera file states: correct "
            "that, or remove this file"
        )
    own = np.column_stack([np.interp(stamps, table[:, 0], column) for column in table[:, 1:].T])
    return OwnIntrinsics(own, shared)


def _row(path: Path, number: int, line: str) -> list[float]:
    """Stamp in s, fx, fy, cx, cy. Raises UserError."""
    stamp, _, rest = line.partition(",")
    try:
        row = [int(stamp) / 1e9, *(float(field) for field in rest.split(","))]
    except (ValueError, OverflowError):
        row = []
    if len(row) != 5 or not np.isfinite(row).all() or min(row[1:3]) <= 0:
        raise UserError(f"{path} line {number}: expected stamp [ns],fx,fy,cx,cy, found {line[:60]!r}")
    return row


def _both(own: OwnIntrinsics | None, k: int, shape: tuple[int, ...]) -> tuple[Taps, Taps] | None:
    """Of columns and rows."""
    x, y = (None if own is None else own.taps(k, axis, shape[1 - axis]) for axis in (0, 1))
    return None if x is None or y is None else (x, y)


def _interpolated_color(image: ByteArray, x: Taps, y: Taps) -> ByteArray:
    """OpenCV rounds positions to 1/32 pixel, which no 8-bit image shows, and takes a seventh of NumPy's time."""
    warp = np.array([[x.scale, 0.0, x.shift], [0.0, y.scale, y.shift]])
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = image.shape[1], image.shape[0]
    return np.asarray(cv2.warpAffine(image, warp, size, flags=how, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _interpolated_depth(z: Float32Array, x: Taps, y: Taps) -> Float32Array:
    """1/z is linear on a plane. The nearest pixel where the four are not of one surface, or not all there."""
    with np.errstate(divide="ignore", invalid="ignore"):  # of what is missing
        rho = np.float32(1.0) / z
        a, b, c, d = (rho[rows][:, columns] for rows in (y.first, y.second) for columns in (x.first, x.second))
        wy, wx = y.weight[:, None], x.weight[None, :]
        mixed = (a * (1 - wx) + b * wx) * (1 - wy) + (c * (1 - wx) + d * wx) * wy
        four = a, b, c, d
        least, most = np.minimum.reduce(four), np.maximum.reduce(four)
        smooth = (most - least <= _ONE_SURFACE * least) | _straight(rho)[y.first][:, x.first]
        found = np.where(smooth & np.isfinite(most), np.float32(1.0) / mixed, z[y.nearest][:, x.nearest])
    return np.where(y.inside[:, None] & x.inside[None, :], found, np.float32(0.0))


def _straight(rho: Float32Array) -> np.ndarray:
    """Whether (h, w) the pixel and its neighbours right, below and across go on as those beside them do.

    So they do on a floor that is seen at a grazing angle, however far apart they are, and not over an edge.
    """
    along = [np.pad(_continued(rho if axis else rho.T), ((0, 0), (0, 1))) for axis in (1, 0)]
    right, below = along[0], along[1].T
    return right & below & np.roll(right, -1, axis=0) & np.roll(below, -1, axis=1)


def _continued(rho: Float32Array) -> np.ndarray:
    """For neighbours in rows (h, w - 1): whether 1/z is linear over them and the next one on either side."""
    step = np.diff(rho, axis=1)
    bent = np.abs(np.diff(step, axis=1)) > _BEND * rho[:, 1:-1]
    straight = np.pad(~bent & np.isfinite(step[:, 1:] - step[:, :-1]), ((0, 0), (1, 1)))
    return straight[:, :-1] | straight[:, 1:]
