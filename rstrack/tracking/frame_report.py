"""What became of a frame: diagnostics, and why it was lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from rsgen.array_types import FloatArray
from rstrack.alignment.observation import Observation
from rstrack.alignment.optimizer import Solved


class Fault(StrEnum):
    """Why a frame is lost; its text is what users read in `run.json` and on the screen."""

    NONE = ""
    NO_START = "the first frames have too little depth, or do not fit together"
    NOTHING_SEEN = "hardly a pixel falls on the keyframe"
    UNSETTLED = "the alignment does not converge"
    MISFIT = "an image does not fit the keyframe"
    MOTION = "the images do not agree with the motion"
    UNKNOWN = "the images do not determine the pose"
    # Of a frame that is looked for at the keyframes that look like it.
    NO_PLACE = "no keyframe shows what it shows"
    UNCONFIRMED = "it was found elsewhere, and the next frame has to confirm that"

    def __reduce_ex__(self, _: object) -> tuple[type[Fault], tuple[str]]:
        """By its text, for checkpoints: by its name it would be had through `getattr`, which they do not run."""
        return Fault, (self.value,)


@dataclass(frozen=True)
class FrameReport:
    """Diagnostics of one frame.

    sigma_*: scales of the residuals (m; intensity 0..1), NaN for a term that was not used. inliers_*: pixels that
    counted. iterations, evaluations: steps and linearisations of the optimisation; last_shift_px: how far its last
    step still moved a line. keyframe: a new one was made; lost: no pose was found, and none is given; fault: why.
    observability: smallest eigenvalue of Σ w j jᵀ per pixel, rotations scaled by the scene's depth; near 0 where the
    images leave a motion open. overlap: pixels that fall on the keyframe, against the first frame after it was made.
    covariance: of the pose at its stamp against its keyframe, (6, 6) [m; rad], T_world_depth exp(ξ). drift_world: of
    the keyframe against the first frame, exp(ξ) T_world_depth: the errors of the keyframes before. common (6, m): what
    one σ of each parameter of the calibration that may be wrong moves the pose by, as ξ of its own. None where there
    are none: of lost frames, and with the baseline. held_by_motion: largest part (0..1) that the motion before, not the
    images, has in what is known of any direction. moving: part of the depth image that was left out since it moves by
    itself.
    is_cut: its time was over before its alignment had ended, see `Pace`.
    bridged: its images were of no use, as fault says, and it has its pose from an IMU and from frames after it: until
    these came, it was lost. segment: number, from 1, of the `segments.Segment` that has the frame; 0: the first track.
    """

    stamp: float
    sigma_depth_m: float
    sigma_intensity: float
    inliers_depth: int
    inliers_color: int
    iterations: int
    evaluations: int
    last_shift_px: float
    keyframe: bool
    lost: bool
    observability: float
    overlap: float
    covariance: FloatArray | None = None
    drift_world: FloatArray | None = None
    common: FloatArray | None = None
    held_by_motion: float = float("nan")
    moving: float = 0.0
    fault: Fault = Fault.NONE
    is_cut: bool = False
    bridged: bool = False
    segment: int = 0

    def as_lost(self, fault: Fault) -> FrameReport:
        """The same frame, given up later on; one that is lost already stays so for its own reason."""
        lost = replace(self, lost=True, keyframe=False, fault=self.fault or fault)
        return replace(lost, covariance=None, drift_world=None, common=None, held_by_motion=float("nan"))


def frame_report(
    stamp: float, fresh: Sequence[Observation], solved: Solved | None, *, keyframe: bool, fault: Fault, overlap: float
) -> FrameReport:
    """Of a frame with these observations, lost where there is a fault; solved: None where nothing was optimised."""
    solved = solved or Solved(last_shift=0.0)
    depth = [o for o in fresh if o.is_depth and o.is_linearised]
    color = [o for o in fresh if not o.is_depth and o.is_linearised]
    return FrameReport(
        stamp=stamp,
        sigma_depth_m=depth[0].lin.next_sigma if depth else float("nan"),
        sigma_intensity=color[0].lin.next_sigma if color else float("nan"),
        inliers_depth=sum(o.pixels for o in depth),
        inliers_color=sum(o.pixels for o in color),
        iterations=solved.iterations,
        evaluations=solved.evaluations,
        last_shift_px=solved.last_shift,
        keyframe=keyframe,
        lost=bool(fault),
        observability=max((o.lin.observability for o in (*depth, *color)), default=0.0),
        overlap=overlap,
        fault=fault,
    )
