"""What a comparison of records has found, and how it reads."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rsgen.console.tables import significant
from rstrack.bench.figures import figure_of
from rstrack.bench.record import CellRecord

SIGNIFICANCE = 0.05
"""Chance of any false alarm over all tests of a comparison."""


@dataclass(frozen=True)
class FigureChange:
    """One figure of a cell: means, sums of counts. p: chance of as much without a change; why: other reasons."""

    cell: str
    figure: str = ""
    old: float | None = None
    new: float | None = None
    p: float | None = None
    why: str = ""

    def text(self) -> str:
        """One line."""
        figure = figure_of(self.figure)
        if not self.figure:
            return f"{self.cell}: {self.why}"
        values = " -> ".join(significant(value) for value in (self.old, self.new))
        parts = [f"{values} {figure.unit}".rstrip()]
        if figure.scale == "log" and self.old and self.new:
            parts.append(f"{100.0 * (self.new / self.old - 1.0):+.1f} %")
        parts += [self.why] if self.why else []
        parts += [] if self.p is None else [f"p {self.p:.1g}"]
        return f"{self.cell} {self.figure}: {', '.join(parts)}"


@dataclass(frozen=True)
class RecordComparison:
    """worse, better: beyond chance. unknown: changed, but what chance does there was never measured. cells: names by
    what became of them, where there is nothing to compare. times, size: lines. tests: how many; same: cells all alike.
    """

    worse: tuple[FigureChange, ...] = ()
    better: tuple[FigureChange, ...] = ()
    unknown: tuple[FigureChange, ...] = ()
    cells: dict[str, tuple[str, ...]] = field(default_factory=dict)
    times: tuple[str, ...] = ()
    tests: int = 0
    same: int = 0
    compared: int = 0
    size: tuple[str, ...] = ()

    def text(self) -> str:
        """For the screen: worse first, then better, then what was not compared."""
        lines: list[str] = []
        for name, changes in (("WORSE", self.worse), ("better", self.better)):
            lines += [f"{name}: {len(changes)}", *(f"  {change.text()}" for change in changes)] if changes else []
        if self.unknown:
            lines.append("changed, and not judged: how chance scatters these is not known")
            lines += [f"  {change.text()}" for change in self.unknown]
        lines += [f"{what}: {', '.join(names)}" for what, names in self.cells.items()]
        lines += [*self.times, *self.size]
        verdict = "nothing got worse" if not self.worse else f"{len(self.worse)} figures got worse"
        lines.append(
            f"{verdict}: {self.compared} cells compared, {self.same} of them alike in every run; {self.tests} tests, "
            f"a false alarm in {100 * SIGNIFICANCE:g} % of such comparisons at most"
        )
        return "\n".join(lines)


def times(pairs: Sequence[tuple[CellRecord, CellRecord]]) -> list[str]:
    """A line for each kind of time: its change over all cells, and on which machines."""
    factors: dict[str, list[float]] = defaultdict(list)
    for one, other in pairs:
        after = other.figures
        for name, before in one.figures.items():
            if figure_of(name).is_time and before > 0.0 and after.get(name, 0.0) > 0.0:
                factors[name].append(after[name] / before)
    lines = []
    for name in ("median_ms", "p95_ms", "p99_ms", "total_s"):
        if name in factors:
            of = np.array(factors[name])
            middle = math.exp(float(np.log(of).mean()))
            lines.append(f"  {name}: x {middle:.2f} over {of.size} cells ({of.min():.2f} to {of.max():.2f})")
    if not lines:
        return []
    machines = [sorted({str(pair[k].machine.get("cpu", "?")) for pair in pairs}) for k in (0, 1)]
    loads = [max((float(pair[k].machine.get("load") or 0.0) for pair in pairs), default=0.0) for k in (0, 1)]
    where = " -> ".join(f"{', '.join(m)}, load up to {load:g}" for m, load in zip(machines, loads, strict=True))
    return [f"times, shown and not judged ({where}):", *lines]
