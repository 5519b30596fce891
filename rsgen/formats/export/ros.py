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
import importlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError, how_to_install
from rsgen.files import write_error
from rsgen.formats.export.poses import Loss, between, loss_of_poses, loss_words, observations, shutter_facts
from rsgen.formats.export.shared import ExportOptions, counted, image_streams, new_file
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
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


_SUFFIXES: dict[str, tuple[str, ...]] = {"ros1": (".bag",), "ros2": (), "mcap": (".mcap",)}
TF = "tf2_msgs/msg/TFMessage"  # which rosbags does not know of ROS 1
_BAG_VERSION: Literal[8] = 8  # of ROS 2 Iron; the next writes QoS in a way that older ones cannot read
# ROS's names of lens models, and how many coefficients each has.
_MODELS = {
    "pinhole": ("plumb_bob", 5), "radtan": ("plumb_bob", 5), "rational": ("rational_polynomial", 8),
    "fisheye": ("equidistant", 4),
}  # fmt: skip
# Axes of ROS's vectors, in the order of ours.
_AXES = {"Vector3": "xyz", "Point": "xyz", "Quaternion": "xyzw"}


@dataclass
class Bag:
    """An open bag: `add` makes a topic and returns what writes to it; the rest makes parts of messages.

    kind: ros1, ros2 or mcap; images: written so far, for the progress.
    """

    kind: str
    writer: Any
    store: Any
    images: int = 0

    def add(self, topic: str, name: str, latched: bool = False) -> Callable[..., None]:
        """A new topic of messages `name` (package/msg/Type); returns write(ns, **fields)."""
        how: dict[str, Any] = {"typestore": self.store}
        if self.kind == "ros1":
            how["latching"] = 1 if latched else None
        elif latched:
            how["offered_qos_profiles"] = [_transient_local()]
        connection = self.writer.add_connection(topic, name, **how)
        encode = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr

        def write(ns: int, **fields: Any) -> None:
            self.writer.write(connection, ns, encode(self.message(name, **fields), name))

        return write

    def message(self, name: str, **fields: Any) -> Any:
        """A message, or a part of one."""
        return self.store.types[name](**fields)

    def header(self, ns: int, frame: str) -> Any:
        """std_msgs/Header with a stamp in whole nanoseconds."""
        sec, nanosec = divmod(ns, 1_000_000_000)
        stamp = self.message("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        number = {"seq": 0} if self.kind == "ros1" else {}
        return self.message("std_msgs/msg/Header", **number, stamp=stamp, frame_id=frame)

    def vector(self, name: str, values: FloatArray) -> Any:
        """geometry_msgs' Vector3, Point or Quaternion."""
        fields = zip(_AXES[name], values, strict=True)
        return self.message(f"geometry_msgs/msg/{name}", **{axis: float(value) for axis, value in fields})

    def camera_info(self, header: Any, camera: Camera) -> dict[str, Any]:
        """Fields of sensor_msgs/CameraInfo, by the model's name in ROS; pixel centres as ours. Raises UserError."""
        if camera.model not in _MODELS:
            raise UserError(f"camera_info has no {camera.model} lens: render with radtan, rational or fisheye")
        name, count = _MODELS[camera.model]
        matrices = {
            "D": np.array((*camera.distortion, *[0.0] * count)[:count]),
            "K": camera.K.ravel(),
            "R": np.eye(3).ravel(),
            "P": np.column_stack([camera.K, np.zeros(3)]).ravel(),
        }
        roi = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | {"do_rectify": False}
        return {
            "header": header,
            "height": camera.height,
            "width": camera.width,
            "distortion_model": name,
            **(matrices if self.kind == "ros1" else {name.lower(): value for name, value in matrices.items()}),
            "binning_x": 0,
            "binning_y": 0,
            "roi": self.message("sensor_msgs/msg/RegionOfInterest", **roi),
        }


@contextmanager
def new_bag(out: Path, options: ExportOptions, first_s: float) -> Iterator[Bag]:
    """A bag that is at `out` once this ends without an error, and not before.

    first_s: the earliest stamp. Raises UserError if rosbags is not installed, `out` is there already or has another
    suffix, a stamp is negative, or the disk refuses.
    """
    typesys, one, two = _rosbags()
    kind = options.name
    new_file(out, "a bag of this kind", _SUFFIXES[kind])
    if first_s < 0:
        raise UserError(
            f"{out}: ROS's stamps cannot be negative, but an image has {first_s:.9f} s: render with a later one"
        )
    unfinished = out.with_name(f".{out.name}.{os.getpid()}.part")
    disk_errors = (OSError, importlib.import_module("apsw").Error)
    try:
        unfinished.mkdir()
        made = unfinished / (out.stem if kind == "mcap" else out.name)
        if kind == "ros1":
            store, writer = typesys.get_typestore(typesys.Stores.ROS1_NOETIC), one.Writer(made)
            store.register(typesys.get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        else:
            plugin = two.StoragePlugin.MCAP if "mcap" in (kind, options.storage) else two.StoragePlugin.SQLITE3
            store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
            writer = two.Writer(made, version=_BAG_VERSION, storage_plugin=plugin)
        with writer:
            yield Bag(kind, writer, store)
        (made / f"{made.name}.mcap" if kind == "mcap" else made).replace(out)
    except disk_errors as error:
        raise write_error(out, error if isinstance(error, OSError) else OSError(str(error))) from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _transient_local() -> Any:
    """What a late subscriber still gets: ROS 2's word for latched."""
    qos = importlib.import_module("rosbags.interfaces")
    forever = qos.QosTime(2147483647, 4294967295)
    return qos.Qos(
        qos.QosHistory.KEEP_LAST, 1, qos.QosReliability.RELIABLE, qos.QosDurability.TRANSIENT_LOCAL,
        forever, forever, qos.QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip


def _rosbags() -> tuple[Any, Any, Any]:
    try:
        return tuple(importlib.import_module(f"rosbags.{name}") for name in ("typesys", "rosbag1", "rosbag2"))  # type: ignore[return-value]
    except ImportError:
        raise UserError(f"rosbags is not installed: {how_to_install('ros')}") from None
