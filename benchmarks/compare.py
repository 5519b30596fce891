"""What changed between two sets of records, beyond what chance scatters by.

comparison = compare(read_records(Path("benchmarks/results/gate.json")), outcome.records)
print(comparison.text())
sys.exit(bool(comparison.worse))

Seeds, and with them the noise, are the same in both, so that unchanged code gives unchanged errors: figures that are
alike in all runs are no comparison at all. The others are tested one-sidedly, and over all of these tests together
there is a false alarm in at most one comparison of twenty (Holm 1979). The tests:

- Figures with three runs or so: t-test of the means with a moderated variance (`benchmarks.inference`), errors and
  ratios in logarithms. It is not paired: a changed program's errors under the same noise may be alike, or may not, and
  where they are, the test is weaker than it could be. Of what has a nominal value, the distance of the mean from it.
- The same tests together, for each figure of each method over all cells (Stouffer 1949): what makes everything a little
  worse is seen there, long before it is in any one cell. Half of the false alarms are theirs.
- Ten runs and more, as of faults, one a seed: exact signed-rank test (Wilcoxon 1945) of the runs' differences, since
  lost frames are mostly none and sometimes hundreds, of which no mean knows anything. Counts by their differences.
- Counts of fewer runs: exact test of two binomial shares of the frames (Fisher), without frames of two Poisson counts.
- Silently wrong frames, and others that `rstrack.bench.figures` has as outright: the first, where there was none.
  Where there were some, as of methods that take a rolling shutter for a global one, they are counts like others.
- A cell that failed, or has no error in a run or in all of them where there was one: worse.

Milliseconds are never judged, since machines differ, and one machine from one day to the next: the ratio of median
times in one run is. Other people's trackers and the size of the product are shown, and not judged.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter

from scipy import special

from benchmarks.comparison import SIGNIFICANCE, FigureChange, RecordComparison, times
from benchmarks.inference import (
    Prior,
    fisher_p,
    holm,
    poisson_p,
    priors,
    signed_rank_p,
    spread_of,
    stouffer_p,
)
from benchmarks.size import CELL as SIZE
from benchmarks.size import size_changes
from rstrack.bench.figures import FigureInfo, figure_of
from rstrack.bench.record import CellRecord

PAIRED_FROM = 10
"""Runs from which these are compared one by one: fewer cannot be told from chance by ranks (2⁻¹⁰ at the least)."""
_DIGITS = 6
_FAILED, _OTHERWISE = "failed", "defined otherwise now, not compared"
_FATES = (_FAILED, "not run", "skipped", "not finished", _OTHERWISE, "new", "had failed before")


@dataclass(frozen=True)
class _Test:
    change: FigureChange
    p_worse: float
    p_better: float
    is_of_means: bool = False


@dataclass
class _Judged:
    """Changes so far; what tests say of theirs is known once all are there."""

    worse: list[FigureChange] = field(default_factory=list)
    better: list[FigureChange] = field(default_factory=list)
    unknown: list[FigureChange] = field(default_factory=list)
    tests: list[_Test] = field(default_factory=list)


def compare(old: Mapping[str, CellRecord], new: Mapping[str, CellRecord]) -> RecordComparison:
    """Compare all cells that both have. `RecordComparison.worse` is empty where nothing got worse beyond chance."""
    known = priors([old, new])
    judged, cells = _Judged(), defaultdict[str, list[str]](list)
    pairs: list[tuple[CellRecord, CellRecord]] = []
    same = 0
    for name in dict.fromkeys(name for name in (*old, *new) if name != SIZE):
        before, after = old.get(name), new.get(name)
        fate = _fate(before, after)
        if fate:
            cells[fate].append(name)
        if before is None or after is None:
            continue
        if fate == _FAILED and before.error is None and before.runs and not after.is_others:
            judged.worse.append(FigureChange(name, why=f"failed: {after.error}"))
        if not fate:
            pairs.append(_shared(before, after))
            if not after.is_others:
                same += not _judge(*pairs[-1], known, judged)
    together = _together(judged.tests)
    tests = [*together, *judged.tests]
    worse, better = (
        [
            dataclasses.replace(family[k].change, p=p(family[k]))
            for family in (together, judged.tests)
            for k in holm([p(test) for test in family], SIGNIFICANCE / 2)
        ]
        for p in (attrgetter("p_worse"), attrgetter("p_better"))
    )
    return RecordComparison(
        (*judged.worse, *worse), (*judged.better, *better), tuple(judged.unknown),
        {what: tuple(cells[what]) for what in _FATES if cells[what]}, tuple(times(pairs)), len(tests), same,
        sum(not after.is_others for _, after in pairs), size_changes(old, new),
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------------


def _fate(before: CellRecord | None, after: CellRecord | None) -> str:
    """Why two records cannot be compared; empty if they can."""
    if after is None:
        return "not run"
    if after.error is not None:
        return "skipped" if after.skipped else _FAILED
    if before is None:
        return "new"
    if before.error is not None:
        return "had failed before"
    if not after.complete:
        return "not finished"
    definitions = [json.dumps(record.settings, sort_keys=True, default=str) for record in (before, after)]
    return _OTHERWISE if definitions[0] != definitions[1] or not {*before.seeds} & {*after.seeds} else ""


def _judge(one: CellRecord, other: CellRecord, known: Mapping[str, Prior], judged: _Judged) -> bool:
    """Add what changed between two records of the same runs to `judged`; whether anything did."""
    names = [n for n in _names(one) if figure_of(n).is_judged and one.values(n) != other.values(n)]
    for name in names:
        had, missing = len(one.values(name)), len(other.runs) - len(other.values(name))
        # Counts of some cases only may have none of these; an error is missing where the track is gone.
        is_gone = had > 0 and (missing == len(other.runs) or (missing > 0 and had == len(one.runs)))
        if is_gone and figure_of(name).scale != "count":
            why = f"missing in {missing} of its runs"
            judged.worse.append(FigureChange(one.cell, name, _shown(one, name), _shown(other, name), why=why))
        elif figure_of(name).outright and one.total(name) == 0.0 < other.total(name):
            why = "there was none"
            judged.worse.append(FigureChange(one.cell, name, 0.0, other.total(name), why=why))
        else:
            test = _test(one, other, name, known.get(name))
            if test is None:
                judged.unknown.append(FigureChange(one.cell, name, _shown(one, name), _shown(other, name)))
            else:
                judged.tests.append(test)
    return bool(names)


def _shared(before: CellRecord, after: CellRecord) -> tuple[CellRecord, CellRecord]:
    """Both with the runs of the seeds that both have, to the digits that files keep."""
    seeds = [seed for seed in before.seeds if seed in after.seeds]

    def only(record: CellRecord) -> CellRecord:
        runs = dict(zip(record.seeds, record.runs, strict=True))
        rounded = ({name: _rounded(value) for name, value in runs[seed].items()} for seed in seeds)
        return dataclasses.replace(record, seeds=tuple(seeds), runs=tuple(rounded))

    return only(before), only(after)


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(f"{value:.{_DIGITS}g}")


def _names(record: CellRecord) -> list[str]:
    return list(dict.fromkeys(name for run in record.runs for name in run))


def _shown(record: CellRecord, name: str) -> float | None:
    """A count's sum, or a figure's mean."""
    return record.total(name) if figure_of(name).scale == "count" else record.figures.get(name)


def _test(one: CellRecord, other: CellRecord, name: str, prior: Prior | None) -> _Test | None:
    """Old against new of one figure; None: there is no scatter to compare the difference with."""
    figure = figure_of(name)
    change = FigureChange(one.cell, name, _shown(one, name), _shown(other, name))
    pairs = [(a.get(name), b.get(name)) for a, b in zip(one.runs, other.runs, strict=True)]
    both = [(a, b) for a, b in pairs if a is not None and b is not None]
    if len(both) >= PAIRED_FROM:
        differences = [_cost(figure, b) - _cost(figure, a) for a, b in both]
        return _Test(change, signed_rank_p(differences), signed_rank_p([-d for d in differences]))
    if figure.scale == "count":
        return _count_test(change, one, other)
    return _t_test(change, one, other, prior)


def _cost(figure: FigureInfo, value: float) -> float:
    """One run's badness, of ranks' use only: what has no logarithm is below all that have one."""
    scaled = figure.on_scale(value)
    return figure.badness([-1e3 if scaled is None else scaled])


def _t_test(change: FigureChange, one: CellRecord, other: CellRecord, prior: Prior | None) -> _Test | None:
    figure = figure_of(change.figure)
    values = [
        [x for value in record.values(change.figure) if (x := figure.on_scale(value)) is not None]
        for record in (one, other)
    ]
    if not all(values):
        return None
    own = [spread_of(figure, record.values(change.figure)) for record in (one, other)]
    variance, dof = (0.0, 0.0) if prior is None else prior.with_own(own[0] + own[1])
    sd, kept = one.scatter.get(change.figure, (0.0, 0.0))
    if kept > (0.0 if prior is None else prior.pooled):
        # Measured on more cells, when the old ones were accepted, than are here; their own runs are in it.
        variance, dof = Prior(sd**2, kept, kept + own[1].dof).with_own(own[1])
    if variance <= 0.0 or dof <= 0.0:
        return None
    difference = figure.badness(values[1]) - figure.badness(values[0])
    t = difference / math.sqrt(variance * (1 / len(values[0]) + 1 / len(values[1])))
    return _Test(change, float(special.stdtr(dof, -t)), float(special.stdtr(dof, t)), is_of_means=True)


def _count_test(change: FigureChange, one: CellRecord, other: CellRecord) -> _Test:
    sign = 1 if figure_of(change.figure).better == "less" else -1
    counts = [round(record.total(change.figure)) for record in (one, other)]
    frames = [round(record.total("frames")) for record in (one, other)]
    if all(0 <= count <= of for count, of in zip(counts, frames, strict=True)):
        more = fisher_p(counts[0], frames[0], counts[1], frames[1])
        fewer = fisher_p(counts[1], frames[1], counts[0], frames[0])
    else:
        more = poisson_p(counts[0], len(one.runs), counts[1], len(other.runs))
        fewer = poisson_p(counts[1], len(other.runs), counts[0], len(one.runs))
    return _Test(change, *((more, fewer) if sign > 0 else (fewer, more)))


def _together(tests: Sequence[_Test]) -> list[_Test]:
    """Each figure of each method, over all cells whose means were tested."""
    families: dict[tuple[str, str], list[_Test]] = defaultdict(list)
    for test in tests:
        if test.is_of_means:
            measure, _, method = test.change.cell.split("/")
            families[f"{measure}/*/{method}", test.change.figure].append(test)
    out = []
    for (cell, name), of in families.items():
        if len(of) > 1:
            old, new = (_mean(figure_of(name), [getattr(test.change, when) for test in of]) for when in ("old", "new"))
            change = FigureChange(cell, name, old, new, why=f"mean of {len(of)} cells")
            out.append(_Test(change, stouffer_p([t.p_worse for t in of]), stouffer_p([t.p_better for t in of])))
    return out


def _mean(figure: FigureInfo, values: Sequence[float]) -> float | None:
    """On the figure's scale."""
    scaled = [x for value in values if (x := figure.on_scale(value)) is not None]
    mean = math.fsum(scaled) / len(scaled) if scaled else math.nan
    return None if not scaled else math.exp(mean) if figure.scale == "log" else mean
