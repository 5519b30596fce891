"""Find lost frames: at any keyframe that looks like them, or led by an IMU over frames that show nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment.observation import matched_brightness
from rstrack.alignment.priors import ACCELERATION
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.fast_spline import motion
from rstrack.keyframes import coarse_search
from rstrack.keyframes.keyframe import Reference
from rstrack.tracking.frame_report import Fault
from rstrack.tracking.judgement.innovation import Prediction, by_images, contradicts
from rstrack.tracking.judgement.lost_track import implausible
from rstrack.tracking.matching import Match, Verdict, judge_unpredicted, match
from rstrack.tracking.track import TrackState
from rstrack.tracking.window import LEVELS, Window

# Seconds for which an IMU alone leads: in two a phone's is off by some centimetres, from where images are not aligned.
_LONGEST_S = 2.0
# Frames in a row that show something, but not where the IMU leads: then it is no blackout.
_MOST_ODD = 6
# Keyframes at which a lost frame is looked for, at once.
_PLACES = 3
# An IMU is off by no more than a hand in so many seconds, s: 0.25 m and 27 degrees.
_LED_OFF_S = 0.05


@dataclass
class Bridge:
    """over: frames since the last one that was found. odd: how many of them were not dark."""

    over: list[DeviceFrame] = field(default_factory=list)
    odd: int = 0

    def leads(self, track: TrackState, new: DeviceFrame) -> bool:
        """Whether the motion since the last frame that was found is known well enough to look for a new one there."""
        window, end = track.window, track.found.end
        return (
            window is not None
            and new.last_time - end < _LONGEST_S
            and self.odd < _MOST_ODD
            and window.is_led(end, new.last_time)
        )

    def put(self, track: TrackState, new: DeviceFrame) -> None:
        """A frame that was not found: lost, until one after it is."""
        self.over.append(new)
        self.odd += not track.succession.is_unfit(new)

    def close(self, track: TrackState) -> None:
        """A frame beyond was found, on the same segment of the spline: those before have poses, too."""
        for frame in self.over:
            track.found.add(frame)
            report = track.reports[frame.index]
            track.reports[frame.index] = replace(report, lost=False, bridged=True)
        self.reset()

    def reset(self) -> None:
        """The track begins anew: what was lost stays so."""
        self.over, self.odd = [], 0


@dataclass(frozen=True)
class _Jump:
    """A pose that does not follow from the motion before: at a keyframe, at a time (s). To be confirmed."""

    ref: Reference
    T_ref_cam: FloatArray
    time: float


class Relocaliser:
    """Remembers what was tried for the frames that are lost in a row."""

    def __init__(self) -> None:
        self._lost_in_a_row = 0
        self._jump: _Jump | None = None
        # Stamp of the last frame that was found though its pose does not follow from the motion before.
        self._jumped = -np.inf

    def reset(self) -> None:
        """The camera has been found."""
        self._lost_in_a_row, self._jump = 0, None

    def find(
        self, track: TrackState, new: DeviceFrame, T_led: FloatArray | None = None
    ) -> tuple[Match, Verdict] | Fault:  # fmt: skip
        """Where a frame was taken that follows a track's last ones, or why it is not known.

        Small images are aligned to some keyframes, and the whole one from the best of these poses; others take their
        turn with the next frame, or at once where an IMU has led nearby. A pose that does not follow from the motion
        before is none until the next frame is found beside it. T_led (4, 4): where an IMU has it.
        """
        jump, self._jump = self._jump, None
        starts = [(jump.ref, jump.T_ref_cam)] if jump else self._searched(track, new, T_led)
        self._lost_in_a_row += 1
        fault = Fault.NO_PLACE
        for ref, T_ref_cam in starts:
            found, verdict = self._aligned(track, new, ref, T_ref_cam)
            fault = verdict.fault
            if not fault:
                break
        if fault:
            return fault
        mid = new.depth.exposure.mid_time
        T_found = found.window.spline.pose(mid)
        if jump and not implausible(jump.ref.T_world_base @ jump.T_ref_cam, T_found, mid - jump.time):
            self._jumped = new.stamp
            return found, verdict
        # Where the frame before did not follow either, stamps lie, or rows: then the motion says nothing of this one.
        is_led = self._jumped != track.found.stamps[-1]
        if not (_is_near(track, found) and (not is_led or _follows(track, found))):
            self._jump = _Jump(found.ref, se3.inverse(found.ref.T_world_base) @ T_found, mid)
            return Fault.UNCONFIRMED
        self._jumped = self._jumped if is_led else new.stamp
        return found, verdict

    def _searched(
        self, track: TrackState, new: DeviceFrame, T_led: FloatArray | None
    ) -> list[tuple[Reference, FloatArray]]:  # fmt: skip
        """The keyframe and T_ref_cam (4, 4) whose turn it is; where an IMU has led, all that are near, best first."""
        window, ref = track.known()
        newest = track.keyframes.newest if ref.rolling is not None else ref
        skip = (self._lost_in_a_row // 2) * (_PLACES - 1)
        # What looks alike may be anywhere; where an IMU led, what is there comes first.
        led = [] if T_led is None else track.keyframes.near(T_led, _PLACES - 1)
        places = [newest, *(led or track.keyframes.candidates(new, skip, _PLACES - 1))]
        T_ends = [window.spline.pose(track.found.end), *(place.T_world_base for place in places[1:])]
        if T_led is not None:
            places, T_ends = [*places, *places], [*T_ends, *[T_led] * len(places)]
        ranked = coarse_search.ranked(
            coarse_search.small_frame(new, track.rig, track.options.geometric),
            [(coarse_search.small_keyframe(place), se3.inverse(place.T_world_base) @ T)
             for place, T in zip(places, T_ends, strict=True)],
        )  # fmt: skip
        near = [] if T_led is None else where_led(T_led, places, ranked)
        if near:
            return [(places[k], T) for k, T in near]
        if not ranked:
            return []
        chosen, T_ref_cam = ranked[self._lost_in_a_row % len(ranked)]
        return [(places[chosen], T_ref_cam)]

    def _aligned(
        self, track: TrackState, new: DeviceFrame, ref: Reference, T_ref_cam: FloatArray
    ) -> tuple[Match, Verdict]:  # fmt: skip
        window = track.known()[0]
        fresh = track.observe(new, ref, matched_brightness(new, ref))

        def begin() -> Window:
            return window.restarted(new, track.found.end, ref.T_world_base @ T_ref_cam)

        found = match(track, begin, new, ref, fresh, LEVELS)
        return found, judge_unpredicted(track, found)


def _is_near(track: TrackState, found: Match) -> bool:
    """Whether a hand may have moved the camera to a pose since the last one."""
    end, mid = track.found.end, found.frame.depth.exposure.mid_time
    return not implausible(track.known()[0].spline.pose(end), found.window.spline.pose(mid), mid - end)


def _follows(track: TrackState, found: Match) -> bool:
    """Whether pose and velocity follow from the last ones, by the covariances of both.

    By itself an image may be off in its velocity, and in its pose with it, as where it is blurred otherwise than its
    keyframe. Under the wrong shutter, or beside a gyroscope, images are not held against a prediction.
    """
    (window, ref), state, mid = track.known(), found.window.state, found.frame.depth.exposure.mid_time
    uncertainty = track.covariances.uncertainty
    if track.has_gyro or not track.is_modelled:
        return True
    now = by_images(found.fresh, state, track.covariances.considered(0.0), uncertainty.systematic.median_inflation)
    begin = mid - (found.frame.stamp - track.found.stamps[-1])
    last = Prediction(begin, *motion(window.spline, begin), uncertainty.state + uncertainty.mixture)
    to_camera = se3.adjoint(se3.inverse(state.spline.pose(mid)))
    older, newer = sorted((ref.index, found.ref.index))
    drift = to_camera @ (uncertainty.drift_of(newer) - uncertainty.drift_of(older)) @ to_camera.T
    return now is None or not contradicts(last, now, ACCELERATION, drift)


def where_led(
    T_led: FloatArray, places: Sequence[Reference], ranked: Sequence[tuple[int, FloatArray]]
) -> list[tuple[int, FloatArray]]:
    """Those of ranked poses, T_place_cam (4, 4) at a place by its number, where an IMU may have led: T_led (4, 4)."""
    return [(k, T) for k, T in ranked if not implausible(T_led, places[k].T_world_base @ T, _LED_OFF_S)]
