"""What the readout sweep found: for each method and shutter the error over the seeds, with its interval, and tables."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.tables import NOTHING, Entry, Table, csv_text, fixed, significant
from rsgen.files import atomic_write
from rstrack.bench.methods.results import QUANTITIES, Quantity
from rstrack.bench.readout.cases import Case, cases_of
from rstrack.bench.readout.run import SweepResult
from rstrack.data.estimate import plain

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Point:
    """Of one method with one shutter: geometric mean and interval over the seeds on which it kept the track.

    mean, low, high: None where no seed counts; the interval is None too where but one does. lost: seeds without.
    """

    case: Case
    method: str
    values: tuple[float, ...]
    lost: int

    @property
    def mean(self) -> float | None:
        """Geometric: errors are compared by their ratios."""
        return log_interval(self.values)[0]

    @property
    def low(self) -> float | None:
        """Lower end of the interval."""
        return log_interval(self.values)[1]

    @property
    def high(self) -> float | None:
        """Its upper end."""
        return log_interval(self.values)[2]


def log_interval(values: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Geometric mean of positive values and its two-sided interval of CONFIDENCE by Student's t, in logarithms."""
    from scipy.special import stdtrit

    logs = np.log(np.array([value for value in values if value > 0.0]))
    if not logs.size:
        return None, None, None
    mean = float(logs.mean())
    if logs.size == 1:
        return math.exp(mean), None, None
    half = float(stdtrit(logs.size - 1, 0.5 + 0.5 * CONFIDENCE) * logs.std(ddof=1) / math.sqrt(logs.size))
    return math.exp(mean), math.exp(mean - half), math.exp(mean + half)


def points_of(result: SweepResult, quantity: Quantity = QUANTITIES[0]) -> list[Point]:
    """Of all cases and methods that were run, in order."""
    found = []
    for case in cases_of(result.config):
        for method in result.methods:
            cells = result.cells.get((case, method), ())
            values = [cell.figure(quantity.metric) for cell in cells]
            if cells:
                known = tuple(value for value in values if value is not None)
                found.append(Point(case, method, known, len(values) - len(known)))
    return found


def growth(points: Sequence[Point]) -> float | None:
    """Largest over smallest mean of a method's points, one a readout; None if it was lost at one, or has but one."""
    means = [point.mean for point in points]
    if len(means) < 2 or any(mean is None for mean in means):
        return None
    known = [mean for mean in means if mean is not None]
    return max(known) / min(known)


def write_sweep(result: SweepResult, out: Path) -> str:
    """Write results.json, .csv, .md and .txt into `out`; returns the text. Raises UserError."""
    points = {quantity.name: points_of(result, quantity) for quantity in QUANTITIES}
    tables = sweep_tables(result)
    listed = sweep_notes(result)
    text = "\n\n".join([*(f"{table.title}\n{table.text()}" for table in tables), "\n".join(listed)])
    notes = "\n".join(f"- {note}" for note in listed)
    markdown = "\n\n".join([*(f"**{table.title}**\n\n{table.markdown()}" for table in tables), notes]) + "\n"
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / "results.txt", (text + "\n").encode())
    atomic_write(out / "results.md", markdown.encode())
    atomic_write(out / "results.csv", csv_text(_records(points)).encode())
    data = {
        "machine": result.machine, "version": result.version, "sweep": result.config.model_dump(mode="json"),
        "left_out": list(result.lacking), "points": _records(points), "cells": _cell_records(result),
    }  # fmt: skip
    atomic_write(out / "results.json", (json.dumps(plain(data), indent=1) + "\n").encode())
    return text


def sweep_tables(result: SweepResult, quantity: Quantity = QUANTITIES[0]) -> list[Table]:
    """A table for each motion and exposure: a row for each method, a column for each readout, and the growth."""
    points = points_of(result, quantity)
    readouts = sorted(result.config.readouts_s)
    tables = []
    for entry in result.config.motions:
        for exposure in result.config.exposures_s:
            rows: list[tuple[Entry | str, ...]] = []
            for method in result.methods:
                line = [
                    next((p for p in points if _is_at(p, entry.name, exposure, readout, method)), None)
                    for readout in readouts
                ]
                factor = growth([p for p in line if p is not None]) if None not in line else None
                rows.append((method, *map(_entry, line), "" if len(line) < 2 else fixed(factor, 2)))
            head = ("method", *(f"{1e3 * readout:g} ms" for readout in readouts), "most / least")
            title = f"{entry.name}, exposure {1e3 * exposure:g} ms: {quantity.title}, {quantity.unit}, by readout"
            tables.append(Table(head, tuple(rows), title))
    return tables


def sweep_notes(result: SweepResult) -> list[str]:
    """What has to be said about the figures, one line each."""
    noise = result.config.noise
    frames = sorted({*result.frames.values()})
    over = f"{frames[0]} frames" if len(frames) == 1 else f"{frames[0]} to {frames[-1]} frames"
    noisy = f"noise (depth {noise.depth:g} z² m, grey values {noise.intensity:g})"
    lines = [f"RMSE over {over}, one seed of {noisy}: no intervals"]
    if noise.seeds > 1:
        lines = [
            f"RMSE over {over}; geometric mean over {noise.seeds} seeds of {noisy}, in brackets its "
            f"{100 * CONFIDENCE:.0f} % interval: what other noise would change, not what another motion would"
        ]
    some = [p for p in points_of(result) if p.lost]
    if some:
        lost = ", ".join(f"{p.method} on {p.case.name} {p.lost} of {p.lost + len(p.values)}" for p in some)
        lines.append(f"† lost or failed (poses for fewer than half of the frames): {lost}")
    errors: dict[str, int] = {}
    for cells in result.cells.values():
        for cell in cells:
            if cell.error is not None:
                errors[f"{cell.method}: {cell.error}"] = errors.get(f"{cell.method}: {cell.error}", 0) + 1
    lines += [f"failed, {count} cells: {error}" for error, count in errors.items()]
    if result.lacking:
        lines.append(f"left out, not installed: {', '.join(result.lacking)} (pip install '.[peers]')")
    if result.interrupted:
        lines.append("not run yet (-): the same command goes on where this one ended")
    m = result.machine
    lines.append(f"version {result.version}; {m.get('cpu')}, {m.get('cpu_count')} CPUs, {m.get('system')}")
    return lines


# ---------------------------------------------------------------------------------------------------------------------


def _is_at(point: Point, motion: str, exposure_s: float, readout_s: float, method: str) -> bool:
    case = point.case
    return (case.motion, case.exposure_s, case.readout_s, point.method) == (motion, exposure_s, readout_s, method)


def _entry(point: Point | None) -> Entry:
    if point is None:
        return Entry(NOTHING)
    if point.mean is None:
        return Entry("lost")
    scale = QUANTITIES[0].scale
    text = significant(point.mean, 3, scale)
    if point.low is not None:
        text += f" [{significant(point.low, 2, scale)}, {significant(point.high, 2, scale)}]"
    return Entry(text, mark="†" if point.lost else "")


def _records(points: dict[str, list[Point]]) -> list[dict[str, Any]]:
    records: dict[tuple[Case, str], dict[str, Any]] = {}
    for name, found in points.items():
        for p in found:
            case = p.case
            first = {
                "motion": case.motion, "readout_s": case.readout_s, "exposure_s": case.exposure_s, "method": p.method,
                "seeds": len(p.values), "lost": p.lost,
            }  # fmt: skip
            record = records.setdefault((case, p.method), first)
            record |= {name: p.mean, f"{name}_low": p.low, f"{name}_high": p.high}
    return list(records.values())


def _cell_records(result: SweepResult) -> list[dict[str, Any]]:
    return [
        {"sequence": c.sequence, "method": c.method, "frames": c.frames, "lost": c.lost, "error": c.error}
        | {quantity.name: c.figure(quantity.metric) for quantity in QUANTITIES}
        | {"seconds": c.seconds}
        for cells in result.cells.values()
        for c in cells
    ]
