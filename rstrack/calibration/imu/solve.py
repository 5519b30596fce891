"""The joint solution: the unit, and the track's own errors, which would otherwise pass for accelerations.

Unknown beside the unit are the track's corrections x (see `tracked`), and its drift: world rotation and shift, a line
between values a second apart, which walk. Of the track its poses at the frames are taken for measured, with white
errors about that drift. How large errors are is found on the way: of poses and of the drift's steps by their residuals,
of both sensors likewise, but never below what is stated. Samples count robustly (Huber).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cho_solve_banded, cholesky_banded

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rstrack.calibration.imu.normal import Data, Sizes, known, samples, tracked_poses
from rstrack.calibration.imu.tracked import corrections, motion_at
from rstrack.calibration.imu.unit import COUNT, Unit, at_stamps, hats, readings, unit_size

_MOST, _SETTLED, _SAME = 30, 0.05, 0.05
_SLOW_S = 1.0
# Where errors' sizes begin: of poses (rad, m), and of the drift's steps a second; and what they never fall below.
_POSES, _STEPS = (3e-4, 5e-4), (3e-4, 5e-4)
_LEAST = (1e-5, 1e-5)
# Frames over which errors of poses may be alike.
_LAGS = 8
_TELLS_LITTLE = "IMU: the recording tells too little of it: record 20 s with turns about all axes, or track it better"


@dataclass(frozen=True)
class Solution:
    """unit with the covariance (13 + 6 m, 13 + 6 m) of a step of it; x (k, 6): the track's corrections; sizes found."""

    unit: Unit
    covariance: FloatArray
    x: FloatArray
    sizes: Sizes
    iterations: int


def solve(data: Data, unit: Unit, done: Callable[[int], None] = lambda _: None) -> Solution:
    """From a start on. done: told of each step. Raises UserError: it does not settle, or too little is told."""
    x = np.zeros((data.track.count, 6))
    at_frames = motion_at(data.track, data.frame_times)
    slow_times = np.arange(data.frame_times[0], data.frame_times[-1] + _SLOW_S, _SLOW_S)
    slow, weights = np.zeros((len(slow_times), 6)), hats(slow_times, data.frame_times)
    root, size = np.sqrt(data.rate_hz), unit_size(unit)
    sizes = Sizes(data.noise.gyro_density * root, data.noise.accel_density * root, _POSES, _STEPS)
    for iteration in range(1, _MOST + 1):
        done(iteration)
        normal = samples(data, unit, x, sizes)
        normal = normal.plus(tracked_poses(at_frames, x, slow, weights, sizes, size))
        D, b = known(unit, slow, slow_times, sizes, data.noise)
        D[:, :] += normal.D
        b += normal.b
        try:
            factor = cholesky_banded(normal.band, lower=True)
            inner = cho_solve_banded((factor, True), np.column_stack([normal.C, normal.a]))
            lower = np.linalg.cholesky(D - normal.C.T @ inner[:, :-1])
        except np.linalg.LinAlgError:
            raise UserError(_TELLS_LITTLE) from None
        step = cho_solve((lower, True), b - normal.C.T @ inner[:, -1])
        covariance = np.asarray(cho_solve((lower, True), np.eye(len(D))[:, :size]))[:size]
        unit = unit.moved(step[:size])
        x = x + (inner[:, -1] - inner[:, :-1] @ step).reshape(x.shape)
        slow = slow + step[size:].reshape(-1, 6)
        before = sizes
        about = corrections(at_frames, x)[0] - _drift(at_frames.R, weights @ slow)
        sizes = _measured(data, unit, x, about, np.diff(slow, axis=0), sizes)
        moved = np.abs(step[:COUNT]) / np.sqrt(np.diag(covariance)[:COUNT])
        if not np.isfinite(moved).all():
            break
        if iteration > 3 and moved.max() < _SETTLED and sizes.like(before, _SAME):
            return Solution(unit, covariance, x, sizes, iteration)
    raise UserError(f"{_TELLS_LITTLE} (no solution after {_MOST} steps)")


def _drift(R_world_depth: FloatArray, slow: FloatArray) -> FloatArray:
    """Corrections (n, 6) that a drift (n, 6) in the world's axes makes."""
    return np.hstack([np.einsum("nji,nj->ni", R_world_depth, slow[:, :3]), slow[:, 3:]])


def _measured(
    data: Data, unit: Unit, x: FloatArray, about: FloatArray, steps: FloatArray, before: Sizes
) -> Sizes:  # fmt: skip
    """Errors' sizes by what is left: robustly of samples, where many are."""
    found = readings(unit, *at_stamps(data.track, unit, x, data.stamps))
    root = np.sqrt(data.rate_hz)
    gyro, accel = (
        max(stated * root, 1.4826 * float(np.median(np.abs((seen - guess)[counts]))))
        for stated, seen, guess, counts in (
            (data.noise.gyro_density, data.gyro, found[0], data.gyro_counts),
            (data.noise.accel_density, data.accel, found[1], data.accel_counts),
        )
    )
    return Sizes(gyro, accel, _rms(about * _alike(about), before.poses), _rms(steps, before.steps))


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
