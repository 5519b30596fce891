"""Normal equations of a unit, a track's corrections and its drift: banded in the corrections, dense in the rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from rsgen.array_types import BoolArray, FloatArray
from rstrack.calibration.imu.tracked import Motion, Track, corrections, spread
from rstrack.calibration.imu.unit import (
    COUNT,
    DRIFT,
    OFFSET,
    Unit,
    at_stamps,
    by_corrections,
    by_time,
    by_unit,
    readings,
    unit_size,
)
from rstrack.data.imu.description import ImuNoise
from rstrack.inertial.belief import WARMS

BAND = 24  # of four control points of six
_HUBER = 2.5
# Held so where nothing tells them, σ: corrections (rad, m); of the unit's NAMES rad, m, s, s/s, parts, rad; biases.
_FREE = (0.02, 0.05)
PRIOR = np.array([*(1.0,) * 3, *(0.5,) * 3, 0.2, 5e-4, *(0.05,) * 3, *(1.0,) * 2])
_BIAS = np.array([*(0.3,) * 3, *(1.0,) * 3])
# The drift begins with nothing: what is constant in it, gravity takes.
_PINNED = (1e-6, 1e-6)


@dataclass(frozen=True)
class Data:
    """What is given. stamps (n,), gyro, accel (n, 3) with which of them count (n, 3) each; frame_times (k,): when the
    track's poses hold, s; noise and rate_hz as stated."""

    track: Track
    stamps: FloatArray
    gyro: FloatArray
    accel: FloatArray
    gyro_counts: BoolArray
    accel_counts: BoolArray
    frame_times: FloatArray
    noise: ImuNoise
    rate_hz: float


@dataclass(frozen=True)
class Sizes:
    """Standard deviations: of samples (rad/s, m/s²), of the track's poses and its drift's steps a second (rad, m)."""

    gyro: float
    accel: float
    poses: tuple[float, float]
    steps: tuple[float, float]

    def like(self, other: Sizes, part: float) -> bool:
        """Whether all are the other's, to a part."""
        mine, theirs = ((s.gyro, s.accel, *s.poses, *s.steps) for s in (self, other))
        return all(abs(np.log(a / b)) < part for a, b in zip(mine, theirs, strict=True))


@dataclass(frozen=True)
class Normal:
    """band (24, 6 k), lower, and a (6 k,): of the corrections; D (q, q), b (q,): of unit, then drift; C (6 k, q)."""

    band: FloatArray
    a: FloatArray
    C: FloatArray
    D: FloatArray
    b: FloatArray

    def plus(self, other: Normal) -> Normal:
        """Both together: this one has no drift yet."""
        size, more = len(self.b), len(other.b) - len(self.b)
        D, b, C = other.D.copy(), other.b.copy(), other.C + np.pad(self.C, ((0, 0), (0, more)))
        D[:size, :size] += self.D
        b[:size] += self.b
        return Normal(self.band + other.band, self.a + other.a, C, D, b)


def samples(data: Data, unit: Unit, x: FloatArray, sizes: Sizes) -> Normal:
    """Of both sensors' samples, weighted by their residuals. Raises UserError: taken outside the track."""
    motion, t = at_stamps(data.track, unit, x, data.stamps)
    found = readings(unit, motion, t)
    J_unit = by_unit(unit, motion, t, by_time(data.track, unit, x, data.stamps), data.stamps)
    # The clock is the gyroscope's to tell. An acceleration bends where the motion's knots are, or jerks start; what the
    # corrections' knots miss of that would draw the samples towards them: half a millisecond on table1.
    J_unit[1][..., [OFFSET, DRIFT]] = 0.0
    J_near = by_corrections(unit, motion)
    count, q = x.size, J_unit.shape[-1]
    parts = []
    for k, (seen, counts, sigma) in enumerate(
        ((data.gyro, data.gyro_counts, sizes.gyro), (data.accel, data.accel_counts, sizes.accel))
    ):
        r = (seen - found[k]) / sigma
        weight = np.sqrt(np.minimum(1.0, _HUBER / np.maximum(np.abs(r), 1e-12))) * counts
        scaled = weight / sigma
        J = spread(motion, J_near[k] * scaled[None, :, :, None], len(x))
        parts.append((J, J_unit[k].reshape(-1, q) * scaled.reshape(-1, 1), (r * weight).ravel()))
    H = sum(J.T @ J for J, _, _ in parts)
    return Normal(
        _banded(H, count),
        sum(J.T @ r for J, _, r in parts),
        sum(J.T @ B for J, B, _ in parts),
        sum(B.T @ B for _, B, _ in parts),
        sum(B.T @ r for _, B, r in parts),
    )


def tracked_poses(
    at_frames: Motion, x: FloatArray, slow: FloatArray, weights: FloatArray, sizes: Sizes, size: int
) -> Normal:
    """Of the track's poses about its drift, and of corrections that nothing tells.

    slow (m, 6): the drift; weights (frames, m): of its values at the frames; size: of the unit's step.
    """
    frames, scale = len(at_frames.R), np.repeat(1.0 / np.array(sizes.poses), 3)
    turn = np.swapaxes(at_frames.R, 1, 2)
    into = np.zeros((frames, 6, 6))  # a drift in the world's axes as corrections
    into[:, :3, :3], into[:, 3:, 3:] = turn, np.eye(3)
    about = corrections(at_frames, x)[0] - (into @ (weights @ slow)[..., None])[..., 0]
    dense = -weights[:, None, :, None] * into[:, :, None, :] * scale[:, None, None]
    B = np.pad(dense.reshape(6 * frames, -1), ((0, 0), (size, 0)))
    blocks = np.zeros((2, 3, frames, 3, 6))
    blocks[0, 0, :, :, :3], blocks[1, 0, :, :, 3:] = np.eye(3) * scale[0], np.eye(3) * scale[3]
    order = np.arange(6 * frames).reshape(frames, 2, 3)
    r = -about * scale
    free = np.tile(np.repeat(1.0 / np.square(_FREE), 3), len(x))
    band, a, C = np.zeros((BAND, x.size)), -free * x.ravel(), np.zeros((x.size, B.shape[1]))
    band[0] = free
    for k in range(2):
        J = spread(at_frames, blocks[k], len(x))
        band += _banded(J.T @ J, x.size)
        a += J.T @ r.reshape(frames, 2, 3)[:, k].ravel()
        C += J.T @ B[order[:, k].ravel()]
    return Normal(band, a, C, B.T @ B, B.T @ r.ravel())


def known(
    unit: Unit, slow: FloatArray, slow_times: FloatArray, sizes: Sizes, noise: ImuNoise
) -> tuple[FloatArray, FloatArray]:
    """Information (q, q) and its gradient (q,) on unit and drift: priors, walks of biases, steps of the drift."""
    size, q = unit_size(unit), unit_size(unit) + slow.size
    D, b = np.zeros((q, q)), np.zeros(q)
    D[np.arange(COUNT), np.arange(COUNT)] = PRIOR**-2.0
    walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3)
    gaps = np.diff(unit.bias_times)[:, None]
    _walking(D, b, COUNT, unit.biases, np.hypot(walk * np.sqrt(gaps), np.repeat(WARMS, 3) * gaps))
    at = np.arange(COUNT, size)
    D[at, at] += np.tile(_BIAS**-2.0, len(unit.biases))
    b[at] -= (unit.biases * _BIAS**-2.0).ravel()
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
    band = np.zeros((BAND, count))
    for k in range(BAND):
        band[k, : count - k] = H.diagonal(-k)
    return band
