"""Residuals of gyroscope and accelerometer at their own stamps, by the spline's control points, biases and gravity.

r = [ω_imu + b_g − gyro; f + b_a − accel] by `rstrack.inertial.factor`, of an IMU at exp([0; φ]) T_imu_depth: φ, an
estimate's turn, turns it where it sits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.geometry import so3
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import Quadratic
from rstrack.data.imu.description import ImuNoise
from rstrack.data.imu.recording import ImuRecording
from rstrack.inertial.estimate import GRAVITY, SIZE, TURN, ImuEstimate
from rstrack.inertial.factor import ImuFactor, motion

# Part of a sensor's range from which on a reading is saturated, or may be.
_SATURATED = 0.995
# An outlier stands out from between its neighbours by so many σ of the noise, and so many times as far as the four
# around it differ: motion that sudden would show in these, too. A bus that drops a bit leaves such readings.
_SIGMAS, _TIMES = 20.0, 3.0


@dataclass(frozen=True)
class ImuReadings:
    """n of a unit's samples: t (n,) s, values (n, 6) = [gyro; accel], counts (n, 6): whether a reading does."""

    t: FloatArray
    values: FloatArray
    counts: FloatArray

    @classmethod
    def of(cls, imu: ImuRecording) -> ImuReadings:
        """All of a recording; saturated readings, outliers, and those that are not numbers do not count."""
        gyro = np.full_like(imu.accel, np.nan) if imu.gyro is None else imu.gyro
        values = np.concatenate([gyro, imu.accel], axis=1)
        parts = zip((gyro, imu.accel), reading_sigmas(imu), strict=True)
        with np.errstate(invalid="ignore"):
            counts = np.isfinite(values) & within_range(values, imu.noise)
            counts &= ~np.concatenate([outliers(part, sigma) for part, sigma in parts], axis=1)
        return cls(np.asarray(imu.t, dtype=np.float64), np.where(counts, values, 0.0), counts.astype(np.float64))

    def between(self, begin: float, end: float) -> ImuReadings:
        """Those of begin ≤ t < end."""
        part = slice(*np.searchsorted(self.t, [begin, end]))
        return ImuReadings(self.t[part], self.values[part], self.counts[part])

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class ImuQuadratic:
    """½ xᵀ H x + gᵀ x over control points from `first` on and, last, the numbers of a `ImuEstimate`; cost: at x = 0."""

    first: int
    H: FloatArray
    g: FloatArray
    cost: float

    @property
    def count(self) -> int:
        """Control points."""
        return (len(self.g) - SIZE) // 6

    def without_imu(self, estimate: ImuEstimate, at: FloatArray) -> tuple[Quadratic, float, FloatArray]:
        """Over the control points alone, the IMU's numbers, here around `at` (12,), being best at every step and known
        beforehand as `estimate` says; the cost, and the best ones (12,) where no control point moves."""
        off = at - estimate.mean
        gradient = self.g[6 * self.count :] + estimate.information @ off
        model, step = without_tail(self.first, self.H, self.g, estimate.information, gradient)
        cost = self.cost + 0.5 * float(off @ estimate.information @ off) - 0.5 * float(gradient @ step)
        return model, cost, at - step


def without_tail(
    first: int, H: FloatArray, g: FloatArray, information: FloatArray, gradient: FloatArray
) -> tuple[Quadratic, FloatArray]:  # fmt: skip
    """H, g without the IMU's numbers, the last ones, of which there is more information (12, 12); and what these are
    smaller by where they are best (12,). gradient (12,): by them, of all together."""
    z, c = slice(len(g) - SIZE, None), slice(0, len(g) - SIZE)
    solved = np.linalg.solve(H[z, z] + information, np.column_stack([H[z, c], gradient]))
    rest = H[c, c] - H[c, z] @ solved[:, :-1]
    return Quadratic(first, 0.5 * (rest + rest.T), g[c] - H[c, z] @ solved[:, -1]), np.asarray(solved[:, -1])


@dataclass(frozen=True)
class Scatter:
    """Residuals r (n, 6), and by_imu (n, 6, 12) what an estimate's numbers do to them."""

    r: FloatArray
    by_imu: FloatArray

    def after(self, change: FloatArray) -> FloatArray:
        """(n, 6), where these have changed by (12,), to first order in the turn."""
        return self.r + self.by_imu @ change


@dataclass(frozen=True)
class ImuResiduals:
    """Residuals of n samples, linearised: r (n, 6), J (n, 6, 36) their derivatives by the four control points and by a
    estimate's numbers, first (n,) the first of these control points."""

    samples: ImuReadings
    r: FloatArray
    J: FloatArray
    first: IntArray

    @classmethod
    def of(cls, spline: Spline, samples: ImuReadings, T_imu_depth: FloatArray, estimate: FloatArray) -> ImuResiduals:
        """Around a spline and an estimate's numbers (12,). All samples' times must be within the spline."""
        turn = estimate[TURN]
        a, b, c = so3.exp_coefficients(so3.squared_norm(turn))
        T_imu_depth = np.concatenate([so3.polynomial(turn, a, b) @ T_imu_depth[:3], T_imu_depth[3:]])
        at = ImuFactor(motion(spline, samples.t), T_imu_depth, estimate[GRAVITY])
        J = np.zeros((len(samples), 6, 24 + SIZE))
        J[:, :, :24] = at.by_motion
        J[:, :, 24:30] = np.eye(6)
        J[:, :, 30:33] = at.by_gravity
        # exp(φ + δ) = exp(Jl(φ) δ) exp(φ).
        J[:, :, 33:] = at.by_rotation @ so3.polynomial(turn, b, c)
        return cls(samples, at.readings + estimate[:6] - samples.values, J, at.motion.first)

    def until(self, end: float) -> ImuResiduals:
        """Those of samples before a time, s."""
        n = int(np.searchsorted(self.samples.t, end))
        samples = self.samples.between(-np.inf, end)
        return ImuResiduals(samples, self.r[:n], self.J[:n], self.first[:n])

    def moved(self, first: int, increments: FloatArray) -> ImuResiduals:
        """Where control points from number `first` on have moved by increments (k, 6)."""
        step = increments[self.first[:, None] - first + np.arange(4)].reshape(len(self.r), 24, 1)
        return ImuResiduals(self.samples, self.r + (self.J[:, :, :24] @ step)[..., 0], self.J, self.first)

    def summed(self, sigma: FloatArray) -> tuple[ImuQuadratic | None, Scatter]:
        """Their normal equations, and how they scatter about the spline and an estimate's numbers.

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
        return ImuQuadratic(first, total[:-1, :-1], total[:-1, -1], 0.5 * float(total[-1, -1])), scatter


def within_range(values: FloatArray, noise: ImuNoise) -> BoolArray:
    """Which readings (n, 6) = [gyro; accel] are not saturated."""
    limits = [np.inf if limit is None else _SATURATED * limit for limit in (noise.gyro_range, noise.accel_range)]
    return np.asarray(np.abs(values) < np.repeat(limits, 3))


def outliers(values: FloatArray, sigma: float) -> BoolArray:
    """Which readings (n, 3), even ones, of noise sigma are. The first and the last two are not looked at, nor what is
    beside no number."""
    found = np.zeros(values.shape, dtype=bool)
    if len(values) < 5:
        return found
    a, b, x, c, d = (values[i : len(values) - 4 + i] for i in range(5))
    usual = np.abs(b - a) + np.abs(c - b) + np.abs(d - c)
    found[2:-2] = np.abs(x - 0.5 * (b + c)) > _SIGMAS * sigma + _TIMES * usual
    return found


def reading_sigmas(recording: ImuRecording) -> FloatArray:
    """σ (2,) of a gyroscope's reading (rad/s) and of an accelerometer's (m/s²), as stated."""
    noise, root = recording.noise, np.sqrt(recording.rate_hz)
    return np.array([noise.gyro_density, noise.accel_density]) * root


def guessed_gravity(spline: Spline, readings: ImuReadings, recording: ImuRecording) -> FloatArray:
    """Gravity in the world (3,), m/s², if the mean force were nothing else."""
    R = spline.pose(readings.t)[:, :3, :3] @ recording.T_imu_depth[:3, :3].T
    up = (R @ readings.values[:, 3:, None])[..., 0].sum(axis=0)
    return np.asarray(-recording.gravity * up / max(1e-9, float(np.linalg.norm(up))))
