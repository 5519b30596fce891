"""The online tracker (paper, section 3.5): grow the spline, align, freeze, choose keyframes, fuse.

tracker = Tracker(rig, Options())
for frame in frames:
    tracker.feed(frame)
stamps, T_world_depth = tracker.trajectory
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.so3 import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.linearise import Terms
from rstrack.alignment.normal_equations import acceleration_prior, pose_constraint
from rstrack.alignment.optimizer import Extra, Observation, Problem, Solved, SplineState, optimise
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, DeviceRig
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.keyframes.store import KeyframeSet
from rstrack.options import Options
from rstrack.tracking.frame_report import FrameReport, frame_report
from rstrack.tracking.lost_track import Health

# Motion prior: standard deviation of accelerations, m/s² and rad/s². Hand-held cameras reach 35 m/s² (DESIGN section
# 5), so it says little where there are data. The newest control points, whose weight in the newest lines is only u³/6,
# are held a good deal tighter: small systematic errors of the lines would throw them about.
_ACCELERATION = np.array([5.0, 5.0, 5.0, 10.0, 10.0, 10.0])
_NEWEST_TRIPLES, _NEWEST_FACTOR = 2, 0.1
# Metres and radians within which the reference's pose is held while its own control points are free.
_GAUGE = np.full(6, 1e-6)
# Levels to go through from a prediction by constant velocity, and from anything worse.
_TRACKING_LEVELS, _LEVELS = (1, 0), (2, 1, 0)
# Steps at most on the pyramid's levels, finest first.
_MOST_STEPS = (15, 8, 30)
# Seconds without a frame after which the motion before says nothing about where the camera is, and beyond which
# frames hardly belong to one recording.
_GAP_S, _BREAK_S = 0.3, 3600.0
# Knots are never further apart than this many times the spacing that was asked for.
_WIDEST = 2.0
# Part of the pixels that must have depth for a frame to become a keyframe.
_LEAST_DEPTH = 0.02


class Tracker:
    """Estimates T_world_depth(t); the world is the depth camera's frame at the middle of the first image."""

    def __init__(self, rig: Rig, options: Options | None = None) -> None:
        self.rig, self.options = rig, (options or Options()).decided(rig.depth_shutter)
        self._device = DeviceRig(rig, self.options)
        self._terms = Terms.of(self._device, self.options.blur_sigma_px)
        self._maker = KeyframeMaker.of(self._device)
        self._state: SplineState | None = None
        self._reference: Reference | None = None
        self._keyframes = KeyframeSet(self._maker, self.options)
        # Frames whose control points still move, and the newest one whose do not.
        self._recent: deque[DeviceFrame] = deque()
        self._active: list[Observation] = []
        self._health = Health()
        self._pixels = 0
        # The newest frame, while it is the reference and cannot be rectified yet.
        self._unconverged: DeviceFrame | None = None
        # First control point of the current piece of the spline: those before it belong to another, or to a gap.
        self._piece = 0
        self._stamps: list[float] = []
        self._last_fed: float | None = None
        self.spline_valid: list[tuple[float, float]] = []
        self.reports: list[FrameReport] = []

    # -- what it has found ------------------------------------------------------------------------------------------

    @property
    def spline(self) -> Spline | None:
        """T_world_depth(t) so far; the newest few control points still move. Meaningful within `spline_valid` (s)."""
        return None if self._state is None else self._state.spline

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) of the frames that were not lost and T_world_depth (n, 4, 4) there."""
        if self.spline is None:
            return np.zeros(0), np.zeros((0, 4, 4))
        stamps = np.array(self._stamps)
        return stamps, self.spline.pose(stamps)

    @property
    def keyframes(self) -> int:
        """How many there have been."""
        return self._keyframes.made

    # -- the loop ---------------------------------------------------------------------------------------------------

    def feed(self, frame: Frame) -> FrameReport:
        """Track one frame. Raises UserError if it is not newer than the one before or its images are not the rig's."""
        stamp = frame.depth.stamp
        gap = np.inf if self._last_fed is None else stamp - self._last_fed
        if not np.isfinite(stamp) or (self._last_fed is not None and not 0.0 < gap < _BREAK_S):
            raise UserError(
                f"tracker: frame stamped {stamp:.6f} s follows one stamped {self._last_fed} s: frames must come in "
                f"order of time and less than {_BREAK_S:.0f} s apart; cut the recording there"
            )
        new = self._device.upload(len(self.reports), frame)
        self._last_fed = stamp
        if len(self._stamps) == 1:
            self._fit_knots(gap)
        if self._state is None:
            report = self._start(new)
        elif not self._keyframes:
            report = self._bootstrap(new)
        elif gap > _GAP_S:
            report = self._relocalise(new)
        else:
            report = self._track(new)
        self.reports.append(report)
        return report

    def _start(self, new: DeviceFrame) -> FrameReport:
        if self._unfit(new):
            return self._report(new, lost=True)
        self._state = self._new_state(new, self.options.knot_spacing_s)
        self._recent.append(new)
        if new.depth.exposure.lens.lines > 1:
            self._reference = self._maker.rolling(new.index, new.depth, new.colors, self._state.spline)
        else:
            self._new_keyframe(new, None)
        self._placed(new)
        return self._report(new, keyframe=True)

    def _new_state(self, first: DeviceFrame, dt: float) -> SplineState:
        state = SplineState.still(min(first.first_time, first.stamp) - self.options.knot_phase * dt, dt, np.eye(4))
        state.extend(first.last_time)
        return state

    def _fit_knots(self, gap: float) -> None:
        """A global shutter gives one pose a frame, `gap` s apart: no more knots than that can be told."""
        state, _ = self._known()
        if self._recent[0].depth.exposure.lens.lines == 1 and gap > state.dt:
            self._state = self._new_state(self._recent[0], min(gap, _WIDEST * state.dt))

    def _bootstrap(self, new: DeviceFrame) -> FrameReport:
        """Joint alignment of the first frames with the first one, all of them rolling, from zero motion."""
        state, ref = self._known()
        state.extend(new.last_time)
        fresh = self._observe(new, ref)
        free = (0, len(state.points))

        extras = [self._prior(state, free), _gauge(ref)]
        solved = self._optimise(state, fresh, self._active, free, extras, bandwidth=6 * free[1])
        if self._health.fault(fresh, solved, ref.pixels):
            return self._begin_anew(new)
        self._active += fresh
        self._recent.append(new)
        self._placed(new)
        if len(self._recent) < self.options.bootstrap_frames:
            return self._report(new, fresh, solved)
        self._leave_bootstrap(state)
        return self._report(new, fresh, solved, keyframe=True)

    def _begin_anew(self, new: DeviceFrame) -> FrameReport:
        """The first frames did not fit together: they are lost, and the newest is the first one."""
        self._state, self._reference, self._active = None, None, []
        self._stamps.clear()
        self.spline_valid.clear()
        self._recent.clear()
        self.reports = [r.as_lost() for r in self.reports]
        return self._start(new)

    def _leave_bootstrap(self, state: SplineState) -> None:
        """Rectify the middle frame and align all others to it."""
        frames = list(self._recent)
        middle = min(
            (f for f in frames if not self._unfit(f)),
            key=lambda f: abs(f.index - frames[len(frames) // 2].index),
        )
        ref = self._new_keyframe(middle, None)
        self._active = [o for frame in frames if frame is not middle for o in self._observe(frame, ref)]
        free = (0, len(state.points))
        self._optimise(state, self._active, [], free, [self._prior(state, free)], levels=(0,))

    def _track(self, new: DeviceFrame) -> FrameReport:
        state, ref = self._known()
        before = state.copy()
        state.smooth_end(self.spline_valid[-1][1])
        state.extend(new.last_time)
        free = (max(self._piece, state.segment(new.first_time)), len(state.points))
        self._active = [o for o in self._active if o.lin is not None and o.lin.model.last > free[0]]
        on_reference = self._observe(new, ref)
        anchor = self._keyframes.anchor
        fresh = on_reference + (self._observe(new, anchor) if anchor is not None else [])
        extras = [self._prior(state, free)]
        if state.segment(ref.t) + 4 > free[0] and new.depth.exposure.lens.lines == 1:
            # The first keyframe of a global shutter: no other frame tells where it was taken.
            extras.append(_gauge(ref))
        # A reference that still moves ties its own control points to those of the newest lines.
        bandwidth = 24 if ref.rolling is None else 6 * (free[1] - free[0])
        solved = self._optimise(state, fresh, self._active, free, extras, bandwidth, _TRACKING_LEVELS)
        if self._health.fault(on_reference, solved, ref.pixels):
            self._state = before
            return self._relocalise(new)
        self._active += fresh
        self._recent.append(new)
        self._placed(new)
        overlap = self._overlap(on_reference)
        changed = self._renew_keyframe(state, new, free[0], overlap)
        return self._report(new, on_reference, solved, keyframe=changed, overlap=overlap)

    def _relocalise(self, new: DeviceFrame) -> FrameReport:
        """Align a frame alone to the last keyframes, from where the track ended and from where they were taken."""
        state, _ = self._known()
        end = self.spline_valid[-1][1]
        for ref in self._keyframes.recent:
            for T_world_body in (state.spline.pose(end), ref.T_world_base):
                trial = state.restarted(end, new.first_time, new.last_time, T_world_body)
                first = trial.segment(new.first_time)
                fresh, free = self._observe(new, ref), (first, len(trial.points))
                solved = self._optimise(trial, fresh, [], free, [self._prior(trial, free, first)])
                if self._health.fault(fresh, solved, ref.pixels):
                    continue
                self._state, self._piece, self._reference = trial, first, ref
                self._active, self._pixels, self._unconverged = fresh, 0, None
                self._keyframes.anchor = None
                self._recent = deque([new])
                self._placed(new, joined=False)
                return self._report(new, fresh, solved, overlap=self._overlap(fresh))
        self._active = []
        self._recent.clear()
        return self._report(new, lost=True)

    # -- keyframes --------------------------------------------------------------------------------------------------

    def _renew_keyframe(self, state: SplineState, new: DeviceFrame, first_free: int, overlap: float) -> bool:
        """Fuse frames whose control points are frozen; make another frame the reference once it is left behind."""
        frozen = [f for f in self._recent if state.segment(f.last_time) + 4 <= first_free]
        for done in frozen[:-1]:
            self._recent.popleft()
            self._fuse(done, state)
        if self._unconverged is not None:
            if state.segment(self._unconverged.last_time) + 4 > first_free:
                return False
            self._new_keyframe(self._unconverged, self._keyframes.newest if self.options.fuse else None)
            return True
        _, ref = self._known()
        T_base_cam = se3.inverse(ref.T_world_base) @ state.spline.pose(new.depth.exposure.mid_time)
        if not frozen or frozen[-1].index <= ref.index or not self.options.left_behind(T_base_cam, overlap):
            return False
        if self.options.keyframe_strategy == "newest" and new.depth.exposure.lens.lines > 1:
            if self._unfit(new):
                return False
            self._reference = self._maker.rolling(new.index, new.depth, new.colors, state.spline)
            self._unconverged, self._pixels = new, 0
            return False
        old = self._keyframes.return_to(state.spline.pose(frozen[-1].depth.exposure.mid_time), ref)
        if old is not None:
            self._reference, self._pixels = old, 0
            return True
        if self._unfit(frozen[-1]):
            return False
        self._new_keyframe(frozen[-1], ref if self.options.fuse else None)
        return True

    def _fuse(self, done: DeviceFrame, state: SplineState) -> None:
        before = self._keyframes.newest
        after = self._keyframes.fuse(done, state.spline)
        if self._reference is before:
            self._reference = after

    def _unfit(self, frame: DeviceFrame) -> bool:
        """Whether a frame shows too little to align others to it."""
        return frame.depth_share < _LEAST_DEPTH or (self.options.photometric and not frame.colors)

    def _new_keyframe(self, frame: DeviceFrame, older: Reference | None) -> Reference:
        state = self._state
        assert state is not None
        self._reference = self._keyframes.make(frame, state.spline, older)
        self._unconverged, self._pixels = None, 0
        return self._reference

    def _overlap(self, fresh: list[Observation]) -> float:
        first = next((o.lin for o in fresh if o.lin is not None and o.lin.count), None)
        if first is None:
            return 0.0
        self._pixels = max(self._pixels, first.count)
        return first.count / self._pixels

    # -- pieces -----------------------------------------------------------------------------------------------------

    def _known(self) -> tuple[SplineState, Reference]:
        assert self._state is not None and self._reference is not None
        return self._state, self._reference

    def _observe(self, frame: DeviceFrame, ref: Reference) -> list[Observation]:
        depth = [Observation(frame.index, frame.depth, ref)] if self.options.geometric else []
        return depth + [Observation(frame.index, c, ref, frame.depth) for c in frame.colors if ref.points]

    def _prior(self, state: SplineState, free: tuple[int, int], piece: int | None = None) -> Extra:
        first, last = max(self._piece if piece is None else piece, free[0] - 2), free[1]
        sigma = np.repeat(_ACCELERATION[None] * state.dt**2, last - first - 2, axis=0)
        sigma[-_NEWEST_TRIPLES:] *= _NEWEST_FACTOR
        return lambda spline: acceleration_prior(spline, first, last, sigma)

    def _optimise(
        self, state: SplineState, fresh: list[Observation], settled: list[Observation], free: tuple[int, int],
        extras: list[Extra], bandwidth: int = 24, levels: tuple[int, ...] = _LEVELS,
    ) -> Solved:  # fmt: skip
        problem = Problem(fresh, settled, free, extras, self.rig.depth_camera.fx, bandwidth)
        try:
            return optimise(self._terms, state, problem, levels, _MOST_STEPS)
        except np.linalg.LinAlgError:
            # The images say nothing about some motion, not even with the prior: as lost as can be.
            return Solved()

    def _placed(self, new: DeviceFrame, joined: bool = True) -> None:
        self._stamps.append(new.stamp)
        begin = min(new.first_time, new.stamp)
        if joined and self.spline_valid:
            begin = self.spline_valid.pop()[0]
        self.spline_valid.append((begin, new.last_time))

    def _report(
        self, new: DeviceFrame, fresh: Sequence[Observation] = (), solved: Solved | None = None, *,
        keyframe: bool = False, lost: bool = False, overlap: float = 1.0,
    ) -> FrameReport:  # fmt: skip
        depth = [o.lin for o in fresh if o.is_depth and o.lin is not None]
        color = [o.lin for o in fresh if not o.is_depth and o.lin is not None]
        return frame_report(new.stamp, depth, color, solved, keyframe=keyframe, lost=lost, overlap=overlap)


def _gauge(ref: Reference) -> Extra:
    """Holds the spline to a reference's pose while its control points are free."""
    return lambda spline: pose_constraint(spline, ref.t, ref.T_world_base, _GAUGE)
