"""Registered depth: the times of its rows, and depth and colour pixel on pixel as other trackers want them.

registrar = Registrar(dataset.rig)
image = registrar(dataset.depth(k), dataset.images.color(i))

A driver that warps depth into the colour camera hardly changes the order of the rows: the cameras lie beside each other
with their rows alike, so a row of the registered image shows one row of the depth sensor, or between two, wherever in
the row and however far away: sensor row ≈ a·row + b. Its times are those of a shutter that reads a times as long and
starts b rows later. Where the sensor's geometry is not known, a = 1 and b = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.data.rig import Rig

# Inverse depth is linear in the pixels of a plane: second differences above this share of it are an edge.
_EDGE = 0.02
_BEND = np.array([[1.0, -2.0, 1.0]], np.float32)
# Outside every image, for pixels that are seen nowhere.
_NOWHERE = -1e4


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


# Depths (m) that are looked at: the middle of what such sensors see.
_DEPTHS = (1.0, 2.0, 4.0)
_EVERY = 8


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
