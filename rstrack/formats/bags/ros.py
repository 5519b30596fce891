"""Recordings of ROS drivers: images with camera_info, frames by tf, an IMU; in any kind of bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.sequence.format import StreamName
from rstrack.formats.bags import realsense
from rstrack.formats.bags.bag import BagReader, Message, is_bag, open_bag
from rstrack.formats.bags.messages import (
    base_of,
    between,
    camera_of_info,
    find_color,
    find_depth,
    find_imu,
    find_info,
    is_registered,
    items_of,
    stated_shutter,
)
from rstrack.formats.pixels import is_float_depth
from rstrack.formats.recording import FLOAT_DEPTH_SCALE, ReadOptions, Recording

OPTIONS = ("topics",)
matches = is_bag
_MILLIMETRES = 1000.0


def read(path: Path, options: ReadOptions) -> Recording:
    """A bag's cameras; its images are read as they are asked for. Raises UserError, one line."""
    with open_bag(path) as bag:
        return realsense.read_bag(bag, options) if realsense.is_realsense(bag) else _read_bag(bag, options)


def _read_bag(bag: BagReader, named: ReadOptions) -> Recording:
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
