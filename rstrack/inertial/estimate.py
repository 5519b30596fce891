"""The estimate of an IMU's biases, of gravity and of its turn, twelve normally distributed numbers, and its record."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from rsgen.array_types import FloatArray
from rsgen.geometry import so3
from rsgen.geometry.so3 import hat
from rsgen.geometry.spline import Spline
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
# χ² of three numbers that chance exceeds once in 10⁵, and a turn, rad, that is worth saying.
_BEYOND, _WORTH_SAYING = float(chdtri(3, 1e-5)), np.radians(0.1)


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


def estimate_dict(estimate: ImuEstimate, sigma: FloatArray) -> dict[str, Any]:
    """Gravity in the run's world (m/s²) and the biases (rad/s, m/s²), each with σ; sigma (2,): of readings."""
    sigmas = estimate.sigmas
    return {
        "gravity": estimate.mean[GRAVITY].tolist(),
        "gravity_sigma_deg": estimate.direction_deg,
        "gyro_bias": estimate.mean[GYRO].tolist(),
        "gyro_bias_sigma": sigmas[GYRO].tolist(),
        "accel_bias": estimate.mean[ACCEL].tolist(),
        "accel_bias_sigma": sigmas[ACCEL].tolist(),
        "T_imu_depth_turn": estimate.mean[TURN].tolist(),
        "T_imu_depth_turn_sigma": sigmas[TURN].tolist(),
        "T_imu_depth_is_contradicted": is_contradicted(estimate),
        "gyro_residual": float(sigma[0]),
        "accel_residual": float(sigma[1]),
    }


def is_contradicted(estimate: ImuEstimate) -> bool:
    """Whether the IMU is turned from where T_imu_depth has it, beyond chance and by more than a bias of the images by a
    thousandth of the motion explains."""
    turn = estimate.mean[TURN]
    beyond = float(turn @ np.linalg.solve(estimate.covariance[TURN, TURN], turn))
    return beyond > _BEYOND and bool(np.linalg.norm(turn) > _WORTH_SAYING)


def text(found: dict[str, Any], begin: float, bridged: int) -> str:
    """One line of an IMU's record; begin: stamp (s) of the run's first frame. bridged: frames with the IMU's pose."""
    if found["usable_s"] is None:
        return "IMU: it was of no use: too short a track to tell its biases"
    known = found["gravity_determined_s"]
    when = "" if known is None else f" (to 0.3° after {known - begin:.1f} s)"
    over = f", {bridged} frames bridged" if bridged else ""
    return _summary(found, when) + over + _contradiction(found)


def refined_text(found: dict[str, Any]) -> str:
    """One line of `estimate_dict`, of a whole recording."""
    return _summary(found, "")


def upright(gravity: FloatArray) -> FloatArray:
    """T_upright_world (4, 4) by the shortest turn: gravity (3,), in the world, points along −z of what is upright."""
    up = -gravity / np.linalg.norm(gravity)
    axis, cosine = np.cross(up, [0.0, 0.0, 1.0]), float(up[2])
    sine = float(np.linalg.norm(axis))
    # Upside down every axis across is as short a way.
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    T = np.eye(4)
    T[:3, :3] = so3.exp(np.arctan2(sine, cosine) * axis)
    return T


def turned(T_upright_world: FloatArray, spline: Spline) -> Spline:
    """T_upright_body(t) of T_world_body(t)."""
    return Spline(T_upright_world @ spline.control_points, spline.t0, spline.dt, spline.first)


def _summary(found: dict[str, Any], when: str) -> str:
    biases = f"{_vector(found['gyro_bias'])} rad/s and {_vector(found['accel_bias'])} m/s²"
    return f"IMU: gravity known to {found['gravity_sigma_deg']:.2f}°{when}, biases {biases}"


def _contradiction(found: dict[str, Any]) -> str:
    if not found["T_imu_depth_is_contradicted"]:
        return ""
    degrees = np.degrees(np.linalg.norm(found["T_imu_depth_turn"]))
    return (
        f"\nIMU: turned by {degrees:.2f}° from where T_imu_depth has it, which the track takes into account; "
        "rstrack calibrate SEQ --free imu writes one that fits"
    )


def _vector(values: list[float]) -> str:
    return "(" + ", ".join(f"{value:.4f}" for value in values) + ")"
