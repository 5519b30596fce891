"""What a track's images tell of the calibration itself: a Kalman filter of its errors, beside the poses.

Depth and colour of a frame each find its pose. The two are apart by D θ and noise. θ are the errors of all parameters,
in σ of the camera file; they stay the same. D is what one σ of each moves the one image by, less what it moves the
other. Colour's clock alone is put right while tracking: for a lens all keyframes would have to be made again. The
others are estimated beside it, so that it is not taken for what they do.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.tracking.judgement.consider import CLOCK, COUNT

# Frames that tell as much as one: they share a keyframe, with what its noise and depth have wrong. wild2's clock is the
# same from three starts by 30; by 1 it is several of its σ apart.
_ALIKE = 30.0


@dataclass(frozen=True, eq=False)
class CalibrationErrors:
    """mean (21,), covariance (21, 21): of what the parameters are too large by, in σ of the camera file."""

    mean: FloatArray = field(default_factory=lambda: np.zeros(COUNT))
    covariance: FloatArray = field(default_factory=lambda: np.eye(COUNT))

    @property
    def clock(self) -> tuple[float, float]:
        """Colour's clock: what its offset is too large by, and how far that may be wrong."""
        return float(self.mean[CLOCK]), float(np.sqrt(self.covariance[CLOCK, CLOCK]))

    def with_frame(self, apart: FloatArray, D: FloatArray, R: FloatArray) -> CalibrationErrors:
        """With a frame whose two images' poses are `apart` (6,), though the clock was put right by its mean.

        D (6, 21): by how much one σ of each parameter has them apart. R (6, 6): covariance of all else.
        """
        P, R = self.covariance, _ALIKE * R
        still_wrong = np.where(np.arange(len(self.mean)) == CLOCK, 0.0, self.mean)
        gain = np.linalg.solve(D @ P @ D.T + R, D @ P).T
        # Joseph's form: the covariance stays positive where D is large.
        left = np.eye(len(P)) - gain @ D
        return CalibrationErrors(self.mean + gain @ (apart - D @ still_wrong), left @ P @ left.T + gain @ R @ gain.T)
