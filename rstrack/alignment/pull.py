"""How far a frame's own images would move it if nothing else held it, and how far each of its terms alone.

At the solution of (12) everything that is summed there is in balance. Where a frame has been found, its images are in
balance by themselves too, but for noise. Where it has not, they pull against the frames before and the prior of the
motion, or depth pulls against colour, though each may fit its neighbourhood well enough. So they do where the spline
cannot follow the motion within an image: they are asked for a shift and turn of all lines and for one that grows from
the first line to the last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState

# σ of a shift (m) and turn (rad) before anything is known of a frame: what its images do not see pulls nowhere.
_PRIOR = np.tile([0.05, 0.05, 0.05, *np.radians([3.0, 3.0, 3.0])], 2)


@dataclass(frozen=True)
class Pulls:
    """sigmas: how many σ of what they know all images of a frame pull by, and depth and colour alone; NaN without any.

    told (6, 6): what the normal equations say that all of them know of the pose, all lines moved at once, as increments
    [m; rad] in the depth camera's axes at mid readout.
    """

    sigmas: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    told: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def excess(self) -> float:
        """By how much σ of what these images tell are too small, 1 at least: as far as they pull further than noise.

        As the Birge ratio (Physical Review 40, 1932), for the largest of the three: √(χ²/12), two twists' numbers.
        """
        told = [sigmas for sigmas in self.sigmas if np.isfinite(sigmas)]
        return max(1.0, max(told, default=0.0) / np.sqrt(len(_PRIOR)))

    @property
    def information(self) -> FloatArray:
        """What the images know of the pose (6, 6), as far as they agree with what it was found to be."""
        return self.told / self.excess**2


_Seen = tuple[Observation, FloatArray, FloatArray]
"""An observation with its H (12, 12) and g (12,) of `steady`."""


def pulls(fresh: Sequence[Observation], state: SplineState) -> Pulls:
    """Of a frame's observations in the current state."""
    seen = [(o, *steady(o, state)) for o in fresh if o.is_linearised]
    kinds = [[s for s in seen if s[0].is_depth is is_depth] for is_depth in (True, False)]
    return Pulls((_pull(seen), _pull(kinds[0]), _pull(kinds[1])), _told(seen, state))


def _told(seen: Sequence[_Seen], state: SplineState) -> FloatArray:
    total = np.zeros((6, 6))
    for o, H, _ in seen:
        turn = np.kron(np.eye(2), state.spline.pose(o.image.exposure.mid_time)[:3, :3])
        total += turn.T @ H[:6, :6] @ turn
    return total


def _pull(seen: Sequence[_Seen]) -> float:
    if not seen:
        return float("nan")
    H = np.diag(1.0 / _PRIOR**2) + sum(own for _, own, _ in seen)
    g = np.sum([own for _, _, own in seen], axis=0)
    return float(np.sqrt(max(0.0, float(g @ np.linalg.solve(H, g)))))


def rigid_pull(fresh: Sequence[Observation], state: SplineState) -> tuple[float, float]:
    """Metres and σ that observations would move a frame by whose lines can only move as one body; 0 without any."""
    seen = [steady(o, state) for o in fresh if o.is_linearised]
    if not seen:
        return 0.0, 0.0
    g = np.sum([g[:6] for _, g in seen], axis=0)
    twist = np.linalg.solve(np.diag(1.0 / _PRIOR[:6] ** 2) + sum(H[:6, :6] for H, _ in seen), g)
    metres = np.linalg.norm(twist[:3]) + fresh[0].ref.median_depth * np.linalg.norm(twist[3:])
    return float(metres), float(np.sqrt(max(0.0, float(g @ twist))))


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
