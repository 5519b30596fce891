"""How far a frame's own images would move it if nothing else held it, and how far each of its terms alone.

At the solution of (12) everything that is summed there is in balance. Where a frame has been found, its images are in
balance by themselves too, but for noise. Where it has not, they pull against the frames before and the prior of the
motion, or depth pulls against colour, though each may fit its neighbourhood well enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState

# σ of a rigid shift (m) and turn (rad) before anything is known of a frame: what its images do not see pulls nowhere.
_PRIOR = np.array([0.05, 0.05, 0.05, *np.radians([3.0, 3.0, 3.0])])


@dataclass(frozen=True)
class Pulls:
    """Metres by which points at the median depth would move: by all of a frame's images, by depth and by colour alone.

    NaN where there is no such image. sigmas: how many σ of what these images know each of the three is.
    """

    whole: float
    depth: float
    color: float
    sigmas: tuple[float, float, float] = (np.inf, np.inf, np.inf)

    def scaled(self, factor: float) -> Pulls:
        """All of them, in metres, times a factor."""
        return replace(self, whole=factor * self.whole, depth=factor * self.depth, color=factor * self.color)


def pulls(fresh: Sequence[Observation], state: SplineState) -> Pulls:
    """Of a frame's observations in the current state."""
    seen = [(o, *rigid(o, state)) for o in fresh if o.is_linearised]
    depth, color = [s for s in seen if s[0].is_depth], [s for s in seen if not s[0].is_depth]
    (whole, a), (depth_alone, b), (color_alone, c) = (_pull(some) for some in (seen, depth, color))
    return Pulls(whole, depth_alone, color_alone, (a, b, c))


def _pull(seen: Sequence[tuple[Observation, FloatArray, FloatArray]]) -> tuple[float, float]:
    """Metres and σ that observations pull by, each with its H (6, 6) and g (6,) of a rigid motion; NaN without any."""
    if not seen:
        return float("nan"), float("nan")
    H = np.diag(1.0 / _PRIOR**2) + sum(own for _, own, _ in seen)
    g = np.sum([own for _, _, own in seen], axis=0)
    twist = np.linalg.solve(H, g)
    metres = np.linalg.norm(twist[:3]) + seen[0][0].ref.median_depth * np.linalg.norm(twist[3:])
    return float(metres), float(np.sqrt(max(0.0, float(g @ twist))))


def rigid(o: Observation, state: SplineState) -> tuple[FloatArray, FloatArray]:
    """H (6, 6) and g (6,) of a twist of all lines at once, in the world's axes about the camera at mid readout.

    All control points moved by one left increment move every pose by it.
    """
    model = o.model(state)
    n = len(model.g) // 6
    H, g = model.H.reshape(n, 6, n, 6).sum(axis=(0, 2)), model.g.reshape(n, 6).sum(axis=0)
    x, y, z = state.spline.pose(o.image.exposure.mid_time)[:3, 3]
    about = np.eye(6)
    about[:3, 3:] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    return about.T @ H @ about, about.T @ g
