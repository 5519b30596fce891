"""A tracker that corrects itself where the camera comes back, while it goes on.

tracker = LoopTracker(rig, Options(loops="online"))
for frame in frames:
    tracker.feed(frame)
    stamps, T_world_depth = tracker.trajectory          # corrected as far as that is known now, the newest last

The tracker within goes on in a world of its own that drifts, to the same bits as without loops; what it has found is
moved where it is read. As ROS has it: within is `odom`, here is `map` (REP 105).
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.closing import Closed, Moves, closed
from rstrack.adjustment.loops import Loop, LoopSearch
from rstrack.data.imu.recording import ImuRecording
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import Timer, untimed
from rstrack.keyframes.archive import StoredFrames
from rstrack.options import Options
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.loop_closing import Closing, graph_of, search_of
from rstrack.tracking.spline_tracker import Tracker

# A loop says something new where it is so far (squared, in σ; six numbers' 99 % quantile) from where the others have
# put its keyframes.
_NEW = 16.8
# Part by which the keyframes must have grown in number before everything is adjusted anew: its cost grows with them.
_GROWTH = 0.03
# Control points that the newest frame's lines depend on.
_NEWEST = 4
# What a tracker of the same rig and options would have too.
_MADE_ANEW = "rig", "_tracker", "_load", "_frames"


class LoopTracker:
    """Estimates T_world_depth(t) as `Tracker` does; poses given before move when a loop is closed.

    One C² spline throughout. Where it was corrected the past moves as far as it was wrong, and the first frame stays.
    """

    def __init__(
        self, rig: Rig, options: Options | None = None, timer: Timer = untimed,
        load: Callable[[int], Frame] | None = None, imu: ImuRecording | None = None,
    ) -> None:  # fmt: skip
        """load: a frame by its number, counted from 0 as they were fed; without it keyframes' images are kept.

        imu: as `Tracker` has it.
        """
        self.rig, self._load = rig, load
        self._tracker = Tracker(rig, options, timer, imu)
        self._frames = StoredFrames(1e9 * self.options.memory_gb)
        self._held: deque[tuple[int, Frame]] = deque()
        self._moves = Moves()
        # By what each keyframe was moved, and the one that frames are aligned to now.
        self._by_keyframe: dict[int, FloatArray] = {}
        self._at, self._segment_start = -1, 0
        self._looked: set[int] = set()
        self._loops: list[Loop] = []
        self._closed: Closed | None = None
        self._closed_at = 0  # keyframes that there were then
        self._tried, self._faults = 0, Counter[str]()
        self._seconds, self._problem = 0.0, ""

    # -- as a tracker -----------------------------------------------------------------------------------------------

    @property
    def options(self) -> Options:
        """With all that depends on the rig."""
        return self._tracker.options

    @property
    def reports(self) -> list[FrameReport]:
        """Of all frames so far."""
        return self._tracker.reports

    @property
    def keyframes(self) -> int:
        """How many there have been."""
        return self._tracker.keyframes

    @property
    def reference(self) -> int | None:
        """Number of the frame whose keyframe new ones are aligned to."""
        return self._tracker.reference

    @property
    def spline(self) -> Spline | None:
        """T_world_depth(t) so far, corrected."""
        found = self._tracker.spline
        return None if found is None else self._moves.spline(found)

    @property
    def spline_valid(self) -> Sequence[tuple[float, float]]:
        """Times (begin, end) in s within which the spline is an estimate."""
        return self._tracker.spline_valid

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) of the frames that were not lost and T_world_depth (n, 4, 4) there, corrected."""
        stamps, T_world_depth = self._tracker.trajectory
        found = self._tracker.spline
        if found is None or self._closed is None:
            return stamps, T_world_depth
        return stamps, self._moves.poses(found, stamps, T_world_depth)

    @property
    def uncorrected(self) -> Tracker:
        """The tracker within."""
        return self._tracker

    def feed(self, frame: Frame) -> FrameReport:
        """Track one frame, and close loops where it completes a keyframe. Raises UserError as `Tracker.feed`."""
        number = len(self.reports)
        report = self._tracker.feed(frame)
        if self._load is None and not report.lost:
            self._held.append((number, frame))
        is_new = self._follow()
        self._keep()
        if is_new:
            begin = time.perf_counter()
            self._look()
            self._seconds += time.perf_counter() - begin
        return report

    # -- loops ------------------------------------------------------------------------------------------------------

    @property
    def closing(self) -> Closing:
        """What has become of loops so far."""
        moves = None if self._closed is None else self._moves
        return Closing(
            list(self._loops), self._closed, self._seconds, self._tried, dict(self._faults), self._problem, moves
        )  # fmt: skip

    def finished(self, progress: Progress = no_progress) -> Closing:
        """Look at what is left, and close all loops once more. No frame may follow."""
        begin = time.perf_counter()
        self._tracker.track.all_keyframes()
        self._at = -1
        self._look()
        if self._loops:
            self._close(progress)
        self._seconds += time.perf_counter() - begin
        return self.closing

    def _follow(self) -> bool:
        """What is aligned to another keyframe from now on moves as that does. Whether it is."""
        at, window = self._tracker.reference, self._tracker.track.window
        if at is None or at == self._at:
            return False
        spline = self._tracker.spline
        assert spline is not None and window is not None
        count, begin = len(spline.control_points), window.segment_start
        before = self._moves.of(count - 1, 1)[0]
        T = self._by_keyframe.setdefault(at, self._by_keyframe.get(self._at, before))
        if not np.array_equal(T, before):
            self._moves = self._moves.then(begin if begin != self._segment_start else count - _NEWEST, T)
        self._at, self._segment_start = at, begin
        return True

    def _keep(self) -> None:
        """Of a camera's images those of keyframes, and those that may become one."""
        recent, archive = self._tracker.track.succession.recent, self._tracker.track.keyframes.archive
        pending = recent[0].index if recent else len(self.reports)
        while self._held:
            number, frame = self._held[0]
            is_keyframe = number == self._at or number in archive
            if not is_keyframe and number >= pending:
                break
            self._held.popleft()
            if is_keyframe:
                self._frames.add(number, frame)

    def _look(self) -> None:
        """Look for loops of keyframes that have been left behind since, and close them if they say something new."""
        spline, archive = self._tracker.spline, self._tracker.track.keyframes.archive
        fresh = sorted(k for k in archive.indices if k not in self._looked and k != self._at)
        if spline is None or not fresh:
            return
        poses = {k: self._by_keyframe[k] @ archive.pose(k) for k in archive.indices if k in self._by_keyframe}
        search = search_of(self._tracker, archive, spline, self._load or self._frames.get, poses)
        news = False
        for late in fresh:
            self._looked.add(late)
            try:
                found = search.find_of(late)
            except (UserError, np.linalg.LinAlgError) as error:
                self._problem = str(error)
                continue
            self._loops += found
            news = news or any(self._is_new(loop, search, spline) for loop in found)
        self._tried, self._faults = self._tried + search.tried, self._faults + search.faults
        if news and len(archive) >= (1.0 + _GROWTH) * self._closed_at:
            self._close()

    def _is_new(self, loop: Loop, search: LoopSearch, spline: Spline) -> bool:
        moved = self._moves.spline(spline)
        for s in loop.sightings:
            T_ref_cam = se3.inverse(search.pose(s.keyframe)) @ moved.pose(s.t)
            e = se3.log(se3.inverse(s.T_ref_cam) @ T_ref_cam)
            if e @ s.information @ e > _NEW:
                return True
        return False

    def _close(self, progress: Progress = no_progress) -> None:
        """Adjust everything to all loops."""
        keyframes = self._tracker.track.all_keyframes()
        graph = graph_of(self._tracker, keyframes)
        try:
            self._closed = closed(graph, self._loops, float(self._tracker.trajectory[0][0]), progress)
        except np.linalg.LinAlgError as error:
            self._problem = str(error)
            return
        self._closed_at = len(keyframes)
        self._moves = Moves.between(graph.at.spline, self._closed.state.spline)
        before = self._by_keyframe
        self._by_keyframe = {
            k: se3.orthonormalise(T @ se3.inverse(keyframes.pose(k))) for k, T in self._closed.state.keyframes.items()
        }
        if self._at >= 0 and self._at not in self._by_keyframe:
            # Rolling still: it moves with the newest control points.
            assert self._at in before
            self._by_keyframe[self._at] = self._moves.points[-1]

    # -- checkpoints ------------------------------------------------------------------------------------------------

    @property
    def state(self) -> dict[str, Any]:
        """All that feeding frames has changed."""
        own = {name: value for name, value in vars(self).items() if name not in _MADE_ANEW}
        return own | {"tracker": self._tracker.state}

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        own = dict(state)
        self._tracker.state = own.pop("tracker")
        vars(self).update(own)
