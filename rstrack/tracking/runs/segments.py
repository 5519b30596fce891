"""A camera that is lost goes on in a track of its own: a segment, begun with the last frames that were found.

segments = segments_beside(tracker, rig, options, load)
for frame in frames:
    tracker.feed(frame)
    segments.feed(frame, tracker.reports)
estimate = segments.joined(Estimate(*tracker.trajectory))
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.files import write_error
from rsgen.geometry import se3
from rstrack.data.estimate import SEGMENTS, Estimate, write_poses
from rstrack.data.imu.recording import ImuRecording
from rstrack.data.rig import Frame, Rig
from rstrack.options import Options
from rstrack.tracking.any_tracker import AnyTracker, make_tracker

if TYPE_CHECKING:
    from rstrack.tracking.frame_report import FrameReport

# Seconds without a pose after which the camera begins a segment.
_LOST_S = 0.5


@dataclass(frozen=True)
class Segment:
    """Poses T_segment_depth (n, 4, 4) at stamps (n,), in a world of their own.

    reports: of each, by its stamp. ties (m,): stamps of those that the first track has found too, or a segment before
    that is tied. Without one it is not known where the segment lies.
    """

    stamps: FloatArray
    T_segment_depth: FloatArray
    reports: Mapping[float, FrameReport]
    ties: FloatArray

    @property
    def is_tied(self) -> bool:
        """Whether it shares a frame with what is known before."""
        return len(self.ties) > 0

    def report(self, stamp: float, before: Mapping[float, FrameReport], track: Estimate) -> FrameReport:
        """Of the frame at a stamp (s), where the nearest tie has the segment; before: reports of what it is tied to.

        The errors that both tracks have at the tie, as far as they are noise, come on top of the segment's own.
        """
        own, tie = self.reports[stamp], self.ties[np.argmin(np.abs(self.ties - stamp))]
        there, here = before[tie], self.reports[tie]
        parts = there.drift_world, there.covariance, here.covariance, here.drift_world, own.drift_world
        known = [part for part in parts if part is not None]
        if len(known) < len(parts):
            return own  # of a method without covariances
        T_world_tie = track.T_world_depth[np.searchsorted(track.stamps, tie)]
        T, T_tie = (self.T_segment_depth[np.searchsorted(self.stamps, t)] for t in (stamp, tie))
        tie_to_world, segment_to_world = se3.adjoint(T_world_tie), se3.adjoint(T_world_tie @ se3.inverse(T_tie))
        to_world = np.eye(6), tie_to_world, tie_to_world, segment_to_world, segment_to_world
        drift = np.sum([A @ C @ A.T for A, C in zip(to_world, known, strict=True)], axis=0)
        common = own.common
        if common is not None and there.common is not None and here.common is not None:
            common = common + se3.adjoint(se3.inverse(T) @ T_tie) @ (there.common - here.common)
        return replace(own, drift_world=drift, common=common)


@dataclass
class Segments:
    """make: a tracker like the first one. load: a frame that was fed, by its number. overlap: the last frames with a
    pose, which a segment begins with. found: the segments that have ended, in their order."""

    make: Callable[[], AnyTracker]
    load: Callable[[int], Frame]
    overlap: int
    found: list[Segment] = field(default_factory=list)
    _tracker: AnyTracker | None = None
    # Stamp of the segment's last pose (or of where it began); stamps of the tied ones' poses; the first frame that none
    # has been fed in vain.
    _own: float = np.inf
    _known: set[float] = field(default_factory=set)
    _next: int = 0

    @property
    def begun(self) -> bool:
        """Whether the camera has been in one, or is now."""
        return bool(self.found) or self._tracker is not None

    def feed(self, frame: Frame, reports: Sequence[FrameReport]) -> None:
        """The newest frame, and the first track's reports of all frames. Raises UserError as `Tracker.feed`."""
        stamp, newest = frame.depth.stamp, len(reports) - 1
        if self._tracker is None and reports[-1].lost:
            known = (k for k in range(newest, -1, -1) if self._has_pose(reports[k]))
            last = list(islice(known, self.overlap))
            if last and stamp - reports[last[0]].stamp > _LOST_S:
                self._tracker, self._own = self.make(), stamp
                # Frames that an earlier segment could make nothing of are not tried twice.
                for k in range(max(last[-1], self._next), newest):
                    self._follow(self.load(k))
        if self._tracker is None:
            return
        self._follow(frame)
        if stamp - self._own > _LOST_S:
            # Another one begins with what a tied one has found last, and with new frames after others.
            ended = self.end(reports)
            self._next = self._next if ended is not None and ended.is_tied else newest + 1
        elif not reports[-1].lost:
            self.end(reports)

    def _has_pose(self, report: FrameReport) -> bool:
        return not report.lost or report.stamp in self._known

    def _follow(self, frame: Frame) -> None:
        assert self._tracker is not None
        if not self._tracker.feed(frame).lost:
            self._own = frame.depth.stamp

    def end(self, reports: Sequence[FrameReport]) -> Segment | None:
        """The camera's segment, if it is in one, is over. Without two poses, one of them its own, it is none."""
        tracker, self._tracker = self._tracker, None
        if tracker is None:
            return None
        stamps, T_segment_depth = tracker.trajectory
        is_tie = np.isin(stamps, [r.stamp for r in reports if self._has_pose(r)])
        if len(stamps) < 2 or is_tie.all():
            return None
        own = {r.stamp: r for r in tracker.reports if not r.lost}
        self.found.append(Segment(stamps, T_segment_depth, own, stamps[is_tie]))
        self._known |= set(stamps.tolist()) if is_tie.any() else set()
        return self.found[-1]

    def joined(self, track: Estimate) -> Estimate:
        """The first track, and the poses of segments that are tied to it, which have no spline.

        Each tie says where the segment lies; between two of them it is interpolated.
        """
        stamps, T_world_depth = track.stamps, track.T_world_depth
        for segment in self.found:
            if not segment.is_tied:
                continue
            is_tie, own = np.isin(segment.stamps, segment.ties), segment.T_segment_depth
            T_world_segment = T_world_depth[np.searchsorted(stamps, segment.ties)] @ se3.inverse(own[is_tie])
            is_missing = ~np.isin(segment.stamps, stamps)  # an IMU may have bridged some since
            missing = segment.stamps[is_missing]
            at = np.clip(missing, segment.ties[0], segment.ties[-1])
            poses = se3.orthonormalise(se3.interpolated(segment.ties, T_world_segment, at) @ own[is_missing])
            order = np.argsort(np.concatenate([stamps, missing]))
            stamps = np.concatenate([stamps, missing])[order]
            T_world_depth = np.concatenate([T_world_depth, poses])[order]
        return Estimate(stamps, T_world_depth, track.spline, track.info)

    def reports(self, reports: Sequence[FrameReport], track: Estimate) -> list[FrameReport]:
        """The first track's reports, with those of segments of frames that it has lost. track: `joined`."""
        found = {r.stamp: r for r in reports}
        for k, segment in enumerate(self.found, 1):
            for t in segment.stamps.tolist():
                if found[t].lost:
                    own = segment.report(t, found, track) if segment.is_tied else found[t]
                    found[t] = replace(own, segment=k, keyframe=False)
        return list(found.values())

    def info(self) -> list[dict[str, Any]]:
        """For run.json: of each segment its number of poses, and stamps, s: of the first, the last, the first tie."""
        return [
            {
                "poses": len(one.stamps),
                "begin": one.stamps[0],
                "end": one.stamps[-1],
                "tie": one.ties[0] if one.is_tied else None,
            }
            for one in self.found
        ]

    def text(self) -> str:
        """One line; empty where there are none."""
        if not self.found:
            return ""
        count, tied = len(self.found), sum(one.is_tied for one in self.found)
        of = "a segment of its own" if count == 1 else f"{count} segments of their own"
        where = f", {count - tied} of them tied to nothing: {SEGMENTS}/" if tied < count else ""
        return f"lost for more than {_LOST_S} s: {sum(len(one.stamps) for one in self.found)} poses in {of}{where}"

    def write(self, run: Path) -> None:
        """The segments that are tied to nothing, into a run's folder; an earlier run's go. Raises UserError."""
        folder = run / SEGMENTS
        try:
            if folder.exists():
                shutil.rmtree(folder)
            if not all(one.is_tied for one in self.found):
                folder.mkdir()
        except OSError as error:
            raise write_error(folder, error) from None
        for k, one in enumerate(self.found, 1):
            if not one.is_tied:
                write_poses(folder / f"{k}.txt", one.stamps, one.T_segment_depth, "T_segment_depth")


def segments_beside(
    tracker: AnyTracker, rig: Rig, options: Options, load: Callable[[int], Frame], interval_s: float | None = None,
    imu: ImuRecording | None = None,
) -> Segments:  # fmt: skip
    """Of a track by a tracker that was made with the same: each by one like it, without loops, that begins with what it
    has learnt of the cameras. load: a frame that was fed, by its number."""
    alone = replace(options, loops="off")
    return Segments(
        lambda: make_tracker(rig, alone, interval_s=interval_s, imu=imu, after=tracker), load, alone.bootstrap_frames
    )
