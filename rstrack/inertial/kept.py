"""A prior whose normal equations are kept while the spline hardly moves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.spline_state import SplineState

# Increments of control points (m, rad) that leave the samples' derivatives as they were.
_SAME = 1e-2


class Kept:
    """A `rstrack.alignment.priors.Prior` of an IMU, around a state.

    summed: its model around the state as it is now, and the cost there. first, end: the control points that it depends
    on, and how many there were of all.
    """

    def __init__(self, state: SplineState, first: int, summed: Callable[[], tuple[Quadratic, float]]) -> None:
        self.state, self.first, self.end = state, first, state.end
        self._summed = summed
        self._known: tuple[Quadratic, float] | None = None
        self._at: FloatArray = np.zeros((0, 6))

    def __call__(self, spline: Spline) -> tuple[Quadratic, float]:
        if self._known is not None:
            model, cost = self._known
            moved = self.state.received(model.first, model.last) - self._at
            if np.abs(moved).max() < _SAME:
                step = moved.ravel()
                turned = model.H @ step
                there = Quadratic(model.first, model.H, model.g + turned)
                return there, cost + float(step @ (model.g + 0.5 * turned))
        self._known = self._summed()
        model, _ = self._known
        self._at = self.state.received(model.first, model.last)
        return self._known
