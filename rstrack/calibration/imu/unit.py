"""The unknowns of an IMU, what it reads on a motion, and the derivatives of that.

    gyro = (1 + s) R ω + b_g,    accel = R [Rwᵀ (a − g) + ω̇ × l + ω × (ω × l)] + b_a

of samples stamped t, which are taken at t + offset + drift (t − middle). R: R_imu_depth; l: the IMU's place in the
depth camera's frame, so that T_imu_depth = [R, −R l]; Rw: R_world_depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import so3
from rsgen.geometry.so3 import cross, hat
from rstrack.calibration.imu.tracked import Motion, Track, corrected, motion_at

NAMES = (
    "T_imu_depth.rx", "T_imu_depth.ry", "T_imu_depth.rz", "lever.x", "lever.y", "lever.z", "offset_s", "drift",
    "scale.x", "scale.y", "scale.z", "gravity.1", "gravity.2",
)  # fmt: skip
"""The unknowns that do not change, in the order of their vectors: R ← exp(ε) R, m, s, s/s, parts, rad."""
COUNT = len(NAMES)
ROTATION, LEVER, OFFSET, DRIFT, SCALE, GRAVITY = slice(0, 3), slice(3, 6), 6, 7, slice(8, 11), slice(11, 13)
# Half of the step in s with which readings are derived by time.
_STEP_S = 1e-4


@dataclass(frozen=True)
class Unit:
    """Values: see above. middle: where offset_s holds, s. scale (3,); gravity (3,): g in the track's world, m/s².

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
    def T_imu_depth(self) -> FloatArray:
        """(4, 4)."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, -self.R @ self.lever
        return T

    def times(self, stamps: FloatArray) -> FloatArray:
        """When samples of these stamps (n,) were taken, on the images' clock, s."""
        return stamps + self.offset_s + self.drift * (stamps - self.middle)

    def level(self) -> FloatArray:
        """Two directions (3, 2) across gravity."""
        g = self.gravity / np.linalg.norm(self.gravity)
        return np.asarray(np.linalg.svd(g[None])[2][1:].T)

    def moved(self, step: FloatArray) -> Unit:
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


def unit_size(unit: Unit) -> int:
    """Length of a step of a unit."""
    return COUNT + unit.biases.size


def hats(knots: FloatArray, t: FloatArray) -> FloatArray:
    """Weights (n, m) of values at knots (m,) for what is linear between, at times t (n,); constant outside."""
    if len(knots) == 1:
        return np.ones((len(t), 1))
    place = np.clip(np.interp(t, knots, np.arange(len(knots))), 0.0, len(knots) - 1.0)
    below = np.minimum(place.astype(int), len(knots) - 2)
    weights = np.zeros((len(t), len(knots)))
    rows = np.arange(len(t))
    weights[rows, below], weights[rows, below + 1] = 1.0 - (place - below), place - below
    return weights


def readings(unit: Unit, motion: Motion, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gyroscope and accelerometer (n, 3) on a corrected motion at times t (n,)."""
    bias = hats(unit.bias_times, t) @ unit.biases
    gyro = (1.0 + unit.scale) * (motion.rate @ unit.R.T) + bias[:, :3]
    return gyro, _force(unit, motion) @ unit.R.T + bias[:, 3:]


def _force(unit: Unit, motion: Motion) -> FloatArray:
    """Specific force at the IMU's place in body axes (n, 3)."""
    felt = np.einsum("nji,nj->ni", motion.R, motion.acceleration - unit.gravity)
    lever = np.broadcast_to(unit.lever, motion.rate.shape)
    return np.asarray(felt + cross(motion.rate_change, lever) + cross(motion.rate, cross(motion.rate, lever)))


def at_stamps(track: Track, unit: Unit, x: FloatArray, stamps: FloatArray) -> tuple[Motion, FloatArray]:
    """The corrected motion and the times (n,) at which samples of these stamps were taken. Raises UserError."""
    t = unit.times(stamps)
    return corrected(motion_at(track, t), x), t


def by_time(track: Track, unit: Unit, x: FloatArray, stamps: FloatArray) -> FloatArray:
    """Derivative of both readings (2, n, 3) by the time at which they are taken, by central differences."""
    early, late = (replace(unit, offset_s=unit.offset_s + step) for step in (-_STEP_S, _STEP_S))
    pair = [readings(each, *at_stamps(track, each, x, stamps)) for each in (early, late)]
    return (np.stack(pair[1]) - np.stack(pair[0])) / (2.0 * _STEP_S)


def by_unit(unit: Unit, motion: Motion, t: FloatArray, change: FloatArray, stamps: FloatArray) -> FloatArray:
    """Derivatives (2, n, 3, 13 + 6 m) of both readings by a step of the unit. change: `by_time`'s."""
    n, R = len(t), unit.R
    J = np.zeros((2, n, 3, COUNT + unit.biases.size))
    turned = motion.rate @ R.T
    J[0, :, :, ROTATION] = -(1.0 + unit.scale)[:, None] * hat(turned)
    J[0, :, :, SCALE] = turned[:, :, None] * np.eye(3)
    J[1, :, :, ROTATION] = -hat(_force(unit, motion) @ R.T)
    J[1, :, :, LEVER] = R @ (hat(motion.rate_change) + hat(motion.rate) @ hat(motion.rate))
    # g ← exp(turn) g moves g by turn × g; the force by −Rwᵀ of that.
    J[1, :, :, GRAVITY] = R @ np.swapaxes(motion.R, 1, 2) @ hat(unit.gravity) @ unit.level()
    J[..., OFFSET], J[..., DRIFT] = change, change * (stamps - unit.middle)[:, None]
    weights = hats(unit.bias_times, t)
    for axis in range(3):
        J[0, :, axis, COUNT + axis :: 6] = weights
        J[1, :, axis, COUNT + 3 + axis :: 6] = weights
    return J


def by_corrections(unit: Unit, motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Derivatives (3, n, 3, 6) of both readings by the corrections [φ δ] and their first and second derivatives.

    Up to terms of φ itself, which is small.
    """
    n, R = len(motion.rate), unit.R
    gyro, accel = np.zeros((3, n, 3, 6)), np.zeros((3, n, 3, 6))
    scaled = (1.0 + unit.scale)[:, None] * R
    rate, lever = hat(motion.rate), unit.lever
    gyro[0, ..., :3], gyro[1, ..., :3] = scaled @ rate, scaled
    felt = np.einsum("nji,nj->ni", motion.R, motion.acceleration - unit.gravity)
    # ω × (ω × l) by ω: (ω·l) I + ω lᵀ − 2 l ωᵀ.
    along = (motion.rate @ lever)[:, None, None] * np.eye(3)
    swing = along + motion.rate[:, :, None] * lever - 2.0 * lever[:, None] * motion.rate[:, None, :]
    arm = -hat(lever)
    accel[0, ..., :3] = R @ (hat(felt) + arm @ hat(motion.rate_change) + swing @ rate)
    accel[1, ..., :3] = R @ (arm @ rate + swing)
    accel[2, ..., :3] = R @ np.broadcast_to(arm, rate.shape)
    accel[2, ..., 3:] = R @ np.swapaxes(motion.R, 1, 2)
    return gyro, accel
