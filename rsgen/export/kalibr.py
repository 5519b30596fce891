"""Kalibr's calibration files of a sequence: camchain.yaml with `line_delay`, and imu.yaml.

Names and checks after Kalibr's `kalibr_common/ConfigReader.py`; formats: its wiki, "Yaml formats".
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rsgen.array_types import FloatArray
from rsgen.config.imu import ImuConfig
from rsgen.console.progress import Progress, no_progress
from rsgen.export.folder import four_coefficients, new_folder, row_clock, sequence_imu
from rsgen.files import atomic_write, encode_yaml
from rsgen.geometry import se3
from rsgen.sequence.reader import Sequence, Stream

COLOR_TOPIC, DEPTH_TOPIC, IMU_TOPIC = "/cam0/image_raw", "/cam1/image_raw", "/imu0"
_MODELS = {"pinhole": "radtan", "radtan": "radtan", "fisheye": "equidistant"}


def export_kalibr(sequence: Sequence, out: Path, progress: Progress = no_progress) -> str:
    """Write camchain.yaml, and imu.yaml where the sequence has an IMU, into the new folder `out`; returns one line.

    cam0 is the colour camera, cam1 the depth camera. line_delay: s from one row to the next (negative from bottom to
    top). timeshift_cam_imu takes a stamp to row 0's mid-exposure (t_imu = t_cam + shift): row v is exposed at
    stamp + timeshift_cam_imu + v · line_delay. Raises UserError for what Kalibr has no words for (k3, columns read one
    by one), and if `out` is there and not empty.
    """
    imu = sequence_imu(sequence)
    chain = camchain(sequence, imu[0] if imu else None)
    new_folder(out)
    atomic_write(out / "camchain.yaml", encode_yaml(chain))
    if imu is None:
        progress("export", 1.0, "camchain.yaml")
        return f"{out}: camchain.yaml (the sequence has no IMU)"
    atomic_write(out / "imu.yaml", encode_yaml(imu_yaml(imu[0])))
    progress("export", 1.0, "imu.yaml")
    zero = [name for name in _DENSITIES if getattr(imu[0], name) == 0.0]
    note = f"; Kalibr itself refuses a {zero[0]} of 0" if zero else ""
    return f"{out}: camchain.yaml, imu.yaml{note}"


def camchain(sequence: Sequence, imu: ImuConfig | None) -> dict[str, Any]:
    """Content of camchain.yaml; with extrinsics and time shift to the IMU where there is one. Raises UserError."""
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    T_depth_color = se3.inverse(sequence.T_color_depth)
    cameras = {
        "cam0": _camera(color, COLOR_TOPIC) | {"cam_overlaps": [1]},
        "cam1": _camera(depth, DEPTH_TOPIC) | {"cam_overlaps": [0], "T_cn_cnm1": _matrix(T_depth_color)},
    }
    if imu is not None:
        T_depth_imu = imu.T_depth_imu()
        for name, stream, T_cam_depth in (("cam0", color, sequence.T_color_depth), ("cam1", depth, None)):
            T_cam_imu = T_depth_imu if T_cam_depth is None else T_cam_depth @ T_depth_imu
            shift = row_clock(stream.name, stream.camera, stream.shutter).first_s
            cameras[name] |= {"T_cam_imu": _matrix(T_cam_imu), "timeshift_cam_imu": shift}
    return cameras


def imu_yaml(imu: ImuConfig) -> dict[str, Any]:
    """Content of imu.yaml."""
    return {name: float(getattr(imu, name)) for name in _DENSITIES} | {
        "rostopic": IMU_TOPIC,
        "update_rate": float(imu.rate_hz),
    }


_DENSITIES = (
    "accelerometer_noise_density",
    "accelerometer_random_walk",
    "gyroscope_noise_density",
    "gyroscope_random_walk",
)


def _camera(stream: Stream, topic: str) -> dict[str, Any]:
    camera = stream.camera
    return {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": _MODELS[camera.model],
        "distortion_coeffs": four_coefficients(stream.name, camera),
        "resolution": [camera.width, camera.height],
        "rostopic": topic,
        "line_delay": row_clock(stream.name, camera, stream.shutter).delay_s,
    }


def _matrix(T: FloatArray) -> list[list[float]]:
    return [[float(value) + 0.0 for value in row] for row in T]  # no negative zeros
