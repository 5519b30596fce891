"""The online tracker (paper, section 3.5): predict, observe, solve, judge, fuse, renew the keyframe.

tracker = Tracker(rig, Options())
for frame in frames:
    tracker.feed(frame)
stamps, T_world_depth = tracker.trajectory
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rstrack.adjustment.chain import KeyframeModel
from rstrack.alignment.linearise import Terms
from rstrack.data.imu.recording import ImuRecording
from rstrack.data.moving_masks import MovingMasks
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, Timer, frame_without, untimed
from rstrack.inertial.inertia import Inertia
from rstrack.keyframes.archive import Archive
from rstrack.options import Options
from rstrack.tracking.bootstrap import bootstrap, fit_knots, start
from rstrack.tracking.frame_report import Fault, FrameReport
from rstrack.tracking.judgement.lost_track import UsualScales
from rstrack.tracking.judgement.pose_covariances import PoseCovariances
from rstrack.tracking.matching import Match, Verdict, judge_predicted, match
from rstrack.tracking.relocalise import Bridge, Relocaliser
from rstrack.tracking.track import Track
from rstrack.tracking.window import LEVELS, TRACKING_LEVELS, Window

# Seconds without a frame after which the motion before says nothing about where the camera is, and beyond which
# frames hardly belong to one recording.
_GAP_S, _BREAK_S = 0.3, 3600.0
# Seconds ahead that constant velocity predicts to within a few pixels: a hand turns by up to 10 rad/s² more.
_SURE_S = 0.045
# The same where an IMU leads: it is off by a millimetre or two then.
_LED_S = 0.5
# Frames of a new piece that are aligned jointly: fewer do not tell its velocity.
_YOUNG = 4

# What of a tracker frames change, beside its track.
_STATE = "relocaliser", "bridge", "last_fed"


class Tracker:
    """Estimates T_world_depth(t); the world is the depth camera's frame at the middle of the first image."""

    def __init__(
        self, rig: Rig, options: Options | None = None, timer: Timer = untimed, imu: ImuRecording | None = None
    ) -> None:  # fmt: skip
        """timer: watches the parts of the work, see `Timer`. imu: of a unit on the cameras, for methods that use one;
        UserError if they have none."""
        options = options or Options()
        if options.inertial and imu is None:
            raise UserError(f"method {options.method}: needs an IMU's recording, and there is none")
        self._track = Track(rig, options, timer, imu if options.inertial else None)
        self._relocaliser = Relocaliser()
        self._bridge = Bridge()
        self._last_fed: float | None = None

    def learn_cameras(self, other: Tracker) -> None:
        """Before the first frame: begin with what another tracker of the same recording has learnt of the cameras."""
        self._track.covariances.uncertainty = other._track.covariances.uncertainty.begun_anew()

    # -- what it has found ------------------------------------------------------------------------------------------

    @property
    def rig(self) -> Rig:
        """Whose images it tracks."""
        return self._track.rig

    @property
    def options(self) -> Options:
        """As decided for this rig."""
        return self._track.options

    @property
    def reports(self) -> list[FrameReport]:
        """One of every frame fed."""
        return self._track.reports

    @property
    def spline(self) -> Spline | None:
        """T_world_depth(t) so far; the newest few control points still move. Meaningful within `spline_valid` (s)."""
        return None if self._track.window is None else self._track.window.state.whole

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) of the frames that were not lost and T_world_depth (n, 4, 4) there."""
        if self._track.window is None:
            return np.zeros(0), np.zeros((0, 4, 4))
        return self._track.found.all(self._track.window.spline)

    @property
    def spline_valid(self) -> list[tuple[float, float]]:
        """Times (begin, end) in s within which the spline is an estimate."""
        return self._track.found.valid

    @property
    def uncorrected(self) -> Tracker:
        """Itself: it closes no loops while tracking."""
        return self

    @property
    def color_late(self) -> tuple[float, float]:
        """Seconds that colour was found to be later than its stamps, and σ of that; (0, 0) where the file is exact."""
        return self._track.covariances.color_late

    @property
    def keyframes(self) -> int:
        """How many there have been."""
        return self._track.keyframes.made

    # -- checkpoints ------------------------------------------------------------------------------------------------

    @property
    def engine(self) -> Engine:
        """Where it works."""
        return self._track.device.e

    @property
    def shared(self) -> dict[str, object]:
        """What another tracker of the same rig and options has as well, by name."""
        return self._track.shared

    @property
    def state(self) -> dict[str, Any]:
        """All that feeding frames has changed."""
        own = {name: getattr(self, f"_{name}") for name in _STATE}
        return own | {"track": self._track.state}

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        self._track.state = state["track"]
        for name in _STATE:
            setattr(self, f"_{name}", state[name])

    @property
    def archive(self) -> Archive:
        """Where its keyframes are put away."""
        return self._track.keyframes.archive

    # -- for the whole track to be adjusted -------------------------------------------------------------------------

    def all_keyframes(self) -> Archive:
        """All rectified keyframes, the newest put away with them."""
        self._track.keyframes.archive_newest()
        return self._track.keyframes.archive

    @property
    def seen(self) -> list[KeyframeModel]:
        """What its frames said of the spline's control points."""
        return self._track.chain.seen

    @property
    def inertia(self) -> Inertia | None:
        """What has been found of an IMU, where the method uses one."""
        return self._track.inertia

    @property
    def usual(self) -> UsualScales:
        """How well its images fit."""
        return self._track.usual

    @property
    def covariances(self) -> PoseCovariances:
        """How far off its poses may be."""
        return self._track.covariances

    @property
    def inflations(self) -> tuple[float, float]:
        """By how much the covariances that depth's pixels give are too small, and colour's."""
        depth, color = self._track.independence
        return depth.inflation, color.inflation

    @property
    def terms(self) -> Terms:
        """Its kernels."""
        return self._track.terms

    @property
    def left_out(self) -> MovingMasks:
        """What frames have been found to show that moves by itself, by their numbers."""
        return self._track.left_out

    @property
    def reference(self) -> int | None:
        """Number of the frame whose keyframe new ones are aligned to."""
        ref = self._track.succession.reference
        return None if ref is None else ref.index

    @property
    def piece(self) -> int:
        """First control point of the current piece of the spline."""
        return 0 if self._track.window is None else self._track.window.piece

    @property
    def pending(self) -> int:
        """Number of the oldest frame that may still become a keyframe."""
        recent = self._track.succession.recent
        return recent[0].index if recent else len(self.reports)

    def upload(self, index: int, frame: Frame) -> DeviceFrame:
        """A frame of the recording as it is aligned: without what has been found to move in it."""
        new, masks = self._track.upload(index, frame), self._track.left_out
        mask = masks.grid(index)
        return new if mask is None else frame_without(self._track.device.e, new, mask, masks.stride)

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
        track = self._track
        new = track.upload(len(track.reports), frame)
        self._last_fed = stamp
        if len(track.found.stamps) == 1 and track.succession.recent:
            fit_knots(track, gap)
        if track.window is None:
            report = start(track, new)
        elif not track.keyframes:
            report = bootstrap(track, new)
        elif self._bridge.leads(track, new):
            report = self._follow(new, stamp - track.found.stamps[-1], led=True)
        elif stamp - track.found.stamps[-1] > _GAP_S:
            report = self._relocalise(new)
        else:
            report = self._follow(new, gap)
        track.reports.append(report)
        return report

    def _follow(self, new: DeviceFrame, gap: float, led: bool = False) -> FrameReport:
        """Go on with a frame where the motion leads, `gap` s after the one before; led: by an IMU."""
        track = self._track
        before, ref = track.known()
        young = before.piece > 0 and track.age < _YOUNG

        def begin() -> Window:
            window = before.copy()
            window.predict(new, track.found.end, young)
            return window

        anchor = track.keyframes.anchor
        fresh = track.observe(new, ref) + ([] if anchor is None else track.observe(new, anchor))
        levels = LEVELS if young or gap > (_LED_S if led else _SURE_S) else TRACKING_LEVELS
        found = match(track, begin, new, ref, fresh, levels, track.succession.recent[-1].depth)
        verdict = judge_predicted(track, found, gap, young)
        if not verdict.fault:
            return self._go_on(found, verdict)
        if not led:
            return self._relocalise(new, verdict.fault)
        # Where the camera has turned away from the keyframe meanwhile another one may show what it sees.
        others = (verdict.fault is Fault.NOTHING_SEEN or gap > _GAP_S) and not track.succession.is_unfit(new)
        T_led = found.predicted.pose(new.depth.exposure.mid_time)
        report = self._relocalise(new, verdict.fault, T_led) if others else track.report(new, fault=verdict.fault)
        if report.lost:
            self._bridge.put(track, new)
        return report

    def _go_on(self, found: Match, verdict: Verdict) -> FrameReport:
        """A frame was found where the motion led: learn from it, and renew the keyframe."""
        track, window, on_reference = self._track, found.window, found.on_reference
        new = replace(found.frame, depth=found.left.depth)
        self._bridge.close(track)
        self._take(new, found, verdict)
        track.learn(found.ref, on_reference, window, verdict.score, new.last_time)
        track.succession.recent.append(new)
        track.placed(new, found.fresh)
        track.age += 1
        track.succession.judged_colors(bool(new.colors and found.ref.points) and all(o.is_depth for o in on_reference))
        overlap = track.succession.overlap(on_reference)
        track.succession.saw_through(found.left.gone)
        frozen = track.succession.fuse_frozen(window)
        renewed = track.succession.renew(window, new, frozen, overlap)
        track.found.release(window, min(min(f.first_time, f.stamp) for f in track.succession.recent))
        return track.report(new, on_reference, found.solved, keyframe=renewed, overlap=overlap)

    def _relocalise(
        self, new: DeviceFrame, fault: Fault = Fault.NONE, T_led: FloatArray | None = None
    ) -> FrameReport:  # fmt: skip
        """Find a frame again and go on with a new piece of the spline; what was reported before stays as it is.

        fault: why it is not where the motion led, if it was looked for there. T_led (4, 4): where an IMU led it.
        """
        track = self._track
        where = self._relocaliser.find(track, new, T_led)
        if isinstance(where, Fault):
            return track.report(new, fault=fault or where)
        found, verdict = where
        # The new piece may need control points of the last frames before: their poses are kept, not their spline.
        track.found.begin_piece(track.known()[0].spline, found.window.state.untouched)
        new = replace(new, depth=found.left.depth)
        self._take(new, found, verdict)
        track.chain.cut(found.window.piece)
        excess = verdict.score.excess
        track.chain.add(found.ref, found.fresh, found.window.state, excess)
        track.succession.use(found.ref, new)
        self._relocaliser.forget()
        self._bridge.forget()
        if track.inertia is not None:
            track.inertia.begin_segment()
            track.learn_inertia(found.fresh, found.window, excess, new.last_time)
        track.age = 1
        track.placed(new, found.fresh, joined=False)
        return track.report(new, found.fresh, found.solved, overlap=track.succession.overlap(found.fresh))

    def _take(self, new: DeviceFrame, found: Match, verdict: Verdict) -> None:
        """The track has the frame's pose and what is known of it."""
        track = self._track
        track.window, track.covariances.uncertainty, track.covariances.common = (
            found.window, verdict.uncertainty, verdict.common,
        )  # fmt: skip
        track.remember(new)
        found.window.keep(found.fresh)
