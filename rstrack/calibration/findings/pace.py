"""How fast the camera moved and turned over the recording, by the first track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset

# Instants at most.
_MOST = 300


@dataclass(frozen=True)
class Pace:
    """Speeds (n,) in m/s and rad/s of the depth camera, at times (n,) in s since the recording's first frame."""

    times_s: FloatArray
    speeds: FloatArray
    rotations: FloatArray

    def as_dict(self) -> dict[str, list[float]]:
        """For JSON, to a ten-thousandth."""
        named = {"time_s": self.times_s, "m_s": self.speeds, "rad_s": self.rotations}
        return {name: np.round(values, 4).tolist() for name, values in named.items()}


def pace_of(dataset: Dataset, followed: Sequence[range], track: Spline) -> Pace:
    """At the stamps of the frames that were followed, or so many of them."""
    frames = np.concatenate([np.arange(run.start, run.stop) for run in followed])
    frames = frames[:: -(-len(frames) // _MOST)]
    velocity = track.velocity(dataset.stamps[frames])
    speeds, rotations = (np.linalg.norm(v, axis=1) for v in (velocity[:, :3], velocity[:, 3:]))
    return Pace(since_begin(dataset, frames), speeds, rotations)


def since_begin(dataset: Dataset, frames: Sequence[int] | np.ndarray) -> FloatArray:
    """Stamps (n,) of frames, s since the recording's first."""
    return np.asarray(dataset.stamps[np.asarray(frames)] - dataset.stamps[0])
