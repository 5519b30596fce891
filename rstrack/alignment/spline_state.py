"""The spline, equation (4), while it grows and moves."""

from __future__ import annotations

import copy

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.images.fast_spline import changed, moved

# Position u of the last line on its knot interval below which the last control point (weight u³/6) is mere guesswork.
_OBSERVED = 0.6


class SplineState:
    """The growing spline, and the sum of increments (m, 6) that each of its control points has received.

    Only the end is held here, from control point number `first` on, and copied with every step; what is before it moves
    no more and is in `done`, to which it is only ever added.
    """

    def __init__(self, spline: Spline, done: PointStore | None = None) -> None:
        """done: the control points before the spline's first."""
        self.spline, self.done = spline, done or PointStore()
        self.moved = np.zeros((len(spline.control_points), 6))
        # Until this time (s) the spline is what it was before it was restarted.
        self.untouched = spline.t_end

    @classmethod
    def still(cls, t0: float, dt: float, T_world_body: FloatArray, count: int = 4) -> SplineState:
        """Control points that are all at T_world_body (4, 4), from time t0 (s) on, dt (s) apart."""
        return cls(Spline(np.repeat(T_world_body[None], count, axis=0), t0, dt))

    @property
    def points(self) -> FloatArray:
        """Control points (m, 4, 4) from number `first` on."""
        return self.spline.control_points

    @property
    def first(self) -> int:
        """Number of the first control point that is held."""
        return self.spline.first

    @property
    def end(self) -> int:
        """Number of control points, with those before `first`."""
        return self.first + len(self.points)

    @property
    def dt(self) -> float:
        """Seconds between knots."""
        return self.spline.dt

    @property
    def whole(self) -> Spline:
        """With all control points."""
        if not self.first:
            return self.spline
        return Spline(np.concatenate([self.done.points[: self.first], self.points]), self.spline.t0, self.dt)

    def received(self, first: int, last: int) -> FloatArray:
        """Sums of increments (last − first, 6) of control points that are held."""
        return self.moved[first - self.first : last - self.first].copy()

    def distance_from(self, before: SplineState) -> float:
        """Largest increment (m, rad) that a control point which both hold has received since."""
        first, last = max(self.first, before.first), min(self.end, before.end)
        return float(np.abs(self.received(first, last) - before.received(first, last)).max(initial=0.0))

    def copy(self) -> SplineState:
        """A state that can be changed without changing this one."""
        twin = copy.copy(self)
        twin.moved = self.moved.copy()
        return twin

    def release(self, first: int) -> None:
        """Hold the control points from number `first` on only: the others move no more."""
        count = first - self.first
        self.done.put(self.first, self.points[:count])
        self.spline, self.moved = self.spline.tail(first), self.moved[count:].copy()

    def restarted(self, end: float, first: float, last: float, T_world_body: FloatArray) -> SplineState:
        """The same up to time `end`, as far as `untouched`; from `first` to `last` at rest at T_world_body (4, 4)."""
        points = self.points
        keep = self.segment(end) + 4
        start, stop = self.segment(first), self.segment(last) + 4
        gap = np.repeat(points[keep - 1 - self.first][None], max(0, start - keep), axis=0)
        still = np.repeat(T_world_body[None], stop - start, axis=0)
        earlier = points[: min(keep, start) - self.first]
        spline = Spline(np.concatenate([earlier, gap, still]), self.spline.t0, self.dt, self.first)
        state = SplineState(spline, self.done)
        state.untouched = self.spline.t0 + (min(keep, start) - 3) * self.dt
        return state

    def segment(self, t: float) -> int:
        """Number of the first of the four control points that a time depends on."""
        return int(np.floor((t - self.spline.t0) / self.spline.dt))

    def extend(self, t: float) -> None:
        """Grow with constant velocity until time t is covered."""
        points = self.points
        missing = self.segment(t) + 4 - self.end
        if missing <= 0:
            return
        step = se3.inverse(points[-2]) @ points[-1]
        new = [points[-1]]
        for _ in range(missing):
            # Products drift away from rotations, and inverses by transposition amplify that (2.4 times a knot).
            new.append(se3.orthonormalise(new[-1] @ step))
        self.spline = changed(self.spline, self.end, np.array(new[1:]))
        self.moved = np.concatenate([self.moved, np.zeros((missing, 6))])

    def smooth_end(self, t: float) -> None:
        """Lay the last control point on with constant velocity if lines until time t (s) hardly observe it.

        It weighs u³/6 in them at most, so that a systematic error of the lines is magnified; and the next control
        points are extrapolated from it.
        """
        points = self.points
        s = (t - self.spline.t0) / self.spline.dt
        if s - np.floor(s) > _OBSERVED or self.segment(t) + 4 != self.end:
            return
        step = se3.inverse(points[-3]) @ points[-2]
        T = se3.orthonormalise(points[-2] @ step)
        self.apply(self.end - 1, se3.log(T @ se3.inverse(points[-1]))[None])

    def apply(self, first: int, increments: FloatArray) -> None:
        """T_i ← exp(δ_i) T_i for control points number first, first + 1, ...; increments (n, 6)."""
        at = slice(first - self.first, first - self.first + len(increments))
        self.spline = changed(self.spline, first, moved(self.points[at], increments))
        self.moved[at] += increments


class PointStore:
    """Poses (n, 4, 4) that grow at their end, at a cost that does not depend on how many there are."""

    def __init__(self) -> None:
        self._room, self.count = np.empty((64, 4, 4)), 0

    @property
    def points(self) -> FloatArray:
        """All of them, not to be written to."""
        view = self._room[: self.count]
        view.setflags(write=False)
        return view

    def put(self, at: int, points: FloatArray) -> None:
        """Poses from number `at` on, at most the next one: they are the last ones then."""
        if not 0 <= at <= self.count:
            raise IndexError(f"poses from number {at} on, where there are {self.count}")
        end = at + len(points)
        if end > len(self._room):
            room = np.empty((max(end, 2 * len(self._room)), 4, 4))
            room[:at] = self._room[:at]
            self._room = room
        self._room[at:end] = points
        self.count = end
