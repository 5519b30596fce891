"""Score test of a frame: whether its images agree with where it was found, together and each term alone (Rao 1948).

At the solution of (12) the gradients of all terms add up to zero. Where a frame has been found, those of its own images
do so by themselves, but for noise. Where it has not, they balance the frames before and the prior of the motion, or
depth balances colour, though each may fit its neighbourhood well enough. So they do where the spline cannot follow the
motion within an image: the test has a twist of all lines and one that grows from the first line to the last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState

# Prior σ of a shift (m) and turn (rad): a direction that the images do not see has a score of zero.
_PRIOR = np.tile([0.05, 0.05, 0.05, *np.radians([3.0, 3.0, 3.0])], 2)


@dataclass(frozen=True)
class Scores:
    """sigmas: √(gᵀ H⁻¹ g) of all images of a frame, of depth and of colour alone; NaN without any.

    formal (6, 6): information that the normal equations of all of them have of the pose, all lines moved at once, as
    increments [m; rad] in the depth camera's axes at mid readout.
    """

    sigmas: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    formal: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def excess(self) -> float:
        """Factor by which formal σ are too small, 1 at least: the Birge ratio (Physical Review 40, 1932) of the largest
        of the three, √(χ²/12) with the two twists' numbers."""
        known = [sigmas for sigmas in self.sigmas if np.isfinite(sigmas)]
        return max(1.0, max(known, default=0.0) / np.sqrt(len(_PRIOR)))

    @property
    def information(self) -> FloatArray:
        """Information (6, 6) of the pose, as far as the images agree with it."""
        return self.formal / self.excess**2


_Seen = tuple[Observation, FloatArray, FloatArray]
"""An observation with its H (12, 12) and g (12,) of `steady`."""


def scores(fresh: Sequence[Observation], state: SplineState) -> Scores:
    """Of a frame's observations in the current state."""
    seen = [(o, *steady(o, state)) for o in fresh if o.is_linearised]
    kinds = [[s for s in seen if s[0].is_depth is is_depth] for is_depth in (True, False)]
    return Scores((_score(seen), _score(kinds[0]), _score(kinds[1])), _information(seen, state))


def _information(seen: Sequence[_Seen], state: SplineState) -> FloatArray:
    total = np.zeros((6, 6))
    for o, H, _ in seen:
        turn = np.kron(np.eye(2), state.spline.pose(o.image.exposure.mid_time)[:3, :3])
        total += turn.T @ H[:6, :6] @ turn
    values, basis = np.linalg.eigh(total)
    # Of a motion that no pixel sees rounding may leave less than nothing, which would pass for knowledge when inverted.
    return total if values[0] >= 0.0 else np.asarray((basis * np.maximum(values, 0.0)) @ basis.T)


def _score(seen: Sequence[_Seen]) -> float:
    if not seen:
        return float("nan")
    H = np.diag(1.0 / _PRIOR**2) + sum(own for _, own, _ in seen)
    g = np.sum([own for _, _, own in seen], axis=0)
    return float(np.sqrt(max(0.0, float(g @ np.linalg.solve(H, g)))))


def steady(o: Observation, state: SplineState) -> tuple[FloatArray, FloatArray]:
    """H (12, 12) and g (12,) of two twists of an image's lines, in the world's axes about the camera at mid readout.

    The first six move all lines, the others as much as a line is after mid readout: the last by all of it, the first by
    its opposite (no line if all are exposed at once). All control points moved by one left increment move every pose by
    it; by one that grows with their times (Greville), by one that grows with the pose's, to first order.
    """
    model, exposure = o.model(state), o.image.exposure
    mid, half = exposure.mid_time, 0.5 * (exposure.last_time - exposure.first_time)
    at = state.spline.t0 + (np.arange(model.first, model.last) - 1) * state.dt
    after = (at - mid) / half if half > 0.0 else np.zeros(len(at))
    x, y, z = state.spline.pose(mid)[:3, 3]
    about = np.eye(6)
    about[:3, 3:] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    basis = np.kron(np.stack([np.ones(len(at)), after], axis=1), about)
    return basis.T @ model.H @ basis, basis.T @ model.g
