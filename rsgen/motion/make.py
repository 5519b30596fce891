"""From the settings of a motion to its trajectory: the size and angle that meet the targets, hand-shake included.

Also the noise that a hand's shake is made of, and the tremor that is added to any motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from rsgen.array_types import FloatArray
from rsgen.config.motion import MotionConfig, TremorConfig
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.motion.paths import MotionPath, make_path, window
from rsgen.motion.statistics import MotionStatistics, motion_statistics
from rsgen.sequence.trajectory import Trajectory


def band_noise(
    rng: np.random.Generator, count: int, rate_hz: float, band_hz: tuple[float, float], exponent: float
) -> FloatArray:
    """(count, 6) samples at `rate_hz` of six independent signals, each with an RMS of exactly one and a mean of zero.

    Their power spectral density is f^-exponent within band_hz = (low, high) and zero outside; Fourier coefficients are
    independent complex Gaussians (Shinozuka & Deodatis, "Simulation of stochastic processes by spectral
    representation", Appl. Mech. Rev. 44(4), 1991, with random amplitudes). The signals have the period count / rate_hz.

    A model, not a fit to recordings: exponent 2 makes the velocity white (a random walk held in place), larger
    exponents put the motion into slow sway and leave less for what is above 3 Hz. The hand's tremor proper, of about
    8 to 12 Hz, is faster than a spline with 50 ms knots can follow: see `rsgen.motion.make`.
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
