"""The online tracker (paper, section 3.5): predict, match, test, fuse, renew the keyframe.

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
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rstrack.data.imu.recording import ImuRecording
from rstrack.data.moving_masks import MovingMasks
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, Timer, untimed
from rstrack.inertial.inertia import Inertia
from rstrack.options import Options
from rstrack.tracking.bootstrap import bootstrap, fit_knots, start
from rstrack.tracking.frame_report import Fault, FrameReport
from rstrack.tracking.matching import Match, Verdict, judge_predicted, match
from rstrack.tracking.relocalise import Bridge, Relocaliser
from rstrack.tracking.track import TrackState
from rstrack.tracking.window import LEVELS, TRACKING_LEVELS, Window

# Seconds without a frame after which the motion before says nothing about where the camera is, and beyond which
# frames hardly belong to one recording.
_GAP_S, _BREAK_S = 0.3, 3600.0
# Seconds ahead that constant velocity predicts to within a few pixels: a hand turns by up to 10 rad/s² more.
_SURE_S = 0.045
# The same where an IMU leads: it is off by a millimetre or two then.
_LED_S = 0.5
# Frames of a new segment that are aligned jointly: fewer do not determine its velocity.
_YOUNG = 4

# What of a tracker frames change, beside its track.
_STATE = "relocaliser", "bridge", "last_fed", "postponed"
# Of a frame's work, for its `Pace`.
_KEYFRAME = "keyframe"


class Tracker:
    """Estimates T_world_depth(t); the world is the depth camera's frame at the middle of the first image.

    track: what it has found so far, with which kernels.
    """

    def __init__(
        self, rig: Rig, options: Options | None = None, timer: Timer = untimed, imu: ImuRecording | None = None
    ) -> None:  # fmt: skip
        """timer: watches the parts of the work, see `Timer`. imu: on the cameras, for methods that use one; UserError
        if they have none."""
        options = options or Options()
        if options.inertial and imu is None:
            raise UserError(f"method {options.method}: needs an IMU's recording, and there is none")
        self.track = TrackState(rig, options, timer, imu if options.inertial else None)
        self._relocaliser = Relocaliser()
        self._bridge = Bridge()
        self._last_fed: float | None = None
        self._postponed = False

    # -- frame by frame ---------------------------------------------------------------------------------------------

    def feed(self, frame: Frame) -> FrameReport:
        """Track one frame. Raises UserError if it is not newer than the one before or its images are not the rig's."""
        track, stamp = self.track, frame.depth.stamp
        gap = np.inf if self._last_fed is None else stamp - self._last_fed
        if not np.isfinite(stamp) or (self._last_fed is not None and not 0.0 < gap < _BREAK_S):
            raise UserError(
                f"tracker: frame stamped {stamp:.6f} s follows one stamped {self._last_fed} s: frames must come in "
                f"order of time and less than {_BREAK_S:.0f} s apart; cut the recording there"
            )
        track.terms.pace.begin()
        new = track.upload(len(track.reports), frame)
        self._last_fed = stamp
        if len(track.found.stamps) == 1 and track.succession.recent:
            fit_knots(track, gap)
        if track.window is None or not track.keyframes:
            track.terms.pace.lift()
            report = start(track, new) if track.window is None else bootstrap(track, new)
        elif self._bridge.leads(track, new):
            report = self._follow(new, stamp - track.found.stamps[-1], led=True)
        elif stamp - track.found.stamps[-1] > _GAP_S:
            track.terms.pace.lift()
            report = self._relocalise(new)
        else:
            report = self._follow(new, gap)
        track.reports.append(report)
        track.terms.pace.end()
        return report

    def _follow(self, new: DeviceFrame, gap: float, led: bool = False) -> FrameReport:
        """Predict, match, test, fuse, renew the keyframe: a frame `gap` s after the one before; led: by an IMU."""
        track = self.track
        before, ref = track.known()
        young = before.segment_start > 0 and track.age < _YOUNG

        def predict() -> Window:
            window = before.copy()
            window.predict(new, track.found.end, young)
            return window

        anchor = track.keyframes.anchor
        fresh = track.observe(new, ref) + ([] if anchor is None else track.observe(new, anchor))
        levels = LEVELS if young or gap > (_LED_S if led else _SURE_S) else TRACKING_LEVELS
        found = match(track, predict, new, ref, fresh, levels, track.succession.recent[-1].depth)
        verdict = judge_predicted(track, found, gap, young)
        if verdict.fault:
            return self._search(found, verdict.fault, gap, led)
        self._bridge.close(track)
        new = self._accept(found, verdict)
        track.learn(found, verdict.score.excess, new)
        track.placed(new, found.fresh)
        overlap = track.succession.view(new, found.ref, found.on_reference, found.left.gone)
        frozen = track.succession.fuse_frozen(found.window)
        renewed = self._renew(found.window, new, frozen, overlap)
        track.found.release(found.window, min(min(f.first_time, f.stamp) for f in track.succession.recent))
        return track.report(new, found.on_reference, found.solved, keyframe=renewed, overlap=overlap)

    def _renew(self, window: Window, new: DeviceFrame, frozen: DeviceFrame | None, overlap: float) -> bool:
        """Renew the keyframe if need be; at the next frame where there is no time left, but not twice."""
        track, pace = self.track, self.track.terms.pace
        self._postponed = not self._postponed and not pace.allows(_KEYFRAME)
        pace.reserve(_KEYFRAME if self._postponed else "")
        if self._postponed:
            return False
        with pace.part(_KEYFRAME):
            return track.succession.renew(window, new, frozen, overlap)

    def _search(self, found: Match, fault: Fault, gap: float, led: bool) -> FrameReport:
        """A frame is not where the motion led: look for it elsewhere."""
        track, new = self.track, found.frame
        track.terms.pace.lift()
        if not led:
            return self._relocalise(new, fault)
        # Where the camera has turned away from the keyframe meanwhile another one may show what it sees.
        others = (fault is Fault.NOTHING_SEEN or gap > _GAP_S) and not track.succession.is_unfit(new)
        T_led = found.predicted.pose(new.depth.exposure.mid_time)
        report = self._relocalise(new, fault, T_led) if others else track.report(new, fault=fault)
        if report.lost:
            self._bridge.put(track, new)
        return report

    def _relocalise(
        self, new: DeviceFrame, fault: Fault = Fault.NONE, T_led: FloatArray | None = None
    ) -> FrameReport:  # fmt: skip
        """Find a frame again and go on with a new segment of the spline; what was reported before stays as it is.

        fault: why it is not where the motion led, if it was looked for there. T_led (4, 4): where an IMU led it.
        """
        track = self.track
        where = self._relocaliser.find(track, new, T_led)
        if isinstance(where, Fault):
            return track.report(new, fault=fault or where)
        found, verdict = where
        # The new segment may need control points of the last frames before: their poses are stored, not their spline.
        track.found.begin_segment(track.known()[0].spline, found.window.state.untouched)
        new = self._accept(found, verdict)
        track.begin_segment(found, verdict.score.excess, new)
        self._relocaliser.reset()
        self._bridge.reset()
        track.placed(new, found.fresh, joined=False)
        return track.report(new, found.fresh, found.solved, overlap=track.succession.overlap(found.fresh))

    def _accept(self, found: Match, verdict: Verdict) -> DeviceFrame:
        """The track has the frame's pose and what is known of it. The frame, without what moves in it."""
        track, new = self.track, replace(found.frame, depth=found.left.depth)
        track.window = found.window
        track.covariances.uncertainty, track.covariances.common = verdict.uncertainty, verdict.common
        track.remember(new)
        found.window.keep(found.fresh)
        return new

    # -- what it has found ------------------------------------------------------------------------------------------

    @property
    def rig(self) -> Rig:
        """Whose images it tracks."""
        return self.track.rig

    @property
    def options(self) -> Options:
        """As decided for this rig."""
        return self.track.options

    @property
    def reports(self) -> list[FrameReport]:
        """One of every frame fed."""
        return self.track.reports

    @property
    def spline(self) -> Spline | None:
        """T_world_depth(t) so far; the newest few control points still move. Meaningful within `spline_valid` (s)."""
        return None if self.track.window is None else self.track.window.state.whole

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) of the frames that were not lost and T_world_depth (n, 4, 4) there."""
        if self.track.window is None:
            return np.zeros(0), np.zeros((0, 4, 4))
        return self.track.found.all(self.track.window.spline)

    @property
    def spline_valid(self) -> list[tuple[float, float]]:
        """Times (begin, end) in s within which the spline is an estimate."""
        return self.track.found.valid

    @property
    def uncorrected(self) -> Tracker:
        """Itself: it closes no loops while tracking."""
        return self

    @property
    def keyframes(self) -> int:
        """How many there have been."""
        return self.track.keyframes.made

    @property
    def reference(self) -> int | None:
        """Number of the frame whose keyframe new ones are aligned to."""
        ref = self.track.succession.reference
        return None if ref is None else ref.index

    @property
    def color_late(self) -> tuple[float, float]:
        """Seconds that colour was found to be later than its stamps, and σ of that; 0 where the file is exact."""
        return self.track.covariances.color_late

    @property
    def inertia(self) -> Inertia | None:
        """What has been found of an IMU, where the method uses one."""
        return self.track.inertia

    @property
    def left_out(self) -> MovingMasks:
        """What frames have been found to show that moves by itself, by their numbers."""
        return self.track.left_out

    @property
    def state(self) -> dict[str, Any]:
        """All that feeding frames has changed, for checkpoints."""
        return {name: getattr(self, f"_{name}") for name in _STATE} | {"track": self.track.state}

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        self.track.state = state["track"]
        for name in _STATE:
            setattr(self, f"_{name}", state[name])
