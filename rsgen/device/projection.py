"""Projection on the device, with derivatives, and the rolling-shutter projection of equation (3), in two ways.

`project_rolling` is the tracker's: few steps, from flat tables with one pose per line, differentiable. `MovingCamera`
is the truth's: to convergence, from a table of poses in time. Vectors are tuples of device floats. Twins of
rsgen.geometry.camera and rsgen.geometry.shutter; the tests compare them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import drjit as dr

from rsgen.device.lens import Lens, PoseTable, contains, distort
from rsgen.geometry.camera import Camera

Vector = tuple[Any, Any, Any]

# Floats per line: rotation (row-major) and translation from base to camera, and the camera's own twist per line delay.
FROM_BASE = 18
# Floats per line: rotation and translation from camera to base.
TO_BASE = 12
_MIN_DEPTH = 0.05
_TRUTHS_MIN_DEPTH = 1e-9  # as in `Camera.project`
# Enough where the image moves along the scan at up to half the scan's own speed (at a tenth, 3 are).
_SECANT_STEPS = 6
# Lines. Below the first, rounding of float32 would spoil the secant; beyond the second, the line was not found.
_SECANT_FROM = 0.05
_FOUND_WITHIN = 0.005


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

    def vjp(self, ax: Any, ay: Any) -> Vector:
        """(ax, ay) times the 2x3 derivative by q."""
        bx = (ax * self._du[0] + ay * self._dv[0]) * self._inv_z
        by = (ax * self._du[1] + ay * self._dv[1]) * self._inv_z
        return bx, by, -(bx * self.xn + by * self.yn)

    def jvp(self, v: Vector) -> tuple[Any, Any]:
        """The 2x3 derivative by q times v."""
        nx, ny = (v[0] - self.xn * v[2]) * self._inv_z, (v[1] - self.yn * v[2]) * self._inv_z
        return self._du[0] * nx + self._du[1] * ny, self._dv[0] * nx + self._dv[1] * ny

    def shift_of(self, x: Any, y: Any) -> Vector:
        """The shift of the point, at its depth, that moves its pixel by (x, y)."""
        (a, b), (c, d) = self._du, self._dv
        scale = self.q[2] / (a * d - b * c)
        return scale * (d * x - b * y), scale * (a * y - c * x), type(self.q[2])(0.0)


def project(camera: Camera, q: Vector) -> Projection:
    """Pixels of points in the camera's frame."""
    xn, yn, inv_z, valid = _normalised(camera, q, _MIN_DEPTH)
    d = distort(camera, xn, yn)
    x, y = camera.fx * d.x + camera.cx, camera.fy * d.y + camera.cy
    du, dv = (camera.fx * d.dxx, camera.fx * d.dxy), (camera.fy * d.dxy, camera.fy * d.dyy)
    return Projection(q, x, y, valid, du, dv, inv_z, xn, yn)


def _normalised(camera: Camera, q: Vector, min_depth: float) -> tuple[Any, Any, Any, Any]:
    """x/z, y/z and 1/z of points in the camera's frame, and whether the camera is defined there."""
    valid = q[2] > min_depth
    inv_z = dr.rcp(dr.select(valid, q[2], 1.0))
    xn, yn = q[0] * inv_z, q[1] * inv_z
    if camera.model != "pinhole":
        valid &= xn * xn + yn * yn < camera.max_radius**2
    return xn, yn, inv_z, valid


def gather(table: Any, entry: Any, count: int, first: int = 0, stride: int = FROM_BASE) -> list[Any]:
    """Floats first..first+count of each entry of a table with `stride` floats per entry.

    By two or four at once where all of these numbers are even: loads of such packets take 0.4 of the time.
    """
    packet = math.gcd(count, first, stride, 4)
    if packet == 1:
        return [dr.gather(type(table), table, entry * stride + (first + i)) for i in range(count)]
    kind = getattr(import_module(type(table).__module__), f"Array{packet}f")
    at = entry * (stride // packet) + first // packet
    return [value for i in range(count // packet) for value in dr.gather(kind, table, at + i)]


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
class RollingProjection:
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
        by the pixel and az by the depth q_z; the line's own change of time is included (docs/method.md)."""
        bx, by, bz = self.at.vjp(ax, ay)
        bz = bz + az
        if self.lens.rolls:
            rate = (ax * self.pixel_speed[0] + ay * self.pixel_speed[1] + az * self.speed[2]) * self.gain
            lx, ly, lz = self.at.vjp(*self.lens.line_gradient)
            bx, by, bz = bx + rate * lx, by + rate * ly, bz + rate * lz
        M = self.M
        return (
            M[0] * bx + M[3] * by + M[6] * bz,
            M[1] * bx + M[4] * by + M[7] * bz,
            M[2] * bx + M[5] * by + M[8] * bz,
        )


def project_rolling(lens: Lens, table: Any, p_base: Vector, UInt: Any, Int: Any, first: Any = 0) -> RollingProjection:
    """Solve equation (3) for points of the base frame; `table` holds FROM_BASE floats for each line.

    first: entry of line 0, where the table has the lines of several images.

    Newton from the middle line with constant velocity, then from the line that this finds (paper, section 3.7), at most
    three lines off at 0.5 m/s and 1 rad/s: what is left is below 3e-4 px, most of it rounding.
    """
    Float = type(p_base[0])
    if not lens.rolls:
        M = gather(table, UInt(0), 12)
        at = project(lens.camera, move(M, p_base))
        zero = Float(0.0)
        return RollingProjection(
            at, at.x, at.y, at.q[2], zero, UInt(0), M, (zero, zero, zero), (zero, zero), Float(1.0), at.valid, lens
        )
    last = lens.lines - 1
    half = last // 2
    middle = Float(half)
    at, _, speed, pixel_speed, slope = _look(lens, table, UInt(half) + first, p_base)
    line = middle + (lens.line_of(at.x, at.y) - middle) / (1.0 - slope)
    valid = at.valid
    row = UInt(Int(dr.round(dr.clip(dr.select(dr.isfinite(line), line, middle), 0.0, Float(last)))))
    at, M, speed, pixel_speed, slope = _look(lens, table, row + first, p_base)
    gain = dr.rcp(1.0 - slope)
    ahead = (lens.line_of(at.x, at.y) - Float(row)) * gain
    # A shutter that the picture outruns sees a point twice or never.
    valid &= at.valid & (slope < 0.5) & (slope > -2.0)
    x, y = dr.fma(pixel_speed[0], ahead, at.x), dr.fma(pixel_speed[1], ahead, at.y)
    z = dr.fma(speed[2], ahead, at.q[2])
    return RollingProjection(at, x, y, z, Float(row) + ahead, row, M, speed, pixel_speed, gain, valid, lens)


def _look(
    lens: Lens, table: Any, row: Any, p_base: Vector
) -> tuple[Projection, list[Any], Vector, tuple[Any, Any], Any]:
    M = gather(table, row, FROM_BASE)
    at = project(lens.camera, move(M, p_base))
    omega_q = cross((M[15], M[16], M[17]), at.q)
    speed = (-(M[12] + omega_q[0]), -(M[13] + omega_q[1]), -(M[14] + omega_q[2]))
    pixel_speed = at.jvp(speed)
    gx, gy = lens.line_gradient
    return at, M, speed, pixel_speed, gx * pixel_speed[0] + gy * pixel_speed[1]


@dataclass(frozen=True)
class MovingCamera:
    """A camera that moves while it exposes one frame. Times are seconds after the first line's shutter opened.

    Points are homogeneous, (p, w): w = 1 for a point p in metres, w = 0 for a point at infinity in direction p. Give
    positions relative to a reference near the camera, the table's: float32 then stays good to about 1e-4 px wherever
    the world's origin is.
    """

    lens: Lens
    poses: PoseTable
    carry: Callable[[Any, Vector], Vector] | None = None  # where points that move by themselves are at times t

    def pose(self, t: Any) -> tuple[Vector, Sequence[Any]]:
        """The camera's position and the rows of its [R t], T_world_cam."""
        rows = self.poses.at(t, beyond=True)  # half a line at most
        return (rows[0].w, rows[1].w, rows[2].w), rows

    def project_at(self, t: Any, p: Vector, w: Any) -> tuple[tuple[Any, Any], Any]:
        """Pixels of points seen at times t, and where that is defined (see `Camera.project`)."""
        camera = self.lens.camera
        origin, rows = self.pose(t)
        if self.carry is not None:
            p = self.carry(t, p)
        q = rotated_back(rows, (p[0] - w * origin[0], p[1] - w * origin[1], p[2] - w * origin[2]))
        xn, yn, _, valid = _normalised(camera, q, _TRUTHS_MIN_DEPTH)
        d = distort(camera, xn, yn)
        return (dr.fma(d.x, camera.fx, camera.cx), dr.fma(d.y, camera.fy, camera.cy)), valid

    def project(self, start: Any, p: Vector, w: Any) -> tuple[tuple[Any, Any], Any, Any]:
        """Where and when the frame's lines at mid-exposure show points: pixels, times and whether found.

        Solves line(π(T(t)⁻¹ p)) = line, equation (3), by the secant method in lines, beginning at `start` (lines, any
        reals). Lines are continuous. Found: in front of the camera, in the image, and the line converged.
        """
        lens = self.lens
        delay, last = lens.shutter.line_delay(lens.camera), lens.lines - 1.0
        half = 0.5 * lens.shutter.exposure_s

        def step(
            count: Any, line: Any, error: Any, slope: Any, _x: Any, _y: Any, _defined: Any
        ) -> tuple[Any, Any, Any, Any, Any, Any, Any]:
            new = dr.clip(line - error / slope, -0.5, last + 0.5)
            (x, y), defined = self.project_at(half + new * delay, p, w)
            new_error, way = lens.line_of(x, y) - new, new - line
            secant = (new_error - error) / way
            slope = dr.select((dr.abs(way) > _SECANT_FROM) & (secant < 0), secant, slope)
            return count + 1, new, new_error, slope, x, y, defined

        line = dr.clip(start, -0.5, last + 0.5)
        (x, y), defined = self.project_at(half + line * delay, p, w)
        # A loop on the device: written out, all steps take a second to be compiled, and eight where things move.
        _, line, error, _, x, y, defined = dr.while_loop(
            (dr.uint32_array_t(line)(0), line, lens.line_of(x, y) - line, type(line)(-1.0), x, y, defined),
            lambda count, *_: count < _SECANT_STEPS,
            step,
        )
        found = defined & contains(lens.camera, x, y) & (dr.abs(error) < _FOUND_WITHIN)
        return (x, y), half + line * delay, found


def rotated(rows: Sequence[Any], v: Any) -> Vector:
    """R v, given the rows of R or of [R t]."""
    x, y, z = (row[0] * v[0] + row[1] * v[1] + row[2] * v[2] for row in rows)
    return x, y, z


def rotated_back(rows: Sequence[Any], v: Any) -> Vector:
    """Rᵀ v, given the rows of R or of [R t]."""
    a, b, c = rows
    x, y, z = (a[k] * v[0] + b[k] * v[1] + c[k] * v[2] for k in range(3))
    return x, y, z
