"""How far off the truth itself is, where it was measured too: motion capture errs by millimetres within a second."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError


@dataclass(frozen=True)
class TruthNoise:
    """Errors of the truth's motions over one second: σ along and about each of the camera's axes, mm and degrees.

    σ grows as the square root of the time.
    """

    translation_mm: float
    rotation_deg: float

    @classmethod
    def parse(cls, text: str) -> TruthNoise:
        """The noise that 'MM,DEG' names. Raises UserError."""
        try:
            mm, deg = (float(word) for word in text.split(","))
        except ValueError:
            mm = deg = math.nan
        if not (0.0 <= mm < math.inf and 0.0 <= deg < math.inf):
            raise UserError(f"--truth-noise {text}: expected MM,DEG, two numbers of at least 0, for example 2,0.25")
        return cls(mm, deg)

    def covariance(self, seconds: FloatArray) -> FloatArray:
        """Covariances (k, 6, 6), [m; rad], of the truth's motions over so many seconds (k,)."""
        sigma = np.repeat([1e-3 * self.translation_mm, np.radians(self.rotation_deg)], 3)
        return np.asarray(seconds[:, None, None] * np.diag(sigma**2))
