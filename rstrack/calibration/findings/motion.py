"""How much a recording moves in what a calibration used of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset


@dataclass(frozen=True)
class Motion:
    """Mean speeds in the stretches that were used, m/s and rad/s, and the changes of the latter, rad/s²."""

    speed: float
    rotation: float
    change: float

    def text(self) -> str:
        """In plain words."""
        return (
            f"this recording moves at {self.speed:.2f} m/s and turns at {np.degrees(self.rotation):.1f} deg/s, which "
            f"changes by {np.degrees(self.change):.0f} deg/s a second"
        )


def motion_of(dataset: Dataset, parts: Sequence[range], track: Spline) -> Motion:
    """Of the stretches of frames that were used, by the track."""
    stamps = np.concatenate([dataset.stamps[part.start : part.stop] for part in parts])
    v, a = track.velocity(stamps), track.acceleration(stamps)
    means = [float(np.linalg.norm(x, axis=1).mean()) for x in (v[:, :3], v[:, 3:], a[:, 3:])]
    return Motion(*means)
