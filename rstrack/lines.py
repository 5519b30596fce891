"""When the lines of an image are exposed, and their poses and derivatives as tables for the kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.geometry import se3
from rsgen.geometry.so3 import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.warp import Lens


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


def to_base_table(spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> FloatArray:
    """T_base_cam of each line (lines, 12): rotation row-major, translation."""
    T = se3.inverse(T_world_base) @ spline.pose(exposure.times()) @ se3.inverse(exposure.T_cam_body)
    return np.concatenate([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]], axis=1)


def from_base_table(spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> FloatArray:
    """T_cam_base of each line and the camera's body twist per line delay (lines, 18)."""
    T_world_body, twist = spline.pose_and_velocity(exposure.times())
    T = exposure.T_cam_body @ se3.inverse(T_world_body) @ T_world_base
    delay = exposure.lens.shutter.line_delay(exposure.lens.camera)
    twist_cam = delay * twist @ se3.adjoint(exposure.T_cam_body).T
    return np.concatenate([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3], twist_cam], axis=1)


IDENTITY_FROM_BASE = np.concatenate([np.eye(3).ravel(), np.zeros(9)])[None]
