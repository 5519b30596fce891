"""The joint solution: an IMU, and the track's own errors, which would otherwise pass for accelerations.

Unknown beside the IMU are the track's corrections x (see `imu_model`), and its drift: world rotation and shift, a line
between values a second apart, which walk. Of the track its poses at the frames are taken for measured, with white
errors about that drift. How large errors are is found on the way: of poses and of the drift's steps by their residuals,
of both sensors likewise, but never below what is stated. ImuReadings count robustly (Huber).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve, cho_solve_banded, cholesky_banded

from rsgen.array_types import BoolArray, FloatArray
from rsgen.errors import UserError
from rstrack.calibration.imu_model import COUNT, CorrectedTrack, Corrections, ImuPrediction, ImuUnknowns, hats
from rstrack.data.imu.description import ImuNoise
from rstrack.inertial.estimate import bias_walk

_BAND = 24  # of four control points of six
_HUBER = 2.5
# Held so where nothing observes them, σ: corrections (rad, m); of the IMU's NAMES rad, m, s, s/s, parts, rad; biases.
_FREE = (0.02, 0.05)
_PRIOR = np.array([*(1.0,) * 3, *(0.5,) * 3, 0.2, 5e-4, *(0.05,) * 3, *(1.0,) * 2])
_BIAS = np.array([*(0.3,) * 3, *(1.0,) * 3])
# The drift begins with nothing: what is constant in it, gravity takes.
_PINNED = (1e-6, 1e-6)
_MOST, _SETTLED, _SAME = 30, 0.05, 0.05
# Seconds between values of the drift.
_SLOW_S = 1.0
# Where errors' sizes begin: of poses (rad, m), and of the drift's steps a second; and what they never fall below.
_POSES, _STEPS = (3e-4, 5e-4), (3e-4, 5e-4)
_LEAST = (1e-5, 1e-5)
# Frames over which errors of poses may be alike.
_LAGS = 8
_TOO_LITTLE = "IMU: the recording is too poor for it: record 20 s with turns about all axes, or track it better"


@dataclass(frozen=True)
class ImuData:
    """What is given. stamps (n,), readings (n, 6) = [gyro; accel] and which of them count (n, 6); frame_times (k,):
    when the track's poses hold, s; noise as stated, and sigmas (2,) of a sample by it, rad/s and m/s²."""

    track: CorrectedTrack
    stamps: FloatArray
    readings: FloatArray
    counts: BoolArray
    frame_times: FloatArray
    noise: ImuNoise
    sigmas: FloatArray


@dataclass(frozen=True)
class ErrorSizes:
    """Standard deviations: of samples (rad/s, m/s²), of the track's poses and its drift's steps a second (rad, m)."""

    gyro: float
    accel: float
    poses: tuple[float, float]
    steps: tuple[float, float]

    def like(self, other: ErrorSizes, part: float) -> bool:
        """Whether all are the other's, to a part."""
        mine, theirs = ((s.gyro, s.accel, *s.poses, *s.steps) for s in (self, other))
        return all(abs(np.log(a / b)) < part for a, b in zip(mine, theirs, strict=True))


@dataclass(frozen=True)
class BorderedSystem:
    """band (24, 6 k), lower, and a (6 k,): of the corrections; D (q, q), b (q,): of the IMU, then of the
    drift; C (6 k, q)."""

    band: FloatArray
    a: FloatArray
    C: FloatArray
    D: FloatArray
    b: FloatArray

    def plus(self, other: BorderedSystem) -> BorderedSystem:
        """Both together: this one has no drift yet."""
        size, more = len(self.b), len(other.b) - len(self.b)
        D, b, C = other.D.copy(), other.b.copy(), other.C + np.pad(self.C, ((0, 0), (0, more)))
        D[:size, :size] += self.D
        b[:size] += self.b
        return BorderedSystem(self.band + other.band, self.a + other.a, C, D, b)


@dataclass(frozen=True)
class ImuSolution:
    """imu, and the covariance (13 + 6 m, 13 + 6 m) of a step of it; x (k, 6): the track's corrections; sizes found."""

    imu: ImuUnknowns
    covariance: FloatArray
    x: FloatArray
    sizes: ErrorSizes


def solve(data: ImuData, imu: ImuUnknowns, done: Callable[[int], None] = lambda _: None) -> ImuSolution:
    """From a start on. done: called at each step. Raises UserError: it does not settle, or too little is determined."""
    x = np.zeros((data.track.count, 6))
    R_frames = data.track.spline.pose(data.frame_times)[:, :3, :3]
    at_frames = data.track.corrections(data.frame_times)
    slow_times = np.arange(data.frame_times[0], data.frame_times[-1] + _SLOW_S, _SLOW_S)
    slow, weights = np.zeros((len(slow_times), 6)), hats(slow_times, data.frame_times)
    sizes, size = ErrorSizes(data.sigmas[0], data.sigmas[1], _POSES, _STEPS), imu.size
    for iteration in range(1, _MOST + 1):
        done(iteration)
        normal = _samples(data, imu, x, sizes)
        normal = normal.plus(_tracked_poses(at_frames, R_frames, x, slow, weights, sizes, size))
        D, b = _known(imu, slow, slow_times, sizes, data.noise)
        D[:, :] += normal.D
        b += normal.b
        try:
            factor = cholesky_banded(normal.band, lower=True)
            inner = cho_solve_banded((factor, True), np.column_stack([normal.C, normal.a]))
            lower = np.linalg.cholesky(D - normal.C.T @ inner[:, :-1])
        except np.linalg.LinAlgError:
            raise UserError(_TOO_LITTLE) from None
        step = cho_solve((lower, True), b - normal.C.T @ inner[:, -1])
        covariance = np.asarray(cho_solve((lower, True), np.eye(len(D))[:, :size]))[:size]
        imu = imu.moved(step[:size])
        x = x + (inner[:, -1] - inner[:, :-1] @ step).reshape(x.shape)
        slow = slow + step[size:].reshape(-1, 6)
        before = sizes
        about = at_frames.values(x)[0] - _drift(R_frames, weights @ slow)
        sizes = _measured(data, imu, x, about, np.diff(slow, axis=0), sizes)
        moved = np.abs(step[:COUNT]) / np.sqrt(np.diag(covariance)[:COUNT])
        if not np.isfinite(moved).all():
            break
        if iteration > 3 and moved.max() < _SETTLED and sizes.like(before, _SAME):
            return ImuSolution(imu, covariance, x, sizes)
    raise UserError(f"{_TOO_LITTLE} (no solution after {_MOST} steps)")


def _samples(data: ImuData, imu: ImuUnknowns, x: FloatArray, sizes: ErrorSizes) -> BorderedSystem:
    """Of both sensors' samples, weighted by their residuals. Raises UserError: taken outside the track."""
    at = ImuPrediction(data.track, imu, x, data.stamps)
    sigma = np.repeat([sizes.gyro, sizes.accel], 3)
    r = (data.readings - at.readings) / sigma
    weight = np.sqrt(np.minimum(1.0, _HUBER / np.maximum(np.abs(r), 1e-12))) * data.counts
    scaled = (weight / sigma)[..., None]
    J = at.corrections.spread(at.by_corrections * scaled, len(x))
    B, r = (at.by_imu * scaled).reshape(-1, imu.size), (r * weight).ravel()
    return BorderedSystem(_banded(J.T @ J, x.size), J.T @ r, J.T @ B, B.T @ B, B.T @ r)


def _tracked_poses(
    at_frames: Corrections, R_frames: FloatArray, x: FloatArray, slow: FloatArray, weights: FloatArray,
    sizes: ErrorSizes, size: int,
) -> BorderedSystem:  # fmt: skip
    """Of the track's poses about its drift, and of corrections that nothing observes.

    R_frames (frames, 3, 3): R_world_depth. slow (m, 6): the drift; weights (frames, m): of its values at the frames;
    size: of the IMU's step.
    """
    frames, scale = len(R_frames), np.repeat(1.0 / np.array(sizes.poses), 3)
    into = np.zeros((frames, 6, 6))  # a drift in the world's axes as corrections
    into[:, :3, :3], into[:, 3:, 3:] = np.swapaxes(R_frames, 1, 2), np.eye(3)
    r = -((at_frames.values(x)[0] - _drift(R_frames, weights @ slow)) * scale).ravel()
    dense = -weights[:, None, :, None] * into[:, :, None, :] * scale[:, None, None]
    B = np.pad(dense.reshape(6 * frames, -1), ((0, 0), (size, 0)))
    J = at_frames.spread(np.tile(np.eye(6, 18) * scale[:, None], (frames, 1, 1)), len(x))
    free = np.tile(np.repeat(1.0 / np.square(_FREE), 3), len(x))
    band = _banded(J.T @ J, x.size)
    band[0] += free
    return BorderedSystem(band, J.T @ r - free * x.ravel(), J.T @ B, B.T @ B, B.T @ r)


def _known(
    imu: ImuUnknowns, slow: FloatArray, slow_times: FloatArray, sizes: ErrorSizes, noise: ImuNoise
) -> tuple[FloatArray, FloatArray]:
    """Information (q, q) and its gradient (q,) on IMU and drift: priors, walks of biases, steps of the drift."""
    size, q = imu.size, imu.size + slow.size
    D, b = np.zeros((q, q)), np.zeros(q)
    D[np.arange(COUNT), np.arange(COUNT)] = _PRIOR**-2.0
    _walking(D, b, COUNT, imu.biases, bias_walk(noise, np.diff(imu.bias_times)))
    at = np.arange(COUNT, size)
    D[at, at] += np.tile(_BIAS**-2.0, len(imu.biases))
    b[at] -= (imu.biases * _BIAS**-2.0).ravel()
    _walking(D, b, size, slow, np.repeat(sizes.steps, 3) * np.sqrt(np.diff(slow_times)[:, None]))
    first, pinned = np.arange(size, size + 6), np.repeat(_PINNED, 3) ** -2.0
    D[first, first] += pinned
    b[first] -= slow[0] * pinned
    return D, b


def _walking(D: FloatArray, b: FloatArray, first: int, values: FloatArray, sigma: FloatArray) -> None:
    """Adds steps' information: values (m, 6) from unknown `first` on, whose steps have sigma (m − 1, 6)."""
    before = first + np.arange(values.size - 6)
    w, step = sigma.ravel() ** -2.0, np.diff(values, axis=0).ravel()
    for i, j, sign in (
        (before, before, 1.0),
        (before + 6, before + 6, 1.0),
        (before, before + 6, -1.0),
        (before + 6, before, -1.0),
    ):
        D[i, j] += sign * w
    b[before] += w * step
    b[before + 6] -= w * step


def _banded(H: sparse.csr_array, count: int) -> FloatArray:
    """The lower band (24, count) of a symmetric matrix."""
    band = np.zeros((_BAND, count))
    for k in range(_BAND):
        band[k, : count - k] = H.diagonal(-k)
    return band


def _drift(R_world_depth: FloatArray, slow: FloatArray) -> FloatArray:
    """Corrections (n, 6) that a drift (n, 6) in the world's axes makes."""
    return np.hstack([np.einsum("nji,nj->ni", R_world_depth, slow[:, :3]), slow[:, 3:]])


def _measured(
    data: ImuData, imu: ImuUnknowns, x: FloatArray, about: FloatArray, steps: FloatArray, before: ErrorSizes
) -> ErrorSizes:
    """Errors' sizes by what is left: robustly of samples, where many are."""
    left = np.abs(data.readings - ImuPrediction(data.track, imu, x, data.stamps).readings)
    gyro, accel = (
        max(stated, 1.4826 * float(np.median(left[:, part][data.counts[:, part]])))
        for stated, part in zip(data.sigmas, (slice(3), slice(3, 6)), strict=True)
    )
    return ErrorSizes(gyro, accel, _rms(about * _alike(about), before.poses), _rms(steps, before.steps))


def _alike(about: FloatArray) -> float:
    """By what errors of poses (n, 6) are larger in sums than white ones: neighbouring frames err alike."""
    turns = about[:, :3] - about[:, :3].mean(axis=0)
    total = float((turns**2).sum())
    lags = range(1, min(_LAGS, len(turns) - 1))
    along = sum(float((turns[k:] * turns[:-k]).sum()) for k in lags)
    return float(np.sqrt(max(1.0, 1.0 + 2.0 * along / total))) if total > 0.0 else 1.0


def _rms(new: FloatArray, old: tuple[float, float]) -> tuple[float, float]:
    """Of rotations and shifts (n, 6); on the way no faster than to a third."""
    rms = [float(np.sqrt(np.mean(np.square(part)))) for part in (new[:, :3], new[:, 3:])]
    return (max(rms[0], old[0] / 3.0, _LEAST[0]), max(rms[1], old[1] / 3.0, _LEAST[1]))
