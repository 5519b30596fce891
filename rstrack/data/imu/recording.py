"""An inertial measurement unit's samples, and what is known of the unit beforehand."""

from __future__ import annotations

from dataclasses import dataclass

from rsgen.array_types import FloatArray


@dataclass(frozen=True)
class ImuNoise:
    """Densities as Kalibr states them (its wiki, "IMU Noise Model"), per axis.

    gyro_density rad/s/√Hz, gyro_walk rad/s²/√Hz, accel_density m/s²/√Hz, accel_walk m/s³/√Hz. gyro_range (rad/s) and
    accel_range (m/s²): the largest readings of an axis, where the unit saturates; None: not known.
    """

    gyro_density: float
    gyro_walk: float
    accel_density: float
    accel_walk: float
    gyro_range: float | None = None
    accel_range: float | None = None


@dataclass(frozen=True)
class ImuRecording:
    """n samples of one unit fixed to the depth camera, in the order of time.

    t (n,): s, on the clock of the images' stamps as far as it is known. gyro (n, 3): angular rate, rad/s; None where
    there is no gyroscope. accel (n, 3): specific force a − g, m/s²: at rest it reads −g. Both in the IMU's frame, at
    its own place. T_imu_depth (4, 4): p_imu from p_depth. gravity: its strength, m/s²; its direction in the tracker's
    world is not known beforehand.
    """

    t: FloatArray
    gyro: FloatArray | None
    accel: FloatArray
    noise: ImuNoise
    T_imu_depth: FloatArray
    rate_hz: float
    gravity: float = 9.80665
