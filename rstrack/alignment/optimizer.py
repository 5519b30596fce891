"""Levenberg-Marquardt over the control points that are still free, equation (12), with lazy relinearisation.

Each observation keeps its quadratic model. While the increments since then have moved its lines by less than a
fraction of a pixel the model is only shifted (g += H ε); it is linearised anew beyond that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.alignment.linearise import Terms
from rstrack.alignment.normal_equations import AndersonMixing, assemble, solve_damped
from rstrack.alignment.observation import Observation
from rstrack.alignment.priors import Prior
from rstrack.alignment.spline_state import SplineState

# A step that moves no line further is the last one, at the coarse levels and at the finest (pixels).
STOP_PX = (0.02, 0.1, 0.3)
SETTLED_PX = 2.0
"""Beyond a last step that moves lines further an alignment may be anywhere: no time is too short to go on."""
# Lines that have moved less since a linearisation keep it.
RELINEARISE_PX = 0.02
# The same where all but the noise is predicted.
_PREDICTED_PX = 0.005
# The same for noisy depth: part of what its σ moves a pixel by. (Noise-free depth is held to the pixels above,
# and what does not fit must not end early for it.)
_NOISE_SHARE, _MOST_TOLERANCE_PX = 0.1, 0.08
# Where noise, not rounding, is what limits (σ over the smallest credible one): a step shorter than so many σ of the
# result, squared, is the last one of a level, finest first, and what has moved by so many keeps its linearisation.
_NOISY, _LAST, _MATTERS = 2.0, (1.0, 10.0, 10.0), 2.0
# Rise of the negative log-likelihood per pixel from which on a step has made things worse: less is noise of gating.
_WORSE = 2e-5
MOST_STEPS = (15, 8, 30)
"""Steps at most on the levels of the pyramid, finest first."""


@dataclass
class Solved:
    """What an optimisation did: linearisations, steps, refused steps, and the last step's movement of a line in px.

    is_within_noise: that step was shorter than what noise leaves open. is_cut: there was no time for more, see `Pace`;
    first, step (n, 6): the last step, of the control points from number `first` on.
    """

    evaluations: int = 0
    iterations: int = 0
    refused: int = 0
    last_shift: float = np.inf
    is_within_noise: bool = False
    is_cut: bool = False
    first: int = 0
    step: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))


@dataclass(frozen=True)
class Problem:
    """Observations and priors over the free control points free[0]..free[1].

    `fresh` observations go through the pyramid's levels; `settled` ones keep their models of the finest level as long
    as these are good. `focal` in pixels, to measure how far lines move. `bandwidth`: of the system. rigid: the free
    control points move as one body. predicted: all but the noise is known beforehand, so that how far lines move does
    not show whether weights and σ are those of the finest level: it is linearised twice there at least, and stays
    so for a quarter of the pixels.
    """

    fresh: Sequence[Observation]
    settled: Sequence[Observation]
    free: tuple[int, int]
    priors: Sequence[Prior]
    focal: float
    bandwidth: int = 24
    rigid: bool = False
    predicted: bool = False


def optimise(
    terms: Terms, state: SplineState, problem: Problem, levels: Sequence[int], most: Sequence[int],
    hopeless: Callable[[Sequence[Observation]], bool] | None = None,
    before_finest: Callable[[], None] | None = None,
) -> Solved:  # fmt: skip
    """Minimise (12) by Levenberg-Marquardt on each of the pyramid's levels, coarse to fine, most[level] steps at most.

    A level ends when no line of the fresh images moves any more. Steps that raise the cost are taken back and damped.
    hopeless: given the fresh observations after each level; True skips the finer ones.
    before_finest: called before the last level if others were before it; may change what the fresh ones see.
    Raises numpy.linalg.LinAlgError where the system has no solution.
    """
    done = Solved()
    for level in levels:
        if before_finest is not None and level == levels[-1] != levels[0]:
            before_finest()
        for observation in problem.fresh:
            observation.restart(state, keep_sigma=level != levels[0])
        _optimise_level(terms, state, problem, level, most[level], done)
        if hopeless is not None and hopeless(problem.fresh):
            break
    return done


def _optimise_level(terms: Terms, state: SplineState, problem: Problem, level: int, most: int, done: Solved) -> None:
    first, damping, cost = problem.free[0], 0.0, np.inf
    every = (*problem.fresh, *problem.settled)
    weights: dict[int, float] = {}
    step: FloatArray | None = None
    acceleration, is_plain = AndersonMixing(), True
    before = [o.linearisation for o in every]
    once_more = problem.predicted and level == 0
    done.is_cut = False
    for n in range(most):
        may_end = n > 0 and (level > 0 or done.last_shift <= SETTLED_PX)
        if may_end and not terms.pace.allows_step(level):
            done.is_cut = True
            break
        with terms.pace.step(level):
            done.evaluations += _linearise(terms, state, problem, level, once_more and n == 1)
            priors = [prior(state.spline) for prior in problem.priors]
            now = _cost(state, problem, weights) + sum(c for _, c in priors)
            if step is not None and now > cost + _WORSE * sum(weights.values()):
                # Worse than before: back to where it was, and a shorter step from there.
                state.apply(first, -step)
                for observation, earlier in zip(every, before, strict=True):
                    observation.linearisation = earlier
                priors = [prior(state.spline) for prior in problem.priors]
                damping = max(1e-3, 10.0 * damping) if is_plain else damping
                acceleration.reset()
                done.refused += 1
            else:
                damping, cost = 0.1 * damping if damping > 1e-4 else 0.0, now
            before = [o.linearisation for o in every]
            models = [o.model(state) for o in every] + [prior for prior, _ in priors]
            with terms.timer("linear algebra: assemble"):
                H, g = assemble(models, *problem.free)
            with terms.timer("linear algebra: solve"):
                plain = _damped_step(H, g, damping, problem)
                at = state.received(first, first + len(plain)).ravel()
                step = acceleration.extrapolated(at, plain.ravel(), H).reshape(-1, 6)
                is_plain = bool((step == plain).all())
            state.apply(first, step)
            done.iterations += 1
            done.first, done.step = first, plain
            done.last_shift = max(_shift(problem, first, step), _shift(problem, first, plain))
            done.is_within_noise = -float(g @ plain.ravel()) < _LAST[level] and all(_is_noisy(o) for o in problem.fresh)
            if once_more and n == 0:
                continue
            if done.is_within_noise or done.last_shift < (_tolerance(problem) if level == 0 else STOP_PX[level]):
                break


def _shift(problem: Problem, first: int, step: FloatArray) -> float:
    """Pixels by which a step (n, 6) of the control points from `first` on moves the lines of the fresh images."""
    shifts = []
    for o in problem.fresh:
        model = o.lin.model
        increments = np.zeros((model.last - model.first, 6))
        low, high = max(first, model.first), min(first + len(step), model.last)
        if low < high:
            increments[low - model.first : high - model.first] = step[low - first : high - first]
        shifts.append(o.lin.row_shift(increments, problem.focal, o.ref.median_depth))
    return max(shifts, default=0.0)


def _damped_step(H: FloatArray, g: FloatArray, damping: float, problem: Problem) -> FloatArray:
    """Increments (n, 6)."""
    count = len(g) // 6
    if not problem.rigid:
        return solve_damped(H, g, problem.bandwidth, damping).reshape(-1, 6)
    together = np.tile(np.eye(6), (count, 1))
    return np.tile(solve_damped(together.T @ H @ together, together.T @ g, problem.bandwidth, damping), (count, 1))


def _linearise(terms: Terms, state: SplineState, problem: Problem, level: int, once_more: bool) -> int:
    """Anew what has moved; once_more: and all that is fresh. Returns how many that were."""
    tolerance = RELINEARISE_PX * (1 + 4 * level) if level else _tolerance(problem)
    fresh = [
        o for o in problem.fresh if once_more or not o.is_linearised or _has_moved(o, state, problem.focal, tolerance)
    ]
    settled = [o for o in problem.settled if level == 0 and _has_moved(o, state, problem.focal, tolerance)]
    anew = (*fresh, *settled)
    for finish in [o.start(terms, state, level) for o in anew]:
        finish()
    return len(anew)


def _has_moved(observation: Observation, state: SplineState, focal: float, tolerance: float) -> bool:
    """Whether a linearisation is no longer good: its lines have moved by pixels, and by more than they are known to."""
    shift = observation.shift(state, focal)
    if shift <= tolerance:
        return False
    return not np.isfinite(shift) or not _is_noisy(observation) or observation.distance(state) > _MATTERS


def _is_noisy(observation: Observation) -> bool:
    return observation.lin.sigma > _NOISY * observation.lin.floor


def _tolerance(problem: Problem) -> float:
    """Pixels that lines may move without mattering, at the finest level: less than noise moves them."""
    depth = [o for o in problem.fresh if o.is_depth and o.is_linearised]
    noise_px = min((problem.focal * o.lin.next_sigma / o.ref.median_depth for o in depth), default=0.0)
    least = _PREDICTED_PX if problem.predicted else RELINEARISE_PX
    return min(max(least, _NOISE_SHARE * noise_px), _MOST_TOLERANCE_PX)


def _cost(state: SplineState, problem: Problem, weights: dict[int, float]) -> float:
    """Negative log-likelihood of the images; an observation's number of pixels counts as it was when first asked."""
    total = 0.0
    for observation in (*problem.fresh, *problem.settled):
        lin = observation.lin
        pixels = weights.setdefault(id(observation), observation.stands_for * lin.count)
        total += pixels * (np.log(lin.sigma) + lin.cost / max(1, lin.count)) + observation.change(state)
    return float(total)
