"""What `rstrack bench` found: a view on its records, their averages, and results.json, written and read again here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ValidationError

from rsgen.errors import UserError, first_problem
from rsgen.files import atomic_write, read_text
from rstrack.bench.methods.config import SequenceInfo
from rstrack.bench.methods.variants import method_of, row_of
from rstrack.bench.record import Record
from rstrack.bench.tables import paper
from rstrack.options import METHODS

RESULTS = "results.json"
BASELINE = "baseline"

# A track with poses for fewer of the frames says little of its error: it counts as lost.
_LEAST_COVERAGE = 0.5


@dataclass(frozen=True)
class Quantity:
    """What a table is of. name: of the figure in records and in the paper's; the rest is for reading."""

    name: str
    title: str
    unit: str
    paper_digits: int


QUANTITIES = (
    Quantity("ate_mm", "ATE", "mm", 1),
    Quantity("drift_mm_s", "drift", "mm/s", 1),
    Quantity("drift_deg_s", "drift", "deg/s", 3),
)
"""RMSE all of them; drift is the relative pose error over one second."""


def counts(figures: Mapping[str, float | None]) -> bool:
    """Whether a run's errors mean something: at least half of the frames have a pose."""
    frames, lost = figures.get("frames") or 0.0, figures.get("lost") or 0.0
    return figures.get(QUANTITIES[0].name) is not None and lost <= (1.0 - _LEAST_COVERAGE) * frames


def figure(record: Record | None, name: str) -> float | None:
    """A figure of a record; None where it failed, the track is lost or lacks it."""
    if record is None or record.error is not None:
        return None
    return record.figures.get(name) if counts(record.figures) else None


def is_good(record: Record) -> bool:
    """Whether it has run and kept the track."""
    return record.error is None and counts(record.figures)


def folder_of(record: Record) -> Path:
    """Of its run, relative to that of the results."""
    return Path("cells", record.cell)


def truth_offset_s(record: Record) -> float | None:
    """The offset of the truth's clock that the errors are for, s; None for clocks as they are."""
    offset_ms = record.figures.get("truth_offset_ms")
    return None if offset_ms is None else 1e-3 * offset_ms


class Results(BaseModel, frozen=True):
    """What there is of a plan, as results.json has it. methods: variants of all methods. records: by cells' order."""

    sequences: tuple[SequenceInfo, ...]
    methods: tuple[str, ...]
    records: tuple[Record, ...]

    def record(self, sequence: str, method: str) -> Record | None:
        """The record of a cell, None if it was not run."""
        return next((r for r in self.records if (r.case, r.method) == (sequence, method)), None)

    def figure(self, sequence: str, method: str, quantity: Quantity) -> float | None:
        """Of a cell; None where it has none."""
        return figure(self.record(sequence, method), quantity.name)

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
        where both do: one setting for the whole group and all quantities, not the luckier one of every cell.
        """
        lines: dict[str, list[str]] = {}
        for name in self.methods:
            lines.setdefault(row_of(name), []).append(name)
        return {row: self._best(self.names(group), names) for row, names in lines.items()}

    def _best(self, sequences: Sequence[str], names: Sequence[str]) -> str:
        ate = {name: [self.figure(sequence, name, QUANTITIES[0]) for sequence in sequences] for name in names}
        common = [k for k in range(len(sequences)) if all(ate[name][k] is not None for name in names)]

        def badness(name: str) -> tuple[int, float]:
            return sum(a is None for a in ate[name]), sum(ate[name][k] or 0.0 for k in common)

        return min(names, key=badness)


@dataclass(frozen=True)
class Average:
    """Of one variant over the sequences of a group; None where it lacks one of them.

    better_pct: how much smaller than that of the baseline that is shown, in per cent; None without a baseline.
    """

    group: str
    method: str
    sequences: tuple[str, ...]
    values: dict[str, float | None]
    better_pct: dict[str, float | None]

    @property
    def theirs(self) -> paper.Figures | None:
        """The paper's average over the same sequences."""
        return paper.average(self.sequences, row_of(self.method))


def averaged_sequences(results: Results, group: str) -> tuple[str, ...]:
    """The sequences of a group on which every one of our methods that are shown kept the track: averages are over them.

    Other trackers and settings are averaged over the same ones, or not at all, so that they cannot change ours.
    """
    shown = list(results.shown(group).values())
    ours = [name for name in shown if method_of(name) in METHODS] or shown
    rows = {name: [results.record(name, method) for method in ours] for name in results.names(group)}
    return tuple(name for name, row in rows.items() if all(r is not None and is_good(r) for r in row))


def averages(results: Results) -> list[Average]:
    """All groups' averages of all variants."""
    found = []
    for group in results.groups:
        names = averaged_sequences(results, group)
        values = {
            method: {q.name: _mean([results.figure(name, method, q) for name in names]) for q in QUANTITIES}
            for method in results.methods
        }
        base = values.get(results.shown(group).get(BASELINE, ""), {})
        for method in results.methods:
            better = {q.name: better_pct(values[method][q.name], base.get(q.name)) for q in QUANTITIES}
            found.append(Average(group, method, names, values[method], better))
    return found


def better_pct(value: float | None, baseline: float | None) -> float | None:
    """How much smaller the value is, per cent of the baseline's; negative if it is larger."""
    return None if value is None or not baseline else 100.0 * (1.0 - value / baseline)


def write_json(results: Results, out: Path) -> None:
    """Write results.json. Raises UserError."""
    atomic_write(out / RESULTS, (results.model_dump_json(indent=1) + "\n").encode())


def read_results(path: Path) -> Results:
    """Read and check results.json. Raises UserError naming the first wrong field."""
    try:
        return Results.model_validate_json(read_text(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: run 'rstrack bench' again") from None


def _mean(values: Sequence[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return sum(there) / len(there) if there and len(there) == len(values) else None
