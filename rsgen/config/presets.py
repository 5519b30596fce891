"""Cameras by name: `preset: kinect_v1` in a config fills in whatever the config does not say itself."""

from __future__ import annotations

from typing import Any, Literal, get_args

Preset = Literal["kinect_v1"]

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
        "driver": {"offset_s": 0.008, "jitter_s": 0.0016, "grid_s": 0.004, "dropped": 0.002, "repeated": 0.001},
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
        "driver": {"offset_s": 0.030, "jitter_s": 0.0016, "grid_s": 0.004, "dropped": 0.002},
    },
    "T_color_depth": [[1, 0, 0, -0.025], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    "tremor": {"rotation_deg": 0.05, "position_m": 0.0003},
}
_PRESETS: dict[str, dict[str, Any]] = {"kinect_v1": _KINECT_V1}
assert set(_PRESETS) == set(get_args(Preset))


def with_preset(data: dict[str, Any]) -> dict[str, Any]:
    """A config's data with what its `preset` says wherever the data say nothing; null switches a section off."""
    name = data.get("preset")
    return _merged(_PRESETS[name], data) if isinstance(name, str) and name in _PRESETS else data


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    both = below | above
    for key in below.keys() & above.keys():
        if isinstance(below[key], dict) and isinstance(above[key], dict):
            both[key] = _merged(below[key], above[key])
    return both
