"""What `rstrack bench` found: cells, their averages, and results.json, which is written and read again here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from rsgen.errors import UserError, first_problem
from rsgen.files import read_text
from rstrack.bench.methods import paper
from rstrack.bench.methods.plan import SequenceInfo
from rstrack.bench.methods.variants import folder_of, fuses, method_of, row_of
from rstrack.data.estimate import plain
from rstrack.metrics.clock import TruthOffset
from rstrack.options import METHODS

RESULTS = "results.json"
BASELINE = "baseline"

# A track with poses for fewer of the frames says little of its error: it counts as lost.
_LEAST_COVERAGE = 0.5


@dataclass(frozen=True)
class Quantity:
    """What a table is of. name: in files, with its unit; metric: in `Metrics`; the rest is for reading."""

    name: str
    metric: str
    title: str
    unit: str
    scale: float
    paper_digits: int


QUANTITIES = (
    Quantity("ate_m", "ate_rmse_m", "ATE", "mm", 1e3, 1),
    Quantity("rpe_m_s", "rpe_trans_rmse_m_per_s", "drift", "mm/s", 1e3, 1),
    Quantity("rpe_deg_s", "rpe_rot_rmse_deg_per_s", "drift", "deg/s", 1.0, 3),
)
"""RMSE all of them; drift is the relative pose error over one second."""


@dataclass(frozen=True)
class Cell:
    """What a job came to.

    method: a variant, see `variants`. metrics: `Metrics.as_dict()`, None if fewer than three frames have a pose.
    frames: asked for; lost: those of them without a pose. seconds: wall clock of tracking with reading, None if not
    known. error: why it could not be run. truth_offset: of the truth's clock, as it was asked for; truth_offset_s: that
    of the metrics, None for clocks as they are.
    """

    key: str
    sequence: str
    method: str
    metrics: dict[str, Any] | None
    frames: int
    lost: int
    seconds: float | None
    error: str | None = None
    truth_offset: TruthOffset | None = None
    truth_offset_s: float | None = None

    @property
    def counts(self) -> bool:
        """Whether its figures mean something: at least half of the frames have a pose."""
        return self.metrics is not None and self.lost <= (1.0 - _LEAST_COVERAGE) * self.frames

    @property
    def folder(self) -> Path:
        """Of its run, relative to that of the results."""
        return Path("cells", self.sequence, folder_of(self.method))

    def figure(self, name: str) -> float | None:
        """A figure of `metrics` by name; None where the track is lost or lacks it."""
        value = self.metrics.get(name) if self.metrics is not None and self.counts else None
        return None if value is None else float(value)


@dataclass(frozen=True)
class Results:
    """What there is of a plan. methods: variants of all methods; interrupted: some cells are missing."""

    sequences: tuple[SequenceInfo, ...]
    methods: tuple[str, ...]
    cells: tuple[Cell, ...]
    machine: dict[str, Any]
    version: str
    interrupted: bool = False

    def cell(self, sequence: str, method: str) -> Cell | None:
        """The cell, None if it was not run."""
        return next((c for c in self.cells if (c.sequence, c.method) == (sequence, method)), None)

    def figure(self, sequence: str, method: str, quantity: Quantity) -> float | None:
        """Of a cell; None where it has none."""
        cell = self.cell(sequence, method)
        return None if cell is None else cell.figure(quantity.metric)

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


def averaged_sequences(results: Results, group: str) -> tuple[str, ...]:
    """The sequences of a group on which every one of our methods that are shown kept the track: averages are over them.

    Other trackers and settings are averaged over the same ones, or not at all, so that they cannot change ours.
    """
    shown = list(results.shown(group).values())
    ours = [name for name in shown if method_of(name) in METHODS] or shown
    cells = {name: [results.cell(name, method) for method in ours] for name in results.names(group)}
    return tuple(name for name, row in cells.items() if all(cell is not None and cell.counts for cell in row))


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


def results_dict(results: Results) -> dict[str, Any]:
    """For results.json: metres, m/s, deg/s; `run` is relative to its folder."""
    names = [sequence.name for sequence in results.sequences]
    data = {
        "machine": results.machine,
        "version": results.version,
        "sequences": [vars(sequence) for sequence in results.sequences],
        "methods": list(results.methods),
        "cells": [
            {"sequence": c.sequence, "method": c.method, "fuse": fuses(c.method), "run": c.folder.as_posix()}
            | {q.name: c.figure(q.metric) for q in QUANTITIES}
            | {"frames": c.frames, "lost": c.lost, "seconds": c.seconds, "error": c.error}
            | {"truth_offset": c.truth_offset, "truth_offset_s": c.truth_offset_s}
            for c in results.cells
        ],
        "shown": {group: list(results.shown(group).values()) for group in results.groups},
        "averages": [
            {"group": a.group, "method": a.method, "sequences": a.sequences, **a.values, "better_pct": a.better_pct}
            for a in averages(results)
        ],
        "paper": [
            {"sequence": name, "method": method} | {q.name: getattr(figures, q.name) for q in QUANTITIES}
            for (name, method), figures in paper.FIGURES.items()
            if name in names and method in {row_of(variant) for variant in results.methods}
        ],
    }
    plain_data: dict[str, Any] = plain(data)
    return plain_data


class _StoredCell(BaseModel):
    """Figures are None where the track is lost or the cell could not be run."""

    sequence: str
    method: str
    ate_m: float | None = None
    rpe_m_s: float | None = None
    rpe_deg_s: float | None = None
    frames: int
    lost: int
    seconds: float | None = None
    error: str | None = None
    truth_offset: TruthOffset | None = None
    truth_offset_s: float | None = None

    def cell(self) -> Cell:
        figures = {q.metric: getattr(self, q.name) for q in QUANTITIES}
        metrics = None if self.ate_m is None else figures
        clock = (self.truth_offset, self.truth_offset_s)
        return Cell("", self.sequence, self.method, metrics, self.frames, self.lost, self.seconds, self.error, *clock)


class _StoredResults(BaseModel):
    sequences: tuple[SequenceInfo, ...]
    methods: tuple[str, ...]
    cells: tuple[_StoredCell, ...]
    machine: dict[str, Any] = {}
    version: str = ""


def read_results(path: Path) -> Results:
    """Read and check results.json, averages aside, which follow. Raises UserError naming the first wrong field."""
    try:
        stored = _StoredResults.model_validate_json(read_text(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: run 'rstrack bench' again") from None
    cells = tuple(cell.cell() for cell in stored.cells)
    return Results(stored.sequences, stored.methods, cells, stored.machine, stored.version)


def _mean(values: Sequence[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return sum(there) / len(there) if there and len(there) == len(values) else None
