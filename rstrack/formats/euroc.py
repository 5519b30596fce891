"""EuRoC/ASL folders with depth: mav0/cam0, mav0/depth0 (16-bit PNG), imu0, state_groundtruth_estimate0.

EuRoC itself has no depth; `rsgen export euroc` writes depth0 like a camera, with `depth_scale`, and the lines' times of
both in an entry `rolling_shutter` of sensor.yaml.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.files import listed_file, read_bytes, read_text
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rstrack.data.imu.description import body_pose, read_asl_yaml, read_sensor_yaml
from rstrack.formats.pixels import compressed_color, compressed_depth
from rstrack.formats.recording import (
    ImuSample,
    Item,
    ReadOptions,
    RecordedImage,
    RecordedPose,
    Recording,
    StreamCamera,
    camera_of,
    pose_of,
    with_shutter,
)

_MILLIMETRES = 1000.0
_TRUTH = "state_groundtruth_estimate0"


def matches(path: Path) -> bool:
    """Whether a folder is mav0, or has it."""
    return (_root(path) / "cam0" / "sensor.yaml").is_file()


def read(path: Path, _: ReadOptions) -> Recording:
    """The cameras of a folder; images are read as asked for. Raises UserError, also where there is no depth."""
    root = _root(path)
    if not (root / "depth0" / "sensor.yaml").is_file():
        there = ", ".join(sorted(p.name for p in root.iterdir() if p.is_dir()))
        raise UserError(
            f"{root}: has no depth images (depth0; there are {there}): rstrack tracks colour with depth only"
        )
    sensors = {name: read_asl_yaml(root / name / "sensor.yaml") for name in ("cam0", "depth0")}
    T_body = {name: _on_body(root / name / "sensor.yaml") for name in sensors}
    color, depth = (_camera(root / name / "sensor.yaml", data) for name, data in sensors.items())
    listed = {name: _listed(root, name) for name in sensors}
    T_color_depth = se3.inverse(T_body["cam0"]) @ T_body["depth0"]
    sensor = root / "imu0" / "sensor.yaml"
    imu = read_sensor_yaml(sensor) if sensor.is_file() else None
    scale = sensors["depth0"].get("depth_scale", _MILLIMETRES)
    if not isinstance(scale, int | float) or not 1 <= scale < 1e6:
        raise UserError(f"{root / 'depth0' / 'sensor.yaml'}: depth_scale must lie in 1 to 1e6 units per metre")
    return Recording(
        kind="EuRoC folder",
        color=color,
        depth=depth,
        T_color_depth=T_color_depth,
        depth_scale=float(scale),
        items=_items(root, listed, color.camera, depth.camera, T_body["cam0"]),
        images=sum(len(files) for files in listed.values()),
        truth=f"{_TRUTH} of {root}".replace(str(root), root.name),
        is_measured=True,
        source={"color": "cam0", "depth": "depth0"},
        T_imu_depth=None if imu is None else imu.extrinsics(T_color_depth),
        imu_noise=None if imu is None else imu.noise,
    )


def _root(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path


def _on_body(path: Path) -> FloatArray:
    T_body_sensor = body_pose(path)
    assert T_body_sensor is not None  # the file was read before
    return T_body_sensor


def _camera(path: Path, data: dict[str, Any]) -> StreamCamera:
    try:
        width, height = (int(n) for n in data["resolution"])
        intrinsics = [float(n) for n in data["intrinsics"]]
        coefficients = [float(n) for n in data.get("distortion_coefficients") or ()]
        if len(intrinsics) != 4:
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise UserError(
            f"{path}: expected resolution [w, h], intrinsics [fx, fy, cx, cy], distortion_coefficients"
        ) from None
    camera = camera_of(str(path), width, height, intrinsics, str(data.get("distortion_model", "")), coefficients)
    shutter = data.get("rolling_shutter")
    if not isinstance(shutter, dict):
        return StreamCamera(camera)
    return with_shutter(str(path), camera, shutter)


def _rows(path: Path, least: int) -> list[list[str]]:
    rows = [row for row in csv.reader(read_text(path).splitlines()) if row and not row[0].lstrip().startswith("#")]
    for number, row in enumerate(rows, 1):
        if len(row) < least or not row[0].strip().isdigit():
            raise UserError(f"{path}: row {number}: expected {least} fields, the first a stamp in nanoseconds")
    return [[field.strip() for field in row] for row in rows]


def _listed(root: Path, name: str) -> list[tuple[int, Path]]:
    folder, table = root / name / "data", root / name / "data.csv"
    real = folder.resolve()
    return [
        (int(stamp), listed_file(folder, real, file, str(table), "copy the folder again"))
        for stamp, file, *_ in _rows(table, 2)
    ]


def _numbers(path: Path, row: list[str], count: int) -> list[float]:
    try:
        values = [float(text) for text in row[1 : 1 + count]]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise UserError(f"{path}: stamp {row[0][:30]}: expected {count} numbers")
    return values


def _items(
    root: Path, listed: dict[str, list[tuple[int, Path]]], color: Camera, depth: Camera, T_body_color: FloatArray
) -> Iterator[Item]:
    truth, imu = root / _TRUTH / "data.csv", root / "imu0" / "data.csv"
    for row in _rows(truth, 8) if truth.is_file() else ():
        x, y, z, qw, qx, qy, qz = _numbers(truth, row, 7)
        yield RecordedPose(int(row[0]), pose_of((qx, qy, qz, qw), (x, y, z)) @ T_body_color)
    for row in _rows(imu, 7) if imu.is_file() else ():
        w1, w2, w3, a1, a2, a3 = _numbers(imu, row, 6)
        yield ImuSample(int(row[0]), (w1, w2, w3), (a1, a2, a3))
    for stamp_ns, path in listed["cam0"]:
        data, ending = compressed_color(str(path), read_bytes(path), color)
        yield RecordedImage("color", stamp_ns, data, ending)
    for stamp_ns, path in listed["depth0"]:
        yield RecordedImage("depth", stamp_ns, compressed_depth(str(path), read_bytes(path), "16UC1", depth))
