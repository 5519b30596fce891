"""The joint solution: parameters that all stretches share, control points of each its own, and how sure that is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from rsgen.array_types import BoolArray, FloatArray
from rstrack.alignment.acceleration import Acceleration
from rstrack.calibration.pairs.stretch import Stretch, Sums
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.unknowns.known import Known
from rstrack.calibration.unknowns.parameters import COUNT, DEPTH, DRIFT, PRIOR, USEFUL, Parameters

# Steps at most on the pyramid's levels, finest first, and part of the formal σ that ends a level.
_MOST_STEPS, _SMALL = (14, 10, 15), (1.0, 5.0, 10.0)
# About how many times too large the normal equations' information is: a frame counts in several pairs, and pixels are
# not independent. For the prior's share only; what is said of σ is measured.
_COUNTED = 25.0
# Stretches that what is known of all unknowns together counts for, beside the scatter of one.
_POOLED = 4.0
# Systematic error of the colour camera's pose, px, σ: interpolation, spline, surfaces. Seen on renderings.
_BLIND_PX = 0.08
# And of colour's offset in one part of a recording against another, s.
_BLIND_S = 3e-5
# By how much of their noise residuals must move for a useful change of a parameter: see `Solution.unsure`. Made-up
# clocks had up to 0.0067 (still, sliding and evenly turning cameras), true ones 0.009 and more; no made-up extrinsics
# were seen above a thousandth.
_MOVES = np.full(COUNT, 0.0015)
_MOVES[:DRIFT] = 0.0075
# Times that the scales of errors are estimated before the first step of a level; once at the finest.
_ROUNDS = 3

Watch = Callable[[int, int, Parameters], None]
"""Told the level, the step and the values; may raise KeyboardInterrupt."""


@dataclass(frozen=True)
class Solution:
    """values; normal equations of the free parameters at them: A (s, n, n), b (s, n) of the s stretches, free (29,).

    cost: negative log-likelihood a pixel. sigma_depth_m, sigma_intensity: of the residuals, medians. last_step (29,):
    the last one that was taken. blind (29,): σ of what no scatter shows. finished: nobody interrupted it. known (29,):
    σ of what was known beforehand, infinite where nothing was. pixels: that were compared.
    """

    values: Parameters
    free: BoolArray
    A: FloatArray
    b: FloatArray
    cost: float
    sigma_depth_m: float
    sigma_intensity: float
    last_step: FloatArray = field(default_factory=lambda: np.zeros(COUNT))
    blind: FloatArray = field(default_factory=lambda: np.zeros(COUNT))
    finished: bool = True
    known: FloatArray = field(default_factory=lambda: np.full(COUNT, np.inf))
    pixels: int = 1

    @property
    def is_settled(self) -> bool:
        """Whether the last step was within what is not known anyway."""
        return bool((np.abs(self.last_step) <= self.sigmas).all())

    @property
    def sigmas(self) -> FloatArray:
        """Standard errors (29,) as the scatter of the stretches shows them; 0 of what is not free.

        At the solution the stretches' gradients add up to nothing; how far each is from nothing tells how far the next
        recording's solution may lie (the "sandwich" of White, Econometrica 1980, by clusters, of which a stretch is
        one). With few stretches one parameter's scatter says little, so that of all counts too, and Student's factor
        makes two of these σ hold 95 %. What was known beforehand draws the solution to itself, and errs with its own σ.
        """
        count, n = self.b.shape
        told, lent = self.A.sum(axis=0), _COUNTED / self.known[self.free] ** 2
        inverse = np.linalg.pinv(told + np.diag(lent), hermitian=True)
        formal = np.maximum(np.diag(inverse @ told @ inverse), 0.0)
        scatter = self.b - self.b.mean(axis=0)
        spread = np.diag(inverse @ (scatter.T @ scatter) @ inverse) * count / max(1, count - 1)
        ratio = np.divide(spread, formal, out=np.ones(n), where=formal > 0.0)
        all_of_them = np.exp(np.mean(np.log(np.maximum(ratio, 1e-6)))) if n else 1.0
        dof = max(1.0, count - 1.0)
        inflation = np.maximum((_POOLED * all_of_them + dof * ratio) / (_POOLED + dof), 1.0)
        factor = float(stats.t.ppf(0.975, dof)) / 1.96
        sigmas = np.zeros(COUNT)
        borrowed = np.sqrt(inverse**2 @ (_COUNTED * lent))
        sigmas[self.free] = np.hypot(np.hypot(factor * np.sqrt(formal * inflation), borrowed), self.blind[self.free])
        return sigmas

    @property
    def unsure(self) -> FloatArray:
        """How much less sure the parameters (29,) are than is of use: above 1 they are not told; 0 of what is not free.

        By σ, and by how far a change that is just of use would move residuals, in the mean over pixels and with all
        else moved to make up for it: what moves them by less than a hundredth of their noise is at the mercy of a
        hundred small errors of interpolation, which no scatter shows.
        """
        unsure, sigmas = np.zeros(COUNT), self.sigmas
        formal = np.diag(np.linalg.pinv(self.A.sum(axis=0), hermitian=True))
        moved = USEFUL[self.free] / np.sqrt(np.maximum(formal, 1e-30) * self.pixels)
        unsure[self.free] = np.where(np.isfinite(self.known[self.free]), 0.0, _MOVES[self.free] / moved)
        return np.maximum(unsure, sigmas / USEFUL)

    @property
    def shares(self) -> FloatArray:
        """Part (s, 29) of what is known of each parameter that each stretch tells, all others known."""
        own = np.einsum("snn->sn", self.A)
        shares = np.zeros((len(own), COUNT))
        shares[:, self.free] = own / np.maximum(own.sum(axis=0), 1e-300)
        return shares


def solve(
    stretches: Sequence[Stretch], terms: PairTerms, start: Parameters, free: BoolArray, levels: Sequence[int],
    watch: Watch = lambda *_: None, known: Known | None = None, ends: float = 1.0,
) -> Solution:  # fmt: skip
    """Parameters and all control points jointly, coarse to fine; the stretches' splines are moved.

    free (29,): which parameters may change; the others stay at `start`, to which weak ones are held by PRIOR, and to
    what is `known` as firmly as that is. ends: steps so many times larger than usual end a level. Where `watch` raises
    KeyboardInterrupt, what has been found so far is returned, `finished` False. Raises numpy.linalg.LinAlgError where
    images say nothing at all.
    """
    known = known or Known.nothing(start)
    p, acceleration, finished, step = start, Acceleration(), True, np.zeros(COUNT)
    try:
        for level in levels:
            for stretch in stretches:
                for _ in range(_ROUNDS if level else 1):
                    stretch.sums(terms, p, level)
            acceleration.forget()
            for n in range(_MOST_STEPS[level]):
                watch(level, n, p)
                sums = [stretch.sums(terms, p, level) for stretch in stretches]
                step, information = _step(sums, p, start, known, free, acceleration)
                for stretch, one in zip(stretches, sums, strict=True):
                    stretch.move(one.points_step(step))
                p = p.moved(step)
                if (step[free] ** 2 * np.diag(information) < (ends * _SMALL[level]) ** 2).all():
                    break
    except KeyboardInterrupt:
        finished = False
    sums = [stretch.sums(terms, p, levels[-1]) for stretch in stretches]
    reduced = [one.reduced() for one in sums]
    A = np.array([one[np.ix_(free, free)] for one, _ in reduced])
    depth, intensity = np.median([stretch.sigma for stretch in stretches], axis=0)
    pixels = max(1, sum(one.pixels for one in sums))
    cost = sum(one.cost for one in sums) / pixels
    b = np.array([one[free] for _, one in reduced])
    blind = _blind(stretches, terms)
    return Solution(p, free, A, b, cost, float(depth), float(intensity), step, blind, finished, known.sigmas, pixels)


def _blind(stretches: Sequence[Stretch], terms: PairTerms) -> FloatArray:
    """σ (29,) of what no disagreement shows.

    Of the extrinsics, so many pixels as an angle and as a shift; of the drift, so many seconds from the middle to an
    end.
    """
    turn = _BLIND_PX / terms.color.camera.fx
    depth = float(np.median([view.surface.median_depth for stretch in stretches for view in stretch.views]))
    stamps = [view.depth.stamp for stretch in stretches for view in stretch.views]
    drift = _BLIND_S / max(0.5 * (max(stamps) - min(stamps)), 1e-3)
    lens = turn * np.array([1.0, 1.0, 1.0, 1.0, 4.0, 8.0, 1.0, 1.0])
    poses = np.zeros(3), [drift], np.full(3, turn * depth), np.full(3, turn)
    return np.concatenate([*poses, lens, lens, np.zeros(len(DEPTH))])


def _step(
    sums: Sequence[Sums], p: Parameters, start: Parameters, known: Known, free: BoolArray, acceleration: Acceleration
) -> tuple[FloatArray, FloatArray]:
    """The step (29,) of the parameters, and what is known of the free ones."""
    reduced = [one.reduced() for one in sums]
    prior, lent = _COUNTED / PRIOR[free] ** 2, _COUNTED / known.sigmas[free] ** 2
    at = p.since(start)[free]
    information = np.sum([A for A, _ in reduced], axis=0)[np.ix_(free, free)] + np.diag(prior + lent)
    gradient = np.sum([b for _, b in reduced], axis=0)[free] + prior * at
    gradient += lent * p.since(known.values)[free]
    step = np.zeros(COUNT)
    if free.any():
        step[free] = acceleration.extrapolated(at, -np.linalg.solve(information, gradient), information)
    return step, information
