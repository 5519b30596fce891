"""Exact one-sided tests of counts and of paired runs, by counting cases; and many tests together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special, stats

# Deviates are finite, to eight sigma.
_LEAST_P = 1e-15


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
