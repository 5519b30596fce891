"""A sequence as a ROS 1 bag, a ROS 2 bag or an MCAP file, with topics and frames as a RealSense's driver names them.

    /camera/color/image_raw, camera_info           rgb8
    /camera/depth/image_rect_raw, camera_info    32FC1, m, NaN = nothing measured; 16UC1, mm, of a depth_scale of 1000
    /camera/aligned_depth_to_color/image_raw, ...  instead, where depth is registered
    /camera/imu                                    where the sequence has an IMU
    /tf, /ground_truth/pose                        exact T_world_depth (T_world_body of a rig), 200 Hz and at stamps
    /tf_static                                     depth to colour camera, and to the IMU
    /camera/NAME/image_raw (image_rect_raw of depth), camera_info   of every camera of a rig; mono8 of grey ones
    /camera/rolling_shutter, /ground_truth/spline  latched JSON (std_msgs/String): line times; control points

Stamps are the sequence's listed ones in nanoseconds: the end of line 0's exposure. Needs rosbags, an optional extra.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.formats.export.bag import TF, Bag, new_bag
from rsgen.formats.export.poses import Loss, between, loss_of_poses, loss_words, observations, shutter_facts
from rsgen.formats.export.shared import ExportOptions, counted, image_streams
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import nanoseconds
from rsgen.sensors.reports import SequenceImu, sequence_imu
from rsgen.sequence.format import ground_truth, pose_rows, poses_of_rows
from rsgen.sequence.images import ImageStream, Rig, Sequence

COLOR_FRAME, DEPTH_FRAME, IMU_FRAME = (f"camera_{name}_optical_frame" for name in ("color", "depth", "imu"))
WORLD_FRAME, BODY_FRAME = "world", "body"
COLOR_TOPIC, DEPTH_TOPIC = "/camera/color/image_raw", "/camera/depth/image_rect_raw"
ALIGNED_TOPIC = "/camera/aligned_depth_to_color/image_raw"
IMU_TOPIC, SHUTTER_TOPIC = "/camera/imu", "/camera/rolling_shutter"
POSE_TOPIC, SPLINE_TOPIC = "/ground_truth/pose", "/ground_truth/spline"
_LOSS = "tf, interpolated"

Message = tuple[int, Callable[[], None]]


def export_ros(sequence: Rig, out: Path, options: ExportOptions, progress: Progress = no_progress) -> str:
    """Write the bag `out`, whole or not at all; returns one line.

    options.name: ros1 for a .bag, ros2 for a folder, mcap for a file; options.storage: sqlite3 or mcap, of ros2.
    Cameras are those that the sequence declares, poses are true. ROS has no times before 0: what the IMU and the truth
    have before is left out of their topics, not out of the spline. Raises UserError if rosbags is not installed, `out`
    is there or named otherwise, a stamp is negative, or a file cannot be read or written.
    """
    imu = sequence_imu(sequence)
    streams = image_streams(sequence)
    truth = ground_truth(sequence.spline, *(stream.stamps for stream in streams.values()))
    losses, body, of_body = {}, BODY_FRAME, "T_world_body of tf and pose, T_body_cam of tf_static"
    if isinstance(sequence, Sequence):
        losses, body = {_LOSS: loss_of_tf(sequence, truth)}, DEPTH_FRAME
        of_body = "T_world_depth of tf and pose, T_depth_color of tf_static"
    facts = shutter_facts(sequence, losses) | {"poses": of_body}
    firsts = [float(stream.listed[0]) for stream in streams.values()]
    with new_bag(out, options, min(firsts)) as bag:
        start = max(0, min(nanoseconds([*firsts, truth[0, 0]])))
        moved = [s for s in sequence.streams.values() if not (isinstance(sequence, Sequence) and s.is_depth)]
        statics = {_frame(sequence, stream): se3.inverse(stream.T_cam_body) for stream in moved}
        if imu:
            statics[IMU_FRAME] = imu.config.T_depth_imu()
        _write_latched(bag, start, body, statics, facts, sequence.spline)
        sources = [_poses(bag, truth, body), *(_images(bag, sequence, stream) for stream in streams.values())]
        if imu:
            sources.append(_imu(bag, imu))
        images, written = sum(len(stream.paths) for stream in streams.values()), 0
        for _, write in heapq.merge(*sources, key=lambda message: message[0]):
            write()
            if (count := bag.images) > written:
                written = count
                progress("export", written / images, f"image {written} of {images}")
    parts = f"{counted(streams)}, {'IMU' if imu else 'no IMU'}"
    return f"{out}: {parts}, {int((truth[:, 0] >= 0).sum())} poses; {loss_words(losses)}"


def loss_of_tf(sequence: Sequence, truth: FloatArray) -> Loss:
    """What tf's interpolation between the poses `truth` (n, 8) loses for the lines of colour images."""
    true = sequence.as_taken
    observed = observations(true)
    T = poses_of_rows(truth[:, 1:])
    i = np.clip(np.searchsorted(truth[:, 0], observed.t, side="right") - 1, 0, len(truth) - 2)
    part = (observed.t - truth[i, 0]) / (truth[i + 1, 0] - truth[i, 0])
    T_world_color = between(T[i], T[i + 1], part) @ se3.inverse(true.T_color_depth)
    return loss_of_poses(true.streams["color"].camera, observed, T_world_color)


def spline_facts(spline: Spline) -> dict[str, Any]:
    """The cumulative cubic B-spline T_world_depth(t) on SE(3), for JSON."""
    return {
        "format": "rsgen-spline/1",
        "what": "T_world_depth(t): cumulative cubic B-spline on SE(3), uniform knots; t0 s, dt s, control points 4x4",
        "t0": spline.t0,
        "dt": spline.dt,
        "control_points": spline.control_points.tolist(),
    }


def _write_latched(
    bag: Bag, ns: int, body: str, statics: dict[str, FloatArray], facts: dict[str, Any], spline: Spline
) -> None:
    transforms = [_transform(bag, ns, body, child, pose) for child, pose in statics.items()]
    bag.add("/tf_static", TF, latched=True)(ns, transforms=transforms)
    for topic, data in ((SHUTTER_TOPIC, facts), (SPLINE_TOPIC, spline_facts(spline))):
        bag.add(topic, "std_msgs/msg/String", latched=True)(ns, data=json.dumps(data))


def _poses(bag: Bag, truth: FloatArray, body: str) -> Iterator[Message]:
    """tf and poses from time 0 on."""
    tf, posed = bag.add("/tf", TF), bag.add(POSE_TOPIC, "geometry_msgs/msg/PoseStamped")
    truth = truth[truth[:, 0] >= 0]

    def write(ns: int, row: FloatArray) -> None:
        tf(ns, transforms=[_transform(bag, ns, WORLD_FRAME, body, row)])
        position, orientation = bag.vector("Point", row[:3]), bag.vector("Quaternion", row[3:])
        pose = bag.message("geometry_msgs/msg/Pose", position=position, orientation=orientation)
        posed(ns, header=bag.header(ns, WORLD_FRAME), pose=pose)

    for ns, row in zip(nanoseconds(truth[:, 0]), truth[:, 1:], strict=True):
        yield ns, partial(write, ns, row)


def _transform(bag: Bag, ns: int, parent: str, child: str, pose: FloatArray) -> Any:
    """TransformStamped of T_parent_child, a matrix (4, 4) or a row (7,) tx ty tz qx qy qz qw."""
    row = pose if pose.ndim == 1 else pose_rows(pose[None])[0]
    turned = {"translation": bag.vector("Vector3", row[:3]), "rotation": bag.vector("Quaternion", row[3:])}
    transform = bag.message("geometry_msgs/msg/Transform", **turned)
    return bag.message(
        "geometry_msgs/msg/TransformStamped", header=bag.header(ns, parent), child_frame_id=child, transform=transform
    )


def _frame(sequence: Rig, stream: ImageStream) -> str:
    """The frame of a stream's images."""
    if isinstance(sequence, Sequence):
        return DEPTH_FRAME if stream.is_depth and not stream.registered else COLOR_FRAME
    return f"{stream.name}_optical_frame"


def _topic(sequence: Rig, stream: ImageStream) -> str:
    if isinstance(sequence, Sequence):
        return COLOR_TOPIC if stream.name == "color" else ALIGNED_TOPIC if stream.registered else DEPTH_TOPIC
    return f"/camera/{stream.name}/image_{'rect_raw' if stream.is_depth else 'raw'}"


def _images(bag: Bag, sequence: Rig, stream: ImageStream) -> Iterator[Message]:
    topic, frame = _topic(sequence, stream), _frame(sequence, stream)
    image = bag.add(topic, "sensor_msgs/msg/Image")
    info = bag.add(f"{topic.rpartition('/')[0]}/camera_info", "sensor_msgs/msg/CameraInfo")

    def write(ns: int, k: int) -> None:
        header = bag.header(ns, frame)
        pixels, encoding = _depth(sequence, stream, k) if stream.is_depth else _picture(sequence, stream, k)
        size = {"height": pixels.shape[0], "width": pixels.shape[1]}
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
        step = data.size // pixels.shape[0]
        image(ns, header=header, **size, encoding=encoding, is_bigendian=0, step=step, data=data)
        info(ns, **bag.camera_info(header, stream.camera))
        bag.images += 1

    for k, ns in enumerate(nanoseconds(stream.listed)):
        yield ns, partial(write, ns, k)


def _picture(sequence: Rig, stream: ImageStream, k: int) -> tuple[np.ndarray, str]:
    pixels = sequence.picture(stream.name, k)
    return pixels, "rgb8" if pixels.ndim == 3 else "mono8"


def _depth(sequence: Rig, stream: ImageStream, k: int) -> tuple[np.ndarray, str]:
    """Depth image k as ROS has it (REP 118), lossless: mm where the file has them, else metres."""
    units, scale = sequence.units(stream.name, k), stream.depth_scale
    if scale == 1000.0:
        return units.astype("<u2"), "16UC1"
    return np.where(units > 0, units / scale, np.nan).astype("<f4"), "32FC1"


def _imu(bag: Bag, imu: SequenceImu) -> Iterator[Message]:
    """Readings from time 0 on, with covariances of the white noise and no orientation."""
    config, samples = imu.config, imu.samples
    add = bag.add(IMU_TOPIC, "sensor_msgs/msg/Imu")
    gyro, accel = (
        (np.eye(3) * density**2 * config.rate_hz).ravel()
        for density in (config.gyroscope_noise_density, config.accelerometer_noise_density)
    )
    absent = np.zeros(9)
    absent[0] = -1.0

    def write(ns: int, k: int) -> None:
        add(
            ns,
            header=bag.header(ns, IMU_FRAME),
            orientation=bag.vector("Quaternion", np.array([0.0, 0.0, 0.0, 1.0])),
            orientation_covariance=absent,
            angular_velocity=bag.vector("Vector3", samples.gyro[k]),
            angular_velocity_covariance=gyro,
            linear_acceleration=bag.vector("Vector3", samples.accel[k]),
            linear_acceleration_covariance=accel,
        )

    for k, ns in enumerate(nanoseconds(samples.stamps)):
        if ns >= 0:
            yield ns, partial(write, ns, k)
