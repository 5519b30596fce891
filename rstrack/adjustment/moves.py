"""By what loops have moved a track: a spline and its poses as they were found, and as they are corrected."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline


@dataclass(frozen=True)
class Moves:
    """Left motions (in the world) of a spline's control points.

    points (n, 4, 4): of the first n. later: of all from a number on, up to the next, as one body each; where there are
    none of these they go with the last of `points`.
    """

    points: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    later: tuple[tuple[int, FloatArray], ...] = ()

    @classmethod
    def between(cls, before: Spline, after: Spline) -> Moves:
        """Those that make the one spline of the other."""
        return cls(se3.orthonormalise(after.control_points @ se3.inverse(before.control_points)))

    def then(self, first: int, T: FloatArray) -> Moves:
        """From control point number `first` on, T (4, 4) from now on; what is before stays as it is."""
        kept = [(n, before) for n, before in self.later if n < first]
        return replace(self, later=(*kept, (first, T)))

    def of(self, first: int, count: int) -> FloatArray:
        """Motions (count, 4, 4) of control points from number `first` on."""
        numbers = first + np.arange(count)
        known = self.points if len(self.points) else np.eye(4)[None]
        T = known[np.minimum(numbers, len(known) - 1)]
        for begin, motion in self.later:
            T[numbers >= begin] = motion
        return T

    def spline(self, found: Spline) -> Spline:
        """A spline as it was found, moved."""
        T = self.of(found.first, len(found.control_points)) @ found.control_points
        return replace(found, control_points=se3.orthonormalise(T))

    def poses(self, found: Spline, stamps: FloatArray, T_world_depth: FloatArray) -> FloatArray:
        """Poses (n, 4, 4) at stamps (n,) in s, moved as the spline is that was found with them."""
        moved = self.spline(found).pose(stamps) @ se3.inverse(found.pose(stamps))
        return se3.orthonormalise(moved @ T_world_depth)
