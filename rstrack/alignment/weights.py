"""How much a pixel counts: Student-t weights, equation (11), σ of the residuals, and how many pixels are independent.

The normal equations take all pixels for independent. Neighbours are not: interpolation and blur spread noise, a depth
camera is off by centimetres over whole regions, a reference's errors stay where they are. What that does to an estimate
shows in the gradients of the blocks of lines, whose scatter about the solution should be that of the Hessian.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import Any

import drjit as dr
import numpy as np

from rsgen.array_types import FloatArray

# Degrees of freedom (Kerl, Sturm, Cremers, ICRA 2013).
NU = 5.0
# Share of a pixel's weight that its curvature keeps at least.
LEAST_CURVATURE = 0.5

START_DEPTH, START_INTENSITY = 5e-3, 0.03
"""σ (m, intensity) before the first linearisation; every linearisation estimates it anew."""
FLOOR_DEPTH, FLOOR_INTENSITY = 2e-4, 1.0 / 255.0
"""Smallest credible σ (m, intensity): quantisation and interpolation leave about as much."""
GATE_SIGMAS, GATE_INTENSITY = 5.0, 0.3
"""Residuals beyond these, in σ of depth and in intensity, are outliers for certain."""

# Part of an image's blocks of lines over which errors may be correlated, one in so many.
_REACH = 8
# Pixels below which an image's inflation cannot be estimated.
_LEAST_PIXELS = 500
# Frames over which the median is taken.
_MEMORY = 30


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


def inflation(H: FloatArray, g: FloatArray, count: int) -> float:
    """Factor by which the covariance H⁻¹ of a twist is too small, tr(H⁻¹ M)/6: about 1 if pixels are independent.

    H (n, m, 6, 6), g (n, m, 6): of n blocks of lines and m of the reference's, made from `count` pixels. M: covariance
    of the summed gradient as the image's blocks' own gradients show it, correlated over an eighth of them (Newey and
    West, Econometrica 1987), as a sandwich estimator takes it. NaN with too few pixels or blocks.
    """
    reach = len(H) // _REACH
    if not reach or count < _LEAST_PIXELS:
        return float("nan")
    H, g = H.sum(axis=1), g.sum(axis=1)
    total = H.sum(axis=0)
    try:
        r = g - H @ np.linalg.solve(total, g.sum(axis=0))
        M = r.T @ r
        for lag in range(1, reach + 1):
            pairs = r[lag:].T @ r[:-lag]
            M += (1.0 - lag / (reach + 1)) * (pairs + pairs.T)
        return float(np.trace(np.linalg.solve(total, M))) / 6.0
    except np.linalg.LinAlgError:
        return float("nan")


class Independence:
    """Of one term, over the last frames: its pixels count 1/`inflation` each."""

    def __init__(self) -> None:
        self._seen: deque[float] = deque(maxlen=_MEMORY)

    def learn(self, values: Iterable[float]) -> None:
        """Add frames' inflations; NaN are left out."""
        self._seen.extend(value for value in values if np.isfinite(value))

    @property
    def inflation(self) -> float:
        """The median, never below 1."""
        return max(1.0, float(np.median(self._seen))) if self._seen else 1.0
