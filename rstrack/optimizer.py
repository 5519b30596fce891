"""Gauss-Newton over the control points that are still free (equation (12)), with lazy relinearisation.

Each observation keeps its quadratic model. While the increments since then have moved its lines by less than a
fraction of a pixel the model is only shifted (g += H ε); it is linearised anew beyond that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.so3 import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.frames import ColorImage, DepthImage
from rstrack.normal_equations import Quadratic, assemble, solve
from rstrack.reference import Reference
from rstrack.terms import Linearised, Terms

# A step that moves no line further is the last one, at the coarse levels and at the finest (pixels).
STOP_PX = (0.01, 0.1, 0.3)
# Lines that have moved less since a linearisation keep it.
RELINEARISE_PX = 0.02
# Errors at the start of a level, as σ: m and intensity; re-estimated with every linearisation.
_START_DEPTH, _START_INTENSITY = 5e-3, 0.03


class SplineState:
    """The growing spline: control points (m, 4, 4) in the world and the sum of increments that each has received."""

    def __init__(self, t0: float, dt: float, T_world_body: FloatArray, count: int) -> None:
        self.t0, self.dt = t0, dt
        self.points = np.repeat(T_world_body[None], count, axis=0)
        self.moved = np.zeros((count, 6))
        self._spline: Spline | None = None

    @property
    def spline(self) -> Spline:
        """The spline as it is now."""
        if self._spline is None:
            self._spline = Spline(self.points, self.t0, self.dt)
        return self._spline

    def segment(self, t: float) -> int:
        """Index of the first of the four control points that a time depends on."""
        return int(np.floor((t - self.t0) / self.dt))

    def extend(self, t: float) -> None:
        """Grow with constant velocity until time t is covered."""
        missing = self.segment(t) + 4 - len(self.points)
        if missing <= 0:
            return
        step = se3.inverse(self.points[-2]) @ self.points[-1]
        new = [self.points[-1]]
        for _ in range(missing):
            # Products drift away from rotations, and inverses by transposition amplify that (2.4 times a knot).
            new.append(se3.orthonormalise(new[-1] @ step))
        self.points = np.concatenate([self.points, np.array(new[1:])])
        self.moved = np.concatenate([self.moved, np.zeros((missing, 6))])
        self._spline = None

    def apply(self, first: int, increments: FloatArray) -> None:
        """T_i ← exp(δ_i) T_i for control points first, first + 1, ...; increments (n, 6)."""
        last = first + len(increments)
        points = self.points.copy()
        points[first:last] = se3.orthonormalise(se3.exp(increments) @ points[first:last])
        self.points = points
        self.moved[first:last] += increments
        self._spline = None


@dataclass
class Observation:
    """An image against a reference, its current scale σ and its last linearisation."""

    frame: int
    image: DepthImage | ColorImage
    ref: Reference
    sigma: float = 0.0
    lin: Linearised | None = None
    at: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))

    @property
    def is_depth(self) -> bool:
        """Whether this is the geometric term."""
        return isinstance(self.image, DepthImage)

    def linearise(self, terms: Terms, state: SplineState, level: int) -> Linearised:
        """Around the current state; takes the σ that the one before suggested."""
        image = self.image
        if isinstance(image, DepthImage):
            self.lin = terms.geometric(image, self.ref, state.spline, level, self.sigma or _START_DEPTH)
        else:
            self.lin = terms.photometric(image, self.ref, state.spline, level, self.sigma or _START_INTENSITY)
        self.sigma = self.lin.next_sigma
        self.at = state.moved.copy()
        return self.lin

    def shift(self, state: SplineState, focal: float) -> float:
        """Pixels that the lines have moved since the linearisation."""
        if self.lin is None:
            return np.inf
        return self.lin.row_shift(self._since(state), focal, self.ref.lever)

    def model(self, state: SplineState) -> Quadratic:
        """Quadratic model around the current state."""
        assert self.lin is not None
        return self.lin.model.moved(self._since(state))

    def _since(self, state: SplineState) -> FloatArray:
        since = state.moved.copy()
        since[: len(self.at)] -= self.at
        return since


@dataclass
class Solved:
    """What an optimisation did: linearisations, steps, and the last step's largest movement of a line in pixels."""

    evaluations: int = 0
    iterations: int = 0
    last_shift: float = np.inf
    condition: float = np.inf


Extra = Callable[[Spline], Quadratic]


def optimise(
    terms: Terms,
    state: SplineState,
    fresh: Sequence[Observation],
    settled: Sequence[Observation],
    free: tuple[int, int],
    extras: Sequence[Extra],
    levels: Sequence[int],
    most: Sequence[int],
    focal: float,
    bandwidth: int = 24,
) -> Solved:
    """Move the control points free[0]..free[1] until no line of the fresh images moves any more.

    `fresh` observations go through the pyramid's `levels`, coarse to fine, with at most most[level] steps on each;
    `settled` ones keep their models of the finest level as long as they are good. `extras`: priors.
    Raises numpy.linalg.LinAlgError where the system has no solution.
    """
    done = Solved()
    for level in levels:
        for observation in fresh:
            observation.lin, observation.sigma = None, 0.0 if level == levels[0] else observation.sigma
        for _ in range(most[level]):
            models = []
            for observation in (*fresh, *settled):
                is_fresh = any(observation is o for o in fresh)
                if not is_fresh and level > 0 and observation.lin is not None:
                    models.append(observation.model(state))
                    continue
                if observation.lin is None or observation.shift(state, focal) > RELINEARISE_PX * (1 + 4 * level):
                    observation.linearise(terms, state, level if is_fresh else 0)
                    done.evaluations += 1
                models.append(observation.model(state))
            models += [extra(state.spline) for extra in extras]
            H, g = assemble(models, *free)
            step = solve(H, g, bandwidth).reshape(-1, 6)
            if not np.isfinite(step).all():
                raise UserError("tracker: the normal equations gave no finite step")
            state.apply(free[0], step)
            done.iterations += 1
            increments = np.zeros_like(state.moved)
            increments[free[0] : free[0] + len(step)] = step
            shifts = [o.lin.row_shift(increments, focal, o.ref.lever) for o in fresh if o.lin is not None]
            done.last_shift = max(shifts, default=0.0)
            if done.last_shift < STOP_PX[level]:
                break
    return done
