"""Poses of a camera over one frame as a table on the device, evaluated in float64 by the one NumPy spline.

The table's step is the frame's whole span over four times the number of lines, and entries are blended linearly for
each ray or point: the blend's error is far below a micrometre, and a line's own pose costs what a still's does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import aligned
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter

# Poses T_world_cam (n, 4, 4) at times (n,) in seconds, such as `Spline.pose`.
PoseFunction = Callable[[Any], FloatArray]


@dataclass(frozen=True)
class PoseTable:
    """T_world_cam from a frame's first line's shutter opening, stamp − t_e, to its last line's end, stamp + t_r.

    rows: three 4-vectors, the rows of [R t], for each of steps + 1 instants, flat.
    """

    rows: Any
    steps: int
    step_s: Any  # a number, or one on the device
    vector: Any

    @staticmethod
    def of(
        vector: Any, camera: Camera, shutter: Shutter, T_world_cam: PoseFunction, stamp: float,
        reference: FloatArray | None = None,
    ) -> PoseTable:  # fmt: skip
        """Of the frame at `stamp` (s). vector: the device's type of four floats. reference (3,): the positions' origin.

        Raises UserError if `T_world_cam` does over the frame's time.
        """
        span = shutter.exposure_s + shutter.readout_s
        steps = 4 * shutter.line_count(camera) if span > 0 else 1
        step_s = span / steps if span > 0 else 1.0
        grid = stamp - shutter.exposure_s + (span / steps) * np.arange(steps + 1)
        T = np.array(np.broadcast_to(T_world_cam(grid if span > 0 else grid[:1]), (steps + 1, 4, 4)))
        if reference is not None:
            T[:, :3, 3] -= reference
        rows = dr.value_t(vector)(aligned(T[:, :3, :]))
        dr.make_opaque(rows)
        return PoseTable(rows, steps, step_s, vector)

    def followed_by(self, *others: PoseTable) -> PoseTable:
        """One table of several of the same frame, for `at` with a number."""
        rows = dr.concat([self.rows, *(other.rows for other in others)])
        dr.make_opaque(rows)
        return PoseTable(rows, self.steps, self.step_s, self.vector)

    def at(self, t: Any, beyond: bool = False, number: Any = None) -> list[Any]:
        """The rows of [R t] at t seconds after the first line's shutter opened.

        Outside the table they stay as at its end, or with `beyond` go on straight. number: which of the tables that
        were joined, 0 the first.
        """
        x = t / self.step_s
        if not beyond:
            x = dr.clip(x, 0.0, float(self.steps))
        index = dr.uint32_array_t(x)(dr.clip(x, 0.0, float(self.steps - 1)))
        fraction = x - type(x)(index)
        if number is not None:
            index += number * (self.steps + 1)
        low, high = ([dr.gather(self.vector, self.rows, 3 * i + k) for k in range(3)] for i in (index, index + 1))
        return [dr.fma(fraction, b - a, a) for a, b in zip(low, high, strict=True)]
