"""Levenberg-Marquardt over the control points that are still free (equation (12)), with lazy relinearisation.

Each observation keeps its quadratic model. While the increments since then have moved its lines by less than a
fraction of a pixel the model is only shifted (g += H ε); it is linearised anew beyond that.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rsgen.geometry import se3
from rsgen.geometry.so3 import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.linearise import Linearised, Terms
from rstrack.alignment.normal_equations import Quadratic, assemble, solve
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.keyframes.keyframe import STRIDES, Reference

# A step that moves no line further is the last one, at the coarse levels and at the finest (pixels).
STOP_PX = (0.02, 0.1, 0.3)
# Lines that have moved less since a linearisation keep it.
RELINEARISE_PX = 0.02
# Rise of the negative log-likelihood per pixel from which on a step has made things worse: less is noise of gating.
_WORSE = 2e-5
# Increments of control points (m, rad) that change the derivatives of lines by less than a step's own error.
_SAME_SLOPES = 5e-3
# Position u of the last line on its knot interval below which the last control point (weight u³/6) is mere guesswork.
_TOLD = 0.6
# Errors at the start of a level, as σ: m and intensity; re-estimated with every linearisation.
_START_DEPTH, _START_INTENSITY = 5e-3, 0.03


class SplineState:
    """The growing spline: control points (m, 4, 4) in the world and the sum of increments that each has received."""

    def __init__(self, spline: Spline) -> None:
        self.spline = spline
        self.moved = np.zeros((len(spline.control_points), 6))

    @classmethod
    def still(cls, t0: float, dt: float, T_world_body: FloatArray, count: int = 4) -> SplineState:
        """Control points that are all at T_world_body (4, 4), from time t0 (s) on, dt (s) apart."""
        return cls(Spline(np.repeat(T_world_body[None], count, axis=0), t0, dt))

    @property
    def points(self) -> FloatArray:
        """Control points (m, 4, 4)."""
        return self.spline.control_points

    @property
    def dt(self) -> float:
        """Seconds between knots."""
        return self.spline.dt

    def copy(self) -> SplineState:
        """A state that can be changed without changing this one."""
        twin = copy.copy(self)
        twin.moved = self.moved.copy()
        return twin

    def restarted(self, end: float, first: float, last: float, T_world_body: FloatArray) -> SplineState:
        """The same up to time `end`; from `first` to `last` standing still at T_world_body (4, 4)."""
        points = self.points
        keep = self.segment(end) + 4
        start, stop = self.segment(first), self.segment(last) + 4
        gap = np.repeat(points[keep - 1][None], max(0, start - keep), axis=0)
        still = np.repeat(T_world_body[None], stop - start, axis=0)
        return SplineState(
            Spline(np.concatenate([points[: min(keep, start)], gap, still]), self.spline.t0, self.spline.dt)
        )

    def segment(self, t: float) -> int:
        """Index of the first of the four control points that a time depends on."""
        return int(np.floor((t - self.spline.t0) / self.spline.dt))

    def extend(self, t: float) -> None:
        """Grow with constant velocity until time t is covered."""
        points = self.points
        missing = self.segment(t) + 4 - len(points)
        if missing <= 0:
            return
        step = se3.inverse(points[-2]) @ points[-1]
        new = [points[-1]]
        for _ in range(missing):
            # Products drift away from rotations, and inverses by transposition amplify that (2.4 times a knot).
            new.append(se3.orthonormalise(new[-1] @ step))
        self.spline = self.spline.changed(len(points), np.array(new[1:]))
        self.moved = np.concatenate([self.moved, np.zeros((missing, 6))])

    def smooth_end(self, t: float) -> None:
        """Lay the last control point on with constant velocity if lines until time t (s) hardly told where it is.

        It weighs u³/6 in them at most, so that a systematic error of the lines is magnified; and the next control
        points are extrapolated from it.
        """
        points = self.points
        s = (t - self.spline.t0) / self.spline.dt
        if s - np.floor(s) > _TOLD or self.segment(t) + 4 != len(points):
            return
        step = se3.inverse(points[-3]) @ points[-2]
        T = se3.orthonormalise(points[-2] @ step)
        self.apply(len(points) - 1, se3.log(T @ se3.inverse(points[-1]))[None])

    def apply(self, first: int, increments: FloatArray) -> None:
        """T_i ← exp(δ_i) T_i for control points first, first + 1, ...; increments (n, 6)."""
        last = first + len(increments)
        points = se3.orthonormalise(se3.exp(increments) @ self.points[first:last])
        self.spline = self.spline.changed(first, points)
        self.moved[first:last] += increments


# A prior: its quadratic model around a spline, and its cost there.
Extra = Callable[[Spline], tuple[Quadratic, float]]


@dataclass
class Observation:
    """An image against a reference, its current scale σ and its last linearisation.

    occluder: the depth image that tells which points of the reference a colour image cannot see.
    """

    frame: int
    image: DepthImage | ColorImage
    ref: Reference
    occluder: DepthImage | None = None
    visible: Any = None
    sigma: float = 0.0
    lin: Linearised | None = None
    stands_for: float = 1.0
    slopes_at: Spline | None = None
    slopes_moved: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))
    at: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))

    @property
    def is_depth(self) -> bool:
        """Whether this is the geometric term."""
        return isinstance(self.image, DepthImage)

    def linearise(self, terms: Terms, state: SplineState, level: int) -> Linearised:
        """Around the current state; takes the σ that the one before suggested."""
        image = self.image
        slopes_at = self._slopes(state)
        if isinstance(image, DepthImage):
            self.lin = terms.geometric(image, self.ref, state.spline, level, self.sigma or _START_DEPTH, slopes_at)
        else:
            if level == 0 and self.visible is None and self.occluder is not None:
                # Once: the coarse levels have brought the poses close enough to tell, and a fixed set converges.
                self.visible = terms.visible(self.occluder, self.ref, state.spline, level)
            visible = self.visible if level == 0 else None
            sigma = self.sigma or _START_INTENSITY
            self.lin = terms.photometric(image, self.ref, state.spline, level, sigma, slopes_at, visible)
        self.sigma = self.lin.next_sigma
        # A coarse level's pixels stand for those left out: the priors' share must not depend on the level.
        self.stands_for = (STRIDES[level] / STRIDES[0]) ** 2
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
        return self.lin.model.moved(self._since(state)).scaled(self.stands_for)

    def change(self, state: SplineState) -> float:
        """Change of the cost since the linearisation, by the quadratic model."""
        assert self.lin is not None
        model = self.lin.model
        moved = self._since(state)[model.first : model.last].ravel()
        return self.stands_for * float(model.g @ moved + 0.5 * moved @ model.H @ moved)

    def _slopes(self, state: SplineState) -> Spline:
        """Where the poses of its lines are differentiated: an earlier state as long as that is as good."""
        before = self.slopes_moved
        if self.slopes_at is None or np.abs(state.moved[: len(before)] - before).max() > _SAME_SLOPES:
            self.slopes_at, self.slopes_moved = state.spline, state.moved.copy()
        return self.slopes_at

    def _since(self, state: SplineState) -> FloatArray:
        since = state.moved.copy()
        since[: len(self.at)] -= self.at
        return since


@dataclass
class Solved:
    """What an optimisation did: linearisations, steps, refused steps, and the last step's movement of a line in px."""

    evaluations: int = 0
    iterations: int = 0
    refused: int = 0
    last_shift: float = np.inf


@dataclass(frozen=True)
class Problem:
    """Observations and priors over the free control points free[0]..free[1].

    `fresh` observations go through the pyramid's levels; `settled` ones keep their models of the finest level as long
    as these are good. `extras`: priors. `focal` in pixels, to tell how far lines move. `bandwidth`: of the system.
    """

    fresh: Sequence[Observation]
    settled: Sequence[Observation]
    free: tuple[int, int]
    extras: Sequence[Extra]
    focal: float
    bandwidth: int = 24


def optimise(terms: Terms, state: SplineState, problem: Problem, levels: Sequence[int], most: Sequence[int]) -> Solved:
    """Levenberg-Marquardt on each of the pyramid's levels, coarse to fine, with at most most[level] steps.

    A level ends when no line of the fresh images moves any more. Steps that raise the cost are taken back and damped.
    Raises numpy.linalg.LinAlgError where the system has no solution.
    """
    done = Solved()
    for level in levels:
        for observation in problem.fresh:
            observation.lin, observation.sigma = None, 0.0 if level == levels[0] else observation.sigma
        _optimise_level(terms, state, problem, level, most[level], done)
    return done


def _optimise_level(terms: Terms, state: SplineState, problem: Problem, level: int, most: int, done: Solved) -> None:
    first, damping, cost = problem.free[0], 0.0, np.inf
    weights: dict[int, float] = {}
    step: FloatArray | None = None
    undo: list[Any] | None = None
    for _ in range(most):
        done.evaluations += _linearise(terms, state, problem, level)
        priors = [extra(state.spline) for extra in problem.extras]
        now = _cost(state, problem, weights) + sum(c for _, c in priors)
        if undo is not None and step is not None and now > cost + _WORSE * sum(weights.values()):
            # Worse than before: back to where it was, and a shorter step from there.
            state.apply(first, -step)
            for observation, kept in zip((*problem.fresh, *problem.settled), undo, strict=True):
                observation.lin, observation.sigma, observation.at, observation.stands_for = kept
            priors = [extra(state.spline) for extra in problem.extras]
            damping = max(1e-3, 10.0 * damping)
            done.refused += 1
        else:
            damping, cost = 0.1 * damping if damping > 1e-4 else 0.0, now
        undo = [(o.lin, o.sigma, o.at, o.stands_for) for o in (*problem.fresh, *problem.settled)]
        models = [o.model(state) for o in (*problem.fresh, *problem.settled)]
        models += [prior for prior, _ in priors]
        H, g = assemble(models, *problem.free)
        step = _damped_step(H, g, damping, problem.bandwidth)
        state.apply(first, step)
        done.iterations += 1
        increments = np.zeros_like(state.moved)
        increments[first : first + len(step)] = step
        shifts = [o.lin.row_shift(increments, problem.focal, o.ref.lever) for o in problem.fresh if o.lin is not None]
        done.last_shift = max(shifts, default=0.0)
        if done.last_shift < STOP_PX[level]:
            break


def _damped_step(H: FloatArray, g: FloatArray, damping: float, bandwidth: int) -> FloatArray:
    """Increments (n, 6); rounding can make a system indefinite that hardly tells some motion: then damped more."""
    for _ in range(8):
        damped = H.copy()
        damped[np.diag_indices_from(H)] *= 1.0 + damping
        try:
            step = solve(damped, g, bandwidth)
        except np.linalg.LinAlgError:
            step = np.full_like(g, np.nan)
        if np.isfinite(step).all():
            return step.reshape(-1, 6)
        damping = max(1e-9, 100.0 * damping)
    raise np.linalg.LinAlgError("the normal equations have no finite solution")


def _linearise(terms: Terms, state: SplineState, problem: Problem, level: int) -> int:
    """Anew what has moved; returns how many that were."""
    count = 0
    for observation in problem.fresh:
        if observation.lin is None or observation.shift(state, problem.focal) > RELINEARISE_PX * (1 + 4 * level):
            observation.linearise(terms, state, level)
            count += 1
    for observation in problem.settled:
        if level == 0 and observation.shift(state, problem.focal) > RELINEARISE_PX:
            observation.linearise(terms, state, 0)
            count += 1
    return count


def _cost(state: SplineState, problem: Problem, weights: dict[int, float]) -> float:
    """Negative log-likelihood of the images; an observation's number of pixels counts as it was when first asked."""
    total = 0.0
    for observation in (*problem.fresh, *problem.settled):
        lin = observation.lin
        assert lin is not None
        pixels = weights.setdefault(id(observation), observation.stands_for * lin.count)
        total += pixels * (np.log(lin.sigma) + lin.cost / max(1, lin.count)) + observation.change(state)
    return float(total)
