"""ROS messages of images and IMUs as items of a recording."""

from __future__ import annotations

from typing import Any

import numpy as np

from rsgen.geometry.camera import Camera
from rstrack.formats.bags.bag import Message
from rstrack.formats.pixels import color_png, compressed_color, compressed_depth, depth_png
from rstrack.formats.recording import Inertial


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
