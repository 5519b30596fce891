"""When the lines of an image are exposed, and their poses and derivatives as tables for the kernels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.images.fast_spline import rows

NODES = 60
"""Evaluations of the spline that the poses of an image's lines are taken from: about every half of a millisecond."""


@dataclass(frozen=True)
class Exposure:
    """One image's lens, stamp (s, line 0 stops being exposed) and T_cam_body (4, 4): the body is the depth camera."""

    lens: Lens
    stamp: float
    T_cam_body: FloatArray

    def times(self) -> FloatArray:
        """Mid-exposure times (lines,) in s; one for a global shutter."""
        return self.lens.shutter.line_mid_time(self.stamp, np.arange(self.lens.lines), self.lens.camera)

    def block_times(self, per_block: int) -> FloatArray:
        """Times (blocks,) of the middle of each block of lines."""
        first = np.arange(0, self.lens.lines, per_block)
        middle = 0.5 * (first + np.minimum(first + per_block, self.lens.lines) - 1)
        return self.lens.shutter.line_mid_time(self.stamp, middle, self.lens.camera)

    @property
    def first_time(self) -> float:
        """Earliest time in s at which a line is exposed."""
        return float(self.lens.shutter.line_mid_time(self.stamp, 0, self.lens.camera))

    @property
    def last_time(self) -> float:
        """Latest such time."""
        return float(self.lens.shutter.line_mid_time(self.stamp, self.lens.lines - 1, self.lens.camera))

    @property
    def mid_time(self) -> float:
        """Mid readout: the reference time of a rectified image."""
        return 0.5 * (self.first_time + self.last_time)


@lru_cache(maxsize=16)
def _line_blocks(lens: Lens) -> tuple[FloatArray, FloatArray]:
    """Times (n,) of the blocks' middles after the stamp (s), and each line's time after that (n, per block).

    The last block's lines that the image does not have have its middle.
    """
    at_zero = Exposure(lens, 0.0, np.eye(4))
    per_node = max(1, lens.lines // NODES)
    middle = at_zero.block_times(per_node)
    dt = np.zeros(len(middle) * per_node)
    dt[: lens.lines] = at_zero.times() - middle.repeat(per_node)[: lens.lines]
    return middle, dt.reshape(len(middle), per_node)


def line_twists(spline: Spline, exposure: Exposure) -> FloatArray:
    """Body twists (lines, 6) in m/s and rad/s."""
    middle, since = _line_blocks(exposure.lens)
    return rows(spline, exposure.stamp + middle, since, exposure.lens.lines, np.eye(4), np.eye(4), True, 1.0)[:, 12:]


def to_base_table(spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> FloatArray:
    """T_base_cam of each line (lines, 12): rotation row-major, translation."""
    middle, since = _line_blocks(exposure.lens)
    ends = se3.inverse(T_world_base), se3.inverse(exposure.T_cam_body)
    return rows(spline, exposure.stamp + middle, since, exposure.lens.lines, *ends, False)


def from_base_table(spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> FloatArray:
    """T_cam_base of each line and the camera's body twist per line delay (lines, 18)."""
    middle, since = _line_blocks(exposure.lens)
    delay = exposure.lens.shutter.line_delay(exposure.lens.camera)
    ends = exposure.T_cam_body, T_world_base
    return rows(spline, exposure.stamp + middle, since, exposure.lens.lines, *ends, True, delay)


def rows_of(T: FloatArray) -> FloatArray:
    """Poses (..., 4, 4) as (..., 12): rotation row-major, translation."""
    return np.concatenate([T[..., :3, :3].reshape(*T.shape[:-2], 9), T[..., :3, 3]], axis=-1)


IDENTITY_TO_BASE = np.append(np.eye(3).ravel(), np.zeros(3))
IDENTITY_FROM_BASE = np.concatenate([np.eye(3).ravel(), np.zeros(9)])[None]


def to_base(e: Engine, spline: Spline, T_world_base: FloatArray, exposure: Exposure | None) -> Any:
    """`to_base_table` on the device; None: of an image that is rectified to the base frame."""
    return e.upload(IDENTITY_TO_BASE if exposure is None else to_base_table(spline, T_world_base, exposure))


def from_base(e: Engine, spline: Spline, T_world_base: FloatArray, exposure: Exposure | None) -> Any:
    """`from_base_table` on the device, likewise."""
    return e.upload(IDENTITY_FROM_BASE if exposure is None else from_base_table(spline, T_world_base, exposure))
