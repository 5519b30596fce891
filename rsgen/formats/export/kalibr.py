"""Kalibr's calibration files of a sequence: camchain.yaml with `line_delay`, imu.yaml, and for a target all it needs.

Names and checks after Kalibr's `kalibr_common/ConfigReader.py`; formats: its wiki, "Yaml formats". Images and IMU as
`kalibr_bagcreater` reads them: cam0/STAMP.png and imu0.csv, nanoseconds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rsgen.array_types import FloatArray
from rsgen.config.sections import ImuConfig
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml
from rsgen.formats.export.shared import (
    DEFAULTS,
    EPOCH_S,
    ExportOptions,
    four_coefficients,
    new_folder,
    place_images,
)
from rsgen.geometry import se3
from rsgen.geometry.aprilgrid import AprilGrid
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sensors.imu import nanoseconds, write_imu_csv
from rsgen.sensors.reports import SequenceImu, sequence_imu, sequence_target
from rsgen.sequence.images import ImageStream, Rig

IMU_TOPIC = "/imu0"
_MODELS = {"pinhole": "radtan", "radtan": "radtan", "rational": "radtan", "fisheye": "equidistant"}


def export_kalibr(sequence: Rig, out: Path, options: ExportOptions = DEFAULTS, progress: Progress = no_progress) -> str:
    """Write camchain.yaml, and imu.yaml where the sequence has an IMU, into the new folder `out`; returns one line.

    Where a target is in the scene, also target.yaml, images of colour (cam0/STAMP.png) or of a rig's colour and grey
    cameras, and imu0.csv, their stamps EPOCH_S later. Images are hard links, or copies with options.copy.
    cam0 is the colour camera, cam1 the depth camera; of a rig they are its cameras in their order. line_delay: s from
    one row to the next (negative from bottom to top). timeshift_cam_imu takes a stamp to row 0's mid-exposure
    (t_imu = t_cam + shift): row v is exposed at stamp + timeshift_cam_imu + v · line_delay. Raises UserError for what
    Kalibr has no words for (k3, columns read one by one), and if `out` is there and not empty.
    """
    imu, target = sequence_imu(sequence), sequence_target(sequence)
    chain = camchain(sequence, imu)
    new_folder(out)
    atomic_write(out / "camchain.yaml", encode_yaml(chain))
    written, note = ["camchain.yaml"], "" if imu else " (the sequence has no IMU)"
    if imu:
        atomic_write(out / "imu.yaml", encode_yaml(imu_yaml(imu.config)))
        written.append("imu.yaml")
        zero = [name for name in _DENSITIES if getattr(imu.config, name) == 0.0]
        note = f"; Kalibr itself refuses a {zero[0]} of 0" if zero else ""
    if target:
        atomic_write(out / "target.yaml", encode_yaml(target_yaml(target.grid)))
        written.append("target.yaml")
        for name, stream in zip(chain, sequence.streams.values(), strict=True):
            if not stream.is_depth:
                new_folder(out / name)
                files = [f"{ns}.png" for ns in nanoseconds(stream.listed, EPOCH_S)]
                place_images(stream.paths, out / name, options.copy, progress, files)
                written.append(f"{name}/ with {len(files)} images")
        if imu:
            write_imu_csv(out / "imu0.csv", imu.samples, EPOCH_S)
            written.append("imu0.csv")
    progress("export", 1.0, written[-1])
    return f"{out}: {', '.join(written)}{note}"


def target_yaml(grid: AprilGrid) -> dict[str, Any]:
    """Content of target.yaml."""
    return {
        "target_type": "aprilgrid",
        "tagCols": grid.columns,
        "tagRows": grid.rows,
        "tagSize": grid.tag_size_m,
        "tagSpacing": grid.spacing,
    }


def camchain(sequence: Rig, imu: SequenceImu | None) -> dict[str, Any]:
    """Content of camchain.yaml; with extrinsics and time shift to the IMU where there is one. Raises UserError."""
    streams = list(sequence.streams.values())
    cameras: dict[str, Any] = {}
    for k, stream in enumerate(streams):
        others = [i for i in (k - 1, k + 1) if 0 <= i < len(streams)]
        cameras[f"cam{k}"] = _camera(stream, f"/cam{k}/image_raw") | {"cam_overlaps": others}
        if k:
            before = streams[k - 1]
            cameras[f"cam{k}"] |= {"T_cn_cnm1": _matrix(stream.T_cam_body @ se3.inverse(before.T_cam_body))}
        if imu is not None:
            T_cam_imu = stream.T_cam_body @ imu.config.T_depth_imu()
            first_s, _ = row_clock(stream.name, stream.camera, stream.shutter)
            shift = first_s + imu.faults.clock_offset_s
            cameras[f"cam{k}"] |= {"T_cam_imu": _matrix(T_cam_imu), "timeshift_cam_imu": shift}
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


def _camera(stream: ImageStream, topic: str) -> dict[str, Any]:
    camera = stream.camera
    pinhole = [camera.fx, camera.fy, camera.cx, camera.cy]
    if camera.model == "double_sphere":
        lens = {"camera_model": "ds", "intrinsics": [*camera.distortion, *pinhole], "distortion_model": "none"}
        bent: list[float] = []
    else:
        lens = {"camera_model": "pinhole", "intrinsics": pinhole, "distortion_model": _MODELS[camera.model]}
        bent = four_coefficients(stream.name, camera)
    return {
        **lens,
        "distortion_coeffs": bent,
        "resolution": [camera.width, camera.height],
        "rostopic": topic,
        "line_delay": row_clock(stream.name, camera, stream.shutter)[1],
    }


def row_clock(name: str, camera: Camera, shutter: Shutter) -> tuple[float, float]:
    """first, delay in s: mid-exposure of image row v is at stamp + first + v · delay; delay < 0 from bottom to top.

    Raises UserError for a camera, called `name`, that is read column by column.
    """
    if shutter.readout_s == 0.0:
        return -0.5 * shutter.exposure_s, 0.0
    if not shutter.by_rows:
        raise UserError(
            f"{name}: scan {shutter.scan} reads columns, but a line_delay belongs to rows: render with top-bottom"
        )
    rows = [[0.0, 0.0], [0.0, 1.0]]
    first, second = shutter.line_mid_time(0.0, shutter.line_of_pixel(rows, camera), camera)
    return float(first), float(second - first)


def _matrix(T: FloatArray) -> list[list[float]]:
    return [[float(value) + 0.0 for value in row] for row in T]  # no negative zeros
