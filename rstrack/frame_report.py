"""What a tracker says about each frame."""

from __future__ import annotations

from dataclasses import dataclass, replace


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
