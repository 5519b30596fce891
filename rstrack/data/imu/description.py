"""What is known of an IMU beside its samples: an imu.yaml as Kalibr has it, a sensor.yaml of EuRoC, or a sequence.yaml.

imu.yaml (Kalibr's wiki, "Yaml formats", or its results with everything below one entry imu0), with entries of our own:

    accelerometer_noise_density: 2.0e-3    # m/s²/√Hz        T_imu_depth: [[...], ...]    # or Kalibr's T_cam_imu (4x4)
    accelerometer_random_walk: 3.0e-3      # m/s³/√Hz        offset_s: 0.004              # added to the IMU's stamps
    gyroscope_noise_density: 1.7e-4        # rad/s/√Hz       drift_ppm: 12                # by which that grows
    gyroscope_random_walk: 1.9e-5          # rad/s²/√Hz      gyroscope_range: 34.9        # rad/s; accelerometer_range
    update_rate: 200.0                     # Hz              gyroscope_matrix: [[...], ...]      # true to measured
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, validated
from rsgen.files import parse_yaml, read_text, read_yaml
from rsgen.geometry import se3
from rsgen.limits import rigid
from rstrack.data.foreign_camera_files import is_camchain, read_camchain
from rstrack.data.rig import rigid_transform


@dataclass(frozen=True)
class ImuNoise:
    """Densities as Kalibr states them (its wiki, "IMU Noise Model"), per axis.

    gyro_density rad/s/√Hz, gyro_walk rad/s²/√Hz, accel_density m/s²/√Hz, accel_walk m/s³/√Hz. gyro_range (rad/s) and
    accel_range (m/s²): the largest readings of an axis, where the IMU saturates; None: not known.
    """

    gyro_density: float
    gyro_walk: float
    accel_density: float
    accel_walk: float
    gyro_range: float | None = None
    accel_range: float | None = None


EXAMPLE = "T_imu_depth: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
PHONE = ImuNoise(gyro_density=1.3e-4, gyro_walk=2.0e-5, accel_density=1.4e-3, accel_walk=2.0e-4)
"""What an IMU is taken for of which nothing is known: a phone's, twice as noisy as an LSM6DSO (preset phone)."""
STANDARD_GRAVITY = 9.80665
# How far rows of a rotation in a foreign file may be from orthonormal: Kalibr writes 8 digits and more, hands 4.
_RIGID = 1e-3
DENSITIES = (
    "accelerometer_noise_density", "accelerometer_random_walk", "gyroscope_noise_density", "gyroscope_random_walk",
)  # fmt: skip
"""Kalibr's names of what `ImuNoise` holds."""
# Entries of Kalibr's files that say nothing that is needed here.
_KALIBR = ("rostopic", "time_offset", "T_i_b")

Density = Annotated[float, Field(ge=0, le=1e3, allow_inf_nan=False)]
Range = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Vector3 = tuple[Finite, Finite, Finite]
Matrix3 = tuple[Vector3, Vector3, Vector3]


@dataclass(frozen=True)
class ImuDescription:
    """What is known of an IMU. source: where it is stated. None: not stated there.

    T_imu_depth (4, 4); T_cam_imu (4, 4): IMU to colour camera, Kalibr's way to say the same. offset_s, drift: added to
    the IMU's stamps, see `ImuFiles`. gyro_matrix, accel_matrix (3, 3): take the true value to the measured one.
    """

    source: str
    noise: ImuNoise | None = None
    rate_hz: float | None = None
    T_imu_depth: FloatArray | None = None
    T_cam_imu: FloatArray | None = None
    gravity: float = STANDARD_GRAVITY
    offset_s: float = 0.0
    drift: float = 0.0
    gyro_matrix: FloatArray | None = None
    accel_matrix: FloatArray | None = None

    def extrinsics(self, T_color_depth: FloatArray) -> FloatArray | None:
        """T_imu_depth (4, 4), None where it is not stated. T_color_depth (4, 4): depth to colour camera."""
        if self.T_imu_depth is None and self.T_cam_imu is not None:
            return se3.inverse(self.T_cam_imu) @ T_color_depth
        return self.T_imu_depth


class _ImuYaml(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    accelerometer_noise_density: Density | None = None
    accelerometer_random_walk: Density | None = None
    gyroscope_noise_density: Density | None = None
    gyroscope_random_walk: Density | None = None
    update_rate: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None
    accelerometer_range: Range | None = None
    gyroscope_range: Range | None = None
    T_imu_depth: Any = None
    T_cam_imu: Any = None
    gravity: Annotated[float, Field(gt=0, le=1e3, allow_inf_nan=False)] = STANDARD_GRAVITY
    offset_s: Annotated[float, Field(ge=-1e12, le=1e12, allow_inf_nan=False)] = 0.0
    drift_ppm: Annotated[float, Field(ge=-1e4, le=1e4, allow_inf_nan=False)] = 0.0
    gyroscope_matrix: Matrix3 | None = None
    accelerometer_matrix: Matrix3 | None = None


def read_imu_yaml(path: Path) -> ImuDescription:
    """An imu.yaml, or a camchain-imucam.yaml of Kalibr. Raises UserError, one line: what is wrong in it."""
    data = read_yaml(path)
    if is_camchain(data):
        return _of_camchain(path, data)
    inner = data.get("imu0")
    if len(data) == 1 and isinstance(inner, dict):
        data = inner
    model = data.get("model", "calibrated")
    if model != "calibrated":
        raise UserError(
            f"{path}: model is {str(model)[:40]!r}, of which 'calibrated' is read: give its scale and misalignment as "
            "gyroscope_matrix and accelerometer_matrix (3x3, true to measured), without 'model'"
        )
    kept = {str(key): value for key, value in data.items() if key not in (*_KALIBR, "model")}
    yaml = _validated(path, kept)
    matrices = [_invertible(path, name, getattr(yaml, name)) for name in ("gyroscope_matrix", "accelerometer_matrix")]
    return ImuDescription(
        path.name, _noise(path, yaml), yaml.update_rate, _rigid(path, "T_imu_depth", yaml.T_imu_depth),
        _rigid(path, "T_cam_imu", yaml.T_cam_imu), yaml.gravity, yaml.offset_s, 1e-6 * yaml.drift_ppm, *matrices,
    )  # fmt: skip


def _of_camchain(path: Path, data: dict[str, Any]) -> ImuDescription:
    """Where and when by Kalibr's cameras; how noisy by the imu.yaml beside them, if there is one. Raises UserError."""
    chain = read_camchain(path, data)
    tracked = chain.depth or chain.color
    if tracked.T_cam_imu is None:
        raise UserError(f"{path}: has no T_cam_imu: give the camchain-imucam.yaml of kalibr_calibrate_imu_camera")
    beside = path.with_name("imu.yaml")
    found = read_imu_yaml(beside) if beside.is_file() else ImuDescription(path.name)
    T_imu_depth = se3.inverse(tracked.T_cam_imu)
    return replace(found, source=path.name, T_imu_depth=T_imu_depth, offset_s=-(tracked.shift_s or 0.0))


def of_sequence(path: Path, meta: Mapping[str, Any]) -> ImuDescription | None:
    """What a sequence.yaml, whose content is `meta`, states of its IMU, biases and true errors left out; None without.

    Raises UserError.
    """
    config = meta.get("config")
    section = config.get("imu") if isinstance(config, dict) else None
    if not isinstance(section, dict):
        return None
    names = (*DENSITIES, "accelerometer_range", "gyroscope_range", "T_imu_depth")
    kept = {name: section[name] for name in names if section.get(name) is not None}
    yaml = _validated(path, kept | {"update_rate": section.get("rate_hz")}, "config", "imu")
    try:
        gravity = float(np.linalg.norm(np.array(section.get("gravity", (0.0, -STANDARD_GRAVITY, 0.0)), float)))
    except (TypeError, ValueError):
        gravity = np.nan
    if not np.isfinite(gravity):
        raise UserError(f"{path}: config.imu.gravity: expected three numbers, m/s²")
    T_imu_depth = _rigid(path, "config.imu.T_imu_depth", yaml.T_imu_depth)
    streams = meta.get("streams")
    if T_imu_depth is not None and isinstance(streams, dict) and (streams.get("depth") or {}).get("registered"):
        # What is tracked is the camera that depth was warped into.
        T_color_depth = _rigid(path, "T_color_depth", meta.get("T_color_depth"))
        T_imu_depth = T_imu_depth if T_color_depth is None else T_imu_depth @ se3.inverse(T_color_depth)
    return ImuDescription(path.name, _noise(path, yaml), yaml.update_rate, T_imu_depth, gravity=gravity)


def read_sensor_yaml(path: Path) -> ImuDescription:
    """imu0/sensor.yaml of an EuRoC folder, and its pose against those of the cameras beside. Raises UserError."""
    data = read_asl_yaml(path)
    kept = {name: data[name] for name in DENSITIES if name in data} | {"update_rate": data.get("rate_hz")}
    yaml = _validated(path, kept)
    found = ImuDescription(f"{path.parent.name}/{path.name}", _noise(path, yaml), yaml.update_rate)
    T_body = {name: body_pose(path.parents[1] / name / path.name) for name in ("imu0", "depth0", "cam0")}
    if (T_body_imu := T_body["imu0"]) is None:
        return found
    T_imu_body = se3.inverse(T_body_imu)
    if T_body["depth0"] is not None:
        return replace(found, T_imu_depth=T_imu_body @ T_body["depth0"])
    if T_body["cam0"] is not None:
        return replace(found, T_cam_imu=se3.inverse(T_body["cam0"]) @ T_body_imu)
    return found


def imu_yaml(T_imu_depth: FloatArray | None, noise: ImuNoise | None) -> str:
    """Text of an imu.yaml: what is known of an IMU, as `read_imu_yaml` reads it. T_imu_depth (4, 4)."""
    lines = []
    if noise is not None:
        values = (noise.accel_density, noise.accel_walk, noise.gyro_density, noise.gyro_walk)
        lines += [f"{name}: {value:.6g}" for name, value in zip(DENSITIES, values, strict=True)]
        ranges = (("accelerometer_range", noise.accel_range), ("gyroscope_range", noise.gyro_range))
        lines += [f"{name}: {value:.6g}" for name, value in ranges if value is not None]
    if T_imu_depth is not None:
        lines.append("T_imu_depth:")
        lines += [f"- [{', '.join(f'{x + 0.0:.9f}' for x in row)}]" for row in T_imu_depth]
    return "\n".join([*lines, ""])


def body_pose(path: Path) -> FloatArray | None:
    """T_body_sensor (4, 4) of a sensor.yaml of EuRoC; None where there is no such file. Raises UserError."""
    if not path.is_file():
        return None
    try:
        return rigid(np.array(read_asl_yaml(path)["T_BS"]["data"], float).reshape(4, 4), _RIGID)
    except (KeyError, TypeError, ValueError):
        raise UserError(
            f"{path}: T_BS is missing, or no rigid transform: expected 'T_BS: {{data: [16 numbers]}}'"
        ) from None


def read_asl_yaml(path: Path) -> dict[str, Any]:
    """A sensor.yaml of EuRoC, which begins as OpenCV writes: YAML 1.0 by name. Raises UserError."""
    text = read_text(path)
    if not text.startswith("%YAML"):
        return read_yaml(path)
    try:
        data = parse_yaml(text.partition("\n")[2].lstrip("-\n"))
    except Exception as error:  # of a YAML library: what is not YAML shows in many ways
        raise UserError(f"{path}: is not valid YAML ({type(error).__name__})") from None
    return data if isinstance(data, dict) else {}


def _noise(path: Path, yaml: _ImuYaml) -> ImuNoise | None:
    """None where nothing is stated; all four or none. Raises UserError."""
    stated: dict[str, float | None] = {name: getattr(yaml, name) for name in DENSITIES}
    missing = [name for name, value in stated.items() if value is None]
    if len(missing) == len(stated):
        ranges = yaml.gyroscope_range, yaml.accelerometer_range
        return None if ranges == (None, None) else replace(PHONE, gyro_range=ranges[0], accel_range=ranges[1])
    # An accelerometer has no gyroscope's noise.
    if missing and missing != list(DENSITIES[2:]):
        raise UserError(f"{path}: {missing[0]}: is missing: give all four densities, in Kalibr's units, or none")
    accel, accel_walk, gyro, gyro_walk = (0.0 if value is None else value for value in stated.values())
    if missing:
        gyro, gyro_walk = PHONE.gyro_density, PHONE.gyro_walk
    return ImuNoise(gyro, gyro_walk, accel, accel_walk, yaml.gyroscope_range, yaml.accelerometer_range)


def _rigid(path: Path, name: str, value: Any) -> FloatArray | None:
    return None if value is None else rigid_transform(f"{path}: {name}", value)


def _invertible(path: Path, name: str, value: Matrix3 | None) -> FloatArray | None:
    if value is None:
        return None
    matrix = np.array(value)
    if not np.linalg.det(matrix) > 1e-3:
        raise UserError(f"{path}: {name}: must be a scale and a misalignment, near the identity, got {value[0]}, ...")
    return matrix


def _validated(path: Path, data: Mapping[str, Any], *within: str) -> _ImuYaml:
    """within: the entries that it lies in, for messages. Raises UserError."""
    return validated(_ImuYaml.model_validate, data, path, *within, unknown="see docs/format.md, imu.yaml")
