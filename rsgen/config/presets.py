"""Cameras and IMUs by name: a `preset` fills in whatever a config does not set itself."""

from __future__ import annotations

import math
from typing import Any, Literal, get_args

Preset = Literal["kinect_v1", "xtion"]

# A Microsoft Kinect of 2010 under OpenNI, hand-held, as TUM's fr1 sequences have it. Colour: the benchmark's own
# calibration (Sturm et al., IROS 2012). Infrared camera: OpenNI's nominal lens, which seen through that colour lens has
# the borders of fr1_rpy's registered depth to 10 px; its projector, of a wider field of view, is 7.5 cm beside it, the
# colour camera 2.5 cm, between the two. Periods, grid, jitter and delays of stamps, brightness and its steps as
# measured on fr1_rpy (docs/notebook/real-recordings.md); readouts within the 15 to 30 ms that trials on it allow.
# Lasting depth errors and tremor are assumed; with them its twin is about as hard to track.
_KINECT_V1: dict[str, Any] = {
    "color": {
        "width": 640,
        "height": 480,
        "intrinsics": [517.3, 516.5, 318.6, 255.3],
        "model": "radtan",
        "distortion": [0.2624, -0.9531, -0.0054, 0.0026, 1.1633],
        "rate_hz": 29.998,
        "offset_s": 0.011,
        "readout_s": 0.026,
        "exposure_s": 0.020,
        "exposure_gain": 1.5,
        "noise": {"model": "camera", "gain": 2.0, "bayer": "bilinear", "corner_loss": 0.2},
        "auto_exposure": {
            "dead_band_ev": 0.15,
            "step_ev": 0.3,
            "lag_frames": 4,
            "exposure_s": [0.001, 0.030],
            "gain": [2.0, 8.0],
        },
        "auto_white_balance": {},
    },
    "depth": {
        "width": 640,
        "height": 480,
        "intrinsics": [575.8, 575.8, 319.5, 239.5],
        "rate_hz": 29.968,
        "readout_s": 0.030,
        "exposure_s": 0.010,
        "blur_samples": 5,
        "registered": True,
        "noise": {
            "model": "kinect",
            "projector_width": 1.3,
            "edge_dropout": 0.0,
            "grazing_deg": [80.0, 87.0],
            "lateral_sigma_px": 0.2,
            "disparity_sigma_px": 0.01,
            "scale_error": 0.01,
            "distortion_px": 0.12,
            "pattern_px": 0.01,
        },
    },
    "T_color_depth": [[1, 0, 0, -0.025], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    "tremor": {"rotation_deg": 0.05, "position_m": 0.0003},
    "faults": {
        "color": {"offset_s": 0.008, "jitter_s": 0.0016, "grid_s": 0.004, "dropped": 0.002, "repeated": 0.001},
        "depth": {"offset_s": 0.030, "jitter_s": 0.0016, "grid_s": 0.004, "dropped": 0.002},
    },
}
# An Asus Xtion Pro Live under OpenNI, as TUM's fr3 sequences have it: depth to 10 m, registered; lens of the benchmark,
# which has undistorted its images. Noise as in residuals of 64-px planes in fr3_teddy's depth: 0.085 px RMS, alike to
# 1/e within 5 px (docs/notebook/rigs.md). Readouts and the lasting error are assumed, as for the Kinect.
_XTION: dict[str, Any] = {
    "color": _KINECT_V1["color"]
    | {"intrinsics": [535.4, 539.2, 320.1, 247.6], "model": "pinhole", "distortion": [], "rate_hz": 30.0,
       "readout_s": 0.030},
    "depth": _KINECT_V1["depth"]
    | {
        "rate_hz": 30.0,
        "noise": _KINECT_V1["depth"]["noise"]
        | {"max_range_m": 10.0, "scale_error": 0.0, "distortion_px": 0.05, "region_sigma_px": 0.075, "region_px": 5.0},
    },
    "T_color_depth": _KINECT_V1["T_color_depth"],
    "tremor": _KINECT_V1["tremor"],
    "faults": _KINECT_V1["faults"],
}  # fmt: skip
_PRESETS: dict[str, dict[str, Any]] = {"kinect_v1": _KINECT_V1, "xtion": _XTION}
assert set(_PRESETS) == set(get_args(Preset))


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
_IMU_FAULTS = {"phone": {"jitter_s": 5e-5, "dropped": 5e-4}, "d435i": {"jitter_s": 2e-5}}
_IMU_PRESETS: dict[str, dict[str, Any]] = {"phone": _PHONE, "d435i": _D435I, "euroc": _EUROC}
assert set(_IMU_PRESETS) == set(get_args(ImuPreset))


def with_imu_preset(data: Any) -> Any:
    """A section's data, completed by its `preset`."""
    name = data.get("preset") if isinstance(data, dict) else None
    return _IMU_PRESETS[name] | data if isinstance(name, str) and name in _IMU_PRESETS else data


def with_presets(data: dict[str, Any]) -> dict[str, Any]:
    """A config's data, completed by its presets; null switches a section off."""
    name = data.get("preset")
    data = _merged(_PRESETS[name], data) if isinstance(name, str) and name in _PRESETS else data
    imu = data.get("imu")
    unit = imu.get("preset") if isinstance(imu, dict) else None
    faults = _IMU_FAULTS.get(unit) if isinstance(unit, str) else None
    return data if faults is None else _merged({"faults": {"imu": faults}}, data)


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    both = below | above
    for key in below.keys() & above.keys():
        if isinstance(below[key], dict) and isinstance(above[key], dict):
            both[key] = _merged(below[key], above[key])
    return both
