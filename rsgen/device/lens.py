"""Cameras on the device: distortion with its derivatives, its inverse, a pixel's line, and poses over one frame.

The twin of rsgen.geometry.camera and rsgen.geometry.shutter for millions of points in float32; the tests compare them.
Coordinates are device floats of any Dr.Jit backend.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Numbers, aligned
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter

# Newton steps for inverting the distortion: quadratic convergence reaches float32's end in fewer.
_UNDISTORT_STEPS = 8
# In place of a pinhole's, which has none.
_LARGEST_RADIUS = 1e6


@dataclass(frozen=True)
class Lens(Numbers):
    """What a kernel needs to know of a camera and its shutter.

    All of it is compiled in; where a kernel is handed the camera's numbers, only the distortion's model and the scan.
    """

    camera: Camera
    shutter: Shutter

    @property
    def numbers(self) -> list[float]:
        """Of the camera; the shutter's are in tables of poses."""
        return [self.camera.width, self.camera.height, *camera_numbers(self.camera)]

    def traced(self, numbers: Sequence[Any]) -> Lens:
        """With a `TracedCamera`."""
        width, height, *others = numbers
        return Lens(TracedCamera(self.camera, others, (width, height)), self.shutter)

    @property
    def rolls(self) -> bool:
        """Whether its lines are exposed one after the other."""
        return self.shutter.readout_s > 0.0

    @property
    def lines(self) -> int:
        """Lines of an image; 1 stands for all of them with a global shutter."""
        return self.shutter.line_count(self.camera) if self.rolls else 1

    def line_of(self, x: Any, y: Any) -> Any:
        """Line coordinate of a pixel, 0 first read."""
        if not self.rolls:
            return dr.zeros(type(x), 1)
        along = y if self.shutter.by_rows else x
        return along if self.shutter.direction > 0.0 else self.lines - 1 - along

    @property
    def line_gradient(self) -> tuple[float, float]:
        """Derivative of `line_of` by the pixel."""
        return (0.0, self.shutter.direction) if self.shutter.by_rows else (self.shutter.direction, 0.0)


class TracedCamera(Camera):
    """A camera of device numbers, as the functions of `rsgen.device` take it: its model alone is compiled in."""

    inverse_fx: Any
    inverse_fy: Any

    def __init__(self, camera: Camera, numbers: Sequence[Any], size: tuple[Any, Any] | None = None) -> None:
        """numbers: `camera_numbers`, on the device. size: width and height, where they are not compiled in."""
        fx, fy, cx, cy, max_radius, *distortion = numbers
        width, height = size or (camera.width, camera.height)
        self.__dict__.update(
            width=width, height=height, model=camera.model, fx=fx, fy=fy, cx=cx, cy=cy, max_radius=max_radius,
            distortion=tuple(distortion), inverse_fx=dr.rcp(fx), inverse_fy=dr.rcp(fy),
        )  # fmt: skip

    def wider(self, times: int) -> TracedCamera:
        """The same for images so many times as wide and as high."""
        found = copy(self)
        found.__dict__.update(width=times * self.width, height=times * self.height)
        return found


def camera_numbers(camera: Camera) -> list[float]:
    """What a `TracedCamera` has instead of the camera's: 5, and its coefficients."""
    largest = min(camera.max_radius, _LARGEST_RADIUS)
    return [camera.fx, camera.fy, camera.cx, camera.cy, largest, *camera.distortion]


def per_focal(camera: Camera, x: Any, y: Any) -> tuple[Any, Any]:
    """x and y over the focal lengths."""
    if isinstance(camera, TracedCamera):
        return x * camera.inverse_fx, y * camera.inverse_fy
    return x / camera.fx, y / camera.fy


def contains(camera: Camera, x: Any, y: Any) -> Any:
    """Whether pixels lie in the image; twin of `Camera.contains`."""
    return (x >= -0.5) & (y >= -0.5) & (x < camera.width - 0.5) & (y < camera.height - 0.5)


@dataclass(frozen=True)
class Distorted:
    """Distorted normalised coordinates and their derivative by the undistorted ones, which is symmetric."""

    x: Any
    y: Any
    dxx: Any
    dxy: Any
    dyy: Any
    scale: Any  # of the radial part


def distort(camera: Camera, x: Any, y: Any) -> Distorted:
    """Distortion of normalised coordinates by any of the models; twin of `Camera.project`."""
    if camera.model == "pinhole":
        return Distorted(x, y, 1.0, 0.0, 1.0, 1.0)
    r2 = x * x + y * y
    if camera.model in ("radtan", "rational"):
        k1, k2, p1, p2, k3 = camera.brown
        scale = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))
        if camera.model == "rational":
            k4, k5, k6 = camera.distortion[5:]
            below = dr.rcp(1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            scale = scale * below
            slope = (slope - scale * (2.0 * (k4 + r2 * (2.0 * k5 + r2 * (3.0 * k6))))) * below
        return Distorted(
            x * scale + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * scale + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            scale + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
            slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
            scale + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
            scale,
        )
    if camera.model == "double_sphere":
        xi, alpha = camera.distortion
        inverse_d1 = dr.rsqrt(1.0 + r2)
        k = xi * ((1.0 + r2) * inverse_d1) + 1.0
        d2 = dr.sqrt(r2 + k * k)
        scale = dr.rcp(alpha * d2 + (1.0 - alpha) * k)
        slope = -scale * scale * (alpha * (1.0 + k * xi * inverse_d1) / d2 + (1.0 - alpha) * xi * inverse_d1)
        return Distorted(x * scale, y * scale, scale + slope * x * x, slope * x * y, scale + slope * y * y, scale)
    r = dr.sqrt(dr.maximum(r2, 1e-12))
    bent, rate = _bend(camera, dr.atan(r))
    scale = bent / r
    slope = (rate / (1.0 + r2) - scale) / dr.maximum(r2, 1e-12)
    return Distorted(x * scale, y * scale, scale + slope * x * x, slope * x * y, scale + slope * y * y, scale)


def undistort(camera: Camera, xd: Any, yd: Any) -> tuple[Any, Any]:
    """The inverse of `distort` by Newton steps, of a double sphere in closed form; twin of `Camera.unproject`."""
    if camera.model == "double_sphere":
        xi, alpha = camera.distortion
        r2 = xd * xd + yd * yd
        mz = (1.0 - alpha * alpha * r2) / (alpha * dr.sqrt(1.0 - (2.0 * alpha - 1.0) * r2) + 1.0 - alpha)
        factor = (mz * xi + dr.sqrt(mz * mz + (1.0 - xi * xi) * r2)) / (mz * mz + r2)
        scale = factor / (factor * mz - xi)
        return xd * scale, yd * scale
    if camera.model == "fisheye":
        theta_d = dr.sqrt(xd * xd + yd * yd)
        theta = theta_d
        for _ in range(_UNDISTORT_STEPS):
            bent, rate = _bend(camera, theta)
            theta = theta - (bent - theta_d) / rate
        scale = dr.select(theta_d > 1e-6, dr.tan(theta) / dr.maximum(theta_d, 1e-6), 1.0)
        return xd * scale, yd * scale
    if not any(camera.distortion):
        return xd, yd
    if camera.model == "rational":
        x, y = xd, yd
        for _ in range(_UNDISTORT_STEPS):
            d = distort(camera, x, y)
            ex, ey, inverse = d.x - xd, d.y - yd, dr.rcp(d.dxx * d.dyy - d.dxy * d.dxy)
            x, y = x - (d.dyy * ex - d.dxy * ey) * inverse, y - (d.dxx * ey - d.dxy * ex) * inverse
        return x, y
    k1, k2, p1, p2, k3 = camera.brown
    x, y = xd, yd
    for _ in range(_UNDISTORT_STEPS):
        d, r2 = distort(camera, x, y), x * x + y * y
        ex, ey = d.x - xd, d.y - yd
        # The derivative of `distort`, its products grouped otherwise: the last bit of 1 in 10,000 rays hangs on that,
        # and images have to stay what they were.
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        a = d.scale + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        c = d.scale + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        inverse = dr.rcp(a * c - b * b)
        x, y = x - (c * ex - b * ey) * inverse, y - (a * ey - b * ex) * inverse
    return x, y


def _bend(camera: Camera, theta: Any) -> tuple[Any, Any]:
    """θ_d = θ (1 + k1 θ² + …) of a fisheye camera (Kannala-Brandt), and its derivative by θ."""
    k1, k2, k3, k4 = camera.distortion
    t2 = theta * theta
    bent = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return bent, 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))


# Poses T_world_cam (n, 4, 4) at times (n,) in seconds, such as `Spline.pose`.
PoseFunction = Callable[[Any], FloatArray]


@dataclass(frozen=True)
class PoseTable:
    """T_world_cam from a frame's first line's shutter opening, stamp − t_e, to its last line's end, stamp + t_r.

    Evaluated in float64 by the one NumPy spline. The table's step is the frame's whole span over four times the number
    of lines, and entries are blended linearly for each ray or point: the blend's error is far below a micrometre, and a
    line's own pose costs what a still's does.

    rows: three 4-vectors, the rows of [R t], for each of steps + 1 instants, flat.
    """

    rows: Any
    steps: int
    step_s: Any  # a number, or one on the device
    vector: Any

    @staticmethod
    def of(
        vector: Any, camera: Camera, shutter: Shutter, T_world_cam: PoseFunction, stamp: float,
        reference: FloatArray | None = None,
    ) -> PoseTable:  # fmt: skip
        """Of the frame at `stamp` (s). vector: the device's type of four floats. reference (3,): the positions' origin.

        Raises UserError if `T_world_cam` does over the frame's time.
        """
        span = shutter.exposure_s + shutter.readout_s
        steps = 4 * shutter.line_count(camera) if span > 0 else 1
        step_s = span / steps if span > 0 else 1.0
        grid = stamp - shutter.exposure_s + (span / steps) * np.arange(steps + 1)
        T = np.array(np.broadcast_to(T_world_cam(grid if span > 0 else grid[:1]), (steps + 1, 4, 4)))
        if reference is not None:
            T[:, :3, 3] -= reference
        rows = dr.value_t(vector)(aligned(T[:, :3, :]))
        dr.make_opaque(rows)
        return PoseTable(rows, steps, step_s, vector)

    def followed_by(self, *others: PoseTable) -> PoseTable:
        """One table of several of the same frame, for `at` with a number."""
        rows = dr.concat([self.rows, *(other.rows for other in others)])
        dr.make_opaque(rows)
        return PoseTable(rows, self.steps, self.step_s, self.vector)

    def at(self, t: Any, beyond: bool = False, number: Any = None) -> list[Any]:
        """The rows of [R t] at t seconds after the first line's shutter opened.

        Outside the table they stay as at its end, or with `beyond` go on straight. number: which of the tables that
        were joined, 0 the first.
        """
        x = t / self.step_s
        if not beyond:
            x = dr.clip(x, 0.0, float(self.steps))
        index = dr.uint32_array_t(x)(dr.clip(x, 0.0, float(self.steps - 1)))
        fraction = x - type(x)(index)
        if number is not None:
            index += number * (self.steps + 1)
        low, high = ([dr.gather(self.vector, self.rows, 3 * i + k) for k in range(3)] for i in (index, index + 1))
        return [dr.fma(fraction, b - a, a) for a, b in zip(low, high, strict=True)]
