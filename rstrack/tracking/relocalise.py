"""Find lost frames: at any keyframe that looks like them, or led by an IMU over frames that show nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment import brightness
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
    """A pose at a keyframe that the motion before does not lead to. To be confirmed.

    state: of a camera there; of covariance 0 where that is not known.
    """

    ref: Reference
    T_ref_cam: FloatArray
    state: Prediction


class Relocaliser:
    """Remembers what was tried for the frames that are lost in a row."""

    def __init__(self) -> None:
        self._lost_in_a_row = 0
        self._jump: _Jump | None = None

    def reset(self) -> None:
        """The camera has been found."""
        self._lost_in_a_row, self._jump = 0, None

    def find(
        self, track: TrackState, new: DeviceFrame, T_led: FloatArray | None = None
    ) -> tuple[Match, Verdict] | Fault:  # fmt: skip
        """Where a frame was taken that follows a track's last ones, or why it is not known.

        Small images are aligned to some keyframes, and the whole one from the best of these poses; others take their
        turn with the next frame, or at once where an IMU has led nearby. A pose that no hand can have brought the
        camera to is none until the next frame is found beside it. T_led (4, 4): where an IMU has it.
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
        (window, ref), now = track.known(), self._state(track, found)
        recent, uncertainty = track.succession.recent, track.covariances.uncertainty
        end = recent[-1].depth.exposure.mid_time if recent else track.found.end
        last = Prediction(end, *motion(window.spline, end), uncertainty.state + uncertainty.mixture)
        before = [(ref, last), *([(jump.ref, jump.state)] if jump else [])]
        if not any(self._leads_to(track, there, state, found.ref, now) for there, state in before):
            T_found = found.window.spline.pose(new.depth.exposure.mid_time)
            self._jump = _Jump(found.ref, se3.inverse(found.ref.T_world_base) @ T_found, now)
            return Fault.UNCONFIRMED
        return found, verdict

    def _state(self, track: TrackState, found: Match) -> Prediction:
        """What a frame's images say of its state."""
        state, mid = found.window.state, found.frame.depth.exposure.mid_time
        median = track.covariances.uncertainty.systematic.median_inflation
        said = by_images(found.fresh, state, track.covariances.considered(0.0), median) if track.is_modelled else None
        return said or Prediction(mid, *motion(state.spline, mid), np.zeros((12, 12)))

    def _leads_to(
        self, track: TrackState, there: Reference, before: Prediction, ref: Reference, now: Prediction
    ) -> bool:  # fmt: skip
        """Whether a camera in one state at a keyframe may be in another one at `ref` later on."""
        if implausible(before.T_world_depth, now.T_world_depth, now.t - before.t):
            return False
        if not now.covariance.any() or not before.covariance.any() or track.has_gyro:
            return True
        to_camera = se3.adjoint(se3.inverse(now.T_world_depth))
        drift_of = track.covariances.uncertainty.drift_of
        older, newer = sorted((there.index, ref.index))
        drift = to_camera @ (drift_of(newer) - drift_of(older)) @ to_camera.T
        return not contradicts(before, now, ACCELERATION, drift)

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
        fresh = track.observe(new, ref, _matched(new, ref))

        def begin() -> Window:
            return window.restarted(new, track.found.end, ref.T_world_base @ T_ref_cam)

        found = match(track, begin, new, ref, fresh, LEVELS)
        return found, judge_unpredicted(track, found)


def where_led(
    T_led: FloatArray, places: Sequence[Reference], ranked: Sequence[tuple[int, FloatArray]]
) -> list[tuple[int, FloatArray]]:
    """Those of ranked poses, T_place_cam (4, 4) at a place by its number, where an IMU may have led: T_led (4, 4)."""
    return [(k, T) for k, T in ranked if not implausible(T_led, places[k].T_world_base @ T, _LED_OFF_S)]


def _matched(frame: DeviceFrame, ref: Reference) -> FloatArray:
    if not (frame.colors and ref.points):
        return np.asarray(brightness.SAME)
    return np.asarray(brightness.matched(frame.colors[0].moments, ref.moments))
