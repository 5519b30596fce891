"""What is known of a camera before a recording is looked at: values that a solution starts from and is drawn to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rstrack.calibration.unknowns.parameters import COUNT, Parameters

# How far, in σ, what a recording says may lie from what was known before it is taken to contradict it.
_CONTRADICTS = 3.0
# The part of what was known by which a solution has to move at least, over that many σ, to count as moved.
_LEAST = 0.1


@dataclass(frozen=True)
class Known:
    """values, and how sure they are: σ (29,) in the order of NAMES, in their units, infinite where nothing is known."""

    values: Parameters
    sigmas: FloatArray

    @staticmethod
    def nothing(start: Parameters) -> Known:
        """Nothing is known; `start` is where to begin."""
        return Known(start, np.full(COUNT, np.inf))

    def contradicted(self, found: Parameters, sigmas: FloatArray) -> BoolArray:
        """Which (29,) of the known values a recording contradicts, by what was found with them and its σ (10,).

        A solution that was drawn to a right value moves away from it by as much as it gained: σ² before less σ² after.
        """
        is_known = np.isfinite(self.sigmas)
        before = np.where(is_known, self.sigmas, 0.0)
        gained = np.sqrt(np.maximum(before**2 - sigmas**2, (_LEAST * before) ** 2))
        return is_known & (np.abs(found.since(self.values)) > _CONTRADICTS * gained)

    def without(self, dropped: BoolArray) -> Known:
        """The same values, those of `dropped` (29,) for a start only."""
        return replace(self, sigmas=np.where(dropped, np.inf, self.sigmas))
