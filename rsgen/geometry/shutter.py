"""Rolling shutter: which line is exposed when, and where a moving camera sees a point (equation (3) of the paper).

A line is a row of the image (scan top-bottom or bottom-top) or a column (left-right, right-left); line 0 is read first.
A frame's stamp is the instant, in seconds, at which line 0 stops being exposed; line l is exposed over
[stamp + l readout / lines − exposure, stamp + l readout / lines]. A line's pose is that of mid-exposure.
Equation (3): Kerl, Stückler, Cremers, ICCV 2015.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from rsgen.array_types import BoolArray, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.so3 import cross
from rsgen.geometry.spline import Spline

Scan = Literal["top-bottom", "bottom-top", "left-right", "right-left"]
# Image axis that a scan runs along (0 = u, 1 = v) and its direction.
_SCANS: dict[str, tuple[int, float]] = {
    "top-bottom": (1, 1.0),
    "bottom-top": (1, -1.0),
    "left-right": (0, 1.0),
    "right-left": (0, -1.0),
}
# Points solved at once: intermediate results then stay in the cache.
_BLOCK = 4096


@dataclass(frozen=True)
class Shutter:
    """Readout (0: global shutter) and exposure in seconds, and scan direction. Raises UserError where one is absurd."""

    readout_s: float = 0.0
    exposure_s: float = 0.0
    scan: Scan = "top-bottom"

    def __post_init__(self) -> None:
        for name in ("readout_s", "exposure_s"):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value >= 0.0):
                raise UserError(f"shutter: {name} = {value!r} must be a finite number of seconds, 0 or more")
            object.__setattr__(self, name, value)
        if self.scan not in get_args(Scan):
            raise UserError(f"shutter: unknown scan {self.scan!r}; use one of {', '.join(get_args(Scan))}")

    @property
    def axis(self) -> int:
        """Image axis that the scan runs along: 0 = u, 1 = v."""
        return _SCANS[self.scan][0]

    @property
    def direction(self) -> float:
        """1 if the scan runs towards larger coordinates, else −1."""
        return _SCANS[self.scan][1]

    @property
    def by_rows(self) -> bool:
        """Whether a line is a row of the image."""
        return self.axis == 1

    def line_count(self, camera: Camera) -> int:
        """Lines of a frame: the image's height, or its width for the sideways scans."""
        return (camera.width, camera.height)[self.axis]

    def line_delay(self, camera: Camera) -> float:
        """Seconds from one line to the next."""
        return self.readout_s / self.line_count(camera)

    def line_of_pixel(self, uv: npt.ArrayLike, camera: Camera) -> FloatArray:
        """Line coordinate (...,), not rounded, of pixels (..., 2)."""
        along = np.asarray(uv, dtype=np.float64)[..., self.axis]
        return np.asarray(along if self.direction > 0.0 else (self.line_count(camera) - 1) - along)

    def line_end_time(self, stamp: npt.ArrayLike, line: npt.ArrayLike, camera: Camera) -> FloatArray:
        """Time in seconds at which lines (...,) of the frame(s) stamped `stamp` (...,) stop being exposed."""
        line = np.asarray(line, dtype=np.float64)
        return np.asarray(np.asarray(stamp, dtype=np.float64) + line * self.line_delay(camera))

    def line_mid_time(self, stamp: npt.ArrayLike, line: npt.ArrayLike, camera: Camera) -> FloatArray:
        """Mid-exposure time in seconds of lines (...,): the time of a line's pose."""
        return np.asarray(self.line_end_time(stamp, line, camera) - 0.5 * self.exposure_s)


def project_rolling(
    spline: Spline,
    T_cam_body: npt.ArrayLike,
    camera: Camera,
    shutter: Shutter,
    stamp: npt.ArrayLike,
    p_world: npt.ArrayLike,
    iterations: int = 12,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Where and when a frame shows world points (..., 3): pixels uv (..., 2), times t (...,) in seconds, valid (...,).

    Solves t = line_mid_time(stamp, line_of_pixel(π(T_cam_body T_world_body(t)⁻¹ p))), equation (3), by Newton in time
    with the exact derivative, from mid readout, and for what that misses from the first and the last line. Lines are
    continuous here: pixel row 3.4 has a time between those of rows 3 and 4.

    Valid: in front of the camera, in the image, seen within the spline's time span. uv and t are NaN elsewhere. Where
    the image moves along the scan faster than the scan itself, a point may be seen several times or be hard to find:
    one of the times, or none, is returned.

    `stamp` in seconds, a number or broadcast against (...,). `T_cam_body` (4, 4) takes body to camera coordinates.
    """
    p_world = np.asarray(p_world, dtype=np.float64)
    points = p_world.reshape(-1, 3)
    stamps = np.broadcast_to(np.asarray(stamp, dtype=np.float64), p_world.shape[:-1]).reshape(-1)
    uv, t = np.full((len(points), 2), np.nan), np.full(len(points), np.nan)
    frame = _Frame(spline, np.asarray(T_cam_body, dtype=np.float64), camera, shutter)
    last = shutter.line_count(camera) - 1.0
    finite = np.flatnonzero(np.isfinite(points).all(axis=-1))
    for i in range(0, len(finite), _BLOCK):
        todo = finite[i : i + _BLOCK]
        for line in (0.5 * last, 0.0, last) if shutter.readout_s > 0.0 else (0.0,):
            uv[todo], t[todo], retry = frame.solve(points[todo], stamps[todo], line, iterations)
            todo = todo[retry]
    valid = camera.contains(uv)
    uv[~valid], t[~valid] = np.nan, np.nan
    shape = p_world.shape[:-1]
    return uv.reshape(*shape, 2), t.reshape(shape), valid.reshape(shape)


@dataclass(frozen=True)
class _Frame:
    """What Newton in time needs to know besides points and stamps."""

    spline: Spline
    T_cam_body: FloatArray
    camera: Camera
    shutter: Shutter

    def solve(
        self, p_world: FloatArray, stamp: FloatArray, line: float, iterations: int
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Pixels (n, 2) and times (n,), NaN where not found, and whether to retry from another line (n,)."""
        earliest = np.maximum(self.shutter.line_mid_time(stamp, -0.5, self.camera), self.spline.t_begin)
        last_edge = self.shutter.line_count(self.camera) - 0.5
        latest = np.minimum(self.shutter.line_mid_time(stamp, last_edge, self.camera), self.spline.t_end)
        t = np.clip(self.shutter.line_mid_time(stamp, line, self.camera), earliest, latest)
        # A step this small leaves an error of its square. But stamps counted from 1970 are 0.2 microseconds apart.
        tolerance = 1e-5 * self.shutter.line_delay(self.camera) + 4.0 * np.spacing(np.abs(t))
        uv_found, t_found = np.full((len(t), 2), np.nan), np.full(len(t), np.nan)
        retry = np.zeros(len(t), dtype=bool)
        active = np.flatnonzero(earliest <= latest)
        for _ in range(iterations):
            if not active.size:
                break
            uv, uv_dot, error, slope = self._time_equation(t[active], stamp[active], p_world[active])
            hopeless = np.isnan(error) | (slope == 0.0)
            step = np.where(hopeless, 0.0, -error / np.where(hopeless, 1.0, slope))
            new = np.clip(t[active] + step, earliest[active], latest[active])
            step_taken = new - t[active]
            found = ~hopeless & (np.abs(step) <= tolerance[active])
            uv_found[active[found]] = (uv + uv_dot * step_taken[:, None])[found]
            t_found[active[found]] = new[found]
            t[active] = new
            # Pressed against the readout's first or last instant: the point passes above or below the image.
            outside = ~hopeless & ~found & (step_taken == 0.0)
            retry[active] = ~found & ~outside
            active = active[~found & ~outside & ~hopeless]
        return uv_found, t_found, retry

    def _time_equation(
        self, t: FloatArray, stamp: FloatArray, p_world: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Pixels at times t, their velocity, line_mid_time(line of pixel) − t, its derivative; NaN where not seen."""
        same = bool((t == t[0]).all())
        T_world_body, w = self.spline.pose_and_velocity(t[0] if same else t)
        q = se3.transform(se3.inverse(T_world_body), p_world)
        p_cam = se3.transform(self.T_cam_body, q)
        uv, _ = self.camera.project(p_cam)
        p_cam_dot = -(w[..., :3] + cross(w[..., 3:], q)) @ self.T_cam_body[:3, :3].T
        uv_dot = np.einsum("...ij,...j->...i", self.camera.project_jacobian(p_cam), p_cam_dot)
        mid = self.shutter.line_mid_time(stamp, self.shutter.line_of_pixel(uv, self.camera), self.camera)
        rate = self.shutter.direction * self.shutter.line_delay(self.camera) * uv_dot[..., self.shutter.axis]
        return uv, uv_dot, mid - t, rate - 1.0
