"""What an IMU reads beside a track: its unknowns, the track's corrections, and the derivatives by both.

Samples stamped t are taken at t + offset + drift (t − middle); see `rstrack.inertial.factor` for the rest. The camera
was at R exp(φ), p + δ where the track has R, p: φ (body axes, rad) and δ (world axes, m) are cubic B-splines of
coefficients x (k, 6) = [φ δ], on the track's own knots or on finer ones among which those are. Then, up to terms of φ
times its derivatives,

    ω' = exp(−φ) ω + Jr(φ) φ',   ω̇' = exp(−φ) ω̇ + φ'' + ω × φ',   v' = R'ᵀ (ṗ + δ'),   a' = a + δ''.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import so3
from rsgen.geometry.so3 import cross, hat
from rsgen.geometry.spline import BY_U, Spline
from rstrack.inertial.factor import BodyMotion, ImuFactor

NAMES = (
    "T_imu_depth.rx", "T_imu_depth.ry", "T_imu_depth.rz", "lever.x", "lever.y", "lever.z", "offset_s", "drift",
    "scale.x", "scale.y", "scale.z", "gravity.1", "gravity.2",
)  # fmt: skip
"""The unknowns that do not change, in the order of their vectors: R ← exp(ε) R, m, s, s/s, parts, rad."""
COUNT = len(NAMES)
ROTATION, LEVER, OFFSET, DRIFT, SCALE, GRAVITY = slice(0, 3), slice(3, 6), 6, 7, slice(8, 11), slice(11, 13)
# Half of a step in s by which biases are differentiated, which are linear.
_STEP_S = 1e-4
# Weights of four control points as polynomials in u, constant term first.
_BASIS = np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]]).T / 6.0


@dataclass(frozen=True)
class ImuUnknowns:
    """Values. R: R_imu_depth; lever (3,): the IMU's place l in the depth camera's frame, so that T_imu_depth is
    [R, −R l]. middle: where offset_s holds, s. scale (3,): of the gyroscope; gravity (3,): in the track's world, m/s².

    bias_times (m,), s; biases (m, 6): of gyroscope and accelerometer, linear between.
    """

    R: FloatArray
    lever: FloatArray
    offset_s: float
    drift: float
    scale: FloatArray
    gravity: FloatArray
    bias_times: FloatArray
    biases: FloatArray
    middle: float

    @property
    def size(self) -> int:
        """Length of a step."""
        return COUNT + self.biases.size

    @property
    def T_imu_depth(self) -> FloatArray:
        """(4, 4)."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, -self.R @ self.lever
        return T

    def times(self, stamps: FloatArray) -> FloatArray:
        """When samples of these stamps (n,) were taken, on the images' clock, s."""
        return stamps + self.offset_s + self.drift * (stamps - self.middle)

    def bias(self, t: FloatArray) -> FloatArray:
        """(n, 6) at times t (n,)."""
        return hats(self.bias_times, t) @ self.biases

    def level(self) -> FloatArray:
        """Two directions (3, 2) across gravity."""
        g = self.gravity / np.linalg.norm(self.gravity)
        return np.asarray(np.linalg.svd(g[None])[2][1:].T)

    def moved(self, step: FloatArray) -> ImuUnknowns:
        """After a step (13 + 6 m,): that of NAMES, then the biases'."""
        turn = self.level() @ step[GRAVITY]
        return replace(
            self,
            R=so3.exp(step[ROTATION]) @ self.R,
            lever=self.lever + step[LEVER],
            offset_s=self.offset_s + float(step[OFFSET]),
            drift=self.drift + float(step[DRIFT]),
            scale=self.scale + step[SCALE],
            gravity=so3.exp(turn) @ self.gravity,
            biases=self.biases + step[COUNT:].reshape(-1, 6),
        )


@dataclass(frozen=True)
class CorrectedTrack:
    """spline: T_world_depth(t). parts: into how many each of its knots' spacings is cut for the corrections."""

    spline: Spline
    parts: int = 1

    @property
    def count(self) -> int:
        """Of the corrections' coefficients."""
        return self.parts * (len(self.spline.control_points) - 3) + 3

    def corrections(self, t: FloatArray) -> Corrections:
        """At times t (n,), s, within the track. Raises UserError outside."""
        segment, u = self.spline.locate(t)
        within = np.minimum((self.parts * u).astype(int), self.parts - 1)
        powers = (self.parts * u - within)[:, None] ** np.arange(4)
        dt = self.spline.dt / self.parts
        bases = _BASIS, BY_U @ _BASIS / dt, BY_U @ BY_U @ _BASIS / dt**2
        first = self.parts * (segment - self.spline.first) + within
        return Corrections(first, np.stack([powers @ basis for basis in bases]))

    def motion(self, t: FloatArray, at: Corrections, x: FloatArray) -> BodyMotion:
        """The corrected motion at times t (n,), s; its unknowns (m = 18) are the corrections [φ δ] there, and their
        first and second derivatives."""
        T, twist = self.spline.pose_and_velocity(t)
        change, (value, speed, bend) = self.spline.acceleration(t), at.values(x)
        R, v, omega, phi = T[:, :3, :3], twist[:, :3], twist[:, 3:], value[:, :3]
        back = so3.exp(-phi)
        R_new, to_body = R @ so3.exp(phi), back @ np.swapaxes(R, 1, 2)
        omega_new = _turned(back, omega) + _turned(so3.right_jacobian(phi), speed[:, :3])
        v_new = _turned(back, v) + _turned(to_body, speed[:, 3:])
        a_new = _turned(back, change[:, :3] + cross(omega, v)) + _turned(to_body, bend[:, 3:])
        turning = _turned(back, change[:, 3:]) + bend[:, :3] + cross(omega, speed[:, :3])
        rate = np.concatenate([a_new - cross(omega_new, v_new), turning], axis=1)
        by_twist, by_rate, by_turn = np.zeros((len(t), 6, 18)), np.zeros((len(t), 6, 18)), np.zeros((len(t), 3, 18))
        by_twist[:, :3, :3], by_twist[:, 3:, :3] = hat(v_new), hat(omega_new)
        by_twist[:, 3:, 6:9], by_twist[:, :3, 9:12] = np.eye(3), to_body
        by_rate[:, :3, :3], by_rate[:, 3:, :3] = hat(rate[:, :3]), hat(turning)
        by_rate[:, :3, 6:9], by_rate[:, 3:, 6:9] = hat(v_new), hat(omega_new)
        by_rate[:, :3, 9:12], by_rate[:, 3:, 12:15], by_rate[:, :3, 15:] = -hat(omega_new) @ to_body, np.eye(3), to_body
        by_turn[:, :, :3] = R_new
        return BodyMotion(at.first, R_new, np.concatenate([v_new, omega_new], axis=1), rate, by_twist, by_rate, by_turn)


@dataclass(frozen=True)
class Corrections:
    """Where a track's corrections have their coefficients at n times: the first of four (n,), and their weights
    (3, n, 4) in the value and in its first and second derivatives."""

    first: IntArray
    weights: FloatArray

    def values(self, x: FloatArray) -> FloatArray:
        """[φ δ] and its first and second derivatives (3, n, 6) for coefficients x (k, 6)."""
        return np.einsum("onk,nkc->onc", self.weights, x[self.first[:, None] + np.arange(4)])

    def spread(self, J: FloatArray, count: int) -> sparse.csr_array:
        """Derivatives by all coefficients (m n, 6 count), sparse, from those by `values`, J (n, m, 18)."""
        n, m = J.shape[:2]
        values = np.einsum("onk,nioc->nikc", self.weights, J.reshape(n, m, 3, 6))
        columns = 6 * (self.first[:, None] + np.arange(4))[:, None, :, None] + np.arange(6)
        columns = np.broadcast_to(columns, values.shape)
        ends = np.arange(m * n + 1) * (4 * 6)
        return sparse.csr_array((values.ravel(), columns.ravel(), ends), shape=(m * n, 6 * count))


class ImuPrediction:
    """What an IMU with such values reads at stamps (n,), s, on a track with corrections x (k, 6), and the derivatives.

    Raises UserError: taken outside the track.
    """

    def __init__(self, track: CorrectedTrack, imu: ImuUnknowns, x: FloatArray, stamps: FloatArray) -> None:
        self.imu, self.stamps, self.t = imu, stamps, imu.times(stamps)
        self.corrections = track.corrections(self.t)
        motion = track.motion(self.t, self.corrections, x)
        self._factor = ImuFactor(motion, imu.T_imu_depth, imu.gravity)
        self._scale = np.append(1.0 + imu.scale, np.ones(3))

    @property
    def readings(self) -> FloatArray:
        """(n, 6) of gyroscope and accelerometer."""
        return self._scale * self._factor.readings + self.imu.bias(self.t)

    @cached_property
    def by_corrections(self) -> FloatArray:
        """(n, 6, 18): by the corrections and their first and second derivatives, up to terms of φ, which is small."""
        return self._scale[:, None] * self._factor.by_motion

    @cached_property
    def by_imu(self) -> FloatArray:
        """(n, 6, 13 + 6 m): by a step of the unknowns.

        The gyroscope alone determines the clock. An acceleration bends where the motion's knots are, or jerks start;
        what the corrections' knots miss of that would bias the clock: half a millisecond on table1.
        """
        imu, at = self.imu, self._factor
        J = np.zeros((len(self.t), 6, imu.size))
        J[:, :, ROTATION] = self._scale[:, None] * at.by_rotation
        # Elsewhere by l in depth's axes is elsewhere by R l in its own.
        J[:, :, LEVER] = at.by_translation @ -imu.R
        drifting = (imu.bias(self.t + _STEP_S) - imu.bias(self.t - _STEP_S)) / (2.0 * _STEP_S)
        J[:, :3, OFFSET] = self._scale[:3] * at.gyro_by_time + drifting[:, :3]
        J[:, :3, DRIFT] = J[:, :3, OFFSET] * (self.stamps - imu.middle)[:, None]
        J[:, :3, SCALE] = at.readings[:, :3, None] * np.eye(3)
        # g ← exp(turn) g moves g by turn × g.
        J[:, :, GRAVITY] = at.by_gravity @ -hat(imu.gravity) @ imu.level()
        weights = hats(imu.bias_times, self.t)
        for axis in range(6):
            J[:, axis, COUNT + axis :: 6] = weights
        return J


def hats(knots: FloatArray, t: FloatArray) -> FloatArray:
    """Weights (n, m) of values at knots (m,) for what is linear between, at times t (n,); constant outside."""
    place = np.clip(np.interp(t, knots, np.arange(len(knots))), 0.0, len(knots) - 1.0)
    below = np.minimum(place.astype(int), len(knots) - 2)
    weights = np.zeros((len(t), len(knots)))
    rows = np.arange(len(t))
    weights[rows, below], weights[rows, below + 1] = 1.0 - (place - below), place - below
    return weights


def _turned(R: FloatArray, v: FloatArray) -> FloatArray:
    return np.asarray((R @ v[..., None])[..., 0])
