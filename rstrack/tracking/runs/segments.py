"""A camera that is lost goes on in a track of its own: a segment, tied to the first where that finds the camera again.

segments = Segments(lambda: make_tracker(rig, options))
for frame in frames:
    report = tracker.feed(frame)
    segments.feed(frame, report.lost)
estimate = segments.joined(Estimate(*tracker.trajectory))
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.files import write_error
from rsgen.geometry import se3
from rstrack.data.estimate import SEGMENTS, Estimate, write_poses
from rstrack.data.rig import Frame
from rstrack.tracking.any_tracker import AnyTracker

if TYPE_CHECKING:
    from rstrack.tracking.frame_report import FrameReport

# Seconds without a pose after which the camera begins a segment.
_LOST_S = 0.5


@dataclass(frozen=True)
class Segment:
    """Poses T_segment_depth (n, 4, 4) at stamps (n,), in a world of their own.

    tie: stamp of a frame that the first track has found too, which ties the two; None: where it lies is not known.
    """

    stamps: FloatArray
    T_segment_depth: FloatArray
    tie: float | None = None


@dataclass
class Segments:
    """make: a tracker like the first one. found: the segments that have ended, in their order."""

    make: Callable[[], AnyTracker]
    found: list[Segment] = field(default_factory=list)
    _tracker: AnyTracker | None = None
    # Stamps of the first track's last pose, and of the segment's (or of where it began).
    _found: float = np.inf
    _own: float = np.inf

    @property
    def is_open(self) -> bool:
        """Whether the camera is in one now."""
        return self._tracker is not None

    def feed(self, frame: Frame, is_lost: bool) -> None:
        """A frame that the first track has lost, or found. Raises UserError as `Tracker.feed`."""
        stamp = frame.depth.stamp
        if self._tracker is None and is_lost and stamp - self._found > _LOST_S:
            self._tracker, self._own = self.make(), stamp
        if not is_lost:
            self._found = stamp
        if self._tracker is None:
            return
        report = self._tracker.feed(frame)
        if not report.lost:
            self._own = stamp
        if not is_lost:
            self.end(None if report.lost else stamp)
        elif stamp - self._own > _LOST_S:
            self.end()

    def end(self, tie: float | None = None) -> None:
        """The camera's segment, if it is in one, is over; one of a single pose is none. tie: as in `Segment`."""
        if self._tracker is not None:
            stamps, T_segment_depth = self._tracker.trajectory
            if len(stamps) > 1:
                self.found.append(Segment(stamps, T_segment_depth, tie))
            self._tracker = None

    def joined(self, track: Estimate) -> Estimate:
        """The first track, and the poses of segments that are tied to it, which have no spline."""
        stamps, T_world_depth = track.stamps, track.T_world_depth
        for segment in self.found:
            if segment.tie is None:
                continue
            at, own = (int(np.argmin(np.abs(some - segment.tie))) for some in (stamps, segment.stamps))
            T_world_segment = T_world_depth[at] @ se3.inverse(segment.T_segment_depth[own])
            missing = ~np.isin(segment.stamps, stamps)
            stamps = np.concatenate([stamps, segment.stamps[missing]])
            poses = se3.orthonormalise(T_world_segment @ segment.T_segment_depth[missing])
            T_world_depth = np.concatenate([T_world_depth, poses])
        order = np.argsort(stamps)
        return Estimate(stamps[order], T_world_depth[order], track.spline, track.info)

    def told(self, reports: Sequence[FrameReport]) -> list[FrameReport]:
        """The first track's reports, with the segments of frames that it has lost."""
        of = {float(t): (k, one.tie is None) for k, one in enumerate(self.found, 1) for t in one.stamps}
        return [
            replace(r, segment=of[r.stamp][0], lost=of[r.stamp][1]) if r.lost and r.stamp in of else r for r in reports
        ]

    def info(self) -> list[dict[str, Any]]:
        """For run.json: of each segment its number of poses, the stamps of the first and the last, s, and the tie."""
        return [
            {"poses": len(one.stamps), "begin": one.stamps[0], "end": one.stamps[-1], "tie": one.tie}
            for one in self.found
        ]

    def text(self) -> str:
        """One line; empty where there are none."""
        if not self.found:
            return ""
        count, tied = len(self.found), sum(one.tie is not None for one in self.found)
        of = "a segment of its own" if count == 1 else f"{count} segments of their own"
        where = f", {count - tied} of them tied to nothing: {SEGMENTS}/" if tied < count else ""
        return f"lost for more than {_LOST_S} s: {sum(len(one.stamps) for one in self.found)} poses in {of}{where}"

    def write(self, run: Path) -> None:
        """The segments that are tied to nothing, into a run's folder; an earlier run's go. Raises UserError."""
        folder = run / SEGMENTS
        try:
            if folder.exists():
                shutil.rmtree(folder)
            if any(one.tie is None for one in self.found):
                folder.mkdir()
        except OSError as error:
            raise write_error(folder, error) from None
        for k, one in enumerate(self.found, 1):
            if one.tie is None:
                write_poses(folder / f"{k}.txt", one.stamps, one.T_segment_depth, "T_segment_depth")
