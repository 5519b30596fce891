"""Recordings in bags of any kind: of ROS drivers, with camera_info, frames by tf, an IMU; and those of librealsense.

What librealsense records, from a program or its viewer, is a ROS 1 bag, or since 2.57 a ROS 2 recording in SQLite:

    /device_0/sensor_0/Depth_0/image/data            sensor_msgs/Image, mono16; then the unit of depth in m, float32,
                                                     which the definition in the bag does not have
    /device_0/sensor_0/Depth_0/info/camera_info      distortion by librealsense's names
    /device_0/sensor_0/Depth_0/tf/1                  geometry_msgs/Transform: p_stream from p_reference, by its number
    /device_0/sensor_1/Color_0/...                   likewise; /device_0/sensor_2/Gyro_0/imu/data, Accel_0

and in SQLite .../image/data/compressedDepth, .../image/data/compressed, .../image/camera_info, and std_msgs/String for
/tf/ref_1 and .../image/metadata. There headers have the time of recording since its start: the frame's own is in the
metadata. Found by recording with librealsense 2.56 and 2.59.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.limits import rigid
from rsgen.sequence.format import StreamName
from rstrack.formats.bags.bag import BagReader, Message, is_bag, open_bag
from rstrack.formats.bags.messages import (
    COMPRESSED,
    IMAGE,
    IMU,
    base_of,
    between,
    camera_of_info,
    find_color,
    find_depth,
    find_imu,
    find_info,
    is_registered,
    items_of,
    listed,
    stated_shutter,
    transform_of,
)
from rstrack.formats.pixels import is_float_depth
from rstrack.formats.recording import FLOAT_DEPTH_SCALE, ReadOptions, Recording, StreamCamera

OPTIONS = ("topics",)
matches = is_bag
_MILLIMETRES = 1000.0
# Of librealsense's topics: of samples, with the stream's part of the name and its kind; of transforms.
_DATA = re.compile(
    r"(/device_\d+/sensor_\d+/(Depth|Color|Gyro|Accel)_\d+)/(?:image|imu)/data(?:/compressed|/compressedDepth)?"
)
_TF = re.compile(r"/tf/(?:ref_)?(\d+)")
_DEFAULT_UNIT_M = 0.001


def read(path: Path, options: ReadOptions) -> Recording:
    """A bag's cameras; its images are read as they are asked for. Raises UserError, one line."""
    with open_bag(path) as bag:
        return _read_realsense(bag, options) if _is_realsense(bag) else _read_driver(bag, options)


def _read_driver(bag: BagReader, named: ReadOptions) -> Recording:
    color_topic = find_color(bag, named.color)
    color_info = find_info(bag, color_topic, named.color_info, "--color-info")
    color = camera_of_info(bag, color_topic, color_info)
    first_color = _first(bag, color_topic)
    depth_topic, T, registered = _depth(bag, find_depth(bag, named.depth), first_color, color, named)
    notes = []
    if registered:
        depth, depth_info = color, color_info
    else:
        depth_info = find_info(bag, depth_topic, named.depth_info, "--depth-info")
        depth = camera_of_info(bag, depth_topic, depth_info)
        if T is None:
            frames = [m.content.header.frame_id for m in (first_color, _first(bag, depth_topic))]
            notes.append(
                f"no transforms connect {frames[0]!r:.50} and {frames[1]!r:.50}: T_color_depth taken for the identity"
            )
    first = _first(bag, depth_topic).content
    is_float = is_float_depth(first.encoding if hasattr(first, "encoding") else first.format)
    imu = find_imu(bag)
    frame = (first_color if registered else _first(bag, depth_topic)).content.header.frame_id
    first_imu = bag.first(imu[0]) if imu else None
    T_imu = None if first_imu is None else between(bag, str(first_imu.content.header.frame_id), str(frame))
    images: dict[str, tuple[StreamName, Camera]] = {color_topic: ("color", color), depth_topic: ("depth", depth)}
    kind = "ROS 1 bag" if bag.is_ros1 else "ROS 2 recording"
    topics = {"color": color_topic, "depth": depth_topic, "color_info": color_info, "depth_info": depth_info}
    return Recording(
        kind=kind,
        color=stated_shutter(bag, base_of(color_topic), "color", color),
        depth=stated_shutter(bag, base_of(depth_topic), "depth", depth),
        T_color_depth=np.eye(4) if registered else T,
        is_registered=registered,
        depth_scale=FLOAT_DEPTH_SCALE if is_float else _MILLIMETRES,
        items=items_of(bag.path, images, imu),
        images=sum(bag.topics[topic].count for topic in images),
        notes=tuple(notes),
        source=topics | ({"imu": ", ".join(imu)} if imu else {}),
        T_imu_depth=T_imu,
    )


def _first(bag: BagReader, topic: str) -> Message:
    message = bag.first(topic)
    if message is None:
        raise UserError(f"{bag.path}: {topic} has no messages")
    return message


def _depth(
    bag: BagReader, topics: Sequence[str], first_color: Message, color: Camera, named: ReadOptions
) -> tuple[str, FloatArray | None, bool]:
    """The topic of depth, T_color_depth if known, and whether it is registered.

    The sensor's own images where transforms connect the two cameras: their lines have the sensor's times.
    """
    own = topics[0]
    if is_registered(own):
        return own, None, True
    first = _first(bag, own)
    frames = [str(m.content.header.frame_id) for m in (first_color, first)]
    if frames[0] == frames[1] != "":
        info = find_info(bag, own, named.depth_info, "--depth-info")
        if camera_of_info(bag, own, info) == color:
            return own, None, True
    T = between(bag, *frames)
    if T is None and len(topics) > 1:
        return topics[1], None, True
    return own, T, False


# ---------------------------------------------------------------------------------------------------------------------
# of librealsense


def _is_realsense(bag: BagReader) -> bool:
    """Whether librealsense wrote it."""
    return any(_DATA.fullmatch(topic) for topic in bag.of_kind(IMAGE, COMPRESSED))


def _read_realsense(bag: BagReader, named: ReadOptions) -> Recording:
    """The recording of one device. Raises UserError, one line."""
    topics = {"color": _stream_topic(bag, "Color", named.color), "depth": _stream_topic(bag, "Depth", named.depth)}
    prefixes = {name: _prefix(topic) for name, topic in topics.items()}
    color = _stream_camera(bag, topics["color"], named.color_info)
    depth = _stream_camera(bag, topics["depth"], named.depth_info)
    from_reference = {name: _from_reference(bag, prefix) for name, prefix in prefixes.items()}
    T = _between(from_reference["color"], from_reference["depth"])
    alone = "the streams' transforms have no common reference: T_color_depth is taken for the identity"
    images: dict[str, tuple[StreamName, Camera]] = {
        topics["color"]: ("color", color),
        topics["depth"]: ("depth", depth),
    }
    imu = tuple(topic for topic in bag.of_kind(IMU) if _DATA.fullmatch(topic))
    placed = [_between(_from_reference(bag, _prefix(topic)), from_reference["depth"]) for topic in imu]
    device = _text(bag, prefixes["depth"].split("/sensor_")[0] + "/info")
    return Recording(
        kind="RealSense recording",
        color=StreamCamera(color),
        depth=StreamCamera(depth),
        T_color_depth=T,
        depth_scale=float(f"{1.0 / _unit(bag, topics['depth'], prefixes['depth']):.6g}"),
        items=items_of(bag.path, images, imu, None if bag.is_ros1 else _own_stamps),
        images=sum(bag.topics[topic].count for topic in images),
        notes=(alone,) if T is None else (),
        source=topics | ({"imu": ", ".join(imu)} if imu else {}) | ({"device": device} if device else {}),
        T_imu_depth=next((T for T in placed if T is not None), None),
    )


def _stream_topic(bag: BagReader, stream: str, named: str | None) -> str:
    found = [t for t in bag.of_kind(IMAGE, COMPRESSED) if (match := _DATA.fullmatch(t)) and match[2] == stream]
    if named is None:
        if not found:
            raise UserError(f"{bag.path}: librealsense recorded no {stream.lower()} stream; {listed(bag)}")
        return found[0]
    if named not in found:
        raise UserError(f"{bag.path}: {named}: no such {stream.lower()} stream; {listed(bag)}")
    return named


def _prefix(topic: str) -> str:
    match = _DATA.fullmatch(topic)
    assert match is not None
    return match[1]


def _stream_camera(bag: BagReader, image: str, named: str | None) -> Camera:
    prefix = _prefix(image)
    for topic in (named,) if named else (f"{prefix}/info/camera_info", f"{prefix}/image/camera_info"):
        if topic in bag.topics and bag.topics[topic].count:
            return camera_of_info(bag, image, topic)
    raise UserError(
        f"{bag.path}: nothing states the camera of {prefix}: record it again with librealsense 2.10 or newer"
    )


def _from_reference(bag: BagReader, prefix: str) -> dict[int, FloatArray]:
    """T_stream_reference (4, 4) by the number of the reference."""
    found = {}
    for topic in bag.topics:
        match = _TF.fullmatch(topic.removeprefix(prefix)) if topic.startswith(prefix) else None
        message = bag.first(topic) if match else None
        if match is None or message is None:
            continue
        T = transform_of(message.content) if bag.is_ros1 else _of_text(str(message.content.data))
        if T is not None:
            found[int(match[1])] = T
    return found


def _of_text(text: str) -> FloatArray | None:
    """'rotation=<9 numbers, column by column>;translation=<3 numbers>' as (4, 4)."""
    try:
        parts = dict(part.split("=", 1) for part in text.strip("; ").split(";"))
        T = np.eye(4)
        T[:3, :3] = np.array(parts["rotation"].split(","), float).reshape(3, 3).T
        T[:3, 3] = np.array(parts["translation"].split(","), float)
        return se3.orthonormalise(rigid(T, 1e-3))
    except (ValueError, KeyError):
        return None


def _between(to: dict[int, FloatArray], from_: dict[int, FloatArray]) -> FloatArray | None:
    """T_to_from (4, 4) of two streams' poses against their references; None if they have none in common."""
    common = sorted(set(to) & set(from_))
    return to[common[0]] @ se3.inverse(from_[common[0]]) if common else None


def _unit(bag: BagReader, topic: str, prefix: str) -> float:
    """Metres of a unit of depth: stated by the image, else by the sensor's option, else a millimetre."""
    first = bag.first(topic)
    if first is not None and bag.is_ros1 and len(first.rest) >= 4:
        (unit,) = struct.unpack("<f", first.rest[-4:])
        if 1e-6 < unit < 1.0:
            return float(unit)
    sensor = prefix.rpartition("/")[0]
    for option in (f"{sensor}/option/Depth_Units/value", f"{sensor}/option/Depth Units/value"):
        message = bag.first(option) if option in bag.topics else None
        try:
            unit = float(message.content.data) if message is not None else 0.0
        except ValueError:
            continue
        if 1e-6 < unit < 1.0:
            return unit
    return _DEFAULT_UNIT_M


def _text(bag: BagReader, topic: str) -> str:
    """The device's name, as far as it is stated."""
    for message in islice(bag.messages([topic]), 20) if topic in bag.topics else ():
        content = message.content
        if getattr(content, "key", None) == "Name":
            return str(content.value)
        if match := re.search(r"(?:^|;)Name=([^;]+)", str(getattr(content, "data", ""))):
            return match[1]
    return ""


def _own_stamps(bag: BagReader, data: str) -> dict[int, int]:
    """Stamps of a topic's frames in ns by the time at which they were recorded, from their metadata."""
    found, prefix = {}, _prefix(data)
    topics = [topic for topic in bag.topics if topic in (f"{prefix}/image/metadata", f"{prefix}/imu/metadata")]
    for message in bag.messages(topics):
        match = re.search(r"(?:^|;)timestamp=([0-9.]+)(?:;|$)", str(message.content.data))
        if match is not None:
            whole, _, part = match[1].partition(".")
            found[message.arrival_ns] = int(whole or 0) * 10**6 + int((part + "000000")[:6])
    return found
