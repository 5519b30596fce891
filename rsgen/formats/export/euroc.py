"""A sequence as an EuRoC/ASL folder `mav0/` (Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016).

    mav0/body.yaml
    mav0/cam0/    data/STAMP.png (colour), data.csv, sensor.yaml       cam1 ... of a rig
    mav0/depth0/  data/STAMP.png (16-bit), data.csv, sensor.yaml       depth1 ... of a rig
    mav0/imu0/    data.csv, sensor.yaml                                where the sequence has an IMU
    mav0/state_groundtruth_estimate0/  data.csv, sensor.yaml           pose, velocity and biases of the body

The body is the IMU, without one the sequence's: the depth camera, or the body of a rig. EuRoC has one stamp an image
and no time of a row: the stamp stays ours, the end of line 0's exposure, and sensor.yaml has an entry of our own,
`rolling_shutter`, with the rest. The world is the sequence's: gravity need not point along −z as in EuRoC's own sets;
`body.yaml` has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.sections import ImuConfig
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, write_lines
from rsgen.formats.export.shared import (
    DEFAULTS,
    EPOCH_S,
    ExportOptions,
    counted,
    four_coefficients,
    image_streams,
    new_folder,
    part_of,
    place_images,
)
from rsgen.geometry import se3
from rsgen.sensors.imu import ImuSamples, nanoseconds, write_imu_csv
from rsgen.sensors.reports import sequence_imu
from rsgen.sequence.format import ground_truth, pose_rows
from rsgen.sequence.images import ImageStream, Rig, Sequence

_MODELS = {"pinhole": "radial-tangential", "fisheye": "equidistant"} | dict.fromkeys(
    ("radtan", "rational"), "radial-tangential"
)
_TRUTH = "state_groundtruth_estimate0"
_TRUTH_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], "
    "b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], "
    "b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)


def export_euroc(
    sequence: Rig,
    out: Path,
    options: ExportOptions = DEFAULTS,
    progress: Progress = no_progress,
    epoch_s: int = EPOCH_S,
) -> str:
    """Write `out`/mav0; returns one line. Images are hard links, or copies with options.copy.

    epoch_s: whole seconds added to all stamps. Raises UserError if `out`/mav0 is there and not empty, if a stamp is
    negative, if a stream's distortion does not fit EuRoC's four coefficients, or if the disk refuses.
    """
    imu = sequence_imu(sequence)
    T_depth_body = imu.config.T_depth_imu() if imu else np.eye(4)
    root = Path(out) / "mav0"
    streams = image_streams(sequence)
    sensors = {
        name: (streams[own], se3.inverse(streams[own].T_cam_body @ T_depth_body))
        for name, own in sensor_names(streams).items()
    }
    described = {name: _camera_yaml(stream, T_BS) for name, (stream, T_BS) in sensors.items()}
    stamps = {name: nanoseconds(stream.listed, epoch_s) for name, (stream, _) in sensors.items()}
    times = imu.samples.t if imu else ground_truth(sequence.spline)[:, 0]
    if min(*(ns[0] for ns in stamps.values()), nanoseconds(times[:1], epoch_s)[0]) < 0:
        raise UserError(f"{out}: EuRoC's stamps cannot be negative: give an epoch of a second or more")

    new_folder(root, *(f"{name}/data" for name in sensors), _TRUTH, *(["imu0"] if imu else []))
    frame = "the IMU" if imu else "the depth camera" if isinstance(sequence, Sequence) else "that of the rig"
    body: dict[str, Any] = {"comment": f"rsgen {sequence.name}: the body is {frame}", "epoch_s": epoch_s}
    atomic_write(root / "body.yaml", encode_yaml(body | ({"gravity": list(imu.config.gravity)} if imu else {})))
    truth = truth_csv(sequence, times, T_depth_body, imu.samples if imu else None, epoch_s)
    atomic_write(root / _TRUTH / "data.csv", truth)
    truth_sensor = {
        "sensor_type": "visual-inertial",
        "comment": "rsgen: exact, from the spline",
        "T_BS": _matrix(np.eye(4)),
    }
    atomic_write(root / _TRUTH / "sensor.yaml", encode_yaml(truth_sensor))
    if imu:
        write_imu_csv(root / "imu0" / "data.csv", imu.samples, epoch_s)
        atomic_write(root / "imu0" / "sensor.yaml", encode_yaml(_imu_yaml(imu.config)))
    for k, (name, (stream, _)) in enumerate(sensors.items()):
        write_lines(root / name / "data.csv", ["#timestamp [ns],filename", *(f"{ns},{ns}.png" for ns in stamps[name])])
        atomic_write(root / name / "sensor.yaml", encode_yaml(described[name]))
        part = part_of(progress, k / len(sensors), (k + 1) / len(sensors))
        place_images(stream.paths, root / name / "data", options.copy, part, [f"{ns}.png" for ns in stamps[name]])
    return f"{root}: {counted(streams)}, {f'{len(times)} IMU samples' if imu else 'no IMU'}, stamps + {epoch_s} s"


def sensor_names(streams: Mapping[str, ImageStream]) -> dict[str, str]:
    """EuRoC's names of sensors, cam0 ... and depth0 ..., each with that of its stream."""
    names: dict[str, str] = {}
    for kind, is_depth in (("cam", False), ("depth", True)):
        of_kind = [name for name, stream in streams.items() if stream.is_depth == is_depth]
        names |= {f"{kind}{k}": name for k, name in enumerate(of_kind)}
    return names


def truth_csv(
    sequence: Rig, t: FloatArray, T_depth_body: FloatArray, imu: ImuSamples | None, epoch_s: int = 0
) -> bytes:
    """EuRoC's ground truth at times t (n,) s: the body's pose, its velocity in the world, and the IMU's biases.

    T_depth_body (4, 4): body to depth-camera coordinates. Biases are those of `imu`, whose times are t; zero without.
    """
    T_world_depth, twist = sequence.spline.pose_and_velocity(t)
    T_world_body = T_world_depth @ T_depth_body
    v_body = (twist @ se3.adjoint(se3.inverse(T_depth_body)).T)[:, :3]
    v_world = np.einsum("nij,nj->ni", T_world_body[:, :3, :3], v_body)
    rows = pose_rows(T_world_body)[:, [0, 1, 2, 6, 3, 4, 5]]
    biases = np.zeros((len(t), 6)) if imu is None else np.column_stack([imu.gyro_bias, imu.accel_bias])
    table = np.column_stack([rows, v_world, biases]).tolist()
    lines = [
        ",".join([str(stamp), *(f"{value:.12f}" for value in row)])
        for stamp, row in zip(nanoseconds(t, epoch_s), table, strict=True)
    ]
    return "\n".join([_TRUTH_HEADER, *lines, ""]).encode()


def _camera_yaml(stream: ImageStream, T_BS: FloatArray) -> dict[str, Any]:
    camera, shutter = stream.camera, stream.shutter
    coefficients = four_coefficients(stream.name, camera)
    data: dict[str, Any] = {
        "sensor_type": "camera",
        "comment": f"rsgen {stream.name}; stamps are the end of line 0's exposure, see rolling_shutter",
        "T_BS": _matrix(T_BS),
        "rate_hz": stream.rate_hz,
        "resolution": [camera.width, camera.height],
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": _MODELS[camera.model],
        "distortion_coefficients": coefficients,
        "rolling_shutter": {
            "readout_s": shutter.readout_s,
            "exposure_s": shutter.exposure_s,
            "line_delay_s": shutter.line_delay(camera),
            "scan": shutter.scan,
        },
    }
    return data | ({"depth_scale": stream.depth_scale} if stream.depth_scale else {})


def _imu_yaml(imu: ImuConfig) -> dict[str, Any]:
    return {
        "sensor_type": "imu",
        "comment": "rsgen: the body frame",
        "T_BS": _matrix(np.eye(4)),
        "rate_hz": imu.rate_hz,
        "gyroscope_noise_density": imu.gyroscope_noise_density,
        "gyroscope_random_walk": imu.gyroscope_random_walk,
        "accelerometer_noise_density": imu.accelerometer_noise_density,
        "accelerometer_random_walk": imu.accelerometer_random_walk,
    }


def _matrix(T: FloatArray) -> dict[str, Any]:
    return {"cols": 4, "rows": 4, "data": [float(value) + 0.0 for value in T.ravel()]}  # no negative zeros
