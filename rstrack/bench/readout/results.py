"""What the readout sweep found: for each method and shutter the error over the seeds, with its interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.tables import NOTHING, Entry, Table, fixed, significant
from rstrack.bench.readout.config import SweepConfig
from rstrack.bench.record import Record, write_records
from rstrack.bench.tables.cells import counts
from rstrack.bench.tables.figures import heading
from rstrack.bench.tables.files import failures, provenance, write_tables
from rstrack.bench.tables.shown import ERRORS
from rstrack.charts.chart import Chart, Line, method_colors, numbers
from rstrack.charts.to_file import write_charts

CONFIDENCE = 0.95
_DASHED = "Dashed: the shutter is taken for a global one, or for a lidar's sweep."


@dataclass(frozen=True)
class Sweep:
    """records: in the cells' order, those missing of which an interrupt left none. lacking: methods left out, not being
    installed."""

    config: SweepConfig
    records: tuple[Record, ...]
    lacking: tuple[str, ...] = ()
    interrupted: bool = False

    @property
    def methods(self) -> tuple[str, ...]:
        """In the order of the tables."""
        return tuple(dict.fromkeys(record.method for record in self.records))


@dataclass(frozen=True)
class Point:
    """Of one method with one shutter: errors of the seeds on which it kept the track; lost: seeds without."""

    motion: str
    readout_s: float
    exposure_s: float
    method: str
    values: tuple[float, ...]
    lost: int

    @property
    def interval(self) -> tuple[float | None, float | None, float | None]:
        """Geometric mean, for errors are compared by their ratios, and its ends; see `log_interval`."""
        return log_interval(self.values)


def log_interval(values: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Geometric mean of positive values and its two-sided interval of CONFIDENCE by Student's t, in logarithms.

    None where there are no values; the interval is None too where there is but one.
    """
    from scipy.special import stdtrit

    logs = np.log(np.array([value for value in values if value > 0.0]))
    if not logs.size:
        return None, None, None
    mean = float(logs.mean())
    if logs.size == 1:
        return math.exp(mean), None, None
    half = float(stdtrit(logs.size - 1, 0.5 + 0.5 * CONFIDENCE) * logs.std(ddof=1) / math.sqrt(logs.size))
    return math.exp(mean), math.exp(mean - half), math.exp(mean + half)


def points_of(sweep: Sweep, name: str = "ate_mm") -> list[Point]:
    """Of all records, in their order."""
    found = []
    for record in sweep.records:
        shutter = record.settings["sequence"]["set"]
        at = float(shutter["depth.readout_s"]), float(shutter["depth.exposure_s"])
        values = tuple(v for run in record.runs if counts(run) and (v := run.get(name)) is not None)
        lost = sweep.config.noise.seeds - len(values)
        found.append(Point(record.settings["group"], *at, record.method, values, lost))
    return found


def growth(points: Sequence[Point]) -> float | None:
    """Largest over smallest mean of a method's points, one a readout; None if it was lost at one, or has but one."""
    means = [point.interval[0] for point in points]
    known = [mean for mean in means if mean is not None]
    return max(known) / min(known) if len(known) == len(means) > 1 else None


def write_sweep(sweep: Sweep, out: Path) -> str:
    """Write records.json, results.csv, .md and .txt into `out`; returns the text. Raises UserError."""
    write_records(out / "records.json", sweep.records)
    return write_tables(out, sweep_tables(sweep), sweep_notes(sweep), _rows(sweep))


def sweep_tables(sweep: Sweep) -> list[Table]:
    """A table for each motion and exposure: a row for each method, a column for each readout, and the growth."""
    points = {(p.motion, p.exposure_s, p.method, p.readout_s): p for p in points_of(sweep)}
    readouts = sorted(sweep.config.readouts_s)
    tables = []
    for entry in sweep.config.motions:
        for exposure in sweep.config.exposures_s:
            rows: list[tuple[Entry | str, ...]] = []
            for method in sweep.methods:
                line = [points.get((entry.name, exposure, method, readout)) for readout in readouts]
                factor = growth([p for p in line if p is not None]) if None not in line else None
                rows.append((method, *map(_entry, line), "" if len(line) < 2 else fixed(factor, 2)))
            head = ("method", *(f"{1e3 * readout:g} ms" for readout in readouts), "most / least")
            title = f"{entry.name}, exposure {1e3 * exposure:g} ms: {heading('ate_mm')}, by readout"
            tables.append(Table(head, tuple(rows), title))
    return tables


def sweep_notes(sweep: Sweep) -> list[str]:
    """What has to be said about the figures, one line each."""
    noise = sweep.config.noise
    frames = sorted({int(value) for r in sweep.records for value in r.values("frames")}) or [0]
    over = f"{frames[0]} frames" if len(frames) == 1 else f"{frames[0]} to {frames[-1]} frames"
    noisy = f"noise (depth {noise.depth:g} z² m, grey values {noise.intensity:g})"
    lines = [f"RMSE over {over}, one seed of {noisy}: no intervals"]
    if noise.seeds > 1:
        lines = [
            f"RMSE over {over}; geometric mean over {noise.seeds} seeds of {noisy}, in brackets its "
            f"{100 * CONFIDENCE:.0f} % interval: what other noise would change, not what another motion would"
        ]
    points = zip(sweep.records, points_of(sweep), strict=True)
    some = [f"{r.method} on {r.case} {p.lost} of {p.lost + len(p.values)}" for r, p in points if p.lost]
    if some:
        lines.append(f"† lost or failed (poses for fewer than half of the frames): {', '.join(some)}")
    lines += failures(sweep.records)
    if sweep.lacking:
        lines.append(f"left out, not installed: {', '.join(sweep.lacking)} (pip install '.[peers]')")
    if sweep.interrupted:
        lines.append("not run yet (-): the same command goes on where this one ended")
    return [*lines, provenance(sweep.records)]


def sweep_charts(sweep: Sweep) -> list[Chart]:
    """ATE over readout with its interval: motions, then exposures. Points that are lost are left out."""
    points, colors = points_of(sweep), method_colors(sweep.methods)
    charts = []
    for exposure in sweep.config.exposures_s:
        for entry in sweep.config.motions:
            lines = []
            for method in sweep.methods:
                mine = [p for p in points if (p.motion, p.exposure_s, p.method) == (entry.name, exposure, method)]
                mine.sort(key=lambda p: p.readout_s)
                mean, low, high = (numbers([p.interval[k] for p in mine]) for k in range(3))
                x, is_dashed = numbers([p.readout_s for p in mine], 1e3), method not in ("rs-pg", "rs-g")
                lines.append(Line(method, colors[method], x, mean, is_dashed, True, low, high))
            at = f", exposure {1e3 * exposure:g} ms" if len(sweep.config.exposures_s) > 1 else ""
            title = f"{entry.name}{at}: ATE (RMSE)"
            charts.append(Chart(title, "mm", "readout, ms", tuple(lines), is_log=True, note=_DASHED))
    return charts


def draw_sweep(sweep: Sweep, path: Path) -> None:
    """Write the picture: a panel for each motion and exposure. Raises UserError."""
    write_charts(sweep_charts(sweep), path, "", columns=len(sweep.config.motions), one_legend=True)


# ---------------------------------------------------------------------------------------------------------------------


def _entry(point: Point | None) -> Entry:
    if point is None:
        return Entry(NOTHING)
    mean, low, high = point.interval
    if mean is None:
        return Entry("lost")
    text = significant(mean, 3) + ("" if low is None else f" [{significant(low, 2)}, {significant(high, 2)}]")
    return Entry(text, mark="†" if point.lost else "")


def _rows(sweep: Sweep) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for of_each in zip(*(points_of(sweep, name) for name in ERRORS), strict=True):
        p = of_each[0]
        row: dict[str, Any] = {"motion": p.motion, "readout_s": p.readout_s, "exposure_s": p.exposure_s}
        row |= {"method": p.method, "seeds": len(p.values), "lost": p.lost}
        for name, point in zip(ERRORS, of_each, strict=True):
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), point.interval, strict=True))
        rows.append(row)
    return rows
