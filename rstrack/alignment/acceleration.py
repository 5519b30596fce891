"""Longer steps where Gauss-Newton's are too short, from how the last ones fell short.

The Hessian of Gauss and Newton takes gradients of noise for gradients of the scene: on a real recording it is 1.6 times
too large for colour, several times in motions that are hardly seen, and steps then shrink by a tenth at a time.
Anderson's mixing (J. ACM 1965; Walker and Ni, SIAM J. Numer. Anal. 2011) takes them for a fixed-point iteration and
extrapolates from the last few.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from rsgen.array_types import FloatArray

# Steps that are remembered, and how many times as far as the plain step one goes at most.
_MEMORY, _FURTHEST = 3, 4.0
# A step this part of the one before, or less, shows that Gauss-Newton needs no help.
_FAST = 0.3


class Acceleration:
    """The last iterations of one optimisation."""

    def __init__(self) -> None:
        self._at: deque[FloatArray] = deque(maxlen=_MEMORY)
        self._steps: deque[FloatArray] = deque(maxlen=_MEMORY)

    def forget(self) -> None:
        """Begin anew, as where a step has been taken back."""
        self._at.clear()
        self._steps.clear()

    def extrapolated(self, at: FloatArray, step: FloatArray, H: FloatArray) -> FloatArray:
        """The step to take at increments `at` (6n,), where Gauss-Newton's with the Hessian H (6n, 6n) is `step` (6n,).

        Of all mixtures of the last iterations it begins from the one whose mixed step is least, measured by H.
        """
        # Copies: the optimiser moves its increments in place.
        self._at.append(at.copy())
        self._steps.append(step.copy())
        if len(self._steps) < 2:
            return step
        length, before = step @ H @ step, self._steps[-2] @ H @ self._steps[-2]
        if length < _FAST**2 * before:
            return step
        moves, changes = np.diff(np.array(self._at), axis=0).T, np.diff(np.array(self._steps), axis=0).T
        share = np.linalg.lstsq(changes.T @ H @ changes, changes.T @ (H @ step), rcond=1e-6)[0]
        further = step - (moves + changes) @ share
        longer = np.sqrt(max(float(further @ H @ further), 0.0) / max(float(length), 1e-300))
        return further if longer <= _FURTHEST else np.asarray(further * (_FURTHEST / longer))
