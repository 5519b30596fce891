"""What is known of a camera before a recording is looked at: values that a solution starts from and is drawn to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rstrack.calibration.unknowns.parameters import (
    ASPECT_SIGMA,
    COLOR_LENS,
    COUNT,
    DEPTH_LENS,
    EXTRINSICS,
    EXTRINSICS_SIGMA,
    LENS_SIGMA,
    Parameters,
)

# How far, in σ, what a recording says may lie from what was known before it is taken to contradict it.
_CONTRADICTS = 3.0
# The part of what was known by which a solution has to move at least, over that many σ, to count as moved.
_LEAST = 0.1


@dataclass(frozen=True)
class Known:
    """values, and how sure they are: σ (31,) in the order of NAMES, in their units, infinite where nothing is known.

    aspect: σ of fy over fx, of both lenses.
    """

    values: Parameters
    sigmas: FloatArray
    aspect: float = np.inf

    @property
    def information(self) -> FloatArray:
        """The inverse covariance (31, 31), zero where nothing is known."""
        found = np.diag(self.sigmas**-2.0)
        for lens in (DEPTH_LENS, COLOR_LENS):
            focal = slice(lens.start, lens.start + 2)
            found[focal, focal] += self.aspect**-2.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
        return found

    @staticmethod
    def nothing(start: Parameters) -> Known:
        """Nothing is known; `start` is where to begin."""
        return Known(start, np.full(COUNT, np.inf))

    def with_lenses(self) -> Known:
        """With what lenses are like and where two cameras sit, where nothing else is known of them."""
        usual = np.full(COUNT, np.inf)
        usual[DEPTH_LENS] = usual[COLOR_LENS] = LENS_SIGMA
        usual[EXTRINSICS] = EXTRINSICS_SIGMA
        return replace(self, sigmas=np.where(np.isfinite(self.sigmas), self.sigmas, usual), aspect=ASPECT_SIGMA)

    def contradicted(self, found: Parameters, sigmas: FloatArray) -> BoolArray:
        """Which (31,) of the known values a recording contradicts, by what was found with them and its σ (10,).

        A solution that was drawn to a right value moves away from it by as much as it gained: σ² before less σ² after.
        """
        is_known = np.isfinite(self.sigmas)
        before = np.where(is_known, self.sigmas, 0.0)
        gained = np.sqrt(np.maximum(before**2 - sigmas**2, (_LEAST * before) ** 2))
        return is_known & (np.abs(found.since(self.values)) > _CONTRADICTS * gained)

    def without(self, dropped: BoolArray) -> Known:
        """The same values, those of `dropped` (31,) for a start only."""
        return replace(self, sigmas=np.where(dropped, np.inf, self.sigmas))
