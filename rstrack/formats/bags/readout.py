"""Readout times that a recording states: in a topic `rolling_shutter` as `rsgen export` writes it, or Android's
SENSOR_ROLLING_SHUTTER_SKEW among the metadata of images.

Android: "duration between the start of exposure for the first row of the image sensor, and the start of exposure for
one past the last row", in nanoseconds, which is `readout_s` (developer.android.com, CaptureResult).
"""

from __future__ import annotations

import json
import re
from itertools import islice
from typing import Any

import numpy as np

from rsgen.geometry.camera import Camera
from rsgen.sequence.format import StreamName
from rstrack.formats.bags.bag import Bag
from rstrack.formats.recording import StreamCamera
from rstrack.formats.shutter import with_shutter

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
