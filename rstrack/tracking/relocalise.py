"""Find a lost frame: where the track ended, or at any keyframe ever made that looks like it, and make sure of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment import brightness
from rstrack.alignment.observation import Observation
from rstrack.alignment.optimizer import Solved
from rstrack.alignment.pull import pulls
from rstrack.alignment.spline_state import SplineState
from rstrack.data.rig import Rig
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.pyramid import DepthImage
from rstrack.keyframes import coarse_search
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.store import KeyframeStore
from rstrack.options import Options
from rstrack.tracking.judgement.fault import Fault
from rstrack.tracking.judgement.lost_track import FitHistory, coarseness, implausible
from rstrack.tracking.judgement.uncertainty import Uncertainty
from rstrack.tracking.moving.leave_out import LeftOut
from rstrack.tracking.window import LEVELS, Window

# Keyframes at which a lost frame is looked for, at once.
_PLACES = 3
# An IMU is off by no more than a hand in so many seconds, s: 0.25 m and 27 degrees.
_LED_OFF_S = 0.05
# Part of the pixels that must fit where a place is recognised by one image though the others say otherwise. How well
# depth alone must tell all motions (see `FrameReport.observability`), since one wall fits another; less where pixels
# are large.
_SURE_FIT, _SURE_SEEN = 0.9, 2e-3


@dataclass(frozen=True)
class Found:
    """A frame that was found again: a window with a new piece of the spline, and what says so.

    depth: its image, without what moves by itself.
    """

    window: Window
    fresh: list[Observation]
    solved: Solved
    ref: Reference
    uncertainty: Uncertainty
    depth: DepthImage


@dataclass(frozen=True)
class _Jump:
    """A pose further from the last than a hand moves a camera: at a keyframe, at a time (s). To be confirmed."""

    ref: Reference
    T_ref_cam: FloatArray
    time: float


class Relocaliser:
    """Remembers what was tried for the frames that are lost in a row.

    observe: what a frame's images say against a reference, given gain and offset (2,) that are expected. leave_out: see
    `moving.leave_out`.
    """

    def __init__(
        self, rig: Rig, options: Options, keyframes: KeyframeStore, fits: FitHistory,
        observe: Callable[[DeviceFrame, Reference, FloatArray], list[Observation]],
        leave_out: Callable[[list[DeviceFrame], Reference, list[Observation], SplineState], list[LeftOut]],
    ) -> None:  # fmt: skip
        self._rig, self._options, self._keyframes, self._fits = rig, options, keyframes, fits
        self.observe, self.leave_out = observe, leave_out
        self._lost_in_a_row = 0
        self._jump: _Jump | None = None

    def forget(self) -> None:
        """The camera has been found."""
        self._lost_in_a_row, self._jump = 0, None

    def find(
        self, new: DeviceFrame, window: Window, ref: Reference, end: float, uncertainty: Uncertainty,
        torn: bool = False, T_led: FloatArray | None = None,
    ) -> Found | Fault:  # fmt: skip
        """Where a frame was taken, or why that cannot be told; the track ended at time `end` (s).

        Small images are aligned to some keyframes, and the whole one from the best of these poses; others take their
        turn with the next frame, or at once where an IMU has led nearby. A pose that no hand can have brought the
        camera to is none until the next frame is found beside it. torn: whether it was found where the motion led, but
        pulled away from it: under vibration depth alone fits single frames anywhere nearby, and is not believed then.
        T_led (4, 4): where an IMU has it.
        """
        jump, self._jump = self._jump, None
        starts = [(jump.ref, jump.T_ref_cam)] if jump else self._searched(new, window, ref, end, T_led)
        self._lost_in_a_row += 1
        found: Found | Fault = Fault.NO_PLACE
        for start in starts:
            found = self._aligned(new, window, end, *start, uncertainty)
            if isinstance(found, Found):
                break
        if isinstance(found, Fault):
            return found
        if torn and all(o.is_depth for o in found.fresh):
            return Fault.UNKNOWN
        mid = new.depth.exposure.mid_time
        T_found = found.window.spline.pose(mid)
        near = [(window.spline.pose(end), end)]
        if jump:
            near.append((jump.ref.T_world_base @ jump.T_ref_cam, jump.time))
        if all(implausible(T, T_found, mid - time) for T, time in near):
            self._jump = _Jump(found.ref, se3.inverse(found.ref.T_world_base) @ T_found, mid)
            return Fault.UNCONFIRMED
        return found

    def _searched(
        self, new: DeviceFrame, window: Window, ref: Reference, end: float, T_led: FloatArray | None
    ) -> list[tuple[Reference, FloatArray]]:
        """The keyframe and T_ref_cam (4, 4) whose turn it is; where an IMU has led, all that are near, best first."""
        newest = self._keyframes.newest if ref.rolling is not None else ref
        skip = (self._lost_in_a_row // 2) * (_PLACES - 1)
        # What looks alike may be anywhere; where an IMU led, what is there comes first.
        led = [] if T_led is None else self._keyframes.near(T_led, _PLACES - 1)
        places = [newest, *(led or self._keyframes.candidates(new, skip, _PLACES - 1))]
        T_ends = [window.spline.pose(end), *(place.T_world_base for place in places[1:])]
        if T_led is not None:
            places, T_ends = [*places, *places], [*T_ends, *[T_led] * len(places)]
        ranked = coarse_search.ranked(
            coarse_search.small_frame(new, self._rig, self._options.geometric),
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
        self, new: DeviceFrame, window: Window, end: float, ref: Reference, T_ref_cam: FloatArray, before: Uncertainty
    ) -> Found | Fault:
        def restarted() -> Window:
            return window.restarted(new, end, ref.T_world_base @ T_ref_cam)

        trial, fresh = restarted(), self.observe(new, ref, _matched(new, ref))
        solved = trial.solve(fresh, LEVELS, hopeless=self._fits.is_hopeless)
        fitting, colorless = without_misfits(self._fits, fresh, fresh, ref), False
        if len(fitting) < len(fresh) and not self._fits.is_hopeless(fresh):
            colorless = all(o.is_depth for o in fitting)
            trial, fresh = restarted(), fitting
            solved = trial.solve(fresh, LEVELS, hopeless=self._fits.is_hopeless)
        depth = new.depth
        if not self._fits.is_hopeless(fresh):
            # Only now: at a wrong place a good deal would seem to move, and what is left might fit.
            (left,) = self.leave_out([new], ref, fresh, trial.state)
            if left.moves and not self._fits.fault(
                fresh, solved, ref.pixels, pulls(fresh, trial.state), True, colorless
            ):
                depth, solved = left.depth, trial.solve(fresh, (0,))
        pulled = pulls(fresh, trial.state)
        fault = self._fits.fault(fresh, solved, ref.pixels, pulled, True, colorless)
        uncertainty = before.found_anew(pulled.information)
        # Depth alone is much alike in many places.
        is_sure = len(fresh) > 1 or _is_sure(fresh[0], denied=bool(new.colors and ref.points))
        if fault or not is_sure or not uncertainty.is_known:
            return fault or Fault.UNKNOWN
        return Found(trial, fresh, solved, ref, uncertainty, depth)


def where_led(
    T_led: FloatArray, places: Sequence[Reference], ranked: Sequence[tuple[int, FloatArray]]
) -> list[tuple[int, FloatArray]]:
    """Those of ranked poses, T_place_cam (4, 4) at a place by its number, where an IMU may have led: T_led (4, 4)."""
    return [(k, T) for k, T in ranked if not implausible(T_led, places[k].T_world_base @ T, _LED_OFF_S)]


def _is_sure(alone: Observation, denied: bool) -> bool:
    """Whether an image tells the place without others; denied: there are some, and they say otherwise."""
    if not alone.is_linearised or (denied and alone.lin.fit < _SURE_FIT):
        return False
    return not alone.is_depth or alone.lin.observability >= _SURE_SEEN * coarseness(alone) ** -2


def without_misfits(
    fits: FitHistory, fresh: list[Observation], on_reference: Sequence[Observation], ref: Reference
) -> list[Observation]:
    """What is left to align by if a frame's colour images do not fit, or its depth has none to show.

    Where depth does not fit either, the colours may be what drew it away.
    """
    misfits = [o for o, _ in fits.misfits(on_reference, ref.pixels)]
    empty = [o for o in fresh if isinstance(o.image, DepthImage) and o.image.count == 0]
    odd_colors = [o for o in misfits if not o.is_depth]
    if odd_colors and len(odd_colors) < len(on_reference) and not empty:
        return [o for o in fresh if all(o.image is not odd.image for odd in odd_colors)]
    if empty and len(misfits) == 1 and misfits[0].is_depth:
        return [o for o in fresh if not o.is_depth]
    return fresh


def _matched(frame: DeviceFrame, ref: Reference) -> FloatArray:
    if not (frame.colors and ref.points):
        return np.asarray(brightness.SAME)
    return np.asarray(brightness.matched(frame.colors[0].moments, ref.moments))
