"""Student-t weights, equation (11), and the scale of the errors."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

# Degrees of freedom (Kerl, Sturm, Cremers, ICRA 2013; DESIGN section 4).
NU = 5.0
# Share of a pixel's weight that its curvature keeps at least.
LEAST_CURVATURE = 0.5


def weight(s: Any) -> Any:
    """Equation (11), w = (ν + 1) / (ν + s²), for residuals s in units of σ, on the device or not."""
    return (NU + 1.0) / (NU + s * s)


def curvature(s: Any) -> Any:
    """Second derivative of the cost over w: Newton's (ν − s²) / (ν + s²), kept positive.

    Reweighted least squares take 1 for it and converge only linearly.
    """
    return dr.maximum((NU - s * s) / (NU + s * s), LEAST_CURVATURE)


def cost(s: Any) -> Any:
    """Negative log-likelihood (ν + 1)/2 log(1 + s²/ν), without its constant; its derivative by s is w s."""
    return (0.5 * (NU + 1.0)) * dr.log(1.0 + s * s * (1.0 / NU))


def scale_step(sigma: float, weighted: float, count: int, floor: float) -> float:
    """One fixed-point step of σ² = mean of w r², from Σ w (r/σ)² over `count` residuals, kept above `floor`."""
    return max(floor, sigma * math.sqrt(weighted / count)) if count else max(floor, sigma)
