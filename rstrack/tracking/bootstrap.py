"""The first frames of a track: aligned jointly with the first, all of them rolling, until one becomes a keyframe."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from rstrack.alignment.observation import Observation, Scores, scores
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference
from rstrack.tracking.frame_report import Fault, FrameReport
from rstrack.tracking.judgement.innovation import disagreement
from rstrack.tracking.judgement.lost_track import lost
from rstrack.tracking.moving.leave_out import LeftOut, left_out_with, without
from rstrack.tracking.moving.majority import not_with_most
from rstrack.tracking.succession import LEAST_DEPTH
from rstrack.tracking.track import TrackState
from rstrack.tracking.window import LEVELS, Window

# Knots are never further apart than this many times the spacing that was asked for.
_WIDEST = 2.0
# Where depth gives one pose a knot, how far after a knot, in knots: half-way between two it would not see control
# points that alternate, and rolling colours determine these badly.
_AFTER_KNOT = 0.1
# How far depth alone may slide in frames that begin a track, m: before the corridor's wall it slid by 0.25 to 1.
_MOST_APART_M = 0.1


def start(track: TrackState, new: DeviceFrame) -> FrameReport:
    """The first frame. Its depth is enough to begin with: the first colour image often comes a little later."""
    if new.depth_share < LEAST_DEPTH or not (track.options.geometric or new.colors):
        return track.report(new, fault=Fault.NO_START)
    window = _begin(track, new, track.options.knots_s(), track.options.knot_phase)
    track.succession.recent.append(new)
    if new.depth.exposure.lens.lines == 1:
        # Rolling colours, looked up as if the camera stood still, would contradict all that comes: the next keyframe,
        # whose motion is known, has colours.
        colors = () if _colors_roll(track) else new.colors
        track.succession.make(replace(new, colors=colors), window.spline, None)
        track.covariances.uncertainty = track.covariances.uncertainty.of_first()
    track.placed(new)
    return track.report(new, keyframe=True)


def fit_knots(track: TrackState, gap: float) -> None:
    """Knots for frames `gap` s apart; a global shutter gives one pose a frame, which determines no more knots."""
    window, _ = track.known()
    dt, first, phase = track.options.knots_s(gap), track.succession.recent[0], track.options.knot_phase
    if first.depth.exposure.lens.lines == 1 and gap > dt:
        dt = min(gap, _WIDEST * dt)
        phase = _AFTER_KNOT if _colors_roll(track) else phase
    if dt != window.state.dt:
        _begin(track, first, dt, phase)


def bootstrap(track: TrackState, new: DeviceFrame) -> FrameReport:
    """Joint alignment of the first frames with the first one, from zero motion."""
    window, ref = track.known()
    window.state.extend(new.last_time)
    fresh = track.observe(new, ref)
    left = [LeftOut(new.depth)]

    def leave_out() -> None:
        left[:] = track.leave_out([new], ref, fresh, window.state)

    solved = window.solve(fresh, gauge=ref, coupled=True, before_finest=leave_out)
    moves = left[0].moves
    if ref.points or moves:
        if ref.points:
            # Its colours were looked up as if the first frame stood still: again, with the motion found.
            ref = _recolored(track, window, ref, fresh)
        earlier, frames = window.active, [*list(track.succession.recent)[1:], new]

        def leave_out_all() -> None:
            # What moves has moved further by now: it shows in the earlier frames too.
            whole = [replace(frame, depth=frame.depth.occluder) for frame in frames]
            left[:] = track.leave_out(whole, ref, [*earlier, *fresh], window.state)

        if moves:
            _begin_with_most(track, ref, frames, [*earlier, *fresh])
        window.active = []
        levels = LEVELS if moves else (1, 0)
        solved = window.solve([*earlier, *fresh], levels, gauge=ref, coupled=True, before_finest=leave_out_all)
        window.active = earlier
    if lost(fresh, solved, ref.pixels):
        return _begin_anew(track, new)
    track.scales.learn(fresh)
    track.learn_independence(fresh)
    window.keep(fresh)
    track.count(window.active)
    recent = track.succession.recent
    recent.append(new)
    for n, one in enumerate(reversed(left), 1):
        recent[-n] = replace(recent[-n], depth=one.depth)
    new = recent[-1]
    track.placed(new, fresh)
    if len(recent) < track.options.bootstrap_frames:
        return track.report(new, fresh, solved)
    if all(track.succession.is_unfit(f) for f in recent):
        return _begin_anew(track, new)  # none of them has a colour image to go on with
    if not _leave(track, window):
        track.keyframes.drop_first()
        return _begin_anew(track, new)
    return track.report(new, fresh, solved, keyframe=True)


def _colors_roll(track: TrackState) -> bool:
    return track.options.rolling and track.rig.color_shutter.readout_s > 0.0


def _begin(track: TrackState, first: DeviceFrame, dt: float, phase: float) -> Window:
    """A spline with knots dt s apart, one of them `phase` knots before the first frame; a rolling first frame is what
    others are aligned to."""
    window = Window.still(track.terms, track.rig.depth_camera.fx, first, dt, phase, track.inertia)
    if first.depth.exposure.lens.lines > 1:
        track.succession.reference = track.maker.rolling(first.index, first.depth, first.colors, window.spline)
    track.window = window
    return window


def _recolored(track: TrackState, window: Window, ref: Reference, fresh: Sequence[Observation]) -> Reference:
    first = track.succession.recent[0]
    again = track.maker.rolling(first.index, first.depth, first.colors, window.spline)
    track.succession.reference = replace(again, T_world_base=ref.T_world_base)
    for o in (*window.active, *fresh):
        o.see(track.succession.reference)
    return track.succession.reference


def _begin_with_most(
    track: TrackState, ref: Reference, frames: Sequence[DeviceFrame], observations: Sequence[Observation]
) -> None:
    """Leave out of the first frame what does not move as most of it does, until the alignment shows what moves."""
    odd = not_with_most(track.device.e, [track.succession.recent[0], *frames], track.device.rays)
    if odd is not None and odd.any():
        rest = without(track.device.e, ref, odd)
        for o in observations:
            o.see(rest)


def _begin_anew(track: TrackState, new: DeviceFrame) -> FrameReport:
    """The first frames did not fit together: they are lost, and the newest is the first one."""
    track.begin_anew()
    track.reports = [report.as_lost(Fault.NO_START) for report in track.reports]
    return start(track, new)


# -- the first keyframe -----------------------------------------------------------------------------------------------


def _leave(track: TrackState, window: Window) -> bool:
    """Rectify the middle frame and align all others to it. Returns whether they stay."""
    if any(frame.depth.moving for frame in track.succession.recent):
        _leave_out_by_last(track, window)
    frames, covariances = list(track.succession.recent), track.covariances
    center = frames[len(frames) // 2].index
    fit = (frame for frame in frames if not track.succession.is_unfit(frame))
    middle = min(fit, key=lambda frame: abs(frame.index - center))
    ref = track.succession.make(middle, window.spline, None)
    window.active = []
    rest = [frame for frame in frames if frame is not middle]
    others = [o for frame in rest for o in track.observe(frame, ref)]
    window.solve(others, levels=(0,))
    _leave_out_once_more(track, window, ref, rest, others)
    seen_of = {frame.index: [o for o in others if o.frame == frame.index] for frame in frames}
    covariances.look_at(ref, window.spline)
    scores_of = {index: scores(seen, window.state) for index, seen in seen_of.items()}
    if _slides(seen_of.values(), window):
        return False
    if not all(_agree(track, seen_of[frame.index], scores_of[frame.index], window) for frame in rest):
        return False
    window.keep(others)
    for frame in track.succession.recent:
        track.remember(frame)
    for frame in frames:
        seen, own = seen_of[frame.index], scores_of[frame.index]
        track.learn_motion(ref, seen, window, own.excess, frame.last_time)
        covariances.uncertainty = covariances.uncertainty.found_anew(own.information)
        covariances.common = covariances.after(0.0, covariances.uncertainty, seen, window.state, own)
        if frame is not middle:
            covariances.add(frame, ref, window.spline)
    covariances.begin(ref, frames, window.spline)
    for frame in frames[:-1]:
        report = track.reports[frame.index]
        track.reports[frame.index] = covariances.of(report, frame, window.spline, ref.index)
    return True


def _leave_out_by_last(track: TrackState, window: Window) -> None:
    """What has hardly moved since the first frame has done so until the last one: left out of those between."""
    *frames, last = track.succession.recent
    _, ref = track.known()
    rest = [
        replace(frame, depth=left_out_with(track.space, frame.depth, last.depth, ref.median_depth, window.spline))
        for frame in frames
    ]
    track.succession.recent = deque([*rest, last])


def _leave_out_once_more(
    track: TrackState, window: Window, ref: Reference, rest: Sequence[DeviceFrame], others: Sequence[Observation]
) -> None:
    """What moves, as it shows against the rectified keyframe: all are aligned again without it."""
    left = track.leave_out(rest, ref, others, window.state)
    if not any(one.moves for one in left):
        return
    window.solve(others, levels=(0,))
    for one in left:
        track.succession.saw_through(one.gone)
    cleaned = {frame.index: replace(frame, depth=one.depth) for frame, one in zip(rest, left, strict=True)}
    track.succession.recent = deque(cleaned.get(frame.index, frame) for frame in track.succession.recent)


def _slides(seen_of: Iterable[Sequence[Observation]], window: Window) -> bool:
    """Whether a frame that depth alone has aligned may have slid, as before a wall."""
    by_depth = [seen for seen in seen_of if seen and all(o.is_depth for o in seen)]
    return any(np.trace(disagreement(seen, window.state)[:3, :3]) > _MOST_APART_M**2 for seen in by_depth)


def _agree(track: TrackState, seen: Sequence[Observation], score: Scores, window: Window) -> bool:
    """Whether a frame's pose is known in spite of what its images are apart, beyond the running median."""
    covariances, median = track.covariances, track.covariances.uncertainty.systematic.median_inflation
    if not covariances.uncertainty.systematic.inflations:
        return True  # a wrong camera file has them apart in every frame, and there was none yet
    considered, state = covariances.considered(0.0), window.state
    apart = disagreement(seen, state, considered, median) - disagreement(seen, state, considered, np.inf)
    return replace(covariances.uncertainty.found_anew(score.information), mixture=apart).is_known
