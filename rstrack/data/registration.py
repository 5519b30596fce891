"""Images as other cameras would have taken them: registered depth and colour, and images whose own intrinsics change.

registrar = Registrar(dataset.rig)
image = registrar(dataset.depth(k), dataset.images.color(i))     # pixel on pixel, as other trackers want them

**Registered depth** and the times of its rows: a driver that warps depth into the colour camera hardly changes the
order of the rows: the cameras lie beside each other with their rows alike, so a row of the registered image shows one
row of the depth sensor, or between two, wherever in the row and however far away: sensor row ≈ a·row + b. Its times are
those of a shutter that reads a times as long and starts b rows later. Where the sensor's geometry is not known, a = 1
and b = 0.

**Intrinsics that change** from one image to the next, as a phone's autofocus makes them: each is taken to one camera.

    intrinsics.csv, intrinsics_depth.csv    stamp [ns],fx,fy,cx,cy of colour and of depth images, from `rstrack import`

The tracker's kernels have one camera written into them. A pixel's ray is K⁻¹ x with whatever distortion after that, so
that between two images which differ in K alone pixels are moved by x_own = K_own K⁻¹ x: a scale and a shift of columns
and of rows, the same for every lens model. K has the medians of the table; camera.yaml is about that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray, Float32Array, FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import read_text
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.format import StreamName
from rstrack.data.image_files import ImageReader
from rstrack.data.rig import Rig

FILES: dict[StreamName, str] = {"color": "intrinsics.csv", "depth": "intrinsics_depth.csv"}
# Inverse depth is linear in the pixels of a plane: second differences above this share of it are an edge.
_EDGE = 0.02
# Neighbours whose 1/z differs by less, relative, are of one surface however it goes on beside them.
_ONE_SURFACE = 0.03
_BEND = np.array([[1.0, -2.0, 1.0]], np.float32)
# Outside every image, for pixels that are seen nowhere.
_NOWHERE = -1e4
# An image, or the camera file, whose focal length differs by more from the medians is of another camera.
_MOST_APART = 0.25
# Depths (m) at which the rows of registered depth are looked at: the middle of what such sensors see.
_DEPTHS = (1.0, 2.0, 4.0)
_EVERY = 8


@dataclass(frozen=True)
class RegisteredImage:
    """depth: float32 (h, w), planar z in metres, 0 = missing or not seen in colour. color: uint8 (h, w, 3) RGB."""

    depth: Float32Array
    color: ByteArray


class Registrar:
    """Undistorts depth and takes each of its pixels' colour from where the colour camera sees that point.

    That is what drivers offer as 'colour to depth'; unlike depth warped into the colour camera, it has no holes and
    moves no depth but for the distortion. Lines' times are ignored: both images are taken for global-shutter images of
    one instant.

    camera: the pinhole that both have afterwards; it has the depth camera's size, focal lengths and centre.
    """

    def __init__(self, rig: Rig) -> None:
        self.camera = replace(rig.depth_camera, model="pinhole", distortion=())
        self._color_camera, self._T_color_depth = rig.color_camera, rig.T_color_depth
        self._rays = self.camera.unproject(self.camera.pixel_grid())
        is_straight = rig.depth_camera.model == "pinhole"
        self._depth_map = None if is_straight else _pixel_map(rig.depth_camera, self._rays)
        self._is_registered = rig.color_camera == self.camera and np.array_equal(rig.T_color_depth, np.eye(4))

    def __call__(self, depth: Float32Array, color: ByteArray) -> RegisteredImage:
        """depth (h, w), planar z in metres, 0 = missing; color (H, W, 3): as the two cameras took them."""
        z = depth if self._depth_map is None else _undistorted(depth, *self._depth_map)
        if self._is_registered:
            return RegisteredImage(z, color)
        is_known = z > 0
        # A point of the median depth stands in for what was not measured, so that there is colour there too: the
        # pyramids of a tracker would smear black holes into their neighbours.
        elsewhere = float(np.median(z[is_known])) if is_known.any() else 1.0
        p_color = se3.transform(self._T_color_depth, self._rays * np.where(is_known, z, elsewhere)[..., None])
        u, v = _pixel_map(self._color_camera, p_color)
        values = cv2.remap(color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        is_seen = self._color_camera.contains(np.stack([u, v], axis=-1))
        return RegisteredImage(np.where(is_seen, z, np.float32(0)), np.asarray(values, np.uint8))


def _pixel_map(camera: Camera, p_cam: FloatArray) -> tuple[Float32Array, Float32Array]:
    """Where points (h, w, 3) are in the camera's image: u and v (h, w), as OpenCV's remap takes them."""
    uv, is_visible = camera.project(p_cam)
    uv = np.where(is_visible[..., None], uv, _NOWHERE).astype(np.float32)
    return np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])


def _undistorted(z: Float32Array, u: Float32Array, v: Float32Array) -> Float32Array:
    """Depth at pixels (u, v): its inverse is interpolated within a surface, the nearest pixel's across an edge."""
    inverse = np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)
    bend = np.maximum(*(np.abs(cv2.filter2D(inverse, -1, kernel)) for kernel in (_BEND, _BEND.T)))
    is_edge = cv2.dilate((bend > _EDGE * inverse).astype(np.uint8), np.ones((3, 3), np.uint8))

    def at_pixels(image: Any, how: int) -> Float32Array:
        return np.asarray(cv2.remap(image, u, v, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0))

    nearest = at_pixels(inverse, cv2.INTER_NEAREST)
    found = np.where(at_pixels(is_edge, cv2.INTER_NEAREST) > 0, nearest, at_pixels(inverse, cv2.INTER_LINEAR))
    return np.divide(1.0, found, out=np.zeros_like(found), where=found > 0)


def registered_shutter(
    camera: Camera, sensor: Camera, shutter: Shutter, T_color_sensor: FloatArray
) -> tuple[Shutter, float]:
    """The shutter of images of `camera` that were warped from a sensor, and seconds to add to the sensor's stamps.

    shutter: the sensor's; T_color_sensor (4, 4): from it to the camera warped into. Least squares over pixels and
    depths. Raises UserError if the sensor sees none of them, or its lines do not run along those of the image.
    """
    pixels = camera.pixel_grid()[::_EVERY, ::_EVERY].reshape(-1, 2)
    line = shutter.line_of_pixel(pixels, camera)
    rays = camera.unproject(pixels)
    seen_line, on_line = [], []
    for z in _DEPTHS:
        uv, _ = sensor.project(se3.transform(se3.inverse(T_color_sensor), rays * z))
        seen = sensor.contains(uv)
        seen_line.append(shutter.line_of_pixel(uv[seen], sensor))
        on_line.append(line[seen])
    x, y = np.concatenate(on_line), np.concatenate(seen_line)
    slope = 0.0
    if len(x) and np.ptp(x) > 0.0:
        slope, first = np.polyfit(x, y, 1)
    if slope <= 0.1:
        raise UserError("depth.sensor: does not see what registered depth shows: check intrinsics and T_color_sensor")
    delay = shutter.line_delay(sensor)
    readout = slope * delay * shutter.line_count(camera)
    return replace(shutter, readout_s=float(readout)), float(first * delay)


@dataclass(frozen=True)
class OwnIntrinsics:
    """Of a stream's images: own (n, 4) fx fy cx cy of each, and shared (4,), those of the camera they are taken to."""

    own: FloatArray
    shared: FloatArray

    def warp(self, k: int) -> FloatArray | None:
        """(2, 3) from pixels of the shared camera to those of image k: a scale and a shift; None: they are the same."""
        if (self.own[k] == self.shared).all():
            return None
        warp = np.zeros((2, 3))
        for axis in (0, 1):
            (f_own, c_own), (f, c) = self.own[k, axis::2], self.shared[axis::2]
            warp[axis, axis], warp[axis, 2] = f_own / f, c_own - f_own / f * c
        return warp


@dataclass(frozen=True)
class SharedImages:
    """Images as one camera for each stream would have taken them. color, depth: None where intrinsics do not change."""

    images: ImageReader
    own_color: OwnIntrinsics | None
    own_depth: OwnIntrinsics | None

    def color(self, k: int) -> ByteArray:
        """RGB (h, w, 3) of colour image k, bilinear; beyond its rim as at the rim. Raises UserError."""
        image, warp = self.images.color(k), None if self.own_color is None else self.own_color.warp(k)
        return image if warp is None else _interpolated_color(image, warp)

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) of depth image k in metres, 0 = missing, also beyond its rim. Raises UserError."""
        z, warp = self.images.depth(k), None if self.own_depth is None else self.own_depth.warp(k)
        return z if warp is None else _interpolated_depth(z, warp)


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


def _interpolated_color(image: ByteArray, warp: FloatArray) -> ByteArray:
    """OpenCV rounds positions to 1/32 pixel, which no 8-bit image shows, and takes a seventh of NumPy's time."""
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = image.shape[1], image.shape[0]
    return np.asarray(cv2.warpAffine(image, warp, size, flags=how, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _interpolated_depth(z: Float32Array, warp: FloatArray) -> Float32Array:
    """1/z is linear on a plane. The nearest pixel where the four are not of one surface, or not all there."""
    (x, wx, x_inside), (y, wy, y_inside) = (
        _taps(float(warp[axis, axis]), float(warp[axis, 2]), z.shape[1 - axis]) for axis in (0, 1)
    )
    with np.errstate(divide="ignore", invalid="ignore"):  # of what is missing
        rho = np.float32(1.0) / z
        a, b, c, d = (rho[rows][:, columns] for rows in (y, y + (wy > 0)) for columns in (x, x + (wx > 0)))
        nearest = z[y + (wy > 0.5)][:, x + (wx > 0.5)]
        wy, wx = wy[:, None], wx[None, :]
        mixed = (a * (1 - wx) + b * wx) * (1 - wy) + (c * (1 - wx) + d * wx) * wy
        four = a, b, c, d
        least, most = np.minimum.reduce(four), np.maximum.reduce(four)
        smooth = (most - least <= _ONE_SURFACE * least) | _straight(rho)[y][:, x]
        found = np.where(smooth & np.isfinite(most), np.float32(1.0) / mixed, nearest)
    return np.where(y_inside[:, None] & x_inside[None, :], found, np.float32(0.0))


def _taps(scale: float, shift: float, size: int) -> tuple[IntArray, Float32Array, npt.NDArray[np.bool_]]:
    """Interpolation at scale · pixel + shift along an axis of n pixels, outside of which is its rim.

    One neighbour (n,), the weight (n,) of the next one, and whether (n,) there is an image.
    """
    positions = scale * np.arange(size) + shift
    held = np.clip(positions, 0.0, size - 1.0)
    first = np.clip(np.floor(held).astype(np.int64), 0, max(size - 2, 0))
    return first, (held - first).astype(np.float32), positions == held


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
    bent = np.abs(np.diff(step, axis=1)) > _EDGE * rho[:, 1:-1]
    straight = np.pad(~bent & np.isfinite(step[:, 1:] - step[:, :-1]), ((0, 0), (1, 1)))
    return straight[:, :-1] | straight[:, 1:]
