"""Student-t weights, equation (11), and the scale of the errors."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rsgen.geometry.so3 import FloatArray

# Degrees of freedom (Kerl, Sturm, Cremers, ICRA 2013; DESIGN section 4).
NU = 5.0


def weight(s: npt.ArrayLike) -> FloatArray:
    """(ν + 1) / (ν + s²) for residuals s in units of σ."""
    s = np.asarray(s, dtype=np.float64)
    return np.asarray((NU + 1.0) / (NU + s * s))


def scale_step(sigma: float, weighted: float, count: int, floor: float) -> float:
    """One fixed-point step of σ² = mean of w r², from Σ w (r/σ)² over `count` residuals, kept above `floor`."""
    return max(floor, sigma * math.sqrt(weighted / count)) if count else max(floor, sigma)
