"""The IMU factor: what a gyroscope and an accelerometer read on a motion, and the derivatives by all unknowns.

    gyro = (1 + s_g) ω + b_g,   accel = (1 + s_a) f + b_a,   f = v̇ + ω × v − R_imu_world g,   of ω, v, v̇ at the IMU

`BodyMotion` is the motion of the body (the depth camera) with derivatives by some unknowns of its own, `motion` that of
a spline. `ImuFactor` takes it to the IMU by the adjoint of T_imu_depth, lever arm included. Tracking, refinement and
calibration take from it the columns of what they estimate, and add biases and scales, which are linear.
Left increments T ← exp(δ) T throughout, as for the images (docs/method.md).

Tracking's are `ImuResiduals`: r = [ω + b_g − gyro; f + b_a − accel] of samples at their own stamps, of an IMU at
exp([0; φ]) T_imu_depth: φ, an estimate's turn, turns it where it sits.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3, so3
from rsgen.geometry.so3 import cross, hat, powers
from rsgen.geometry.spline import BASES, Spline
from rstrack.alignment.normal_equations import Quadratic
from rstrack.inertial.band import ImuReadings
from rstrack.inertial.estimate import GRAVITY, SIZE, TURN, ImuEstimate


@dataclass(frozen=True)
class BodyMotion:
    """At n times: first (n,), the first of the four control points; rotation (n, 3, 3), body to world.

    twist (n, 6) = [v; ω] and rate (n, 6) = [v̇; ω̇] in body coordinates (m/s, rad/s). Their derivatives by m unknowns,
    for a spline the left increments of the four control points (m = 24): by_twist, by_rate (n, 6, m); by_turn (n, 3, m)
    of the pose's left rotation.
    """

    first: IntArray
    rotation: FloatArray
    twist: FloatArray
    rate: FloatArray
    by_twist: FloatArray
    by_rate: FloatArray
    by_turn: FloatArray


@dataclass(frozen=True)
class ImuFactor:
    """n ideal samples of an IMU on a motion; gravity (3,): g in the world, m/s². All derivatives are of `readings`."""

    motion: BodyMotion
    T_imu_depth: FloatArray
    gravity: FloatArray

    @cached_property
    def readings(self) -> FloatArray:
        """(n, 6) = [ω; f] in the IMU's axes, rad/s and m/s², without biases and scales."""
        v, omega = self._twist[:, :3], self._twist[:, 3:]
        force = self._rate[:, :3] + cross(omega, v) - self._R_imu_world @ self.gravity
        return np.concatenate([omega, force], axis=1)

    @cached_property
    def by_motion(self) -> FloatArray:
        """(n, 6, m): by the unknowns of the motion."""
        Ad, v = se3.adjoint(self.T_imu_depth), self._twist[:, :3]
        by_twist, by_rate = Ad @ self.motion.by_twist, Ad @ self.motion.by_rate
        J = np.empty_like(by_twist)
        J[:, :3] = by_twist[:, 3:]
        J[:, 3:] = by_rate[:, :3] + self._across @ by_twist[:, :3] - hat(v) @ by_twist[:, 3:]
        # R ← exp(φ) R turns Rᵀ g by Rᵀ g^ φ.
        J[:, 3:] -= (self._R_imu_world @ hat(self.gravity)) @ self.motion.by_turn
        return J

    @cached_property
    def by_gravity(self) -> FloatArray:
        """(n, 6, 3)."""
        return np.concatenate([np.zeros_like(self._R_imu_world), -self._R_imu_world], axis=1)

    @cached_property
    def by_rotation(self) -> FloatArray:
        """(n, 6, 3): by T_imu_depth ← exp([0; φ]) T_imu_depth."""
        return -np.concatenate([self._across, hat(self.readings[:, 3:])], axis=1)

    @cached_property
    def by_translation(self) -> FloatArray:
        """(n, 6, 3): by T_imu_depth ← exp([ρ; 0]) T_imu_depth, an IMU that is elsewhere by −ρ in its axes."""
        swing = -(hat(self._rate[:, 3:]) + self._across @ self._across)
        return np.concatenate([np.zeros_like(swing), swing], axis=1)

    @property
    def gyro_by_time(self) -> FloatArray:
        """(n, 3): of the gyroscope, by the time of the samples. A cubic spline has none for the accelerometer: its
        acceleration bends at the knots."""
        return self._rate[:, 3:]

    @cached_property
    def _twist(self) -> FloatArray:
        return self.motion.twist @ se3.adjoint(self.T_imu_depth).T

    @cached_property
    def _rate(self) -> FloatArray:
        return self.motion.rate @ se3.adjoint(self.T_imu_depth).T

    @cached_property
    def _across(self) -> FloatArray:
        return hat(self._twist[:, 3:])

    @cached_property
    def _R_imu_world(self) -> FloatArray:
        return self.T_imu_depth[:3, :3] @ np.swapaxes(self.motion.rotation, 1, 2)


def motion(spline: Spline, t: FloatArray) -> BodyMotion:
    """Of a spline at times t (n,) s within it. Raises UserError outside.

    With y = Ad(A_j⁻¹) w_{j−1} and x = Ad(A_j⁻¹) ẇ_{j−1}, both of which Ω_j turns by ad(·) b_j Jr(b_j Ω_j):
    dw_j = Ad(A_j⁻¹) dw_{j−1} + (b_j ad(y) Jr + ḃ_j) dΩ_j,
    dẇ_j = Ad(A_j⁻¹) dẇ_{j−1} + (b_j ad(x) Jr + ḃ_j ad(w_j) + b̈_j) dΩ_j − ḃ_j ad(Ω_j) dw_j.
    The pose's right increment likewise: e_j = Ad(A_j⁻¹) e_{j−1} + b_j Jr dΩ_j, from e_0 = Ad(T_0⁻¹) δ_0.
    """
    segment, u = spline.locate(t)
    held, n = segment - spline.first, len(u)
    p = powers(u, 4)
    b, db, ddb = (p @ basis / spline.dt**k for k, basis in enumerate(BASES))
    three = held[:, None] + np.arange(3)
    omega = spline.increments[three]
    parts = b[..., None] * omega
    A, ad = se3.exp(parts), se3.ad(omega)
    turned = b[..., None, None] * se3.right_jacobian(parts)
    back = se3.adjoint(se3.inverse(A))
    T = spline.control_points[held]
    state = np.zeros((n, 6, 2))  # w and ẇ
    by = np.zeros((n, 6, 60))  # of w and ẇ by Ω_1..Ω_3, of e by those and by δ_0
    by[:, :, 54:] = se3.adjoint(se3.inverse(T))
    one = np.eye(6)
    for j in range(3):
        bj, bbj = db[:, j, None, None], ddb[:, j, None, None]
        state, by = back[:, j] @ state, back[:, j] @ by
        pushed = bj[..., 0] * omega[:, j]
        # Of y, x and w_j = y + ḃ_j Ω_j at once: a call costs more than the numbers.
        ad_y, ad_x, ad_w = se3.ad(np.stack([state[..., 0], state[..., 1], state[..., 0] + pushed]))
        state[..., 0] += pushed
        state[..., 1] += ((bj * ad_w + bbj * one) @ omega[:, j, :, None])[..., 0]
        own = 6 * j
        by[:, :, own : own + 6] += ad_y @ turned[:, j] + bj * one
        by[:, :, 18:36] -= bj * (ad[:, j] @ by[:, :, :18])
        by[:, :, 18 + own : 24 + own] += ad_x @ turned[:, j] + bj * ad_w + bbj * one
        by[:, :, 36 + own : 42 + own] += turned[:, j]
        T = T @ A[:, j]
    R = T[:, :3, :3]
    by[:, 3:, 36:] = R @ by[:, 3:, 36:]
    # Twist, rate and turn, one below the other: a call costs more than the numbers.
    rows = np.concatenate([by[:, :, :18], by[:, :, 18:36], by[:, 3:, 36:54]], axis=1)
    points = _by_points(rows, spline.left_gains[three])
    points[:, 12:, :6] += by[:, 3:, 54:]
    return BodyMotion(segment, R, state[..., 0], state[..., 1], points[:, :6], points[:, 6:12], points[:, 12:])


def _by_points(by_increments: FloatArray, gains: FloatArray) -> FloatArray:
    """From Ω_1..Ω_3 (n, k, 18) to the four control points (n, k, 24): dΩ_j = G_j (δ_j − δ_{j−1})."""
    out = np.zeros((*by_increments.shape[:2], 24))
    for j in range(3):
        part = by_increments[:, :, 6 * j : 6 * j + 6] @ gains[:, j]
        out[:, :, 6 * j : 6 * j + 6] -= part
        out[:, :, 6 * j + 6 : 6 * j + 12] += part
    return out


# -- residuals ---------------------------------------------------------------------------------------------------------


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
        off, points = at - estimate.mean, 6 * self.count
        more = estimate.information, estimate.information @ off
        H, g, step, gained = without(self.H, self.g, slice(points, None), slice(points), more)
        cost = self.cost + 0.5 * float(off @ estimate.information @ off) - gained
        return Quadratic(self.first, H, g), cost, at - step


def without(
    H: FloatArray, g: FloatArray, gone: slice, kept: slice, more: tuple[FloatArray, FloatArray] | None = None
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """½ xᵀ H x + gᵀ x of some numbers, the others (k) being best at every step: H and g.

    Also what these are smaller by where they are best and no other moves (k,), and what that gains. more: H (k, k) and
    g (k,) of what else is known of them.
    """
    own, gradient = (H[gone, gone], g[gone]) if more is None else (H[gone, gone] + more[0], g[gone] + more[1])
    solved = np.linalg.solve(own, np.column_stack([H[gone, kept], gradient]))
    rest, step = H[kept, kept] - H[kept, gone] @ solved[:, :-1], np.asarray(solved[:, -1])
    return 0.5 * (rest + rest.T), g[kept] - H[kept, gone] @ step, step, 0.5 * float(gradient @ step)


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
        return ImuResiduals(self.samples[:n], self.r[:n], self.J[:n], self.first[:n])

    def moved(self, first: int, increments: FloatArray) -> ImuResiduals:
        """Where control points from number `first` on have moved by increments (k, 6)."""
        step = increments[self.first[:, None] - first + np.arange(4)].reshape(len(self.r), 24, 1)
        return ImuResiduals(self.samples, self.r + (self.J[:, :, :24] @ step)[..., 0], self.J, self.first)

    def after(self, change: FloatArray) -> FloatArray:
        """r (n, 6), where the estimate's numbers have changed by (12,), to first order in the turn."""
        return self.r + self.J[:, :, 24:] @ change

    def summed(self, sigma: FloatArray) -> ImuQuadratic | None:
        """Their normal equations; None without samples.

        sigma (2,): of a gyroscope's reading (rad/s), of an accelerometer's (m/s²).
        """
        if not len(self.r):
            return None
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
        return ImuQuadratic(first, total[:-1, :-1], total[:-1, -1], 0.5 * float(total[-1, -1]))
