"""The joint solution: parameters that all windows share, control points of each its own, and how sure that is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import special

from rsgen.array_types import BoolArray, FloatArray
from rstrack.alignment.normal_equations import AndersonMixing, Eliminated
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.pairs.window import RecordingWindow, WindowSums
from rstrack.calibration.parameters import COUNT, DEPTH, DRIFT, PRIOR, USEFUL, Known, Parameters

# Steps at most on a level, and the part of the standard errors, as the windows' scatter shows them, that ends it.
_MOST_STEPS, _SMALL = 15, 0.1
# Windows that what is known of all unknowns together counts for, beside the scatter of one.
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
# Times that the scales of a window's errors are estimated before its first step.
_ROUNDS = 3

Watch = Callable[[int, int, Parameters], None]
"""Given the level, the step and the values; may raise KeyboardInterrupt."""


@dataclass(frozen=True)
class Solution:
    """values; normal equations of the free parameters at them: A (s, n, n), b (s, n) of the s windows, free (31,).

    cost: negative log-likelihood a pixel. sigma_depth_m, sigma_intensity: of the residuals, medians. last_step (31,):
    the last one that was taken. blind (31,): σ of what no scatter shows. finished: nobody interrupted it. known
    (31, 31): `Known.information`. pixels: that were compared. depth_overcounts: mean over windows, see `WindowSums`.
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
    known: FloatArray = field(default_factory=lambda: np.zeros((COUNT, COUNT)))
    pixels: int = 1
    depth_overcounts: float = 1.0

    @property
    def is_settled(self) -> bool:
        """Whether the last step was within what is not known anyway."""
        return bool((np.abs(self.last_step) <= self.sigmas).all())

    @property
    def sigmas(self) -> FloatArray:
        """Standard errors (31,) as the scatter of the windows shows them; 0 of what is not free.

        Student's factor, for there are few of these, makes two σ hold 95 %.
        """
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def covariance(self) -> FloatArray:
        """Covariance (31, 31), to which `sigmas` belong; 0 of what is not free."""
        known = self.known[np.ix_(self.free, self.free)]
        C, _, _ = posterior(self.A, self.b, known)
        factor = float(special.stdtrit(max(1.0, len(self.b) - 1.0), 0.975)) / 1.96
        formal = np.sqrt(np.maximum(np.diag(C), 1e-300))
        bound = np.sqrt(np.divide(1.0, np.diag(known), out=np.full(len(C), np.inf), where=np.diag(known) > 0.0))
        scale = np.minimum(factor * formal, bound) / formal
        found = np.diag(np.where(self.free, self.blind, 0.0) ** 2)
        found[np.ix_(self.free, self.free)] += C * np.outer(scale, scale)
        return found

    def chance(self, gain: float, which: BoolArray) -> float:
        """How often freeing `which` (31,) of the unknowns makes images more likely by as much, though none is needed.

        gain: of the log-likelihood, which counts far too much. Twice that is then a sum of squares of normals, each
        times an eigenvalue of (A⁻¹)⁻¹ (A⁻¹ N A⁻¹), both of these unknowns' blocks (Kent, Biometrika 1982), here by its
        first two moments (Satterthwaite, Biometrics 1946). N: see `posterior`.
        """
        of = which[self.free]
        C = posterior(self.A, self.b, np.zeros(self.A.shape[1:]))[0]
        formal = np.linalg.pinv(self.A.sum(axis=0), hermitian=True)
        M = np.linalg.solve(formal[np.ix_(of, of)], C[np.ix_(of, of)])
        trace, square = float(np.trace(M)), float(np.trace(M @ M))
        return float(special.chdtrc(trace**2 / square, 2.0 * max(gain, 0.0) * trace / square))

    def gain_over(self, values: Parameters, which: BoolArray) -> float:
        """By how much less likely images are with `which` (31,) of the unknowns at `values`, all else moved to make up
        for it: as the log-likelihood's curvature here has it."""
        which, step = which & self.free, self.values.since(values)
        C = np.linalg.pinv(self.A.sum(axis=0), hermitian=True)[np.ix_(which[self.free], which[self.free])]
        return 0.5 * float(step[which] @ np.linalg.pinv(C, hermitian=True) @ step[which])

    @property
    def unsure(self) -> FloatArray:
        """How much less sure the parameters (31,) are than is of use: above 1 undetermined; 0 of what is not free.

        By σ, and by how far a change that is just of use would move residuals, in the mean over pixels and with all
        else moved to make up for it: what moves them by less than a hundredth of their noise is at the mercy of a
        hundred small errors of interpolation, which no scatter shows. What was known beforehand is sure enough.
        """
        unsure, sigmas = np.zeros(COUNT), self.sigmas
        formal = np.diag(np.linalg.pinv(self.A.sum(axis=0), hermitian=True))
        moved = USEFUL[self.free] / np.sqrt(np.maximum(formal, 1e-30) * self.pixels)
        unsure[self.free] = _MOVES[self.free] / moved
        return np.where(np.diag(self.known) > 0.0, 0.0, np.maximum(unsure, sigmas / USEFUL))

    @property
    def shares(self) -> FloatArray:
        """Part (s, 31) of the information on each parameter that each window has, all others known."""
        own = np.einsum("snn->sn", self.A)
        shares = np.zeros((len(own), COUNT))
        shares[:, self.free] = own / np.maximum(own.sum(axis=0), 1e-300)
        return shares


def solve(
    windows: Sequence[RecordingWindow], terms: PairTerms, start: Parameters, free: BoolArray, levels: Sequence[int],
    watch: Watch = lambda *_: None, known: Known | None = None, steps: int = _MOST_STEPS, depth_counts: float = 1.0,
) -> Solution:  # fmt: skip
    """Parameters and all control points jointly, coarse to fine; the windows' splines are moved.

    free (31,): which parameters may change; the others stay at `start`, to which weak ones are held by PRIOR, and to
    what is `known` as firmly as that is. depth_counts: see `RecordingWindow.sums`. Where `watch` raises
    KeyboardInterrupt, what has been found so far is returned, `finished` False. Raises numpy.linalg.LinAlgError where
    images determine nothing.
    """
    known = known or Known.nothing(start)
    p, acceleration, finished, step = start, AndersonMixing(), True, np.zeros(COUNT)
    try:
        new = [window for window in windows if window.is_new]
        for _ in range(_ROUNDS):
            _sums(new, terms, p, levels[0], depth_counts)
        for level in levels:
            acceleration.reset()
            for n in range(steps):
                watch(level, n, p)
                sums = _sums(windows, terms, p, level, depth_counts)
                step, sigmas = _step([one.reduced for one in sums], p, start, known, free, acceleration)
                for window, one in zip(windows, sums, strict=True):
                    window.move(one.points_step(step))
                p = p.moved(step)
                if (np.abs(step[free]) <= _SMALL * sigmas).all():
                    break
        sums = _sums(windows, terms, p, levels[-1], depth_counts)
        last, _ = _step([one.reduced for one in sums], p, start, known, free)
        for window, one in zip(windows, sums, strict=True):
            window.move(one.points_step(last))
        p = p.moved(last)
    except KeyboardInterrupt:
        finished = False
    sums = _sums(windows, terms, p, levels[-1], depth_counts)
    reduced = [one.reduced for one in sums]
    A, b = _of_free(reduced, free)
    depth, intensity = np.median([window.sigma for window in windows], axis=0)
    pixels = max(1, sum(one.pixels for one in sums))
    cost = sum(one.cost for one in sums) / pixels
    blind = _blind(windows, terms)
    return Solution(
        p, free, A, b, cost, float(depth), float(intensity), step, blind, finished, known.information, pixels,
        float(np.mean([one.depth_overcounts for one in sums])),
    )  # fmt: skip


def _sums(
    windows: Sequence[RecordingWindow], terms: PairTerms, p: Parameters, level: int, depth_counts: float
) -> list[WindowSums]:  # fmt: skip
    """Of each window; the device works on one while another's are added up."""
    launched = [window.launched(terms, p, level, depth_counts) for window in windows]
    return [sums() for sums in launched]


def joined(first: Solution, then: Solution) -> Solution:
    """Of two solutions one: `then`'s, found with the parameters that `first` had found held, and `first`'s of these.

    What is unknown of either's is not in the covariance of the other's.
    """
    free, A, b = first.free | then.free, [], []
    for one in (first, then):
        own, full = np.nonzero(one.free[free])[0], np.zeros((len(one.A), int(free.sum()), int(free.sum())))
        full[:, own[:, None], own] = one.A
        A.append(full)
        b.append(np.zeros(full.shape[:2]))
        b[-1][:, own] = one.b
    last_step = np.where(first.free, first.last_step, then.last_step)
    return replace(then, free=free, A=A[0] + A[1], b=b[0] + b[1], last_step=last_step)


def _blind(windows: Sequence[RecordingWindow], terms: PairTerms) -> FloatArray:
    """σ (31,) of what no disagreement shows.

    Of the extrinsics, so many pixels as an angle and as a shift; of the drift, so many seconds from the middle to an
    end.
    """
    turn = _BLIND_PX / terms.color.camera.fx
    depth = float(np.median(np.concatenate([window.images.median_depth for window in windows])))
    stamps = [view.depth.stamp for window in windows for view in window.views]
    drift = _BLIND_S / max(0.5 * (max(stamps) - min(stamps)), 1e-3)
    lens = turn * np.array([1.0, 1.0, 1.0, 1.0, 4.0, 8.0, 1.0, 1.0, 16.0])
    poses = np.zeros(3), [drift], np.full(3, turn * depth), np.full(3, turn)
    return np.concatenate([*poses, lens, lens, np.zeros(len(DEPTH))])


def _step(
    reduced: Sequence[Eliminated], p: Parameters, start: Parameters, known: Known, free: BoolArray,
    acceleration: AndersonMixing | None = None,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """The step (31,) of the parameters, and the standard errors of the free ones.

    Gauss-Newton's, accelerated, the prior against as much as A overcounts in the mean. Without `acceleration` the
    last one, against what A overcounts in each direction: that only shows where gradients add up to nothing.
    """
    A, b = _of_free(reduced, free)
    weak, information = np.diag(PRIOR[free] ** -2.0), known.information[np.ix_(free, free)]
    drawn = weak @ p.since(start)[free] + information @ p.since(known.values)[free]
    C, gain, counted = posterior(A, b, weak + information)
    step = np.zeros(COUNT)
    if acceleration is None:
        step[free] = -C @ (gain @ b.sum(axis=0) + drawn)
    elif free.any():
        total = A.sum(axis=0) + counted * (weak + information)
        plain = -np.linalg.solve(total, b.sum(axis=0) + counted * drawn)
        step[free] = acceleration.extrapolated(p.since(start)[free], plain, total)
    return step, np.sqrt(np.diag(C))


def _of_free(reduced: Sequence[Eliminated], free: BoolArray) -> tuple[FloatArray, FloatArray]:
    """A (s, n, n) and b (s, n) of the free parameters alone."""
    return np.array([one.H[np.ix_(free, free)] for one in reduced]), np.array([one.g[free] for one in reduced])


def posterior(A: FloatArray, b: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Covariance (n, n) of parameters by windows' A (s, n, n) and b (s, n) and a prior's information (n, n); what
    the gradient counts for beside the prior's (n, n): A N⁻¹, N the covariance of the gradient; and how many times too
    large A is in the mean.

    At the solution the windows' gradients add up to nothing; how far each is from nothing shows N (the "sandwich" of
    White, Econometrica 1980, by clusters, of which a window is one). A alone is far too sure: a frame counts in several
    pairs, pixels are not independent, and what no model has is in all of them. The scatter of few windows is shrunk
    towards A times what the two differ by in the mean over parameters.
    """
    total, dof = A.sum(axis=0), max(1.0, len(b) - 1.0)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    total, scatter = total * np.outer(unit, unit), (b - b.mean(axis=0)) * unit
    scatter = scatter.T @ scatter * (len(b) / dof)
    inverse = np.linalg.pinv(total, hermitian=True)
    formal, shown = np.diag(inverse), np.diag(inverse @ scatter @ inverse)
    ratio = np.divide(shown, formal, out=np.ones(len(formal)), where=formal > 0.0)
    counted = max(1.0, float(np.exp(np.mean(np.log(np.maximum(ratio, 1e-6)))))) if len(ratio) else 1.0
    N = (_POOLED * counted * total + dof * scatter) / (_POOLED + dof)
    gain = total @ np.linalg.pinv(N, hermitian=True)
    C = np.linalg.pinv(gain @ total + prior * np.outer(unit, unit), hermitian=True)
    return np.outer(unit, unit) * C, gain * unit / unit[:, None], counted
