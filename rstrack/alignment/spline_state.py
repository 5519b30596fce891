"""The spline while it grows and moves."""

from __future__ import annotations

import copy

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline

# Position u of the last line on its knot interval below which the last control point (weight u³/6) is mere guesswork.
_TOLD = 0.6


class SplineState:
    """The growing spline: control points (m, 4, 4) in the world and the sum of increments that each has received."""

    def __init__(self, spline: Spline) -> None:
        self.spline = spline
        self.moved = np.zeros((len(spline.control_points), 6))

    @classmethod
    def still(cls, t0: float, dt: float, T_world_body: FloatArray, count: int = 4) -> SplineState:
        """Control points that are all at T_world_body (4, 4), from time t0 (s) on, dt (s) apart."""
        return cls(Spline(np.repeat(T_world_body[None], count, axis=0), t0, dt))

    @property
    def points(self) -> FloatArray:
        """Control points (m, 4, 4)."""
        return self.spline.control_points

    @property
    def dt(self) -> float:
        """Seconds between knots."""
        return self.spline.dt

    def copy(self) -> SplineState:
        """A state that can be changed without changing this one."""
        twin = copy.copy(self)
        twin.moved = self.moved.copy()
        return twin

    def restarted(self, end: float, first: float, last: float, T_world_body: FloatArray) -> SplineState:
        """The same up to time `end`; from `first` to `last` standing still at T_world_body (4, 4)."""
        points = self.points
        keep = self.segment(end) + 4
        start, stop = self.segment(first), self.segment(last) + 4
        gap = np.repeat(points[keep - 1][None], max(0, start - keep), axis=0)
        still = np.repeat(T_world_body[None], stop - start, axis=0)
        return SplineState(
            Spline(np.concatenate([points[: min(keep, start)], gap, still]), self.spline.t0, self.spline.dt)
        )

    def segment(self, t: float) -> int:
        """Index of the first of the four control points that a time depends on."""
        return int(np.floor((t - self.spline.t0) / self.spline.dt))

    def extend(self, t: float) -> None:
        """Grow with constant velocity until time t is covered."""
        points = self.points
        missing = self.segment(t) + 4 - len(points)
        if missing <= 0:
            return
        step = se3.inverse(points[-2]) @ points[-1]
        new = [points[-1]]
        for _ in range(missing):
            # Products drift away from rotations, and inverses by transposition amplify that (2.4 times a knot).
            new.append(se3.orthonormalise(new[-1] @ step))
        self.spline = self.spline.changed(len(points), np.array(new[1:]))
        self.moved = np.concatenate([self.moved, np.zeros((missing, 6))])

    def smooth_end(self, t: float) -> None:
        """Lay the last control point on with constant velocity if lines until time t (s) hardly told where it is.

        It weighs u³/6 in them at most, so that a systematic error of the lines is magnified; and the next control
        points are extrapolated from it.
        """
        points = self.points
        s = (t - self.spline.t0) / self.spline.dt
        if s - np.floor(s) > _TOLD or self.segment(t) + 4 != len(points):
            return
        step = se3.inverse(points[-3]) @ points[-2]
        T = se3.orthonormalise(points[-2] @ step)
        self.apply(len(points) - 1, se3.log(T @ se3.inverse(points[-1]))[None])

    def apply(self, first: int, increments: FloatArray) -> None:
        """T_i ← exp(δ_i) T_i for control points first, first + 1, ...; increments (n, 6)."""
        last = first + len(increments)
        points = se3.orthonormalise(se3.exp(increments) @ self.points[first:last])
        self.spline = self.spline.changed(first, points)
        self.moved[first:last] += increments
