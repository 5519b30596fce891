"""A run's estimate of its IMU, for run.json and in a line on the screen; and a world that stands upright."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import chi2

from rsgen.array_types import FloatArray
from rsgen.geometry import so3
from rsgen.geometry.spline import Spline
from rstrack.inertial.estimate import ACCEL, GRAVITY, GYRO, TURN, ImuEstimate
from rstrack.inertial.inertia import Inertia

# χ² of three numbers that chance exceeds once in 10⁵, and a turn, rad, that is worth saying.
_BEYOND, _WORTH_SAYING = float(chi2.isf(1e-5, 3)), np.radians(0.1)


def record(inertia: Inertia) -> dict[str, Any]:
    """The estimate at the end, and when it was known (s)."""
    known = {"usable_s": _known(inertia.usable_s), "gravity_determined_s": _known(inertia.determined_s)}
    return known | estimate_dict(inertia.estimate, inertia.sigma)


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
    """One line of `record`; begin: stamp (s) of the run's first frame. bridged: frames whose pose is the IMU's."""
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


def _known(seconds: float) -> float | None:
    return seconds if np.isfinite(seconds) else None


def _vector(values: list[float]) -> str:
    return "(" + ", ".join(f"{value:.4f}" for value in values) + ")"
