"""Which way is up in a Mitsuba scene: its own camera, never rendered with, tells."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from rsgen.config.sections import Up
from rsgen.formats.mitsuba_xml import old_values as old

_UPRIGHT = 0.8  # cosine: a camera may be tilted, not rolled
_AXES: tuple[tuple[Up, Up], ...] = (("x", "-x"), ("y", "-y"), ("z", "-z"))


def camera_up(path: Path) -> Up | None:
    """The axis of the file that the first of its cameras has up; None if it has none, or one that leans."""
    try:
        cameras = [e for e in ET.parse(path).getroot().iter() if e.tag in ("sensor", "camera")]
        placed = [e for camera in cameras for e in camera.iter() if e.tag in ("lookat", "lookAt", "look_at", "matrix")]
        numbers = old.numbers(placed[0].get("up") or placed[0].get("value") or "")
        up = np.array(numbers if len(numbers) == 3 else numbers[1:12:4])  # of a matrix (4, 4) the second column
        axis = int(np.argmax(np.abs(up)))
        upright = abs(up[axis]) > _UPRIGHT * np.linalg.norm(up)
    except (ET.ParseError, OSError, ValueError, LookupError):
        return None
    return _AXES[axis][int(up[axis] < 0)] if upright else None
