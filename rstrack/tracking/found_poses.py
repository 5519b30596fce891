"""Where the frames of a track were, as far as they were found; and when its spline is known."""

from __future__ import annotations

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.spline_state import PointStore
from rstrack.images.device_frame import DeviceFrame
from rstrack.tracking.window import Window


class FoundPoses:
    """stamps: of the frames that were found. valid: times (begin, end) in s within which the spline is an estimate.

    Poses of the first frames are kept here once nothing moves them; the others are the spline's.
    """

    def __init__(self) -> None:
        self.stamps: list[float] = []
        self.valid: list[tuple[float, float]] = []
        self._settled = PointStore()

    @property
    def end(self) -> float:
        """Time (s) until which the spline is known."""
        return self.valid[-1][1]

    def add(self, new: DeviceFrame, joined: bool = True) -> None:
        """A frame that has been found; joined: to the frames before it, not with a piece of its own."""
        self.stamps.append(new.stamp)
        begin = min(new.first_time, new.stamp)
        if joined and self.valid:
            begin = self.valid.pop()[0]
        self.valid.append((begin, new.last_time))

    def all(self, spline: Spline) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) and poses T_world_depth (n, 4, 4)."""
        return np.array(self.stamps), np.concatenate([self._settled.points, self._moving(spline, len(self.stamps))])

    def begin_piece(self, before: Spline, untouched: float) -> None:
        """All poses stay as they are with the spline `before`, which is another one from time `untouched` (s) on."""
        self._settled.put(self._settled.count, self._moving(before, len(self.stamps)))
        begin, end = self.valid.pop()
        if untouched > begin:
            self.valid.append((begin, min(end, untouched)))

    def release(self, window: Window, begin: float) -> None:
        """Hold no more of the spline than still moves, or times from `begin` (s) on depend on."""
        first = window.releasable(begin)
        if first is None:
            return
        end = self._settled.count
        while window.state.segment(self.stamps[end]) < first:
            end += 1
        self._settled.put(self._settled.count, self._moving(window.spline, end))
        window.state.release(first)

    def _moving(self, spline: Spline, end: int) -> FloatArray:
        """Poses (n, 4, 4) from the first one that is not settled to number `end`."""
        return spline.pose(np.array(self.stamps[self._settled.count : end]))
