"""Statistics of comparisons: how much chance scatters figures, and exact one-sided tests.

The scatter is measured: each cell's own variance, moderated by that of all cells. With three runs a cell's own variance
is off by a factor of two and more. All cells' variances of a figure give the common one (s0²), and how alike they are
(d0 degrees of freedom), by the method of moments of Smyth (2004), *Linear models and empirical Bayes methods*, section
6.2; the two are then weighed by their degrees of freedom (there equation 1).
"""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from rstrack.bench.figures import FigureInfo, figure_of
from rstrack.bench.record import CellRecord

_NEWTON = 50
# Deviates are finite, to eight sigma.
_LEAST_P = 1e-15


@dataclass(frozen=True)
class RunSpread:
    """Sum of squares about the mean, or means, and degrees of freedom."""

    squares: float = 0.0
    dof: float = 0.0

    def __add__(self, other: RunSpread) -> RunSpread:
        return RunSpread(self.squares + other.squares, self.dof + other.dof)


@dataclass(frozen=True)
class Prior:
    """The variance that cells have in common, its worth in degrees of freedom; pooled: those it was measured with."""

    variance: float
    dof: float
    pooled: float

    def with_own(self, own: RunSpread) -> tuple[float, float]:
        """Variance and degrees of freedom of a cell with a spread of its own.

        They are never more than all cells have together: the common variance is not known better (as limma has it).
        A spread of exactly zero means that chance plays no part in this cell's runs, and counts as none.
        """
        if own.squares <= 0.0:
            return self.variance, min(self.dof, self.pooled)
        dof = min(self.dof, self.pooled)
        return (dof * self.variance + own.squares) / (dof + own.dof), min(self.dof + own.dof, self.pooled)


def spread_of(figure: FigureInfo, values: Iterable[float]) -> RunSpread:
    """Of some runs' values, on the figure's scale."""
    scaled = np.array([x for value in values if (x := figure.on_scale(value)) is not None])
    if scaled.size < 2:
        return RunSpread()
    squares = float(((scaled - scaled.mean()) ** 2).sum())
    tiny = (1e-9 * max(1.0, float(np.abs(scaled).max()))) ** 2
    return RunSpread(squares, scaled.size - 1) if squares > tiny else RunSpread()


def fit_prior(spreads: Sequence[RunSpread]) -> Prior | None:
    """s0², d0 of some cells; None: none of them has a variance above zero."""
    known = [spread for spread in spreads if spread.dof > 0.0 and spread.squares > 0.0]
    if not known:
        return None
    squares, dofs = (np.array([getattr(spread, name) for spread in known]) for name in ("squares", "dof"))
    pooled = float(dofs.sum())
    mean = float(squares.sum() / pooled)
    if len(known) < 2:
        return Prior(mean, 0.0, pooled)
    e = np.log(squares / dofs) - special.digamma(dofs / 2) + np.log(dofs / 2)
    # Taken for one standard error more unlike than they are found to be: a d0 that is too large by chance makes false
    # alarms (7 % for 5 %, by simulation of 40 cells of d0 = 4), one that is too small only a duller test.
    found = float(e.var(ddof=1)) * (1.0 + math.sqrt(2.0 / (e.size - 1)))
    excess = found - float(special.polygamma(1, dofs / 2).mean())
    if excess <= 0.0:  # as alike as chance has them
        return Prior(mean, math.inf, pooled)
    half = _inverse_trigamma(excess)
    return Prior(math.exp(float(e.mean()) + float(special.digamma(half)) - math.log(half)), 2.0 * half, pooled)


def priors(many: Iterable[Mapping[str, CellRecord]]) -> dict[str, Prior]:
    """By figure, of all cells of ours in some sets of records; the sets' means may differ."""
    spreads: dict[str, dict[str, RunSpread]] = defaultdict(lambda: defaultdict(RunSpread))
    for records in many:
        for record in records.values():
            if record.error is None and not record.is_others:
                for name in scattered(record):
                    spreads[name][record.cell] += spread_of(figure_of(name), record.values(name))
    fitted = {name: fit_prior(list(of_cells.values())) for name, of_cells in spreads.items()}
    return {name: prior for name, prior in fitted.items() if prior is not None}


def scattered(record: CellRecord) -> list[str]:
    """Names of the record's figures that are judged by their scatter."""
    names = dict.fromkeys(name for run in record.runs for name in run)
    return [name for name in names if figure_of(name).is_judged and figure_of(name).scale != "count"]


def tolerances(records: Mapping[str, CellRecord]) -> dict[str, CellRecord]:
    """The records with each one's scatter, as measured over all of them, to be kept with them when accepted."""
    known = priors([records])
    out = {}
    for cell, record in records.items():
        scatter = {}
        for name in scattered(record) if record.error is None and not record.is_others else []:
            if name in known:
                variance, dof = known[name].with_own(spread_of(figure_of(name), record.values(name)))
                if dof <= 0.0:  # one cell alone shows nothing of the others
                    continue
                scatter[name] = (float(f"{math.sqrt(variance):.6g}"), float(f"{dof:.6g}"))
        out[cell] = dataclasses.replace(record, scatter=scatter)
    return out


def _inverse_trigamma(value: float) -> float:
    """x with trigamma(x) = value > 0, by Newton's method on its reciprocal (Smyth 2004, appendix)."""
    x = 0.5 + 1.0 / value
    for _ in range(_NEWTON):
        trigamma = float(special.polygamma(1, x))
        step = trigamma * (1.0 - trigamma / value) / float(special.polygamma(2, x))
        x += step
        if abs(step) < 1e-9 * x:
            break
    return x


def signed_rank_p(differences: Sequence[float]) -> float:
    """Chance that signs thrown by a coin give as large a sum of the positive differences' ranks, or larger.

    Differences of zero are left out (Wilcoxon), equal ones share their ranks, and the distribution is counted out for
    just these ranks (in halves), so that it is exact with ties too.
    """
    d = np.array([value for value in differences if value != 0.0])
    if not d.size:
        return 1.0
    ranks = np.rint(2 * stats.rankdata(np.abs(d))).astype(np.int64)
    ways = np.zeros(int(ranks.sum()) + 1)
    ways[0] = 1.0
    for rank in ranks:
        ways[rank:] = 0.5 * (ways[rank:] + ways[: ways.size - rank])
        ways[:rank] *= 0.5
    return float(min(1.0, ways[int(ranks[d > 0].sum()) :].sum()))


def fisher_p(old: int, old_of: int, new: int, new_of: int) -> float:
    """Chance of so many or more among the new ones, if old and new have the same share (Fisher's exact test)."""
    return float(stats.hypergeom.sf(new - 1, old_of + new_of, old + new, new_of))


def poisson_p(old: int, old_runs: int, new: int, new_runs: int) -> float:
    """Chance of so many or more in the new runs, if old and new have the same rate."""
    return float(stats.binom.sf(new - 1, old + new, new_runs / (old_runs + new_runs)))


def stouffer_p(p: Sequence[float]) -> float:
    """Chance of as much in some independent tests together (Stouffer 1949): their normal deviates are added."""
    deviates = special.ndtri(np.clip(p, _LEAST_P, 1.0 - _LEAST_P))
    return float(special.ndtr(deviates.sum() / np.sqrt(len(p))))


def holm(p: Sequence[float], significance: float) -> list[int]:
    """Which of some tests are significant together, the most first (Holm 1979)."""
    chosen: list[int] = []
    for rank, k in enumerate(np.argsort(p, kind="stable").tolist()):
        if p[k] * (len(p) - rank) > significance:
            break
        chosen.append(k)
    return chosen
