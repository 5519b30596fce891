"""A frame whose own motion is known, aligned as one body to a keyframe that may be of quite another time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.linearise import Terms
from rstrack.alignment.observation import Observation, matched_brightness, observe
from rstrack.alignment.optimizer import MOST_STEPS, Problem, Solved, optimise
from rstrack.alignment.spline_state import SplineState
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference
from rstrack.options import Options

Judge = Callable[[Sequence[Observation], Solved, SplineState, Reference], tuple[str, FloatArray]]
"""Why a frame's images have not been found at a keyframe, empty if they have; and what they know of its pose (6, 6)."""


@dataclass(frozen=True)
class Alignment:
    """T_ref_cam (4, 4) of a frame at mid readout in a keyframe, and what is known of it.

    information (6, 6): of increments T_ref_cam exp(ξ) as far as the images agree. fault: why it is none; '' if it is.
    fresh, solved: its images, and what the optimisation did.
    """

    T_ref_cam: FloatArray
    information: FloatArray
    fault: str
    fresh: Sequence[Observation]
    solved: Solved

    @property
    def pixels(self) -> int:
        """Of its images that count."""
        return sum(o.pixels for o in self.fresh if o.is_linearised)

    @property
    def sigma_m(self) -> float:
        """Scale of its depth's residuals, m; infinite without any."""
        return min((o.lin.next_sigma for o in self.fresh if o.is_depth and o.is_linearised), default=np.inf)


def align(
    terms: Terms, options: Options, frame: DeviceFrame, ref: Reference, motion: Spline, T_ref_cam: FloatArray,
    levels: Sequence[int], judge: Judge, inflations: tuple[float, float] = (1.0, 1.0),
) -> Alignment:  # fmt: skip
    """Align a frame to a rectified keyframe from T_ref_cam (4, 4) on, through the levels of the pyramid.

    motion: T_world_cam(t) while the frame is exposed, of which only the shape matters. judge: decides whether it was
    found. inflations: by how much the covariances of depth and of colour are too small, see `Independence`.
    """
    mid = frame.depth.exposure.mid_time
    state = _placed(motion, frame, ref.T_world_base @ T_ref_cam @ se3.inverse(motion.pose(mid)))
    fresh = observe(frame, ref, options, matched_brightness(frame, ref), inflations)
    problem = Problem(fresh, (), (state.first, state.end), (), ref.lens.camera.fx, rigid=True)
    try:
        solved = optimise(terms, state, problem, levels, MOST_STEPS)
    except np.linalg.LinAlgError:
        solved = Solved()
    T = se3.inverse(ref.T_world_base) @ state.spline.pose(mid)
    fault, information = judge(fresh, solved, state, ref)
    return Alignment(T, information, fault, fresh, solved)


def _placed(motion: Spline, frame: DeviceFrame, G: FloatArray) -> SplineState:
    """The motion while a frame is exposed, moved by G (4, 4) in the world."""
    first = int(motion.locate(frame.first_time)[0])
    last = int(motion.locate(frame.last_time)[0]) + 4
    points = se3.orthonormalise(G @ motion.control_points[first - motion.first : last - motion.first])
    return SplineState(Spline(points, motion.t0 + first * motion.dt, motion.dt))
