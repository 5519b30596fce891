"""Coordinate frames of a ROS recording: the rigid transform between two of them, along tf_static, or tf."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import islice
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.formats.bags.bag import Bag

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
