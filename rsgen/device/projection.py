"""Projection on the device: camera models with their derivatives, and the rolling-shutter projection of equation (3).

The twin of rsgen.geometry.camera and rsgen.geometry.shutter for millions of points in float32; the tests compare them.
Vectors are tuples of device floats. Poses of an image's lines come as flat tables with one entry per line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter

Vector = tuple[Any, Any, Any]

# Floats per line: rotation (row-major) and translation from base to camera, and the camera's own twist per line delay.
FROM_BASE = 18
# Floats per line: rotation and translation from camera to base.
TO_BASE = 12
_MIN_DEPTH = 0.05


@dataclass(frozen=True)
class Lens:
    """What a kernel needs to know of a camera and its shutter; all of it is compiled in."""

    camera: Camera
    shutter: Shutter

    @property
    def lines(self) -> int:
        """Lines of an image; 1 stands for all of them with a global shutter."""
        return self.shutter.line_count(self.camera) if self.shutter.readout_s > 0.0 else 1

    def line_of(self, x: Any, y: Any) -> Any:
        """Line coordinate of a pixel, 0 first read."""
        if self.lines == 1:
            return dr.zeros(type(x), 1)
        last = self.lines - 1
        scan = self.shutter.scan
        along = y if scan in ("top-bottom", "bottom-top") else x
        return along if scan in ("top-bottom", "left-right") else last - along


@dataclass(frozen=True)
class Projection:
    """Pixel (x, y) of a point q in the camera's frame, and the projection's derivative there."""

    q: Vector
    x: Any
    y: Any
    valid: Any
    # Derivative of the distorted by the undistorted normalised coordinates, times the focal lengths.
    _du: tuple[Any, Any]
    _dv: tuple[Any, Any]
    _inv_z: Any
    # Undistorted normalised coordinates.
    xn: Any
    yn: Any

    def pull(self, ax: Any, ay: Any) -> Vector:
        """(ax, ay) times the 2x3 derivative by q."""
        bx = (ax * self._du[0] + ay * self._dv[0]) * self._inv_z
        by = (ax * self._du[1] + ay * self._dv[1]) * self._inv_z
        return bx, by, -(bx * self.xn + by * self.yn)

    def push(self, v: Vector) -> tuple[Any, Any]:
        """The 2x3 derivative by q times v."""
        nx, ny = (v[0] - self.xn * v[2]) * self._inv_z, (v[1] - self.yn * v[2]) * self._inv_z
        return self._du[0] * nx + self._du[1] * ny, self._dv[0] * nx + self._dv[1] * ny


def project(camera: Camera, q: Vector) -> Projection:
    """Pinhole, radial-tangential or fisheye projection of points in the camera's frame."""
    valid = q[2] > _MIN_DEPTH
    inv_z = dr.rcp(dr.select(valid, q[2], 1.0))
    xn, yn = q[0] * inv_z, q[1] * inv_z
    if camera.model == "pinhole":
        x, y = camera.fx * xn + camera.cx, camera.fy * yn + camera.cy
        return Projection(q, x, y, valid, (camera.fx, 0.0), (0.0, camera.fy), inv_z, xn, yn)
    r2 = xn * xn + yn * yn
    valid &= r2 < camera.max_radius**2
    if camera.model == "radtan":
        k1, k2, p1, p2, k3 = (*camera.distortion, 0.0)[:5]
        scale = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))
        xd = xn * scale + 2.0 * p1 * xn * yn + p2 * (r2 + 2.0 * xn * xn)
        yd = yn * scale + p1 * (r2 + 2.0 * yn * yn) + 2.0 * p2 * xn * yn
        dxx = scale + slope * xn * xn + 2.0 * p1 * yn + 6.0 * p2 * xn
        dyy = scale + slope * yn * yn + 6.0 * p1 * yn + 2.0 * p2 * xn
        dxy = slope * xn * yn + 2.0 * p1 * xn + 2.0 * p2 * yn
    else:
        k1, k2, k3, k4 = camera.distortion
        r = dr.sqrt(dr.maximum(r2, 1e-12))
        angle = dr.atan(r)
        a2 = angle * angle
        scale = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / r
        rate = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))
        slope = (rate / (1.0 + r2) - scale) / dr.maximum(r2, 1e-12)
        xd, yd = xn * scale, yn * scale
        dxx, dyy, dxy = scale + slope * xn * xn, scale + slope * yn * yn, slope * xn * yn
    x, y = camera.fx * xd + camera.cx, camera.fy * yd + camera.cy
    du, dv = (camera.fx * dxx, camera.fx * dxy), (camera.fy * dxy, camera.fy * dyy)
    return Projection(q, x, y, valid, du, dv, inv_z, xn, yn)


def gather(table: Any, entry: Any, count: int, first: int = 0, stride: int = FROM_BASE) -> list[Any]:
    """Floats first..first+count of each entry of a table with `stride` floats per entry."""
    return [dr.gather(type(table), table, entry * stride + (first + i)) for i in range(count)]


def move(M: list[Any], p: Vector) -> Vector:
    """R p + t with M = R (row-major), t."""
    return (
        dr.fma(M[0], p[0], dr.fma(M[1], p[1], dr.fma(M[2], p[2], M[9]))),
        dr.fma(M[3], p[0], dr.fma(M[4], p[1], dr.fma(M[5], p[2], M[10]))),
        dr.fma(M[6], p[0], dr.fma(M[7], p[1], dr.fma(M[8], p[2], M[11]))),
    )


def cross(a: Vector, b: Vector) -> Vector:
    """a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@dataclass(frozen=True)
class Sighting:
    """Where a rolling shutter sees points: projection at the line's time, the line, and how all that moves.

    `line` is the continuous line coordinate, `row` the table entry whose pose was used (a line nearby).
    `speed` q̇ (3) and `pixel_speed` ẋ (2) are per line delay; `gain` is 1/(1 − d(line)/d(line)) of equation (3).
    """

    at: Projection
    x: Any
    y: Any
    z: Any
    line: Any
    row: Any
    M: list[Any]
    speed: Vector
    pixel_speed: tuple[Any, Any]
    gain: Any
    valid: Any
    lens: Lens

    def chain(self, ax: Any, ay: Any, az: Any) -> Vector:
        """Total derivative, by a shift of the point in the *base* frame, of a quantity with the derivatives (ax, ay)
        by the pixel and az by the depth q_z; the line's own change of time is included (DESIGN: total derivative)."""
        bx, by, bz = self.at.pull(ax, ay)
        bz = bz + az
        if self.lens.lines > 1:
            rate = (ax * self.pixel_speed[0] + ay * self.pixel_speed[1] + az * self.speed[2]) * self.gain
            lx, ly, lz = self.at.pull(*_line_gradient(self.lens))
            bx, by, bz = bx + rate * lx, by + rate * ly, bz + rate * lz
        M = self.M
        return (
            M[0] * bx + M[3] * by + M[6] * bz,
            M[1] * bx + M[4] * by + M[7] * bz,
            M[2] * bx + M[5] * by + M[8] * bz,
        )


def _line_gradient(lens: Lens) -> tuple[float, float]:
    sign = 1.0 if lens.shutter.scan in ("top-bottom", "left-right") else -1.0
    return (0.0, sign) if lens.shutter.scan in ("top-bottom", "bottom-top") else (sign, 0.0)


def project_rolling(lens: Lens, table: Any, p_base: Vector, UInt: Any, Int: Any) -> Sighting:
    """Solve equation (3) for points of the base frame; `table` holds FROM_BASE floats for each line.

    Newton from the middle line with constant velocity, then from the line that this finds (paper, section 3.7), at most
    three lines off at 0.5 m/s and 1 rad/s: what is left is below 3e-4 px, most of it rounding.
    """
    Float = type(p_base[0])
    if lens.lines == 1:
        M = gather(table, UInt(0), 12)
        at = project(lens.camera, move(M, p_base))
        zero = Float(0.0)
        return Sighting(
            at, at.x, at.y, at.q[2], zero, UInt(0), M, (zero, zero, zero), (zero, zero), Float(1.0), at.valid, lens
        )
    last = lens.lines - 1
    middle = float(last // 2)
    at, _, speed, pixel_speed, slope = _look(lens, table, UInt(last // 2), p_base)
    line = middle + (lens.line_of(at.x, at.y) - middle) / (1.0 - slope)
    valid = at.valid
    row = UInt(Int(dr.round(dr.clip(dr.select(dr.isfinite(line), line, middle), 0.0, float(last)))))
    at, M, speed, pixel_speed, slope = _look(lens, table, row, p_base)
    gain = dr.rcp(1.0 - slope)
    ahead = (lens.line_of(at.x, at.y) - Float(row)) * gain
    # A shutter that the picture outruns sees a point twice or never.
    valid &= at.valid & (slope < 0.5) & (slope > -2.0)
    x, y = dr.fma(pixel_speed[0], ahead, at.x), dr.fma(pixel_speed[1], ahead, at.y)
    z = dr.fma(speed[2], ahead, at.q[2])
    return Sighting(at, x, y, z, Float(row) + ahead, row, M, speed, pixel_speed, gain, valid, lens)


def _look(
    lens: Lens, table: Any, row: Any, p_base: Vector
) -> tuple[Projection, list[Any], Vector, tuple[Any, Any], Any]:
    M = gather(table, row, FROM_BASE)
    at = project(lens.camera, move(M, p_base))
    omega_q = cross((M[15], M[16], M[17]), at.q)
    speed = (-(M[12] + omega_q[0]), -(M[13] + omega_q[1]), -(M[14] + omega_q[2]))
    pixel_speed = at.push(speed)
    gx, gy = _line_gradient(lens)
    return at, M, speed, pixel_speed, gx * pixel_speed[0] + gy * pixel_speed[1]
