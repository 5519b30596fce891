"""Errors that all pixels of an image have in common, and no scatter shows: steps not taken to the end, interpolation.

Depth and colour of a frame each find its pose. How far apart the two are, beyond their noise, bounds what either has of
such errors: σ is the likeliest of a grid, by the last frames (a variance component, as in Searle, Casella, McCulloch,
Variance Components, 1992, chapter 9). Images that are noisy, or of a camera little known, hardly change it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np
import scipy.linalg

from rsgen.array_types import FloatArray

# σ in pixels of the depth camera where nothing else is known, which counts as a frame, and at most: measured on
# hand-held renderings with noise (docs/notebook/hand-held.md).
SYSTEMATIC_PX = 0.01
_GRID = SYSTEMATIC_PX * 2.0 ** (-0.25 * np.arange(17))
# Frames that count.
_MEMORY = 30


def of_pixels(sigma_px: float, focal_px: float, depth_m: float) -> FloatArray:
    """Covariance (6, 6), [m; rad], of errors of so many pixels, of things so far away."""
    turn = sigma_px / focal_px
    return np.diag(np.repeat([turn * depth_m, turn], 3) ** 2)


@dataclass(frozen=True, eq=False)
class Systematic:
    """What the last frames say: logarithms of the likelihoods (17,) of σ; inflations: see `usual_inflation`."""

    likelihoods: FloatArray = field(default_factory=lambda: np.zeros(len(_GRID)))
    inflations: tuple[float, ...] = ()

    @property
    def px(self) -> float:
        """σ in pixels of the depth camera."""
        first = _likelihoods(np.full(6, 2.0 * SYSTEMATIC_PX**2), np.zeros(6))
        return float(_GRID[np.argmax(first + self.likelihoods)])

    @property
    def usual_inflation(self) -> float:
        """Median of what makes images agree with each other: a wrong camera file has it large."""
        return median(self.inflations) if self.inflations else 1.0

    def with_inflation(self, inflation: float) -> Systematic:
        """With a frame that was found, whose images had to be inflated by so much."""
        return replace(self, inflations=(*self.inflations, inflation)[-_MEMORY:])

    def with_frame(self, apart: FloatArray, covariance: FloatArray, focal_px: float, depth_m: float) -> Systematic:
        """With a frame whose two images' poses are `apart` (6,), [m; rad], of covariance (6, 6) by all else."""
        spread, basis = scipy.linalg.eigh(covariance, of_pixels(1.0, focal_px, depth_m))
        found = _likelihoods((basis.T @ apart) ** 2, np.maximum(spread, 0.0))
        return replace(self, likelihoods=(1.0 - 1.0 / _MEMORY) * self.likelihoods + found)


def _likelihoods(squares: FloatArray, spread: FloatArray) -> FloatArray:
    """Logarithms of how likely distances (6,), squared, are of such a spread (6,) for each σ of both images (17,)."""
    variances = spread + 2.0 * _GRID[:, None] ** 2
    return np.asarray(-0.5 * (np.log(variances) + squares / variances).sum(axis=1))
