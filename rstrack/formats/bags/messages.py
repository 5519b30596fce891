"""What ROS messages contain: images, samples of an IMU, transforms between coordinate frames, and readout times.

A readout is stated in a topic `rolling_shutter` as `rsgen export` writes it, or as Android's
SENSOR_ROLLING_SHUTTER_SKEW among the metadata of images: "duration between the start of exposure for the first row of
the image sensor, and the start of exposure for one past the last row", in nanoseconds, which is `readout_s`
(developer.android.com, CaptureResult).
"""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Sequence
from itertools import islice
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.sequence.format import StreamName
from rstrack.formats.bags.bag import Bag, Message
from rstrack.formats.pixels import color_png, compressed_color, compressed_depth, depth_png
from rstrack.formats.recording import Inertial, StreamCamera, with_shutter


def picture_of(message: Message, is_depth: bool, camera: Camera) -> tuple[bytes, str]:
    """The image of a message as a file, and its ending. Raises UserError."""
    content = message.content
    if not hasattr(content, "format"):
        png = depth_png if is_depth else color_png
        return png(message.where, content, camera), "png"
    data = np.asarray(content.data).tobytes()
    if is_depth:
        return compressed_depth(message.where, data, str(content.format), camera), "png"
    return compressed_color(message.where, data, camera)


def inertial(message: Message, stamp_ns: int) -> Inertial:
    """A sensor_msgs/Imu; of topics of one sensor alone, that one."""
    values = [
        (float(v.x), float(v.y), float(v.z))
        for v in (message.content.angular_velocity, message.content.linear_acceleration)
    ]
    name = message.topic.lower()
    is_gyro, is_accel = "gyro" in name, "accel" in name
    return Inertial(
        stamp_ns, None if is_accel and not is_gyro else values[0], None if is_gyro and not is_accel else values[1]
    )


def nanoseconds(stamp: Any) -> int:
    """A ROS time as one number."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


_TF = "tf2_msgs/TFMessage"
_OLD_TF = "tf/tfMessage"
# Messages of /tf that are looked at where tf_static does not connect the cameras: drivers repeat them all the time.
_FIRST_OF_TF = 500


def transform_of(message: Any) -> FloatArray | None:
    """A geometry_msgs/Transform as (4, 4): coordinates of the child in the parent; None if it is no rigid transform."""
    q = np.array([getattr(message.rotation, axis) for axis in "xyzw"], float)
    t = np.array([getattr(message.translation, axis) for axis in "xyz"], float)
    if not (np.isfinite(q).all() and np.isfinite(t).all()) or abs(np.linalg.norm(q) - 1.0) > 1e-2:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(q).as_matrix(), t
    return T


def between(bag: Bag, target: str, source: str) -> FloatArray | None:
    """T_target_source (4, 4) of two frames by their names; None where no transforms connect them. Raises UserError."""
    names = [name for name in bag.of_kind(_TF, _OLD_TF) if name.rpartition("/")[2] in ("tf_static", "tf")]
    static = [name for name in names if name.endswith("tf_static")]
    messages = [m.content for m in bag.messages(static)]
    found = _path(messages, target, source)
    if found is None:
        rest = [name for name in names if name not in static]
        found = _path([*messages, *(m.content for m in islice(bag.messages(rest), _FIRST_OF_TF))], target, source)
    return found


def _path(messages: Sequence[Any], target: str, source: str) -> FloatArray | None:
    """Along the shortest path of transforms, the first of each pair of frames."""
    edges: dict[str, dict[str, FloatArray]] = {}
    for stamped in (stamped for message in messages for stamped in message.transforms):
        parent, child = stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")
        T = transform_of(stamped.transform)
        if T is not None and child not in edges.get(parent, {}):
            edges.setdefault(parent, {})[child] = T
            edges.setdefault(child, {})[parent] = se3.inverse(T)
    target, source = target.lstrip("/"), source.lstrip("/")
    reached, waiting = {target: np.eye(4)}, deque([target])
    while waiting and source not in reached:
        frame = waiting.popleft()
        for other, T in edges.get(frame, {}).items():
            if other not in reached:
                reached[other] = reached[frame] @ T
                waiting.append(other)
    return reached.get(source)


_METADATA = ("diagnostic_msgs/KeyValue", "std_msgs/String")
_SKEW = re.compile(r"(android\.sensor\.|sensor)?rollingshutterskew(ns)?")
# Metadata messages that are looked at: a frame has some dozens of them.
_FIRST = 200
_LONGEST_NS = 1e9


def stated_shutter(bag: Bag, image: str, stream: StreamName, camera: Camera) -> StreamCamera:
    """The camera of an image's topic with what the bag says of its shutter: of `rsgen export` all, of others the skew.

    Raises UserError: what is said of it is no shutter.
    """
    for topic in bag.of_kind("std_msgs/String"):
        if topic.endswith("/rolling_shutter") and (message := bag.first(topic)) is not None:
            facts = _pairs(str(message.content.data)).get("streams")
            own = facts.get(stream) if isinstance(facts, dict) else None
            if isinstance(own, dict):
                return with_shutter(f"{bag.path}: {topic}", camera, own)
    return StreamCamera(camera, rolling_shutter_skew(bag, image))


def rolling_shutter_skew(bag: Bag, image: str) -> float | None:
    """Seconds that the metadata beside an image's topic state as its readout, None where there is nothing.

    The median, where it is stated for several frames. Raises UserError.
    """
    parent = image.rpartition("/")[0]
    topics = [t for t in bag.of_kind(*_METADATA) if t in (f"{parent}/metadata", f"{image}/metadata")]
    found: list[float] = []
    for message in islice(bag.messages(topics), _FIRST):
        content = message.content
        values = {content.key: content.value} if hasattr(content, "key") else _pairs(str(content.data))
        found += [ns for key, value in values.items() if (ns := _skew_ns(str(key), value)) is not None]
    return float(np.median(found)) * 1e-9 if found else None


def _skew_ns(key: str, value: object) -> float | None:
    if not _SKEW.fullmatch(key.lower().replace("_", "").replace(" ", "")):
        return None
    try:
        ns = float(str(value))
    except ValueError:
        return None
    return ns if 0 <= ns < _LONGEST_NS else None


def _pairs(text: str) -> dict[str, Any]:
    """JSON, or 'key=value;' as librealsense writes it."""
    try:
        data = json.loads(text)
        return data if isinstance(data, dict) else {}
    except (ValueError, RecursionError):
        return dict(pair.split("=", 1) for pair in text.split(";") if "=" in pair)
