"""Which topics of a bag hold what, by their types and names; and what ROS messages contain: images, cameras, frames.

A readout is stated in a topic `rolling_shutter` as `rsgen export` writes it, or as Android's
SENSOR_ROLLING_SHUTTER_SKEW among the metadata of images: "duration between the start of exposure for the first row of
the image sensor, and the start of exposure for one past the last row", in nanoseconds, which is `readout_s`
(developer.android.com, CaptureResult).
"""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, first_few
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.sequence.format import StreamName
from rstrack.formats.bags.bag import BagReader, Message, open_bag
from rstrack.formats.pixels import color_png, compressed_color, compressed_depth, depth_png
from rstrack.formats.recording import (
    ImuSample,
    Item,
    RecordedImage,
    StreamCamera,
    camera_of,
    pose_of,
    with_shutter,
)  # fmt: skip

IMAGE, COMPRESSED, INFO, IMU = (
    "sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/CameraInfo", "sensor_msgs/Imu",
)  # fmt: skip
_TRANSPORTS = ("/compressedDepth", "/compressed")
_NOT_COLOR = ("depth", "infra", "/ir", "confidence", "disparity", "left", "right", "mono", "fisheye", "mask")
_REGISTERED = ("aligned_depth", "depth_registered", "depth_to_rgb", "depth_to_color", "registered")
_MOST_NAMED = 12


def base_of(topic: str) -> str:
    """The image's topic without the transport's part of the name."""
    return next((topic.removesuffix(ending) for ending in _TRANSPORTS if topic.endswith(ending)), topic)


def is_registered(topic: str) -> bool:
    """Whether depth of this topic was warped into the colour camera, by its name."""
    return any(word in topic.lower() for word in _REGISTERED)


def is_rectified(topic: str) -> bool:
    """Whether images of this topic are undistorted: their camera is P of camera_info, without distortion."""
    return "rect" in base_of(topic).rpartition("/")[2].lower()


def find_color(bag: BagReader, named: str | None) -> str:
    """The topic of the colour images. Raises UserError."""

    def rank(topic: str) -> tuple[bool, ...]:
        name = topic.lower()
        return "color" not in name and "rgb" not in name, is_rectified(topic), "raw" not in name

    return _chosen(bag, named, "--color", "colour", _is_color, rank)


def find_depth(bag: BagReader, named: str | None) -> list[str]:
    """Topics of depth images: the sensor's own, or one warped into the colour camera, or both in this order.

    Raises UserError.
    """
    if named is not None:
        return [_chosen(bag, named, "--depth", "depth", _is_depth, lambda _: ())]
    found = [topic for topic in bag.of_kind(IMAGE, COMPRESSED) if _is_depth(topic)]
    kinds = [[t for t in found if is_registered(t) == registered] for registered in (False, True)]
    if not found:
        raise UserError(f"{bag.path}: has no depth images: name their topic with --depth; {listed(bag)}")
    return [
        _only(bag, topics, "--depth", "depth", lambda topic: ("image" not in topic.rpartition("/")[2],))
        for topics in kinds
        if topics
    ]


def find_info(bag: BagReader, image: str, named: str | None, option: str) -> str:
    """The topic of the camera_info that goes with an image's. Raises UserError."""
    known = bag.of_kind(INFO)
    if named is not None:
        if named not in known:
            raise UserError(f"{bag.path}: {option} {named}: no such camera_info; {_some(known)}")
        return named
    base = base_of(image)
    parent = base.rpartition("/")[0]
    for place in (parent, base, parent.rpartition("/")[0]):
        if f"{place}/camera_info" in known:
            return f"{place}/camera_info"
    raise UserError(
        f"{bag.path}: nothing states the camera of {image}: name its camera_info with {option}; {_some(known)}"
    )


def find_imu(bag: BagReader) -> tuple[str, ...]:
    """Topics of the IMU: one that has both, or those of gyro and accelerometer; none where there is no IMU."""
    topics = bag.of_kind(IMU)
    pair = [next((t for t in topics if word in t.lower()), None) for word in ("gyro", "accel")]
    whole = [t for t in topics if not re.search("gyro|accel", t.lower())]
    if whole:
        return (min(whole, key=lambda t: ("camera" not in t.lower(), len(t), t)),)
    return tuple(t for t in pair if t is not None)


def listed(bag: BagReader) -> str:
    """The image topics there are, or all topics where there are none."""
    return _some(bag.of_kind(IMAGE, COMPRESSED) or list(bag.topics))


def _is_depth(topic: str) -> bool:
    return "depth" in topic.lower() and "confidence" not in topic.lower()


def _is_color(topic: str) -> bool:
    name = topic.lower()
    return not any(word in name for word in _NOT_COLOR) and not topic.endswith(_TRANSPORTS[0])


def _chosen(
    bag: BagReader, named: str | None, option: str, what: str, fits: Callable[[str], bool],
    rank: Callable[[str], tuple[bool, ...]],
) -> str:  # fmt: skip
    images = bag.of_kind(IMAGE, COMPRESSED)
    if named is not None:
        if named not in images:
            raise UserError(f"{bag.path}: {option} {named}: no such image topic; {listed(bag)}")
        return named
    found = [topic for topic in images if fits(topic)]
    if not found:
        raise UserError(f"{bag.path}: has no {what} images: name their topic with {option}; {listed(bag)}")
    return _only(bag, found, option, what, rank)


def _only(
    bag: BagReader, found: Sequence[str], option: str, what: str, rank: Callable[[str], tuple[bool, ...]]
) -> str:  # fmt: skip
    """The first by rank, of several transports of the same images the plainest. Raises UserError where two tie."""

    def full(topic: str) -> tuple[tuple[bool, ...], int]:
        transport = next((k for k, ending in enumerate(_TRANSPORTS, 1) if topic.endswith(ending)), 0)
        return rank(topic), transport

    first, *others = sorted(found, key=full)
    same = [topic for topic in others if full(topic)[0] == full(first)[0] and base_of(topic) != base_of(first)]
    if same:
        raise UserError(f"{bag.path}: several topics may be {what}: name one with {option}; {_some([first, *same])}")
    return first


def _some(topics: Sequence[str]) -> str:
    return f"there are {first_few(topics, _MOST_NAMED)}" if topics else "there is none"


OwnStamps = Callable[[BagReader, str], Mapping[int, int]]
"""From a bag and a topic to stamps in ns by the time of recording, where headers do not have them."""


def items_of(
    path: Path, images: Mapping[str, tuple[StreamName, Camera]], imu: Sequence[str], own_stamps: OwnStamps | None = None
) -> Iterator[Item]:
    """Images and samples of a bag in its order. images: stream and camera by topic. Raises UserError."""
    with open_bag(path) as bag:
        stamps = {topic: own_stamps(bag, topic) for topic in (*images, *imu)} if own_stamps else {}
        for message in bag.messages([*images, *imu]):
            header = message.content.header.stamp
            stamp_ns = int(header.sec) * 10**9 + int(header.nanosec)
            if message.topic in stamps:
                stamp_ns = stamps[message.topic].get(message.arrival_ns, 0)
            if message.topic in images:
                stream, camera = images[message.topic]
                data, ending = _picture(message, stream == "depth", camera)
                yield RecordedImage(stream, stamp_ns, data, ending, message.arrival_ns)
            else:
                yield _sample(message, stamp_ns)


def _picture(message: Message, is_depth: bool, camera: Camera) -> tuple[bytes, str]:
    """The image of a message as a file, and its ending. Raises UserError."""
    content = message.content
    if not hasattr(content, "format"):
        png = depth_png if is_depth else color_png
        return png(message.where, content, camera), "png"
    data = np.asarray(content.data).tobytes()
    if is_depth:
        return compressed_depth(message.where, data, str(content.format), camera), "png"
    return compressed_color(message.where, data, camera)


def _sample(message: Message, stamp_ns: int) -> ImuSample:
    """A sensor_msgs/Imu; of topics of one sensor alone, that one."""
    gyro, accel = (
        (float(v.x), float(v.y), float(v.z))
        for v in (message.content.angular_velocity, message.content.linear_acceleration)
    )
    is_gyro, is_accel = (word in message.topic.lower() for word in ("gyro", "accel"))
    return ImuSample(stamp_ns, None if is_accel and not is_gyro else gyro, None if is_gyro and not is_accel else accel)


def camera_of_info(bag: BagReader, image: str, info: str) -> Camera:
    """The camera of an image's topic by its camera_info. Raises UserError."""
    message = bag.first(info)
    if message is None:
        raise UserError(f"{bag.path}: {info} has no messages")
    data = message.content
    K, D, P = (np.ravel(getattr(data, name if bag.is_ros1 else name.lower())) for name in ("K", "D", "P"))
    if is_rectified(image) and P[0] > 0:
        K, D = P[[0, 1, 2, 4, 5, 6, 8, 9, 10]], np.zeros(0)
    if not K[0] > 0:
        raise UserError(f"{bag.path}: {info} has no focal length: the camera was not calibrated; write a camera.yaml")
    return camera_of(
        f"{bag.path}: {info}", int(data.width), int(data.height), K[[0, 4, 2, 5]], str(data.distortion_model), D
    )


_TF = "tf2_msgs/TFMessage"
_OLD_TF = "tf/tfMessage"
# Messages of /tf that are looked at where tf_static does not connect the cameras: drivers repeat them all the time.
_FIRST_OF_TF = 500


def transform_of(message: Any) -> FloatArray | None:
    """A geometry_msgs/Transform as (4, 4): coordinates of the child in the parent; None if it is no rigid transform."""
    q, t = message.rotation, message.translation
    T = pose_of([getattr(q, axis) for axis in "xyzw"], [getattr(t, axis) for axis in "xyz"])
    return T if np.isfinite(T).all() else None


def between(bag: BagReader, target: str, source: str) -> FloatArray | None:
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


def stated_shutter(bag: BagReader, image: str, stream: StreamName, camera: Camera) -> StreamCamera:
    """The camera of an image's topic with the shutter that the bag states: of `rsgen export` all, of others the skew.

    Raises UserError: what is stated is no shutter.
    """
    for topic in bag.of_kind("std_msgs/String"):
        if topic.endswith("/rolling_shutter") and (message := bag.first(topic)) is not None:
            facts = _pairs(str(message.content.data)).get("streams")
            own = facts.get(stream) if isinstance(facts, dict) else None
            if isinstance(own, dict):
                return with_shutter(f"{bag.path}: {topic}", camera, own)
    return StreamCamera(camera, _rolling_shutter_skew(bag, image))


def _rolling_shutter_skew(bag: BagReader, image: str) -> float | None:
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
