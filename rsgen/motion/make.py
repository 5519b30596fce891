"""From the settings of a motion to its trajectory: lines, rolls and tours of a size and an angle that meet the targets.

Also the hand's: the noise that its shake is made of, and the tremor that is added to any motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from rsgen.array_types import FloatArray
from rsgen.config.motion import MotionConfig, TremorConfig, Waypoint
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.motion.statistics import MotionStatistics, motion_statistics
from rsgen.sequence.trajectory import Trajectory

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


def band_noise(
    rng: np.random.Generator, count: int, rate_hz: float, band_hz: tuple[float, float], exponent: float
) -> FloatArray:
    """(count, 6) samples at `rate_hz` of six independent signals, each with an RMS of exactly one and a mean of zero.

    Their power spectral density is f^-exponent within band_hz = (low, high) and zero outside; Fourier coefficients are
    independent complex Gaussians (Shinozuka & Deodatis, "Simulation of stochastic processes by spectral
    representation", Appl. Mech. Rev. 44(4), 1991, with random amplitudes). The signals have the period count / rate_hz.

    A model, not a fit to recordings: exponent 2 makes the velocity white (a random walk held in place), larger
    exponents put the motion into slow sway and leave less for what is above 3 Hz. The hand's tremor proper, of about
    8 to 12 Hz, is faster than a spline with 50 ms knots can follow: see `with_tremor`.
    Raises UserError if the band holds no frequency.
    """
    frequencies = np.fft.rfftfreq(count, 1.0 / rate_hz)
    inside = (frequencies >= band_hz[0]) & (frequencies <= band_hz[1])
    if not inside.any():
        step = rate_hz / count
        raise UserError(
            f"motion: shake_band_hz {list(band_hz)} holds no multiple of 1/duration = {step:.3g} Hz: widen it"
        )
    spectrum = np.zeros((6, len(frequencies)), np.complex128)
    gaussian = rng.normal(size=(6, int(inside.sum()), 2))
    spectrum[:, inside] = (gaussian[..., 0] + 1j * gaussian[..., 1]) * frequencies[inside] ** (-exponent / 2)
    signal = np.fft.irfft(spectrum, n=count).T
    return np.asarray(signal / np.sqrt(np.mean(signal**2, axis=0)))


RATE_HZ = 200.0
"""Poses per second of a made motion: ten per 50 ms knot."""

_SHAKE_STREAM = 0x5AE  # tells the hand-shake's random numbers from others of the same seed
_ROUNDS = 12
_SETTLED = 1e-4  # relative error of length and turning
_FIRST_ANGLE = math.radians(5.0)


def make_motion(config: MotionConfig, seed: int) -> Trajectory:
    """The motion as poses at about 200 Hz from t = 0 on, at rest at both ends: T_world_cam of the body.

    seed: of the hand-shake, where config.seed names no other. Length and mean speeds are those of the poses, chord by
    chord, as `motion_statistics` measures them. Raises UserError if no motion of this kind meets them.
    """
    path, trajectory = _parts(config, seed)
    return trajectory(*_solve(config, path, lambda size, angle: motion_statistics(trajectory(size, angle))))


def least_turning(config: MotionConfig, seed: int) -> float:
    """Mean rotational speed in deg/s of the motion without its sway: mean_rotation_deg_s cannot be less."""
    path, trajectory = _parts(config, seed)
    return motion_statistics(trajectory(path.first_size, 0.0)).mean_rotation_deg_s


def _parts(config: MotionConfig, seed: int) -> tuple[MotionPath, Callable[[float, float], Trajectory]]:
    """The path, and the trajectory of a size and an angle of it, hand-shake included."""
    duration = config.duration_s
    count = math.ceil(duration * RATE_HZ)
    t = np.linspace(0.0, duration, count + 1)
    path = make_path(config, t)
    size = np.repeat([config.shake_position_m, math.radians(config.shake_rotation_deg)], 3)
    rng = np.random.default_rng([seed if config.seed is None else config.seed, _SHAKE_STREAM])
    noise = band_noise(rng, count, count / duration, config.shake_band_hz, config.shake_exponent)
    noise = np.concatenate([noise, noise[:1]]) * size * window(t, duration, config.ramp_s)[:, None]
    turn = so3.exp(noise[:, 3:])

    def trajectory(size: float, angle: float) -> Trajectory:
        position, R = path.poses(size, angle)
        T = np.zeros((len(t), 4, 4))
        T[:, :3, :3] = R @ turn
        T[:, :3, 3] = position + (R @ noise[:, :3, None])[..., 0]
        T[:, 3, 3] = 1.0
        return Trajectory(t, T)

    return path, trajectory


def _solve(
    config: MotionConfig, path: MotionPath, measure: Callable[[float, float], MotionStatistics]
) -> tuple[float, float]:
    """Size and angle by turns, each by Brent's method: one round would do, were a tour's turning not up to its size."""
    size, angle = path.first_size, 0.0

    def turning(x: float) -> float:
        return measure(size, x).mean_rotation_deg_s / config.mean_rotation_deg_s

    def length(x: float) -> float:
        return measure(x, angle).length_m / config.length_m

    less_turning = "shake_rotation_deg, or how far the tour turns" if config.kind == "tour" else "shake_rotation_deg"
    more_turning = "strokes" if config.kind == "roll" else "sway_hz"
    less_length = "shake_position_m, or move waypoints together" if config.kind == "tour" else "shake_position_m"
    more_length = "mean_rotation_deg_s" if config.kind == "roll" else "the distances between waypoints"
    for _ in range(_ROUNDS):
        angle = _reach(turning, 0.0, _FIRST_ANGLE, path.max_angle, "mean_rotation_deg_s", less_turning, more_turning)
        size = _reach(length, path.min_size, path.first_size, path.max_size, "length_m", less_length, more_length)
        if max(abs(turning(angle) - 1.0), abs(length(size) - 1.0)) < _SETTLED:
            return size, angle
    raise UserError(
        f"motion: length_m {config.length_m:g} and mean_rotation_deg_s {config.mean_rotation_deg_s:g} cannot both be "
        "met by this motion: change one of them"
    )


def _reach(
    share: Callable[[float], float], low: float, first: float, high: float, name: str, less: str, more: str
) -> float:
    """The x in [low, high], near `first`, at which the share of target `name` that is reached, which rises, is one."""
    least = share(low)
    if least > 1.0 + _SETTLED:
        raise UserError(f"motion: {name} is too small: at least {least:.4g} times as much is needed; or reduce {less}")
    if least >= 1.0 - _SETTLED:
        return low
    x = min(first, high)
    while (reached := share(x)) < 1.0:
        if x >= high or x > 1e5 * first:
            raise UserError(f"motion: {name} is too large: {reached:.4g} of it is reached; reduce it or raise {more}")
        x = min(2.0 * x, high)
    return float(brentq(lambda x: share(x) - 1.0, low, x, rtol=1e-7))


_TREMOR_STREAM = 0x7E30  # tells its random numbers from others of the same seed
_KNOTS_A_WAVE = 8  # of the band's fastest: a least-squares cubic B-spline then misses a thousandth of it
_SAMPLES_A_KNOT = 4


def with_tremor(spline: Spline, config: TremorConfig, seed: int, span: FloatArray) -> tuple[Trajectory, float]:
    """Poses T_world_cam of T(t) exp(tremor) over span (2,), s, and the knot spacing, s, that a spline of them needs.

    The spacing is a whole fraction of the spline's own. seed: where the config names no other. Raises UserError if the
    span is too short for the band.
    """
    begin, end = map(float, span)
    fraction = max(1, math.ceil(spline.dt * config.band_hz[1] * _KNOTS_A_WAVE))
    spacing = spline.dt / fraction
    count = math.ceil((end - begin) / spacing * _SAMPLES_A_KNOT)
    t = np.linspace(begin, end, count + 1)
    rng = np.random.default_rng([seed if config.seed is None else config.seed, _TREMOR_STREAM])
    noise = band_noise(rng, count, count / (end - begin), config.band_hz, 0.0)
    size = np.repeat([config.position_m, math.radians(config.rotation_deg)], 3)
    twist = np.concatenate([noise, noise[:1]]) * size
    return Trajectory(t, spline.pose(t) @ se3.exp(twist)), spacing
