"""The online tracker (paper, section 3.5): predict, observe, solve, judge, fuse, renew the keyframe.

tracker = Tracker(rig, Options())
for frame in frames:
    tracker.feed(frame)
stamps, T_world_depth = tracker.trajectory
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rstrack.adjustment.chain import Chain
from rstrack.adjustment.graph import Seen
from rstrack.alignment.independence import Independence
from rstrack.alignment.linearise import Terms
from rstrack.alignment.observation import Observation, observe
from rstrack.alignment.optimizer import Solved
from rstrack.alignment.pull import pulls
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, DeviceRig, Timer, untimed
from rstrack.keyframes.archive import Archive
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.keyframes.store import KeyframeStore
from rstrack.options import Options
from rstrack.tracking.found_poses import FoundPoses
from rstrack.tracking.frame_report import FrameReport, frame_report
from rstrack.tracking.gains import Gains
from rstrack.tracking.judgement.fault import Fault
from rstrack.tracking.judgement.lost_track import FitHistory, doubted, draws, implausible, is_settled
from rstrack.tracking.judgement.pose_covariances import PoseCovariances
from rstrack.tracking.judgement.uncertainty import Uncertainty
from rstrack.tracking.relocalise import Relocaliser, without_misfits
from rstrack.tracking.succession import LEAST_DEPTH, Succession
from rstrack.tracking.window import LEVELS, TRACKING_LEVELS, Window

# What a tracker of the same rig and options would make in the same way.
_MADE_ANEW = "rig", "options", "_device", "_terms", "_maker"
# Seconds without a frame after which the motion before says nothing about where the camera is, and beyond which
# frames hardly belong to one recording.
_GAP_S, _BREAK_S = 0.3, 3600.0
# Seconds ahead that constant velocity predicts to within a few pixels: a hand turns by up to 10 rad/s² more.
_SURE_S = 0.045
# Knots are never further apart than this many times the spacing that was asked for.
_WIDEST = 2.0
# Frames of a new piece that are aligned jointly: fewer do not tell its velocity.
_YOUNG = 4


class Tracker:
    """Estimates T_world_depth(t); the world is the depth camera's frame at the middle of the first image."""

    def __init__(self, rig: Rig, options: Options | None = None, timer: Timer = untimed) -> None:
        """timer: watches the parts of the work, see `Timer`."""
        self.rig, self.options = rig, (options or Options()).decided(rig.depth_shutter)
        self._device = DeviceRig(rig, self.options, timer)
        self._terms = Terms.of(self._device, self.options)
        self._maker = KeyframeMaker.of(self._device)
        self._keyframes = KeyframeStore(self._maker, self.options)
        self._window: Window | None = None
        self._fits = FitHistory(self.options.rolling or rig.depth_shutter.readout_s == 0.0)
        self._independence = Independence(), Independence()  # of depth pixels, and of colour pixels
        # What all frames said of the spline.
        self._chain = Chain()
        self._covariances = PoseCovariances(rig.depth_camera.fx)
        self._gains = Gains()
        self._succession = self._successors()
        self._found = FoundPoses()
        self._relocaliser = Relocaliser(rig, self.options, self._keyframes, self._fits, self._observe)
        # Frames of the current piece of the spline.
        self._age = 0
        self._last_fed: float | None = None
        self.reports: list[FrameReport] = []

    # -- what it has found ------------------------------------------------------------------------------------------

    @property
    def spline(self) -> Spline | None:
        """T_world_depth(t) so far; the newest few control points still move. Meaningful within `spline_valid` (s)."""
        return None if self._window is None else self._window.state.whole

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) of the frames that were not lost and T_world_depth (n, 4, 4) there."""
        if self._window is None:
            return np.zeros(0), np.zeros((0, 4, 4))
        return self._found.all(self._window.spline)

    @property
    def spline_valid(self) -> list[tuple[float, float]]:
        """Times (begin, end) in s within which the spline is an estimate."""
        return self._found.valid

    @property
    def keyframes(self) -> int:
        """How many there have been."""
        return self._keyframes.made

    # -- checkpoints ------------------------------------------------------------------------------------------------

    @property
    def engine(self) -> Engine:
        """Where it works."""
        return self._device.e

    @property
    def shared(self) -> dict[str, object]:
        """What another tracker of the same rig and options has as well, by name."""
        shared = {name: getattr(self, name) for name in _MADE_ANEW}
        return shared | {"engine": self.engine, "timer": self._device.timer, "observe": self._relocaliser.observe}

    @property
    def state(self) -> dict[str, Any]:
        """All that feeding frames has changed."""
        own = {name: value for name, value in vars(self).items() if name not in _MADE_ANEW}
        return own | {"resolution": self._device.resolution}

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        own = dict(state)
        self._device.resolution = own.pop("resolution")
        vars(self).update(own)

    @property
    def archive(self) -> Archive:
        """Where its keyframes are put away."""
        return self._keyframes.archive

    # -- for the whole track to be adjusted -------------------------------------------------------------------------

    def all_keyframes(self) -> Archive:
        """All rectified keyframes, the newest put away with them."""
        self._keyframes.put_away()
        return self._keyframes.archive

    @property
    def seen(self) -> list[Seen]:
        """What its frames said of the spline's control points."""
        return self._chain.seen

    @property
    def drift(self) -> dict[int, FloatArray]:
        """Covariances of the keyframes' poses, see `Uncertainty`."""
        return self._covariances.uncertainty.drift

    @property
    def inflations(self) -> tuple[float, float]:
        """By how much the covariances that depth's pixels give are too small, and colour's."""
        depth, color = self._independence
        return depth.inflation, color.inflation

    @property
    def terms(self) -> Terms:
        """Its kernels."""
        return self._terms

    @property
    def reference(self) -> int | None:
        """Number of the frame whose keyframe new ones are aligned to."""
        ref = self._succession.reference
        return None if ref is None else ref.index

    @property
    def piece(self) -> int:
        """First control point of the current piece of the spline."""
        return 0 if self._window is None else self._window.piece

    @property
    def pending(self) -> int:
        """Number of the oldest frame that may still become a keyframe."""
        recent = self._succession.recent
        return recent[0].index if recent else len(self.reports)

    def upload(self, index: int, frame: Frame) -> DeviceFrame:
        """A frame of the recording as it is aligned."""
        return self._device.upload(index, frame)

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
        if len(self._found.stamps) == 1 and self._succession.recent:
            self._fit_knots(gap)
        if self._window is None:
            report = self._start(new)
        elif not self._keyframes:
            report = self._bootstrap(new)
        elif stamp - self._found.stamps[-1] > _GAP_S:
            report = self._relocalise(new)
        else:
            report = self._track(new, gap)
        self.reports.append(report)
        return report

    def _track(self, new: DeviceFrame, gap: float) -> FrameReport:
        window, ref = self._known()
        before = window.copy()
        young = window.piece > 0 and self._age < _YOUNG
        window.predict(new, self._found.end, young)
        on_reference = self._observe(new, ref)
        anchor = self._keyframes.anchor
        fresh = on_reference + ([] if anchor is None else self._observe(new, anchor))
        # The first keyframe of a global shutter: no other frame tells where it was taken.
        gauge = ref if not window.is_frozen(ref.t) and new.depth.exposure.lens.lines == 1 else None
        mid, T_predicted = new.depth.exposure.mid_time, window.spline.pose(new.depth.exposure.mid_time)
        coupled = ref.rolling is not None
        levels = LEVELS if young or gap > _SURE_S else TRACKING_LEVELS
        solved = window.solve(fresh, levels, gauge, coupled, self._fits.is_hopeless)
        if not is_settled(solved) and not self._fits.is_hopeless(fresh):
            # Its steps went to and fro; that says nothing against the place.
            solved = window.solve(fresh, (0,), gauge, coupled)
        fitting = without_misfits(self._fits, fresh, on_reference, ref)
        colorless = False
        if len(fitting) < len(fresh) and not self._fits.is_hopeless(on_reference):
            colorless = all(o.is_depth for o in fitting)
            window = before.copy()
            window.predict(new, self._found.end, young)
            fresh, on_reference = fitting, [o for o in fitting if o.ref is ref]
            solved = window.solve(fresh, levels, gauge, coupled)
        if doubted(fresh):
            solved = window.solve(fresh, (0,), gauge, coupled)
        with self._terms.timer("judgement"):
            pulled = pulls(on_reference, window.state)
            fault = self._fits.fault(on_reference, solved, ref.pixels, pulled, young, colorless)
            uncertainty = self._covariances.uncertainty
            if ref.rolling is None:
                # A rolling reference moves with what is aligned to it, which tells nothing of the two together.
                uncertainty = uncertainty.after(new.stamp - self._found.stamps[-1], pulled.information)
        if not fault and implausible(T_predicted, window.spline.pose(mid), gap):
            fault = Fault.TOO_FAR
        elif not fault and not uncertainty.is_known:
            fault = Fault.LEFT_OPEN
        elif not fault and draws(*self._given(before, window), gap):
            fault = Fault.DRAWS
        if fault:
            self._window = before
            return self._relocalise(new, fault)
        self._window, self._covariances.uncertainty = window, uncertainty
        window.keep(fresh)
        self._chain.add(ref, on_reference, window.state, pulled.excess)
        for is_color, term in enumerate(self._independence):
            term.learn(o.inflation for o in on_reference if o.is_depth != is_color)
        self._succession.recent.append(new)
        self._placed(new, fresh)
        is_colorless = bool(new.colors) and bool(ref.points) and all(o.is_depth for o in on_reference)
        self._age += 1
        self._succession.judged_colors(is_colorless)
        overlap = self._succession.overlap(on_reference)
        frozen = self._succession.fuse_frozen(window)
        renewed = self._succession.renew(window, new, frozen, overlap)
        self._found.release(window, min(min(f.first_time, f.stamp) for f in self._succession.recent))
        return self._report(new, on_reference, solved, keyframe=renewed, overlap=overlap)

    # -- start and restart ------------------------------------------------------------------------------------------

    def _start(self, new: DeviceFrame) -> FrameReport:
        # Its depth is enough to begin with: the first colour image often comes a little later.
        if new.depth_share < LEAST_DEPTH or not (self.options.geometric or new.colors):
            return self._report(new, fault=Fault.NO_DEPTH)
        window = self._begin(new, self.options.knots_s())
        self._succession.recent.append(new)
        if new.depth.exposure.lens.lines == 1:
            self._succession.make(new, window.spline, None)
            self._covariances.uncertainty = Uncertainty.of_first()
        self._placed(new)
        return self._report(new, keyframe=True)

    def _begin(self, first: DeviceFrame, dt: float) -> Window:
        """A spline with knots dt s apart; a rolling first frame is what others are aligned to."""
        window = Window.still(self._terms, self.rig.depth_camera.fx, first, dt, self.options.knot_phase)
        if first.depth.exposure.lens.lines > 1:
            self._succession.reference = self._maker.rolling(first.index, first.depth, first.colors, window.spline)
        self._window = window
        return window

    def _fit_knots(self, gap: float) -> None:
        """Knots for frames `gap` s apart; a global shutter gives one pose each: no more knots than that can be told."""
        window, _ = self._known()
        dt = self.options.knots_s(gap)
        if self._succession.recent[0].depth.exposure.lens.lines == 1 and gap > dt:
            dt = min(gap, _WIDEST * dt)
        if dt != window.state.dt:
            self._begin(self._succession.recent[0], dt)

    def _bootstrap(self, new: DeviceFrame) -> FrameReport:
        """Joint alignment of the first frames with the first one, all of them rolling, from zero motion."""
        window, ref = self._known()
        window.state.extend(new.last_time)
        fresh = self._observe(new, ref)
        solved = window.solve(fresh, gauge=ref, coupled=True)
        if ref.points:
            # Its colours were looked up as if the first frame stood still: again, with the motion found.
            ref, earlier = self._recolored(window, ref, fresh), window.active
            window.active = []
            solved = window.solve([*earlier, *fresh], (1, 0), gauge=ref, coupled=True)
            window.active = earlier
        if self._fits.fault(fresh, solved, ref.pixels):
            return self._begin_anew(new)
        window.keep(fresh)
        self._succession.recent.append(new)
        self._placed(new, fresh)
        if len(self._succession.recent) < self.options.bootstrap_frames:
            return self._report(new, fresh, solved)
        if all(self._succession.is_unfit(f) for f in self._succession.recent):
            return self._begin_anew(new)  # none of them has a colour image to go on with
        self._leave_bootstrap(window)
        return self._report(new, fresh, solved, keyframe=True)

    def _recolored(self, window: Window, ref: Reference, fresh: Sequence[Observation]) -> Reference:
        first = self._succession.recent[0]
        again = self._maker.rolling(first.index, first.depth, first.colors, window.spline)
        self._succession.reference = replace(again, T_world_base=ref.T_world_base)
        for o in (*window.active, *fresh):
            o.see(self._succession.reference)
        return self._succession.reference

    def _begin_anew(self, new: DeviceFrame) -> FrameReport:
        """The first frames did not fit together: they are lost, and the newest is the first one."""
        self._window, self._found = None, FoundPoses()
        self._covariances = PoseCovariances(self.rig.depth_camera.fx)
        self._succession = self._successors()
        self._chain = Chain()
        self.reports = [r.as_lost(Fault.NO_START) for r in self.reports]
        return self._start(new)

    def _leave_bootstrap(self, window: Window) -> None:
        """Rectify the middle frame and align all others to it."""
        frames = list(self._succession.recent)
        middle = min(
            (f for f in frames if not self._succession.is_unfit(f)),
            key=lambda f: abs(f.index - frames[len(frames) // 2].index),
        )
        ref = self._succession.make(middle, window.spline, None)
        window.active = []
        others = [o for frame in frames if frame is not middle for o in self._observe(frame, ref)]
        window.solve(others, levels=(0,))
        window.keep(others)
        for frame in frames:
            seen = [o for o in others if o.frame == frame.index]
            own = pulls(seen, window.state)
            self._chain.add(ref, seen, window.state, own.excess)
            self._covariances.uncertainty = self._covariances.uncertainty.found_anew(own.information)
            if frame is not middle:
                self._covariances.add(frame, ref)
        self._covariances.begin(ref, frames, window.spline)
        for frame in frames[:-1]:
            report = self.reports[frame.index]
            self.reports[frame.index] = self._covariances.of(report, frame, window.spline, ref.index)

    def _relocalise(self, new: DeviceFrame, fault: Fault = Fault.NONE) -> FrameReport:
        """Find a frame again and go on with a new piece of the spline; what was reported before stays as it is.

        fault: why it is not where the motion led, if it was looked for there.
        """
        window, ref = self._known()
        found = self._relocaliser.find(new, window, ref, self._found.end, self._covariances.uncertainty, fault.is_pull)
        if isinstance(found, Fault):
            return self._report(new, fault=fault or found)
        # The new piece may need control points of the last frames before: their poses are kept, not their spline.
        self._found.begin_piece(window.spline, found.window.state.untouched)
        found.window.keep(found.fresh)
        self._window, self._covariances.uncertainty = found.window, found.uncertainty
        self._chain.cut(found.window.piece)
        self._chain.add(found.ref, found.fresh, found.window.state, pulls(found.fresh, found.window.state).excess)
        self._succession.use(found.ref, new)
        self._relocaliser.forget()
        self._age = 1
        self._placed(new, found.fresh, joined=False)
        return self._report(new, found.fresh, found.solved, overlap=self._succession.overlap(found.fresh))

    # -- pieces -----------------------------------------------------------------------------------------------------

    def _known(self) -> tuple[Window, Reference]:
        ref = self._succession.reference
        assert self._window is not None and ref is not None
        return self._window, ref

    def _successors(self) -> Succession:
        return Succession(self._maker, self._keyframes, self.options, self._gains, self._covariances)

    def _observe(self, frame: DeviceFrame, ref: Reference, expected: FloatArray | None = None) -> list[Observation]:
        """What the frame's images say against a reference, as far as their pixels are independent.

        expected (2,): gain and offset of its colours; by default about as before.
        """
        if expected is None:
            expected = self._gains.expected(frame, ref)
        observations = observe(frame, ref, self.options, expected)
        for o in observations:
            o.independent = 1.0 / self._independence[not o.is_depth].inflation
        return observations

    def _given(self, before: Window, after: Window) -> tuple[FloatArray, FloatArray]:
        """Poses (n, 4, 4) of the frames that still move, before and after a new one has been aligned."""
        stamps = [max(frame.stamp, before.spline.t_begin) for frame in self._succession.recent]
        return before.spline.pose(stamps), after.spline.pose(stamps)

    def _placed(self, new: DeviceFrame, fresh: Sequence[Observation] = (), joined: bool = True) -> None:
        """A frame has been found: its stamp, its brightness, and until when the spline is known."""
        self._found.add(new, joined)
        window, ref = self._known()
        oldest = self._succession.recent[0].index if self._succession.recent else new.index
        self._gains.learn(new, fresh, window.state, oldest)
        if ref.rolling is None:
            self._covariances.add(new, ref, oldest)

    def _report(
        self, new: DeviceFrame, fresh: Sequence[Observation] = (), solved: Solved | None = None, *,
        keyframe: bool = False, fault: Fault = Fault.NONE, overlap: float = 1.0,
    ) -> FrameReport:  # fmt: skip
        report = frame_report(new.stamp, fresh, solved, keyframe=keyframe, fault=fault, overlap=overlap)
        return report if fault else self._covariances.report(report, new, fresh, self._known()[0].spline)
