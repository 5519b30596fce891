"""Bags by way of rosbags, an optional extra: ROS 1 (.bag), ROS 2 (a folder) or one MCAP file, whole or not at all."""

from __future__ import annotations

import importlib
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, how_to_install
from rsgen.files import write_error
from rsgen.formats.export.shared import ExportOptions, new_file
from rsgen.geometry.camera import Camera

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
