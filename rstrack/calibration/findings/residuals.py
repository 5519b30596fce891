"""How well images fit together: the scales of their residuals along stretches that are left as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.calibration.pairs.stretch import Stretch
from rstrack.calibration.pairs.terms import FLOOR_DEPTH, FLOOR_INTENSITY, PairTerms
from rstrack.calibration.unknowns.parameters import Parameters

# Stretches at most: an evaluation takes as long as a step of the solution.
_FEW = 3
# Fixed-point steps that are taken: what is missing then, a tenth or so, is extrapolated, to some percent.
_ROUNDS = 3
# Part of the last step that may be added to it at most.
_MOST_MORE = 2.0


@dataclass(frozen=True)
class Residuals:
    """Student's scales of the residuals, medians over stretches: depth in m, intensity of 0 to 1."""

    depth_m: float
    intensity: float


def some_of(stretches: Sequence[Stretch]) -> Sequence[Stretch]:
    """A few, all over the recording: those whose residuals are looked at."""
    return stretches[:: -(-len(stretches) // _FEW)]


def residuals_now(stretches: Sequence[Stretch]) -> Residuals:
    """Those by which the stretches weight their pixels."""
    return _medians(np.array([stretch.sigma for stretch in stretches]))


def residuals_at(stretches: Sequence[Stretch], terms: PairTerms, p: Parameters) -> Residuals:
    """Along the stretches' splines as they are, with values `p`, on the pyramid's finest level.

    Evaluated on copies: the stretches keep their scales and their brightness.
    """
    scales = np.array([_scales(replace(each, brightness=dict(each.brightness)), terms, p) for each in stretches])
    return _medians(np.maximum(extrapolated(np.moveaxis(scales, 1, 0)), (FLOOR_DEPTH, FLOOR_INTENSITY)))


def extrapolated(scales: FloatArray) -> FloatArray:
    """Where steps that shrink by one factor lead (Aitken): of the last three of scales (rounds, ...)."""
    before, last = scales[-2] - scales[-3], scales[-1] - scales[-2]
    ratio = np.divide(last, before, out=np.zeros_like(last), where=before != 0.0)
    most = _MOST_MORE / (1.0 + _MOST_MORE)
    ratio = np.clip(ratio, 0.0, most)
    return np.asarray(scales[-1] + last * ratio / (1.0 - ratio))


def _medians(scales: FloatArray) -> Residuals:
    depth_m, intensity = np.median(scales, axis=0)
    return Residuals(float(depth_m), float(intensity))


def _scales(stretch: Stretch, terms: PairTerms, p: Parameters) -> FloatArray:
    """Those of depth and intensity (rounds, 2) after each step."""
    scales = []
    for _ in range(_ROUNDS):
        stretch.sums(terms, p, 0)
        scales.append(stretch.sigma)
    return np.array(scales)
