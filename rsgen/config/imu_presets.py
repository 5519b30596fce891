"""IMUs by name: `imu: {preset: phone}` fills in whatever the section does not say itself.

White noise, ranges and the drift with temperature are of data sheets; bias walks and how far they warm up are assumed.
Biases are what is left after the customary calibration at rest. Scale and misalignment stay exact: set the matrices.
"""

from __future__ import annotations

import math
from typing import Any, Literal, get_args

ImuPreset = Literal["phone", "d435i", "euroc"]

_G, _DEG = 9.80665, math.pi / 180.0
# By how much a unit warms up while it records, K; with a time constant of a minute and a half.
_WARMS_K, _WARMUP_S = 5.0, 90.0

# ST's LSM6DSO, as many phones have it: 3.8 mdps and 70 µg a √Hz, 0.010 dps and 0.1 mg a K. Android's axes (x right,
# y up, z out of the screen) in a phone held upright, whose depth camera looks out of its back, 5 cm above, 1 cm beside.
_PHONE: dict[str, Any] = {
    "rate_hz": 200.0,
    "T_imu_depth": [[1, 0, 0, -0.01], [0, -1, 0, 0.05], [0, 0, -1, -0.004], [0, 0, 0, 1]],
    "gyroscope_noise_density": 6.6e-5,
    "gyroscope_random_walk": 1.0e-5,
    "accelerometer_noise_density": 6.9e-4,
    "accelerometer_random_walk": 1.0e-4,
    "gyroscope_bias": [0.010, -0.007, 0.005],
    "accelerometer_bias": [0.12, -0.18, 0.09],
    "gyroscope_range": 2000 * _DEG,
    "accelerometer_range": 8 * _G,
    "warmup_s": _WARMUP_S,
    "gyroscope_warmup": _WARMS_K * 0.010 * _DEG,
    "accelerometer_warmup": _WARMS_K * 1e-4 * _G,
    "jitter_s": 5e-5,
    "dropped": 5e-4,
}
# Bosch's BMI055 in a RealSense D435i: 0.014 dps and 150 µg a √Hz, 0.015 dps and 1 mg a K; axes as the depth camera's,
# where librealsense's nominal extrinsics have it; one stream, gyroscope and accelerometer together.
_D435I: dict[str, Any] = {
    "rate_hz": 200.0,
    "T_imu_depth": [[1, 0, 0, -0.00552], [0, 1, 0, 0.0051], [0, 0, 1, 0.01174], [0, 0, 0, 1]],
    "gyroscope_noise_density": 2.44e-4,
    "gyroscope_random_walk": 1.5e-5,
    "accelerometer_noise_density": 1.47e-3,
    "accelerometer_random_walk": 2.0e-4,
    "gyroscope_bias": [-0.004, 0.002, 0.0015],
    "accelerometer_bias": [0.20, -0.10, 0.25],
    "gyroscope_range": 1000 * _DEG,
    "accelerometer_range": 4 * _G,
    "warmup_s": _WARMUP_S,
    "gyroscope_warmup": _WARMS_K * 0.015 * _DEG,
    "accelerometer_warmup": _WARMS_K * 1e-3 * _G,
    "jitter_s": 2e-5,
}
# Analog Devices' ADIS16448 in EuRoC's rig (Burri et al., IJRR 2016): densities of its sensor.yaml, place as its cam0's,
# biases like V1_01's; 0.005 dps and 0.15 mg a K.
_EUROC: dict[str, Any] = {
    "rate_hz": 200.0,
    "T_imu_depth": [[0, -1, 0, -0.0216], [1, 0, 0, -0.0647], [0, 0, 1, 0.0098], [0, 0, 0, 1]],
    "gyroscope_noise_density": 1.6968e-4,
    "gyroscope_random_walk": 1.9393e-5,
    "accelerometer_noise_density": 2.0e-3,
    "accelerometer_random_walk": 3.0e-3,
    "gyroscope_bias": [-0.002, 0.021, 0.077],
    "accelerometer_bias": [-0.013, 0.100, 0.069],
    "gyroscope_range": 1000 * _DEG,
    "accelerometer_range": 18 * _G,
    "warmup_s": _WARMUP_S,
    "gyroscope_warmup": _WARMS_K * 0.005 * _DEG,
    "accelerometer_warmup": _WARMS_K * 1.5e-4 * _G,
}
_PRESETS: dict[str, dict[str, Any]] = {"phone": _PHONE, "d435i": _D435I, "euroc": _EUROC}
assert set(_PRESETS) == set(get_args(ImuPreset))


def with_imu_preset(data: Any) -> Any:
    """A section's data with what its `preset` says wherever they say nothing."""
    name = data.get("preset") if isinstance(data, dict) else None
    return _PRESETS[name] | data if isinstance(name, str) and name in _PRESETS else data
