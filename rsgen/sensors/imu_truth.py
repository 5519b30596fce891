"""What is true of an IMU's samples and of the unit: truth/imu.csv, and truth/imu.yaml as `rstrack` reads it.

They are there where the samples are more than the spline's with noise and walking biases (`ImuConfig.has_truth`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.faults import ImuFaults
from rsgen.config.imu import ImuConfig
from rsgen.geometry import se3
from rsgen.sensors.imu import ImuSamples, nanoseconds

IMU_TRUTH_CSV, IMU_TRUTH_YAML = "truth/imu.csv", "truth/imu.yaml"
IMU_TRUTH_HEADER = (
    "#taken [ns],timestamp [ns],b_w_x [rad s^-1],b_w_y [rad s^-1],b_w_z [rad s^-1],"
    "b_a_x [m s^-2],b_a_y [m s^-2],b_a_z [m s^-2]"
)
"""First line of truth/imu.csv: when each sample of imu.csv was taken, its stamp, and the biases in it."""

_SAME = (
    "accelerometer_noise_density", "accelerometer_random_walk", "gyroscope_noise_density", "gyroscope_random_walk",
    "accelerometer_range", "gyroscope_range",
)  # fmt: skip
_MATRICES = "gyroscope_matrix", "accelerometer_matrix"


def imu_truth_csv(samples: ImuSamples) -> str:
    """Text of truth/imu.csv."""
    biases = np.column_stack([samples.gyro_bias, samples.accel_bias]).tolist()
    lines = [
        ",".join([str(taken), str(stamp), *(f"{value:.12g}" for value in row)])
        for taken, stamp, row in zip(nanoseconds(samples.t), nanoseconds(samples.stamps), biases, strict=True)
    ]
    return "\n".join([IMU_TRUTH_HEADER, *lines, ""])


def imu_truth_yaml(
    config: ImuConfig, faults: ImuFaults | None, start: float, middle: float, T_image_depth: FloatArray
) -> dict[str, Any]:
    """Content of truth/imu.yaml.

    start: true time of the first sample, s, at which faults.clock_offset_s holds. middle: the stamp of the middle depth
    image, s, at which that file's offset does. T_image_depth (4, 4): the depth images' camera, of registered ones.
    """
    faults = faults or ImuFaults()
    drift = 1e-6 * faults.clock_drift_ppm
    taken = start + (middle - faults.clock_offset_s - start) / (1.0 + drift)  # what is stamped `middle`
    T_imu_depth = se3.inverse(config.T_depth_imu()) @ se3.inverse(T_image_depth)
    return {
        **{name: value for name in _SAME if (value := getattr(config, name)) is not None},
        "update_rate": config.rate_hz,
        "T_imu_depth": [[float(x) + 0.0 for x in row] for row in T_imu_depth],
        "offset_s": taken - middle,
        "drift_ppm": -1e6 * drift / (1.0 + drift) + 0.0,
        **{name: [list(row) for row in getattr(config, name)] for name in _MATRICES},
    } | ({"gravity": float(np.linalg.norm(config.gravity))} if any(config.gravity) else {})
