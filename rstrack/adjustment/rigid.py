"""A frame whose own motion is known, aligned as one body to a keyframe that may be of quite another time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment import brightness
from rstrack.alignment.linearise import Terms
from rstrack.alignment.observation import Observation, observe
from rstrack.alignment.optimizer import Problem, Solved, optimise
from rstrack.alignment.pull import pulls, rigid_pull
from rstrack.alignment.spline_state import SplineState
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference
from rstrack.options import Options

# Part of the keyframe's pixels that each image has to see, and of the compared ones that must not be outliers.
_LEAST_SHARE, _LEAST_FIT_DEPTH, _LEAST_FIT_COLOR = 0.25, 0.7, 0.8
# Scales of the residuals beyond so many times the track's own are another place's.
_WORSE = 2.0
# Pixels that the last step may move a line by, where noise does not move it further.
_SETTLED_PX = 0.5
# Metres, at one metre and growing with the square of the distance, by which depth or colour alone may want to go
# elsewhere, where that is more than so many σ.
_TORN, _TORN_SIGMAS = 0.02, 5.0
_MOST_STEPS = (15, 8, 30)


@dataclass(frozen=True)
class Usual:
    """Scales of residuals that a track has: of depth at one metre (m), and of intensity; NaN where there is none."""

    depth: float
    intensity: float


@dataclass(frozen=True)
class Alignment:
    """T_ref_cam (4, 4) of a frame at mid readout in a keyframe, and what is known of it.

    information (6, 6): of increments T_ref_cam exp(ξ) as far as the images agree. fault: why it is none; '' if it is.
    """

    T_ref_cam: FloatArray
    information: FloatArray
    fault: str


def align(
    terms: Terms, options: Options, frame: DeviceFrame, ref: Reference, motion: Spline, T_ref_cam: FloatArray,
    levels: Sequence[int], usual: Usual, inflations: tuple[float, float] = (1.0, 1.0),
) -> Alignment:  # fmt: skip
    """Align a frame to a rectified keyframe from T_ref_cam (4, 4) on, through the levels of the pyramid.

    motion: T_world_cam(t) while the frame is exposed, of which only the shape matters. inflations: by how much the
    covariances of depth and of colour are too small, see `Independence`.
    """
    mid = frame.depth.exposure.mid_time
    state = _placed(motion, frame, ref.T_world_base @ T_ref_cam @ se3.inverse(motion.pose(mid)))
    expected = brightness.SAME
    if frame.colors and ref.points:
        expected = np.asarray(brightness.matched(frame.colors[0].moments, ref.moments))
    fresh = observe(frame, ref, options, expected)
    for o in fresh:
        o.independent = 1.0 / inflations[not o.is_depth]
    problem = Problem(fresh, (), (state.first, state.end), (), ref.lens.camera.fx, rigid=True)
    try:
        solved = optimise(terms, state, problem, levels, _MOST_STEPS)
    except np.linalg.LinAlgError:
        solved = Solved()
    T = se3.inverse(ref.T_world_base) @ state.spline.pose(mid)
    if not any(o.is_linearised for o in fresh):
        return Alignment(T, np.zeros((6, 6)), "no pixel of it falls on the keyframe")
    fault = _fault(fresh, solved, ref, usual) or _torn(fresh, state, ref)
    return Alignment(T, pulls(fresh, state).information, fault)


def _placed(motion: Spline, frame: DeviceFrame, G: FloatArray) -> SplineState:
    """The motion while a frame is exposed, moved by G (4, 4) in the world."""
    first = int(motion.locate(frame.first_time)[0])
    last = int(motion.locate(frame.last_time)[0]) + 4
    points = se3.orthonormalise(G @ motion.control_points[first - motion.first : last - motion.first])
    return SplineState(Spline(points, motion.t0 + first * motion.dt, motion.dt))


def _torn(fresh: Sequence[Observation], state: SplineState, ref: Reference) -> str:
    """Whether depth alone, or colour alone, would put the frame elsewhere, as one body."""
    limit = _TORN * max(1.0, ref.median_depth) ** 2
    for is_depth in (True, False):
        metres, sigmas = rigid_pull([o for o in fresh if o.is_depth is is_depth], state)
        if metres > limit and sigmas > _TORN_SIGMAS:
            return "depth and colour do not agree"
    return ""


def _fault(fresh: Sequence[Observation], solved: Solved, ref: Reference, usual: Usual) -> str:
    if not (solved.is_within_noise or solved.last_shift <= _SETTLED_PX):
        return "the alignment does not settle"
    for o in fresh:
        name = "depth" if o.is_depth else "colour"
        if not o.is_linearised or o.pixels < _LEAST_SHARE * ref.pixels:
            return f"the {name} image sees too little of the keyframe"
        if o.lin.fit < (_LEAST_FIT_DEPTH if o.is_depth else _LEAST_FIT_COLOR):
            return f"the {name} image shows something else"
        known = usual.depth * max(0.5, ref.median_depth) ** 2 if o.is_depth else usual.intensity
        if o.lin.next_sigma > _WORSE * max(known, 3.0 * o.lin.floor):
            return f"the {name} image does not fit"
    return ""
