"""Residuals of gyroscope and accelerometer at their own stamps, by the spline's control points, biases and gravity.

r = [ω_imu + b_g − gyro; a_imu − R_imu_world g + b_a − accel], with twist and rate taken to the unit by the adjoint of
exp([0; φ]) T_imu_depth, lever arm included: a_imu = v̇ + ω × v there (DESIGN section 4). φ, a belief's turn, turns the
unit where it sits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import so3
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import Quadratic
from rstrack.data.imu.recording import ImuRecording
from rstrack.inertial.belief import GRAVITY, SIZE, TURN, Belief
from rstrack.inertial.factor import ImuFactor, motion
from rstrack.inertial.wild import wild

# Readings within this part of the range's end are saturated, or may be.
_SATURATED = 0.995


@dataclass(frozen=True)
class Samples:
    """n of a unit's samples: t (n,) s, values (n, 6) = [gyro; accel], counts (n, 6): whether a reading does."""

    t: FloatArray
    values: FloatArray
    counts: FloatArray

    @classmethod
    def of(cls, imu: ImuRecording) -> Samples:
        """All of a recording; saturated readings, single wild ones, and those that are not numbers do not count."""
        gyro = np.full_like(imu.accel, np.nan) if imu.gyro is None else imu.gyro
        values = np.concatenate([gyro, imu.accel], axis=1)
        limits = [np.inf if r is None else _SATURATED * r for r in (imu.noise.gyro_range, imu.noise.accel_range)]
        root = np.sqrt(imu.rate_hz)
        parts = (gyro, imu.noise.gyro_density * root), (imu.accel, imu.noise.accel_density * root)
        with np.errstate(invalid="ignore"):
            counts = np.isfinite(values) & (np.abs(values) < np.repeat(limits, 3))
            counts &= ~np.concatenate([wild(part, sigma) for part, sigma in parts], axis=1)
        return cls(np.asarray(imu.t, dtype=np.float64), np.where(counts, values, 0.0), counts.astype(np.float64))

    def between(self, begin: float, end: float) -> Samples:
        """Those of begin ≤ t < end."""
        part = slice(*np.searchsorted(self.t, [begin, end]))
        return Samples(self.t[part], self.values[part], self.counts[part])

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class Joint:
    """½ xᵀ H x + gᵀ x over control points from `first` on and, last, the numbers of a `Belief`; cost: at x = 0."""

    first: int
    H: FloatArray
    g: FloatArray
    cost: float

    @property
    def count(self) -> int:
        """Control points."""
        return (len(self.g) - SIZE) // 6

    def without_belief(self, belief: Belief, at: FloatArray) -> tuple[Quadratic, float, FloatArray]:
        """Over the control points alone, a belief's numbers, here around `at` (12,), being best at every step and known
        beforehand as `belief` says; the cost, and the best ones (12,) where no control point moves."""
        z = slice(6 * self.count, None)
        c = slice(0, 6 * self.count)
        off = at - belief.mean
        gradient = self.g[z] + belief.information @ off
        solved = np.linalg.solve(self.H[z, z] + belief.information, np.column_stack([self.H[z, c], gradient]))
        H = self.H[c, c] - self.H[c, z] @ solved[:, :-1]
        g = self.g[c] - self.H[c, z] @ solved[:, -1]
        cost = self.cost + 0.5 * float(off @ belief.information @ off) - 0.5 * float(gradient @ solved[:, -1])
        return Quadratic(self.first, 0.5 * (H + H.T), g), cost, at - solved[:, -1]


@dataclass(frozen=True)
class Scatter:
    """Residuals r (n, 6), and by_belief (n, 6, 12) what a belief's numbers do to them."""

    r: FloatArray
    by_belief: FloatArray

    def after(self, change: FloatArray) -> FloatArray:
        """(n, 6), where these have changed by (12,), to first order in the turn."""
        return self.r + self.by_belief @ change


@dataclass(frozen=True)
class Rows:
    """Residuals of n samples, linearised: r (n, 6), J (n, 6, 36) their derivatives by the four control points and by a
    belief's numbers, first (n,) the first of these control points."""

    samples: Samples
    r: FloatArray
    J: FloatArray
    first: IntArray

    @classmethod
    def of(cls, spline: Spline, samples: Samples, T_imu_depth: FloatArray, belief: FloatArray) -> Rows:
        """Around a spline and a belief's numbers (12,). All samples' times must be within the spline."""
        turn = belief[TURN]
        a, b, c = so3.exp_coefficients(so3.squared_norm(turn))
        T_imu_depth = np.concatenate([so3.polynomial(turn, a, b) @ T_imu_depth[:3], T_imu_depth[3:]])
        at = ImuFactor(motion(spline, samples.t), T_imu_depth, belief[GRAVITY])
        J = np.zeros((len(samples), 6, 24 + SIZE))
        J[:, :, :24] = at.by_motion
        J[:, :, 24:30] = np.eye(6)
        J[:, :, 30:33] = at.by_gravity
        # exp(φ + δ) = exp(Jl(φ) δ) exp(φ).
        J[:, :, 33:] = at.by_rotation @ so3.polynomial(turn, b, c)
        return cls(samples, at.readings + belief[:6] - samples.values, J, at.motion.first)

    def until(self, end: float) -> Rows:
        """Those of samples before a time, s."""
        n = int(np.searchsorted(self.samples.t, end))
        samples = self.samples.between(-np.inf, end)
        return Rows(samples, self.r[:n], self.J[:n], self.first[:n])

    def moved(self, first: int, increments: FloatArray) -> Rows:
        """Where control points from number `first` on have moved by increments (k, 6)."""
        step = increments[self.first[:, None] - first + np.arange(4)].reshape(len(self.r), 24, 1)
        return Rows(self.samples, self.r + (self.J[:, :, :24] @ step)[..., 0], self.J, self.first)

    def summed(self, sigma: FloatArray) -> tuple[Joint | None, Scatter]:
        """Their normal equations, and how they scatter about the spline and a belief's numbers.

        sigma (2,): of a gyroscope's reading (rad/s), of an accelerometer's (m/s²). None without samples.
        """
        scatter = Scatter(self.r, self.J[:, :, 24:])
        if not len(self.r):
            return None, scatter
        root = self.samples.counts / np.repeat(sigma, 3)
        whitened = np.concatenate([self.J, self.r[..., None]], axis=2) * root[..., None]
        starts = np.flatnonzero(np.diff(self.first, prepend=self.first[0] - 1))
        first, count = int(self.first[0]), int(self.first[-1] - self.first[0]) + 4
        size = 6 * count + SIZE
        total, tail = np.zeros((size + 1, size + 1)), slice(6 * count, None)
        for begin, end in zip(starts, [*starts[1:], len(self.first)], strict=True):
            rows = whitened[begin:end].reshape(-1, 24 + SIZE + 1)
            squares, low = rows.T @ rows, 6 * (self.first[begin] - first)
            # Slices are added faster than arrays of indices.
            for to, own in ((slice(low, low + 24), slice(0, 24)), (tail, slice(24, None))):
                total[to, tail] += squares[own, 24:]
                total[to, low : low + 24] += squares[own, :24]
        return Joint(first, total[:-1, :-1], total[:-1, -1], 0.5 * float(total[-1, -1])), scatter
