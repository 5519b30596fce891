"""The first frames of a track: aligned jointly with the first, all of them rolling, until one becomes a keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rstrack.alignment.observation import Observation
from rstrack.alignment.pull import pulls
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.judgement.fault import Fault
from rstrack.tracking.judgement.uncertainty import Uncertainty
from rstrack.tracking.succession import LEAST_DEPTH
from rstrack.tracking.track import Track
from rstrack.tracking.window import Window

# Knots are never further apart than this many times the spacing that was asked for.
_WIDEST = 2.0


def start(track: Track, new: DeviceFrame) -> FrameReport:
    """The first frame. Its depth is enough to begin with: the first colour image often comes a little later."""
    if new.depth_share < LEAST_DEPTH or not (track.options.geometric or new.colors):
        return track.report(new, fault=Fault.NO_DEPTH)
    window = _begin(track, new, track.options.knots_s())
    track.succession.recent.append(new)
    if new.depth.exposure.lens.lines == 1:
        track.succession.make(new, window.spline, None)
        track.covariances.uncertainty = Uncertainty.of_first()
    track.placed(new)
    return track.report(new, keyframe=True)


def fit_knots(track: Track, gap: float) -> None:
    """Knots for frames `gap` s apart; a global shutter gives one pose each: no more knots than that can be told."""
    window, _ = track.known()
    dt, first = track.options.knots_s(gap), track.succession.recent[0]
    if first.depth.exposure.lens.lines == 1 and gap > dt:
        dt = min(gap, _WIDEST * dt)
    if dt != window.state.dt:
        _begin(track, first, dt)


def bootstrap(track: Track, new: DeviceFrame) -> FrameReport:
    """Joint alignment of the first frames with the first one, from zero motion."""
    window, ref = track.known()
    window.state.extend(new.last_time)
    fresh = track.observe(new, ref)
    solved = window.solve(fresh, gauge=ref, coupled=True)
    if ref.points:
        # Its colours were looked up as if the first frame stood still: again, with the motion found.
        ref, earlier = _recolored(track, window, ref, fresh), window.active
        window.active = []
        solved = window.solve([*earlier, *fresh], (1, 0), gauge=ref, coupled=True)
        window.active = earlier
    if track.fits.fault(fresh, solved, ref.pixels):
        return _begin_anew(track, new)
    window.keep(fresh)
    track.succession.recent.append(new)
    track.placed(new, fresh)
    if len(track.succession.recent) < track.options.bootstrap_frames:
        return track.report(new, fresh, solved)
    if all(track.succession.is_unfit(f) for f in track.succession.recent):
        return _begin_anew(track, new)  # none of them has a colour image to go on with
    _leave(track, window)
    return track.report(new, fresh, solved, keyframe=True)


def _begin(track: Track, first: DeviceFrame, dt: float) -> Window:
    """A spline with knots dt s apart; a rolling first frame is what others are aligned to."""
    window = Window.still(track.terms, track.rig.depth_camera.fx, first, dt, track.options.knot_phase, track.inertia)
    if first.depth.exposure.lens.lines > 1:
        track.succession.reference = track.maker.rolling(first.index, first.depth, first.colors, window.spline)
    track.window = window
    return window


def _recolored(track: Track, window: Window, ref: Reference, fresh: Sequence[Observation]) -> Reference:
    first = track.succession.recent[0]
    again = track.maker.rolling(first.index, first.depth, first.colors, window.spline)
    track.succession.reference = replace(again, T_world_base=ref.T_world_base)
    for o in (*window.active, *fresh):
        o.see(track.succession.reference)
    return track.succession.reference


def _begin_anew(track: Track, new: DeviceFrame) -> FrameReport:
    """The first frames did not fit together: they are lost, and the newest is the first one."""
    track.begin_anew()
    track.reports = [report.as_lost(Fault.NO_START) for report in track.reports]
    return start(track, new)


def _leave(track: Track, window: Window) -> None:
    """Rectify the middle frame and align all others to it."""
    frames, covariances = list(track.succession.recent), track.covariances
    middle = min(
        (f for f in frames if not track.succession.is_unfit(f)),
        key=lambda f: abs(f.index - frames[len(frames) // 2].index),
    )
    ref = track.succession.make(middle, window.spline, None)
    window.active = []
    others = [o for frame in frames if frame is not middle for o in track.observe(frame, ref)]
    window.solve(others, levels=(0,))
    window.keep(others)
    for frame in frames:
        seen = [o for o in others if o.frame == frame.index]
        own = pulls(seen, window.state)
        track.chain.add(ref, seen, window.state, own.excess)
        track.learn_inertia(seen, window, own.excess, frame.last_time)
        covariances.uncertainty = covariances.uncertainty.found_anew(own.information)
        if frame is not middle:
            covariances.add(frame, ref)
    covariances.begin(ref, frames, window.spline)
    for frame in frames[:-1]:
        report = track.reports[frame.index]
        track.reports[frame.index] = covariances.of(report, frame, window.spline, ref.index)
