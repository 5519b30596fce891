"""What a tracker says about each frame; `FrameReport` is no HTML page, and so called since live loops read it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from rstrack.alignment.linearise import Linearised
from rstrack.alignment.optimizer import Solved


@dataclass(frozen=True)
class FrameReport:
    """Diagnostics of one frame.

    sigma_*: scales of the residuals (m; intensity 0..1), NaN for a term that was not used. inliers_*: pixels that
    counted. iterations, evaluations: steps and linearisations of the optimisation; last_shift_px: how far its last
    step still moved a line. keyframe: a new one was made; lost: no pose was found, and none is given.
    observability: smallest eigenvalue of Σ w j jᵀ per pixel, rotations scaled by the scene's depth; near 0 where the
    images leave a motion open. overlap: pixels that fall on the keyframe, against the first frame after it was made.
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

    def as_lost(self) -> FrameReport:
        """The same frame, given up later on."""
        return replace(self, lost=True, keyframe=False)


def frame_report(
    stamp: float, depth: Sequence[Linearised], color: Sequence[Linearised], solved: Solved | None, *,
    keyframe: bool, lost: bool, overlap: float,
) -> FrameReport:  # fmt: skip
    """Of a frame whose images ended with these linearisations; solved: None where nothing was optimised."""
    solved = solved or Solved(last_shift=0.0)
    return FrameReport(
        stamp=stamp,
        sigma_depth_m=depth[0].next_sigma if depth else float("nan"),
        sigma_intensity=color[0].next_sigma if color else float("nan"),
        inliers_depth=sum(lin.count for lin in depth),
        inliers_color=sum(lin.count for lin in color),
        iterations=solved.iterations,
        evaluations=solved.evaluations,
        last_shift_px=solved.last_shift,
        keyframe=keyframe,
        lost=lost,
        observability=max((lin.observability for lin in (*depth, *color)), default=0.0),
        overlap=overlap,
    )
