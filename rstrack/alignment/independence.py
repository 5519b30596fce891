"""How many of an image's pixels tell something of their own.

The normal equations take all pixels for independent. Neighbours are not: interpolation and blur spread noise, a depth
camera is off by centimetres over whole regions, a reference's errors stay where they are. What that does to an estimate
can be seen in the gradients of the blocks of lines, whose scatter about the solution should be that of the Hessian.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from rstrack.alignment.block_sums import BlockSums

# Blocks of lines over which errors may be correlated: 7 reach over an eighth of the image.
_REACH = 7
# Pixels below which nothing can be said.
_LEAST_PIXELS = 500
# Frames over which the median is taken, and below which nothing is known yet.
_MEMORY, _FEW = 30, 3


def inflation(sums: BlockSums) -> float:
    """By how much the covariance H⁻¹ of a twist is too small: tr(H⁻¹ M)/6; NaN where that cannot be told.

    M is the covariance of the summed gradient as the blocks' own gradients show it, with their correlation over up to
    _REACH blocks (Newey and West, Econometrica 1987): what a "sandwich" estimator takes in place of H. About 1 for
    independent pixels. For a rectified reference only.
    """
    if sums.H.shape[1] != 1 or len(sums.H) <= _REACH or sums.count < _LEAST_PIXELS:
        return float("nan")
    H, g = sums.H[:, 0], sums.g[:, 0]
    total = H.sum(axis=0)
    try:
        r = g - H @ np.linalg.solve(total, g.sum(axis=0))
        M = r.T @ r
        for lag in range(1, _REACH + 1):
            pairs = r[lag:].T @ r[:-lag]
            M += (1.0 - lag / (_REACH + 1)) * (pairs + pairs.T)
        return float(np.trace(np.linalg.solve(total, M))) / 6.0
    except np.linalg.LinAlgError:
        return float("nan")


class Independence:
    """What the last frames said of one term: its pixels count 1/`inflation` each."""

    def __init__(self) -> None:
        self._seen: deque[float] = deque(maxlen=_MEMORY)

    def learn(self, values: Iterable[float]) -> None:
        """Add frames' inflations; NaN are left out."""
        self._seen.extend(value for value in values if np.isfinite(value))

    @property
    def inflation(self) -> float:
        """The median, never below 1."""
        return max(1.0, float(np.median(self._seen))) if len(self._seen) >= _FEW else 1.0
