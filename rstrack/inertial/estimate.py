"""The estimate of an IMU's biases, of gravity and of its turn: twelve normally distributed numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.geometry.so3 import hat
from rstrack.data.imu.description import ImuNoise

SIZE = 12
"""Gyroscope's bias (rad/s), accelerometer's bias, gravity in the world (both m/s²), and the IMU's turn φ (rad, in its
axes): R_imu_depth is exp(φ) times that of T_imu_depth."""
GYRO, ACCEL, GRAVITY, TURN = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
TURNED = 5e-3
"""σ of that turn beforehand, rad: drawings and hands are right to some tenths of a degree."""
# σ of biases before anything is known: rad/s and m/s², as data sheets of cheap IMUs have them.
_GYRO_BIAS, _ACCEL_BIAS = 0.1, 0.6
STRENGTH = 0.03
"""How well gravity's strength is known, m/s²: over the earth, and of an IMU's scale."""
ALIKE = 8.0
"""Images in a row whose errors are alike, since those of interpolation, of reflections and of the keyframe change
slowly. Beside an IMU's readings so many of them inform about the motion as one would by its scatter."""
WARMS = 2e-5, 5e-4
"""What a bias may do beside its walk while an IMU warms up: in a second, rad/s and m/s²."""
# σ of the gyroscope's bias (rad/s), and of the force (m/s²) that gravity and the accelerometer's bias make together in
# an attitude, below which the IMU is usable; and of gravity's direction, degrees, below which that is determined.
_KNOWN_GYRO, _KNOWN_FORCE, _KNOWN_DEG = 5e-3, 0.15, 0.3


def bias_walk(noise: ImuNoise, seconds: npt.ArrayLike) -> FloatArray:
    """σ (..., 6) of how far the biases, gyroscope first, walk in times (...) in s."""
    s = np.asarray(seconds, dtype=np.float64)[..., None]
    walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3)
    return np.asarray(np.hypot(walk * np.sqrt(s), np.repeat(WARMS, 3) * s))


@dataclass(frozen=True)
class ImuEstimate:
    """mean (12,): gyroscope's bias, accelerometer's bias, gravity in the world, turn. information (12, 12): of it."""

    mean: FloatArray
    information: FloatArray

    @classmethod
    def initial(cls, gravity: FloatArray) -> ImuEstimate:
        """Before anything is known; gravity (3,) a guess in the world, whose strength alone counts."""
        sigma = np.repeat([_GYRO_BIAS, _ACCEL_BIAS, 3.0 * float(np.linalg.norm(gravity)), TURNED], 3)
        mean = np.concatenate([np.zeros(6), np.asarray(gravity, dtype=np.float64), np.zeros(3)])
        return cls(mean, np.asarray(np.diag(sigma**-2.0)))

    @cached_property
    def covariance(self) -> FloatArray:
        """(12, 12)."""
        return np.asarray(np.linalg.inv(self.information))

    @property
    def sigmas(self) -> FloatArray:
        """(12,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def direction(self) -> FloatArray:
        """Unit vector (3,) along gravity, in the world: down."""
        g = self.mean[GRAVITY]
        return np.asarray(g / np.linalg.norm(g))

    @property
    def direction_deg(self) -> float:
        """σ of gravity's direction in the worse of its two ways, degrees."""
        across = np.eye(3) - np.outer(self.direction, self.direction)
        worst = np.linalg.eigvalsh(across @ self.covariance[GRAVITY, GRAVITY] @ across)[-1]
        return float(np.degrees(np.sqrt(max(0.0, worst)) / np.linalg.norm(self.mean[GRAVITY])))

    @property
    def is_determined(self) -> bool:
        """Whether gravity's direction is known to 0.3° (one σ): until then it may be the accelerometer's bias."""
        return self.direction_deg < _KNOWN_DEG

    def is_usable(self, R_imu_world: FloatArray, rate: FloatArray) -> bool:
        """Whether readings in an attitude (3, 3), and at a rate (3,) of the IMU in rad/s, determine accelerations to
        0.15 m/s², and rates to 0.3 °/s."""
        return self.force_variance(R_imu_world) < _KNOWN_FORCE**2 and self.rate_variance(rate) < _KNOWN_GYRO**2

    def force_variance(self, R_imu_world: FloatArray) -> float:
        """Of what gravity, the accelerometer's bias and the turn make together in an attitude (3, 3), in the worst
        direction."""
        turned = hat(R_imu_world @ self.mean[GRAVITY])
        return self._worst(np.concatenate([np.zeros((3, 3)), np.eye(3), -R_imu_world, turned], axis=1))

    def rate_variance(self, rate: FloatArray) -> float:
        """Of what the gyroscope's bias and the turn make together at a rate (3,), rad/s, in the worst direction."""
        return self._worst(np.concatenate([np.eye(3), np.zeros((3, 6)), -hat(rate)], axis=1))

    def of_strength(self, strength: float) -> ImuEstimate:
        """With gravity on the sphere of a known strength, m/s²: |g| is a measurement, taken where it is in the end."""
        mean, u = self.mean, np.zeros(SIZE)
        for _ in range(3):
            u[GRAVITY] = mean[GRAVITY] / max(1e-9, float(np.linalg.norm(mean[GRAVITY])))
            # |g| + u (g' − g) = strength, and u g = |g|: one number is measured, so nothing has to be solved.
            along = self.covariance @ u
            mean = self.mean + along * ((strength - u @ self.mean) / (STRENGTH**2 + u @ along))
        information = self.information + np.outer(u, u) / STRENGTH**2
        return ImuEstimate(mean, 0.5 * (information + information.T))

    def _worst(self, J: FloatArray) -> float:
        return float(np.linalg.eigvalsh(J @ self.covariance @ J.T)[-1])
