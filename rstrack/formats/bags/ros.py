"""Recordings of ROS drivers: images with camera_info, frames by tf, an IMU; in any kind of bag."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rstrack.formats.bags import realsense
from rstrack.formats.bags.bag import Bag, Message, open_bag
from rstrack.formats.bags.messages import between, inertial, nanoseconds, picture_of, stated_shutter
from rstrack.formats.bags.topics import (
    Named,
    base_of,
    find_color,
    find_depth,
    find_imu,
    find_info,
    is_rectified,
    is_registered,
)
from rstrack.formats.pixels import is_float_depth
from rstrack.formats.recording import FLOAT_DEPTH_SCALE, Item, Picture, Recording, camera_of

_MILLIMETRES = 1000.0


def read_bag(path: Path, named: Named) -> Recording:
    """A bag's cameras; its images are read as they are asked for. Raises UserError, one line."""
    with open_bag(path) as bag:
        if realsense.is_realsense(bag):
            return realsense.read_realsense(bag, named)
        return _read_ros(bag, named)


def _read_ros(bag: Bag, named: Named) -> Recording:
    color_topic = find_color(bag, named.color)
    color_info = find_info(bag, color_topic, named.color_info, "--color-info")
    color = _camera(bag, color_topic, color_info)
    first_color = _first(bag, color_topic)
    depth_topic, T, registered = _depth(bag, find_depth(bag, named.depth), first_color, color, named)
    notes = []
    if registered:
        depth, depth_info = color, color_info
    else:
        depth_info = find_info(bag, depth_topic, named.depth_info, "--depth-info")
        depth = _camera(bag, depth_topic, depth_info)
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
    images = {color_topic: ("color", color), depth_topic: ("depth", depth)}
    kind = "ROS 1 bag" if bag.is_ros1 else "ROS 2 recording"
    topics = {"color": color_topic, "depth": depth_topic, "color_info": color_info, "depth_info": depth_info}
    return Recording(
        kind=kind,
        color=stated_shutter(bag, base_of(color_topic), "color", color),
        depth=stated_shutter(bag, base_of(depth_topic), "depth", depth),
        T_color_depth=np.eye(4) if registered else T,
        is_registered=registered,
        depth_scale=FLOAT_DEPTH_SCALE if is_float else _MILLIMETRES,
        items=_items(bag.path, images, imu),
        pictures=sum(bag.topics[topic].count for topic in images),
        notes=tuple(notes),
        source=topics | ({"imu": ", ".join(imu)} if imu else {}),
        T_imu_depth=T_imu,
    )


def _first(bag: Bag, topic: str) -> Message:
    message = bag.first(topic)
    if message is None:
        raise UserError(f"{bag.path}: {topic} has no messages")
    return message


def _depth(
    bag: Bag, topics: Sequence[str], first_color: Message, color: Camera, named: Named
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
        if _camera(bag, own, info) == color:
            return own, None, True
    T = between(bag, *frames)
    if T is None and len(topics) > 1:
        return topics[1], None, True
    return own, T, False


def _camera(bag: Bag, image: str, info: str) -> Camera:
    message = bag.first(info)
    if message is None:
        raise UserError(f"{bag.path}: {info} has no messages")
    data = message.content
    K, D, P = (getattr(data, name, None) for name in ("K", "D", "P"))  # ROS 1; ROS 2 has small letters
    K = np.ravel(data.k if K is None else K)
    D = np.ravel(data.d if D is None else D)
    P = np.ravel(data.p if P is None else P)
    if is_rectified(image) and P[0] > 0:
        K, D = P[[0, 1, 2, 4, 5, 6, 8, 9, 10]], np.zeros(0)
    if not K[0] > 0:
        raise UserError(f"{bag.path}: {info} has no focal length: the camera was not calibrated; write a camera.yaml")
    return camera_of(
        f"{bag.path}: {info}", int(data.width), int(data.height), K[[0, 4, 2, 5]], str(data.distortion_model), D
    )


def _items(path: Path, images: Mapping[str, tuple[Any, Camera]], imu: Sequence[str]) -> Iterator[Item]:
    with open_bag(path) as bag:
        for message in bag.messages([*images, *imu]):
            stamp_ns = nanoseconds(message.content.header.stamp)
            if message.topic in images:
                stream, camera = images[message.topic]
                data, ending = picture_of(message, stream == "depth", camera)
                yield Picture(stream, stamp_ns, data, ending, message.arrival_ns)
            else:
                yield inertial(message, stamp_ns)
