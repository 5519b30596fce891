"""Projection into a moving camera on the device: the twin of `rsgen.geometry.shutter.project_rolling`, per pixel.

Importing this module needs an active Mitsuba variant (`backend.mitsuba()`). Points are homogeneous, (p, w): w = 1
for a point p in metres, w = 0 for a point at infinity in direction p. Positions are relative to a reference near the
camera, so that float32 stays good to about 1e-4 px wherever the world's origin is.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.so3 import FloatArray
from rsgen.render.sensor import PoseFunction

_MIN_DEPTH = 1e-9  # as in `Camera.project`
# Enough where the image moves along the scan at up to half the scan's own speed (at a tenth, 3 are).
_SECANT_STEPS = 6
# Lines. Below the first, rounding of float32 would spoil the secant; beyond the second, the line was not found.
_SECANT_FROM = 0.05
_FOUND_WITHIN = 0.005


class Track:
    """Poses T_world_cam of one frame on the device: a table over its whole exposure, blended linearly as the sensor's.

    Times are seconds after the first line's shutter opened, stamp − t_e.
    """

    def __init__(
        self, camera: Camera, shutter: Shutter, T_world_cam: PoseFunction, stamp: float, reference: FloatArray
    ):
        """`T_world_cam`: times (n,) s → (n, 4, 4); `stamp` in s; `reference` (3,): origin of positions, world, m."""
        self.camera, self.shutter = camera, shutter
        span = shutter.exposure_s + shutter.readout_s
        self._steps = 4 * shutter.line_count(camera) if span > 0 else 1
        self._step_s = span / self._steps if span > 0 else 1.0
        grid = stamp - shutter.exposure_s + (span / self._steps) * np.arange(self._steps + 1)
        T = np.array(np.broadcast_to(T_world_cam(grid if span > 0 else grid[:1]), (len(grid), 4, 4)))
        T[:, :3, 3] -= reference
        self._table = mi.Float(np.ascontiguousarray(T[:, :3, :], np.float32).ravel())
        dr.make_opaque(self._table)

    def pose(self, t: Any) -> tuple[Any, list[Any]]:
        """The camera's position (Point3f, relative to the reference) and the rows of its rotation R_world_cam."""
        x = t / self._step_s
        index = mi.UInt32(dr.clip(x, 0.0, float(self._steps - 1)))
        fraction = x - mi.Float(index)  # beyond the table's ends, half a line at most, it goes on straight
        low, high = ([dr.gather(mi.Vector4f, self._table, 3 * i + k) for k in range(3)] for i in (index, index + 1))
        rows = [dr.fma(fraction, b - a, a) for a, b in zip(low, high, strict=True)]
        return mi.Point3f(*(row.w for row in rows)), [mi.Vector3f(row.x, row.y, row.z) for row in rows]

    def project_at(self, t: Any, p: Any, w: Any) -> tuple[Any, Any]:
        """Pixels (Point2f) of points (p, w) seen at times t, and where that is defined (see `Camera.project`)."""
        origin, R_world_cam = self.pose(t)
        return project(self.camera, to_camera(R_world_cam, p - w * origin))

    def project(self, start: Any, p: Any, w: Any) -> tuple[Any, Any, Any]:
        """Where and when the frame's lines at mid-exposure show points (p, w): pixels, times and whether found.

        Solves line(π(T(t)⁻¹ p)) = line by the secant method in lines, beginning at `start` (lines, any reals). Lines
        are continuous. Found: in front of the camera, in the image, and the line converged.
        """
        delay, last = self.shutter.line_delay(self.camera), self.shutter.line_count(self.camera) - 1.0
        half = 0.5 * self.shutter.exposure_s
        line = dr.clip(start, -0.5, last + 0.5)
        error = self._line(self.project_at(half + line * delay, p, w)[0]) - line
        slope = mi.Float(-1.0)
        for _ in range(_SECANT_STEPS):
            new = dr.clip(line - error / slope, -0.5, last + 0.5)
            uv, defined = self.project_at(half + new * delay, p, w)
            new_error, step = self._line(uv) - new, new - line
            secant = (new_error - error) / step
            slope = dr.select((dr.abs(step) > _SECANT_FROM) & (secant < 0), secant, slope)
            line, error = new, new_error
        found = defined & contains(self.camera, uv) & (dr.abs(error) < _FOUND_WITHIN)
        return uv, half + line * delay, found

    def _line(self, uv: Any) -> Any:
        return line_of_pixel(self.camera, self.shutter, uv)


def line_of_pixel(camera: Camera, shutter: Shutter, uv: Any) -> Any:
    """Line coordinate, not rounded, of pixels (Point2f); twin of `Shutter.line_of_pixel`."""
    along = uv.y if shutter.scan in ("top-bottom", "bottom-top") else uv.x
    return along if shutter.scan in ("top-bottom", "left-right") else (shutter.line_count(camera) - 1.0) - along


def contains(camera: Camera, uv: Any) -> Any:
    """Whether pixels (Point2f) lie in the image; twin of `Camera.contains`."""
    return (uv.x >= -0.5) & (uv.y >= -0.5) & (uv.x < camera.width - 0.5) & (uv.y < camera.height - 0.5)


def to_camera(R_world_cam: list[Any], v_world: Any) -> Any:
    """R_world_camᵀ v (Vector3f) of world vectors v, given the rotation's rows."""
    return R_world_cam[0] * v_world.x + R_world_cam[1] * v_world.y + R_world_cam[2] * v_world.z


def project(camera: Camera, p_cam: Any) -> tuple[Any, Any]:
    """Pixels (Point2f) of points in the camera's frame, and where that is defined; twin of `Camera.project`."""
    front = p_cam.z > _MIN_DEPTH
    inverse = dr.rcp(dr.select(front, p_cam.z, 1.0))
    x, y = p_cam.x * inverse, p_cam.y * inverse
    r2 = x * x + y * y
    defined = front & (r2 < min(camera.max_radius, 1e18) ** 2)
    if camera.model == "radtan":
        x, y = _distort_radtan(x, y, r2, *(*camera.distortion, 0.0)[:5])
    elif camera.model == "fisheye":
        k1, k2, k3, k4 = camera.distortion
        r = dr.sqrt(r2)
        theta = dr.atan(r)
        t2 = theta * theta
        scale = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / dr.select(r > 0, r, 1.0)
        scale = dr.select(r > 0, scale, 1.0)
        x, y = x * scale, y * scale
    return mi.Point2f(dr.fma(x, camera.fx, camera.cx), dr.fma(y, camera.fy, camera.cy)), defined


def _distort_radtan(x: Any, y: Any, r2: Any, k1: float, k2: float, p1: float, p2: float, k3: float) -> tuple[Any, Any]:
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    cross = 2 * x * y
    return x * radial + p1 * cross + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + p2 * cross
