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
from rstrack.adjustment.graph import Seen
from rstrack.alignment.linearise import Terms
from rstrack.alignment.observation import Observation
from rstrack.alignment.pull import pulls
from rstrack.data.imu.recording import ImuRecording
from rstrack.data.moving_masks import MovingMasks
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, Timer, untimed
from rstrack.images.left_out import frame_without
from rstrack.inertial.inertia import Inertia
from rstrack.keyframes.archive import Archive
from rstrack.keyframes.keyframe import Reference
from rstrack.options import Options
from rstrack.tracking.bootstrap import bootstrap, fit_knots, start
from rstrack.tracking.bridging import Bridge
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.judgement.fault import Fault
from rstrack.tracking.judgement.innovation import Innovation, Prediction, doubt, weighed
from rstrack.tracking.judgement.lost_track import implausible, is_settled
from rstrack.tracking.moving.leave_out import LeftOut
from rstrack.tracking.relocalise import Relocaliser, without_misfits
from rstrack.tracking.track import Track
from rstrack.tracking.window import LEVELS, TRACKING_LEVELS

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
        self._track = track = Track(rig, options, timer, imu if options.inertial else None)
        self._relocaliser = Relocaliser(rig, track.options, track.keyframes, track.fits, track.observe, track.leave_out)
        self._bridge = Bridge()
        self._last_fed: float | None = None

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
        return self._track.shared | {
            "observe": self._relocaliser.observe,
            "leave out": self._relocaliser.leave_out,
        }

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
        self._track.keyframes.put_away()
        return self._track.keyframes.archive

    @property
    def seen(self) -> list[Seen]:
        """What its frames said of the spline's control points."""
        return self._track.chain.seen

    @property
    def inertia(self) -> Inertia | None:
        """What has been found of an IMU, where the method uses one."""
        return self._track.inertia

    @property
    def drift(self) -> dict[int, FloatArray]:
        """Covariances of the keyframes' poses, see `Uncertainty`."""
        return self._track.covariances.uncertainty.drift

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
        new, masks = self._track.device.upload(index, frame), self._track.left_out
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
        new = track.device.upload(len(track.reports), frame)
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
        track, fits = self._track, self._track.fits
        window, ref = track.known()
        before = window.copy()
        young = window.piece > 0 and track.age < _YOUNG
        window.predict(new, track.found.end, young)
        on_reference = track.observe(new, ref)
        anchor = track.keyframes.anchor
        fresh = on_reference + ([] if anchor is None else track.observe(new, anchor))
        # The first keyframe of a global shutter: no other frame tells where it was taken.
        gauge = ref if not window.is_frozen(ref.t) and new.depth.exposure.lens.lines == 1 else None
        led_to, mid = window.spline, new.depth.exposure.mid_time
        T_predicted = led_to.pose(mid)
        coupled = ref.rolling is not None
        levels = LEVELS if young or gap > (_LED_S if led else _SURE_S) else TRACKING_LEVELS
        left, last = LeftOut(new.depth), track.succession.recent[-1].depth

        def is_hopeless(seen: Sequence[Observation]) -> bool:
            # What moved in the frame before does not fit here either, until it is left out.
            return fits.is_hopeless(seen, last.moving)

        def leave_out() -> None:
            nonlocal left
            if not is_hopeless(fresh):
                (left,) = track.leave_out([new], ref, fresh, window.state, last)

        solved = window.solve(fresh, levels, gauge, coupled, is_hopeless, leave_out)
        on_reference = [o for o in fresh if o.ref.index == ref.index]
        if not is_settled(solved) and not fits.is_hopeless(fresh):
            # Its steps went to and fro; that says nothing against the place.
            solved = window.solve(fresh, (0,), gauge, coupled)
        fitting = without_misfits(fits, fresh, on_reference, ref)
        colorless = False
        if len(fitting) < len(fresh) and not fits.is_hopeless(on_reference):
            colorless = all(o.is_depth for o in fitting)
            window = before.copy()
            window.predict(new, track.found.end, young)
            fresh, on_reference = fitting, [o for o in fitting if o.ref.index == ref.index]
            solved = window.solve(fresh, levels, gauge, coupled, before_finest=leave_out)
        seconds = new.stamp - track.found.stamps[-1]
        accelerations = track.accelerations(window, seconds, T_predicted[:3, :3])
        uncertainty, common = track.covariances.uncertainty, track.covariances.common
        state, considered = uncertainty.predicted(seconds, *accelerations), track.covariances.considered(seconds)
        predicted, innovation = Prediction.of(led_to, mid, state, track.last_two(new)), Innovation()
        weighs = self._weighs(fresh, ref)
        if weighs and not young:
            innovation = weighed(fresh, window.state, predicted, considered)
            if innovation.inflation > 1.0:
                solved = window.solve(fresh, (0,), gauge, coupled)
        with track.terms.timer("judgement"):
            pulled = pulls(on_reference, window.state)
            fault = fits.fault(on_reference, solved, ref.pixels, pulled, young, colorless)
            if ref.rolling is None:
                # A rolling reference moves with what is aligned to it, which tells nothing of the two together.
                uncertainty = uncertainty.after(seconds, pulled.information, *accelerations)
                common = track.covariances.after(seconds, uncertainty, on_reference, window.state, pulled)
            if weighs:
                more = doubt(innovation, on_reference, window.state, predicted, considered)
                uncertainty = replace(uncertainty, doubt=more)
        if not fault and implausible(T_predicted, window.spline.pose(mid), gap):
            fault = Fault.MOTION
        elif not fault and not uncertainty.is_known:
            fault = Fault.UNKNOWN
        if fault:
            track.window = before
            if not led:
                return self._relocalise(new, fault)
            # Where the camera has turned away from the keyframe meanwhile another one may show what it sees.
            others = (fault is Fault.NOTHING_SEEN or gap > _GAP_S) and not track.succession.is_unfit(new)
            report = self._relocalise(new, fault, T_predicted) if others else track.report(new, fault=fault)
            if report.lost:
                self._bridge.put(track, new)
            return report
        self._bridge.close(track)
        track.window, track.covariances.uncertainty, track.covariances.common = window, uncertainty, common
        new = replace(new, depth=left.depth)
        track.remember(new)
        window.keep(fresh)
        track.learn(ref, on_reference, window, pulled, new.last_time)
        track.succession.recent.append(new)
        track.placed(new, fresh)
        track.age += 1
        track.succession.judged_colors(bool(new.colors and ref.points) and all(o.is_depth for o in on_reference))
        overlap = track.succession.overlap(on_reference)
        track.succession.saw_through(left.gone)
        frozen = track.succession.fuse_frozen(window)
        renewed = track.succession.renew(window, new, frozen, overlap)
        track.found.release(window, min(min(f.first_time, f.stamp) for f in track.succession.recent))
        return track.report(new, on_reference, solved, keyframe=renewed, overlap=overlap)

    def _weighs(self, fresh: Sequence[Observation], ref: Reference) -> bool:
        """Whether the filter's prediction is one to hold images against.

        A rolling reference moves with them; a gyroscope sees how lines move within an image that vibrates, which the
        filter does not; and under the wrong shutter all images are off.
        """
        fits = self._track.fits
        is_told = ref.rolling is None and not self._track.has_gyro and fits.is_modelled
        return is_told and not fits.is_hopeless(fresh)

    def _relocalise(
        self, new: DeviceFrame, fault: Fault = Fault.NONE, T_led: FloatArray | None = None
    ) -> FrameReport:  # fmt: skip
        """Find a frame again and go on with a new piece of the spline; what was reported before stays as it is.

        fault: why it is not where the motion led, if it was looked for there. T_led (4, 4): where an IMU led it.
        """
        track = self._track
        window, ref = track.known()
        uncertainty = track.covariances.uncertainty
        found = self._relocaliser.find(new, window, ref, track.found.end, uncertainty, fault is Fault.MOTION, T_led)
        if isinstance(found, Fault):
            return track.report(new, fault=fault or found)
        # The new piece may need control points of the last frames before: their poses are kept, not their spline.
        track.found.begin_piece(window.spline, found.window.state.untouched)
        found.window.keep(found.fresh)
        track.window, track.covariances.uncertainty = found.window, found.uncertainty
        track.chain.cut(found.window.piece)
        pulled = pulls(found.fresh, found.window.state)
        excess, covariances = pulled.excess, track.covariances
        covariances.common = covariances.after(0.0, found.uncertainty, found.fresh, found.window.state, pulled)
        track.chain.add(found.ref, found.fresh, found.window.state, excess)
        new = replace(new, depth=found.depth)
        track.remember(new)
        track.succession.use(found.ref, new)
        self._relocaliser.forget()
        self._bridge.forget()
        if track.inertia is not None:
            track.inertia.begin_piece()
            track.learn_inertia(found.fresh, found.window, excess, new.last_time)
        track.age = 1
        track.placed(new, found.fresh, joined=False)
        return track.report(new, found.fresh, found.solved, overlap=track.succession.overlap(found.fresh))
