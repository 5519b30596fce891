"""One way to align a frame to a keyframe, and to judge what comes of it, wherever its start comes from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment.observation import Observation, Scores, scores
from rstrack.alignment.optimizer import Solved
from rstrack.alignment.spline_state import SplineState
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.fast_spline import jacobians, motion
from rstrack.images.pyramid import DepthImage
from rstrack.keyframes.keyframe import Reference
from rstrack.tracking.frame_report import Fault
from rstrack.tracking.judgement.calibration_errors import Common
from rstrack.tracking.judgement.innovation import Innovation, Prediction, disagreement, learnt, mixture, weighed
from rstrack.tracking.judgement.lost_track import RunningScales, implausible, is_hopeless, is_settled, lost, misfits
from rstrack.tracking.judgement.uncertainty import PoseCovariances, Uncertainty
from rstrack.tracking.moving.leave_out import LeftOut
from rstrack.tracking.track import Match, TrackState, gauge_of, is_rolling
from rstrack.tracking.window import Window


@dataclass(frozen=True, eq=False)
class Verdict:
    """fault: why a frame has not been found. score: by its images; uncertainty, common: of it, if it has been."""

    fault: Fault
    score: Scores
    uncertainty: Uncertainty
    common: Common


def match(
    track: TrackState, begin: Callable[[], Window], new: DeviceFrame, ref: Reference, fresh: list[Observation],
    levels: Sequence[int], last: DepthImage | None = None,
) -> Match:  # fmt: skip
    """Align a frame's observations, coarse to fine, from where a window has it; once more without images that misfit.

    begin: makes that window. last: depth of the frame before, since what moved in it does not fit here either.
    """
    moving = 0.0 if last is None else last.moving

    def hopeless(seen: Sequence[Observation]) -> bool:
        return is_hopeless(seen, moving)

    def leave_out() -> None:
        if not hopeless(found.fresh):
            (found.left,) = track.leave_out([new], ref, found.fresh, found.window.state, last)

    def solve(stops: Callable[[Sequence[Observation]], bool] | None) -> None:
        gauge = gauge_of(found.window, new, ref)
        found.solved = found.window.solve(found.fresh, levels, gauge, is_rolling(ref), stops, leave_out)

    window = begin()
    found = Match(new, ref, window, window.spline, fresh, Solved(), LeftOut(new.depth))
    solve(hopeless)
    if not is_settled(found.solved) and not is_hopeless(fresh):
        found.again()
    fitting = without_misfits(fresh, ref, track.scales)
    if len(fitting) < len(fresh) and not is_hopeless(found.on_reference):
        found.window, found.fresh, found.whole = begin(), fitting, False
        solve(None)
    return found


def judge_predicted(track: TrackState, found: Match, gap: float, young: bool) -> Verdict:
    """Whether a frame was found where the motion led; gap: s since the one before, or since where an IMU leads from.

    young: its segment of the spline has just begun, and predicts little: all of its images have to fit, as where the
    frame before was lost. A rolling reference moves with what is aligned to it, and does not bind the two. A gyroscope
    sees how rows move within an image that vibrates, which the filter does not. Under the wrong shutter all images are
    off. In these cases no prediction is held against them.
    """
    new, fresh, window = found.frame, found.fresh, found.window
    uncertainty, common = track.covariances.uncertainty, track.covariances.common
    mid, rolls = new.depth.exposure.mid_time, is_rolling(found.ref)
    T_predicted, seconds = found.predicted.pose(mid), new.stamp - track.found.stamps[-1]
    accelerations = track.accelerations(window, seconds, T_predicted[:3, :3])
    considered = track.covariances.considered(seconds)
    state = uncertainty.predicted(seconds, *accelerations)
    predicted, innovation = Prediction.of(found.predicted, mid, state, track.last_two(new)), Innovation()
    weighs = not rolls and not track.has_gyro and track.is_modelled and not is_hopeless(fresh)
    if weighs and not young:
        innovation = weighed(fresh, window.state, predicted, considered)
        if innovation.inflation > 1.0:
            found.again()
    on_reference = found.on_reference
    with track.terms.timer("judgement"):
        score = scores(on_reference, window.state)
        fault = lost(on_reference, found.solved, found.ref.pixels)
        # A depth image that fits far worse than the last ones may show another place: the prediction does not hold
        # then. Noise may be the cause, as on what is far away; where nothing fits as usual nothing is known.
        odd = track.scales.exceeded(on_reference)
        nothing_fits = len(odd) == len(on_reference) and (len(odd) > 1 or not found.whole)
        if not fault and (nothing_fits or ((young or seconds > gap) and (odd or not _fits(track, found)))):
            fault = Fault.MISFIT
        if not rolls:
            seen = score.information
            if weighs and odd:
                uncertainty = uncertainty.found_anew(seen)
            else:
                uncertainty = uncertainty.after(seconds, seen, *accelerations)
            common = track.covariances.after(seconds, uncertainty, on_reference, window.state, score)
        if weighs:
            more = mixture(innovation, on_reference, window.state, predicted, considered)
            uncertainty = replace(uncertainty, mixture=more)
        if found.solved.is_cut:
            off = unfinished(found.solved, window.state, mid)
            uncertainty = replace(uncertainty, mixture=uncertainty.mixture + np.outer(off, off))
        if weighs and not young:
            known = learnt(innovation, uncertainty.systematic, uncertainty.calibration, score.excess)
            uncertainty = replace(uncertainty, systematic=known[0], calibration=known[1])
        if young and not fault:
            median = uncertainty.systematic.median_inflation
            more = uncertainty.mixture + disagreement(on_reference, window.state, considered, median)
            uncertainty = replace(uncertainty, mixture=more)
    if not fault:
        track.scales.learn(on_reference)
        if implausible(T_predicted, window.spline.pose(mid), gap):
            fault = Fault.MOTION
    return Verdict(fault or _unknown(uncertainty), score, uncertainty, common)


def unfinished(solved: Solved, state: SplineState, t: float) -> FloatArray:
    """What may be left of an alignment that was cut, as pose and velocity (12,) at time t (s) in the camera's axes.

    Taken for as much as the last step, as if each were half of the one before: nobody knows what was not done.
    """
    T_camera_world = se3.inverse(motion(state.spline, t)[0])
    first, last = state.segment(t), solved.first + len(solved.step)
    begin, count = min(first, solved.first), max(first + 4, last) - min(first, solved.first)
    steps = np.zeros((count, 6))
    steps[solved.first - begin : last - begin] = solved.step
    off = jacobians(state.spline, T_camera_world, np.array([t]), begin, count)[0] @ steps.ravel()
    return np.concatenate([off, np.zeros(6)])


def _fits(track: TrackState, found: Match) -> bool:
    """Whether a frame was found by all of its images, and does not vibrate, which the spline does not follow."""
    return found.whole and not all(track.scatters(o) for o in found.on_reference)


def judge_unpredicted(track: TrackState, found: Match) -> Verdict:
    """Whether a frame was found where nothing led."""
    state = found.window.state
    verdict = judge_alone(track.scales, track.covariances, found.fresh, found.solved, state, found.ref.pixels)
    if not _fits(track, found):
        verdict = replace(verdict, fault=Fault.MISFIT)
    if not verdict.fault:
        track.scales.learn(found.fresh)
    common = track.covariances.after(0.0, verdict.uncertainty, found.fresh, state, verdict.score)
    return replace(verdict, common=common)


def judge_alone(
    scales: RunningScales, covariances: PoseCovariances, fresh: Sequence[Observation], solved: Solved,
    state: SplineState, expected: int,
) -> Verdict:  # fmt: skip
    """Whether a frame was found, by its images alone: by all of them, as one is alike in many places.

    expected: pixels that a whole image puts on the keyframe.
    """
    score = scores(fresh, state)
    uncertainty = covariances.uncertainty.found_anew(score.information)
    fault = lost(fresh, solved, expected)
    if not fault and scales.exceeded(fresh):
        fault = Fault.MISFIT
    if not fault:
        median = uncertainty.systematic.median_inflation
        apart = disagreement(fresh, state, covariances.considered(0.0), median)
        uncertainty = replace(uncertainty, mixture=apart)
    return Verdict(fault or _unknown(uncertainty), score, uncertainty, covariances.common)


def without_misfits(fresh: list[Observation], ref: Reference, scales: RunningScales) -> list[Observation]:
    """What is left to align by if a frame's colours do not fit, or not as they usually do, or its depth shows nothing.

    Where depth does not fit either, the colours may be what drew it away.
    """
    on_reference = [o for o in fresh if o.ref.index == ref.index]
    unfit = [o for o, _ in misfits(on_reference, ref.pixels)]
    odd = {id(o.image): o for o in (*unfit, *scales.exceeded(on_reference)) if not o.is_depth}
    empty = [o for o in fresh if isinstance(o.image, DepthImage) and o.image.count == 0]
    if odd and len(odd) < len(on_reference) and not empty:
        return [o for o in fresh if id(o.image) not in odd]
    if empty and unfit and not odd:
        return [o for o in fresh if not o.is_depth]
    return fresh


def _unknown(uncertainty: Uncertainty) -> Fault:
    return Fault.NONE if uncertainty.is_known else Fault.UNKNOWN
