"""The motions without their hand-shake: lines, rolls and tours, as functions of a size and an angle to solve for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from rsgen.array_types import FloatArray
from rsgen.config.motion import MotionConfig, Waypoint
from rsgen.errors import UserError
from rsgen.geometry import so3

_UP = np.array([0.0, 1.0, 0.0])
_STEEP = 0.02  # sine of the angle to the vertical below which "up" decides nothing
_SAMPLES_PER_LEG = 400
# Frequencies of the sway about x, y, z, relative to sway_hz: irrational ratios, so that no turning pattern repeats.
_SWAY_RATIOS = np.array([0.5 * (math.sqrt(5.0) - 1.0), 1.0, math.sqrt(0.75)])
_MAX_SWAY = math.radians(60.0)
_MAX_ROLL = math.radians(170.0)
_MAX_SCALE = 4.0


@dataclass(frozen=True)
class MotionPath:
    """Camera poses over time for a size and an angle, which the targets decide.

    poses(size, angle) gives positions (n, 3), world, metres, and R_world_cam (n, 3, 3). The length grows with the
    size in [min_size, max_size], the turning with the angle (radians, at most max_angle); first_size is where to begin.
    """

    poses: Callable[[float, float], tuple[FloatArray, FloatArray]]
    min_size: float
    first_size: float
    max_size: float
    max_angle: float


def look_at(position: ArrayLike, target: ArrayLike) -> FloatArray:
    """R_world_cam (..., 3, 3) of a camera at `position` that looks at `target` (..., 3), x axis level, y axis down.

    Raises UserError where the two coincide or the camera looks straight up or down.
    """
    position, target = np.broadcast_arrays(np.asarray(position, float), np.asarray(target, float))
    forward = target - position
    distance = np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, _UP)
    level = np.linalg.norm(right, axis=-1, keepdims=True)
    bad = level <= _STEEP * distance
    if bad.any():
        where = np.round(position[bad[..., 0]][0], 3).tolist()
        raise UserError(f"motion: looks straight up or down, or at itself, from {where}: move the position or target")
    z, x = forward / distance, right / level
    return np.stack([x, np.cross(z, x), z], axis=-1)


def travel(t: FloatArray, duration: float, ramp: float) -> FloatArray:
    """Share in [0, 1] of a way covered at times t (n,) in [0, duration]: constant speed but for smooth ramps.

    The speed rises and falls over `ramp` seconds along the quintic 6x⁵ − 15x⁴ + 10x³, so acceleration begins at zero.
    """

    def ramped(x: FloatArray) -> FloatArray:  # the quintic's integral, beyond x = 1 with speed one
        inside = np.clip(x, 0.0, 1.0)
        return np.asarray(inside**6 - 3.0 * inside**5 + 2.5 * inside**4 + np.maximum(x - 1.0, 0.0))

    return (ramped(t / ramp) - ramped((t - duration) / ramp + 1.0)) * (ramp / (duration - ramp))


def window(t: FloatArray, duration: float, ramp: float) -> FloatArray:
    """(n,): 0 at both ends, 1 between, by the same quintic: holds back what would move before the start."""
    x = np.clip(np.minimum(t, duration - t) / ramp, 0.0, 1.0)
    return np.asarray(x**3 * (6.0 * x**2 - 15.0 * x + 10.0))


def make_path(config: MotionConfig, t: FloatArray) -> MotionPath:
    """The config's motion at times t (n,), seconds, from 0 to its duration. Raises UserError."""
    kinds = {"line": _line, "roll": _roll, "tour": _tour}
    return kinds[config.kind](config, t)


def _line(config: MotionConfig, t: FloatArray) -> MotionPath:
    """`size`: length of a stroke. The camera swings sinusoidally along its first x axis and sways by `angle`."""
    start, R = np.asarray(config.position), look_at(config.position, config.target)  # type: ignore[arg-type]
    phase = math.pi * config.strokes * travel(t, config.duration_s, config.ramp_s)
    along, sway = 0.5 * (1.0 - np.cos(phase)), _sway(config, t)

    def poses(size: float, angle: float) -> tuple[FloatArray, FloatArray]:
        return start + size * along[:, None] * R[:, 0], R @ so3.exp(angle * sway)

    return MotionPath(poses, 0.0, config.length_m / config.strokes, math.inf, _MAX_SWAY)


def _roll(config: MotionConfig, t: FloatArray) -> MotionPath:
    """`angle`: from the first orientation to the farthest, either way; `size`: from the axis up to the camera.

    Like a camera at the end of a lever, whose axis is parallel to its own z: the centre runs on an arc.
    """
    start, R = np.asarray(config.position), look_at(config.position, config.target)  # type: ignore[arg-type]
    swing = np.sin(math.pi * config.strokes * travel(t, config.duration_s, config.ramp_s))

    def poses(size: float, angle: float) -> tuple[FloatArray, FloatArray]:
        turn = so3.exp(angle * swing[:, None] * np.array([0.0, 0.0, 1.0]))
        lever = np.array([0.0, -size, 0.0])
        return start + (turn @ lever - lever) @ R.T, R @ turn

    return MotionPath(poses, 0.0, 0.1, math.inf, _MAX_ROLL)


def _tour(config: MotionConfig, t: FloatArray) -> MotionPath:
    """`size`: metres along a closed tour, or scale of an open one; `angle`: of the sway."""
    curve = TourCurve.through(config.waypoints, config.closed)
    done, sway = travel(t, config.duration_s, config.ramp_s), _sway(config, t)
    centre = np.mean([w.position for w in config.waypoints], axis=0)

    def poses(size: float, angle: float) -> tuple[FloatArray, FloatArray]:
        position, target = curve.at(done * (size if config.closed else curve.length))
        if not config.closed:
            position = centre + size * (position - centre)
        return position, look_at(position, target) @ so3.exp(angle * sway)

    if config.closed:
        return MotionPath(poses, 0.0, config.length_m, math.inf, _MAX_SWAY)
    return MotionPath(poses, 1.0 / _MAX_SCALE, 1.0, _MAX_SCALE, _MAX_SWAY)


def _sway(config: MotionConfig, t: FloatArray) -> FloatArray:
    """(n, 3) slow turning about the camera's x, y, z; at most one."""
    weights = np.asarray(config.sway) / max(config.sway)
    waves = np.sin(2.0 * math.pi * config.sway_hz * t[:, None] * _SWAY_RATIOS)
    return np.asarray(weights * waves * window(t, config.duration_s, config.ramp_s)[:, None])


@dataclass(frozen=True, eq=False)
class TourCurve:
    """Cubic spline through waypoints, by arc length. both: parameter → position and target (6,); u: metres → parameter.

    length: metres from the first waypoint to the last, closed: back to the first.
    """

    both: CubicSpline
    u: CubicSpline
    length: float
    closed: bool

    @classmethod
    def through(cls, waypoints: Sequence[Waypoint], closed: bool) -> TourCurve:
        """The curve through the waypoints in their order. Raises UserError if neighbours coincide."""
        points = np.array([(*w.position, *w.target) for w in waypoints])
        if closed:
            points = np.concatenate([points, points[:1]])
        legs = np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1)
        if not legs.min() > 1e-3:
            k = int(np.argmin(legs))
            raise UserError(f"motion: waypoints {k} and {(k + 1) % len(waypoints)} are at one place: remove one")
        # Centripetal knots keep the curve from looping where waypoints are spaced unevenly (Lee, CAD 21(6), 1989).
        knots = np.concatenate([[0.0], np.cumsum(np.sqrt(legs))])
        both = CubicSpline(knots, points, bc_type="periodic" if closed else "natural")
        u = np.linspace(0.0, knots[-1], _SAMPLES_PER_LEG * len(legs) + 1)
        chords = np.linalg.norm(np.diff(both(u)[:, :3], axis=0), axis=1)
        s = np.concatenate([[0.0], np.cumsum(chords)])
        return cls(both, CubicSpline(s, u), float(s[-1]), closed)

    def at(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions and targets (n, 3), world, metres, after s (n,) metres."""
        values = self.both(self.u(s % self.length if self.closed else np.clip(s, 0.0, self.length)))
        return values[:, :3], values[:, 3:]

    def waypoint_distances(self) -> FloatArray:
        """(n,) metres along the curve at which it passes its waypoints."""
        count = len(self.both.x) - 1 if self.closed else len(self.both.x)
        s = self.u.x
        return np.asarray(np.interp(self.both.x[:count], self.u(s), s))
