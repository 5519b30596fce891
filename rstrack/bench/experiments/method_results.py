"""What `rstrack bench` found: a view on its records, their averages, and how results.json is read again."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from pydantic import BaseModel, ValidationError

from rsgen.errors import UserError, first_problem
from rsgen.files import read_text
from rstrack.bench import paper
from rstrack.bench.experiments.methods import SequenceInfo, method_of, row_of
from rstrack.bench.record import CellRecord, figure
from rstrack.bench.tables import (
    ERRORS,
)
from rstrack.options import METHODS

RESULTS = "results.json"
AVERAGE = "average"
"""The case that averages are records of."""
BASELINE = "baseline"


class Results(BaseModel, frozen=True):
    """What there is of a plan, as results.json has it. methods: variants of all methods. records: by cells' order."""

    sequences: tuple[SequenceInfo, ...]
    methods: tuple[str, ...]
    records: tuple[CellRecord, ...]

    @cached_property
    def cells(self) -> dict[tuple[str, str], CellRecord]:
        """The records by case and method."""
        return {(record.case, record.method): record for record in self.records}

    def record(self, sequence: str, method: str) -> CellRecord | None:
        """The record of a cell, None if it was not run."""
        return self.cells.get((sequence, method))

    def figure(self, sequence: str, method: str, name: str) -> float | None:
        """Of a cell; None where it has none."""
        return figure(self.record(sequence, method), name)

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the groups, in order."""
        return tuple(dict.fromkeys(sequence.group for sequence in self.sequences))

    def names(self, group: str) -> list[str]:
        """The sequences of a group."""
        return [sequence.name for sequence in self.sequences if sequence.group == group]

    def shown(self, group: str) -> dict[str, str]:
        """What the tables of a group show: a variant for each of their lines (`variants.row_of`).

        Of two settings, that which keeps the track on more sequences, and then that of the smaller mean ATE over those
        where both do: one setting for the whole group and all errors, not the luckier one of every cell.
        """
        rows: dict[str, list[str]] = {}
        for name in self.methods:
            rows.setdefault(row_of(name), []).append(name)
        return {row: self._best(self.names(group), names) for row, names in rows.items()}

    def _best(self, sequences: Sequence[str], names: Sequence[str]) -> str:
        ate = {name: [self.figure(sequence, name, "ate_mm") for sequence in sequences] for name in names}
        common = [k for k in range(len(sequences)) if all(ate[name][k] is not None for name in names)]

        def badness(name: str) -> tuple[int, float]:
            return sum(a is None for a in ate[name]), sum(ate[name][k] or 0.0 for k in common)

        return min(names, key=badness)

    def averaged(self, group: str) -> tuple[str, ...]:
        """The sequences that averages are over: those on which every one of our methods that are shown kept the track.

        Other trackers and settings are averaged over the same ones, or not at all, so that they cannot change ours.
        """
        shown = list(self.shown(group).values())
        ours = [name for name in shown if method_of(name) in METHODS] or shown
        rows = {name: [self.record(name, method) for method in ours] for name in self.names(group)}
        return tuple(name for name, row in rows.items() if all(r is not None and r.is_good for r in row))

    def average(self, group: str, method: str) -> CellRecord:
        """A record of means over `averaged`, of the errors that it has on all of these."""
        records = [self.record(name, method) for name in self.averaged(group)]
        names = [name for name in ERRORS if all(figure(record, name) is not None for record in records)]
        runs = tuple({name: figure(record, name) for name in names} for record in records)
        return CellRecord(f"track/{AVERAGE}/{method}", "", {"group": group}, runs=runs, complete=True)

    def of_group(self, group: str) -> dict[tuple[str, str], CellRecord]:
        """Cells of a group and then its averages, by case and method."""
        found = {at: record for at, record in self.cells.items() if at[0] in self.names(group)}
        return found | {(AVERAGE, method): self.average(group, method) for method in self.methods}

    def theirs(self, group: str, case: str, method: str) -> paper.Figures:
        """The paper's figures of the same; empty: none."""
        return paper.average(self.averaged(group) if case == AVERAGE else (case,), row_of(method))


def better_pct(value: float | None, baseline: float | None) -> float | None:
    """How much smaller the value is, per cent of the baseline's; negative if it is larger."""
    return None if value is None or not baseline else 100.0 * (1.0 - value / baseline)


def read_results(path: Path) -> Results:
    """Read and check results.json. Raises UserError naming the first wrong field."""
    try:
        return Results.model_validate_json(read_text(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: run 'rstrack bench' again") from None
