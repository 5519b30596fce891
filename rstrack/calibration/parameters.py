"""What is calibrated: readouts of both streams, colour's clock against depth's, and the extrinsics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rsgen.geometry import se3

Group = Literal["readout", "offset", "extrinsics"]
GROUPS: tuple[str, ...] = get_args(Group)

NAMES = (
    "depth.readout_s", "color.readout_s", "color.offset_s", "color.drift",
    "T_color_depth.x", "T_color_depth.y", "T_color_depth.z",
    "T_color_depth.rx", "T_color_depth.ry", "T_color_depth.rz",
)  # fmt: skip
"""The unknowns, in the order of their vectors. Extrinsics: T_color_depth ← exp(ε) T_color_depth, ε in colour's axes."""
COUNT = len(NAMES)
DRIFT = NAMES.index("color.drift")

_GROUP_OF: tuple[Group, ...] = ("readout", "readout", "offset", "offset", *(("extrinsics",) * 6))
# What is known of each beforehand (σ): s, s, s, s/s, m, rad.
PRIOR = np.array([0.03, 0.03, 0.05, 5e-4, *(0.05,) * 3, *np.radians((5.0,) * 3)])
# σ above which a value is of no use: it is called undetermined and keeps what it was.
USEFUL = np.array([2e-3, 2e-3, 2e-3, 5e-5, *(5e-3,) * 3, *np.radians((0.3,) * 3)])


@dataclass(frozen=True)
class Parameters:
    """Values of the unknowns.

    *_readout_s: from the first line of an image to after its last, in the camera file's scan; negative: the other way
    round. Colour's stamps t are late or early: taken at t + color_offset_s + color_drift (t − epoch_s). T_color_depth
    (4, 4): p_color from p_depth.
    """

    depth_readout_s: float
    color_readout_s: float
    color_offset_s: float
    color_drift: float
    T_color_depth: FloatArray
    epoch_s: float = 0.0

    def moved(self, step: FloatArray) -> Parameters:
        """After a step (10,) in the order of NAMES."""
        return replace(
            self,
            depth_readout_s=self.depth_readout_s + float(step[0]),
            color_readout_s=self.color_readout_s + float(step[1]),
            color_offset_s=self.color_offset_s + float(step[2]),
            color_drift=self.color_drift + float(step[3]),
            T_color_depth=se3.orthonormalise(se3.exp(step[4:]) @ self.T_color_depth),
        )

    def since(self, start: Parameters) -> FloatArray:
        """The step (10,) that leads here from `start`."""
        T = se3.log(self.T_color_depth @ se3.inverse(start.T_color_depth))
        clocks = (
            self.depth_readout_s - start.depth_readout_s, self.color_readout_s - start.color_readout_s,
            self.color_offset_s - start.color_offset_s, self.color_drift - start.color_drift,
        )  # fmt: skip
        return np.concatenate([clocks, T])

    def color_time(self, stamp: float) -> float:
        """When a colour image that is stamped so was taken, on depth's clock (s)."""
        return stamp + self.color_offset_s + self.color_drift * (stamp - self.epoch_s)


def free_of(groups: Sequence[str]) -> BoolArray:
    """Which of the unknowns (10,) belong to the groups."""
    return np.array([group in groups for group in _GROUP_OF])
