"""What the readout sweep found: for each method and shutter the error over the seeds, with its interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.progress import Progress
from rsgen.console.tables import NOTHING, Entry, Table, fixed, significant
from rsgen.errors import how_to_install
from rstrack.bench.cells import Benchmark
from rstrack.bench.experiments.readout import SweepConfig, installed, sweep_benchmark
from rstrack.bench.experiments.run import Written
from rstrack.bench.figures import heading
from rstrack.bench.record import CellRecord, counts, write_records
from rstrack.bench.runner import Outcome
from rstrack.bench.sequences import Sources
from rstrack.bench.tables import ERRORS, failures, pivot, provenance, write_tables
from rstrack.charts.chart import Chart, Curve, method_colors, numbers
from rstrack.charts.to_file import write_charts
from rstrack.options import Options

CONFIDENCE = 0.95
_Methods = dict[str, dict[float, CellRecord]]
_DASHED = "Dashed: the shutter is taken for a global one, or for a lidar's sweep."


@dataclass(frozen=True)
class Sweep:
    """What has been run. records: in the cells' order, those missing of which an interrupt left none. lacking: methods
    left out, not being installed."""

    config: SweepConfig
    records: tuple[CellRecord, ...]
    lacking: tuple[str, ...] = ()
    interrupted: bool = False

    @property
    def methods(self) -> tuple[str, ...]:
        """In the order of the tables."""
        return tuple(dict.fromkeys(record.method for record in self.records))


@dataclass(frozen=True)
class ReadoutExperiment:
    """The sweep with those of its methods that are installed; options: of ours."""

    config: SweepConfig
    options: Options

    def benchmark(self, sources: Sources, progress: Progress) -> Benchmark:
        """See `sweep_benchmark`."""
        return sweep_benchmark(self.config, installed(self.config.methods)[0], self.options)

    def sweep(self, outcome: Outcome) -> Sweep:
        """What has been run of it."""
        lacking = installed(self.config.methods)[1]
        return Sweep(self.config, tuple(outcome.records.values()), lacking, outcome.interrupted)

    def write(self, outcome: Outcome, out: Path) -> Written:
        """See `Experiment`."""
        sweep = self.sweep(outcome)
        is_good = all(r.error is None and all(map(counts, r.runs)) for r in sweep.records)
        files = "results.txt, .md, .csv, records.json, plots/readout.png and cells/track/CASE/METHOD"
        return Written(write_sweep(sweep, out), files, is_good)

    def draw(self, outcome: Outcome, out: Path, progress: Progress, warn: Callable[[str], None]) -> None:
        """A panel for each motion and exposure."""
        charts, path = sweep_charts(self.sweep(outcome)), out / "plots" / "readout.png"
        write_charts(charts, path, "", columns=len(self.config.motions), one_legend=True)


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


def errors(record: CellRecord, name: str = "ate_mm") -> list[float]:
    """Of the seeds on which it kept the track."""
    return [value for run in record.runs if counts(run) and (value := run.get(name)) is not None]


def growth(means: Sequence[float | None]) -> float | None:
    """Largest over smallest of a method's means, one a readout; None if it was lost at one, or has but one."""
    known = [mean for mean in means if mean is not None]
    return max(known) / min(known) if len(known) == len(means) > 1 else None


def write_sweep(sweep: Sweep, out: Path) -> str:
    """Write records.json, results.csv, .md and .txt into `out`; returns the text. Raises UserError."""
    write_records(out / "records.json", sweep.records)
    return write_tables(out, sweep_tables(sweep), sweep_notes(sweep), _rows(sweep))


def sweep_tables(sweep: Sweep) -> list[Table]:
    """A table for each motion and exposure: a row for each method, a column for each readout, and the growth.

    Entries are geometric means, for errors are compared by their ratios.
    """
    readouts, tables = {f"{1e3 * readout:g} ms": readout for readout in sorted(sweep.config.readouts_s)}, []
    for (motion, exposure), methods in _panels(sweep).items():

        def entry(method: str, column: str, methods: _Methods = methods) -> Entry:
            if column in readouts:
                return _entry(sweep, methods[method].get(readouts[column]))
            line = [methods[method].get(readout) for readout in readouts.values()]
            factor = growth([None if r is None else log_interval(errors(r))[0] for r in line])
            return Entry("" if len(line) < 2 else fixed(factor, 2))

        title = f"{motion}, exposure {1e3 * exposure:g} ms: {heading('ate_mm')}, by readout"
        tables.append(pivot("method", list(methods), (*readouts, "most / least"), entry, title=title))
    return tables


def sweep_notes(sweep: Sweep) -> list[str]:
    """What a reader has to know about the figures, one line each."""
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
    some = [f"{r.method} on {r.case} {lost} of {noise.seeds}" for r in sweep.records if (lost := _lost(sweep, r))]
    if some:
        lines.append(f"† lost or failed (poses for fewer than half of the frames): {', '.join(some)}")
    lines += failures(sweep.records)
    if sweep.lacking:
        lines.append(f"left out, not installed: {', '.join(sweep.lacking)} ({how_to_install('peers', 'orbslam3')})")
    if sweep.interrupted:
        lines.append("not run yet (-): the same command goes on where this one ended")
    return [*lines, provenance(sweep.records)]


def sweep_charts(sweep: Sweep) -> list[Chart]:
    """ATE over readout with its interval: motions, then exposures. Points that are lost are left out."""
    charts = []
    order = sweep.config.exposures_s.index
    for (motion, exposure), methods in sorted(_panels(sweep).items(), key=lambda item: order(item[0][1])):
        at = f", exposure {1e3 * exposure:g} ms" if len(sweep.config.exposures_s) > 1 else ""
        charts.append(readout_chart(f"{motion}{at}", methods))
    return charts


def readout_chart(title: str, methods: Mapping[str, Mapping[float, CellRecord]]) -> Chart:
    """ATE of methods by readout (s): geometric mean of the seeds and its interval, as `log_interval` has them."""
    colors, lines = method_colors(list(methods)), []
    for method, found in methods.items():
        mean, low, high = (numbers([log_interval(errors(r))[k] for _, r in sorted(found.items())]) for k in range(3))
        x, is_dashed = numbers(sorted(found), 1e3), method not in ("rs-pg", "rs-g")
        lines.append(Curve(method, colors[method], x, mean, is_dashed, True, low, high))
    return Chart(f"{title}: ATE (RMSE)", "mm", "readout, ms", tuple(lines), is_log=True, note=_DASHED)


# ---------------------------------------------------------------------------------------------------------------------


def _shutter(record: CellRecord) -> tuple[float, float]:
    """Readout and exposure, s."""
    given = record.settings["sequence"]["set"]
    return float(given["depth.readout_s"]), float(given["depth.exposure_s"])


def _panels(sweep: Sweep) -> dict[tuple[str, float], _Methods]:
    """By motion and exposure, then by method and readout."""
    panels: dict[tuple[str, float], _Methods] = {
        (entry.name, exposure): {method: {} for method in sweep.methods}
        for entry in sweep.config.motions
        for exposure in sweep.config.exposures_s
    }
    for record in sweep.records:
        readout, exposure = _shutter(record)
        panels[record.settings["group"], exposure][record.method][readout] = record
    return panels


def _lost(sweep: Sweep, record: CellRecord) -> int:
    """Seeds without an error."""
    return sweep.config.noise.seeds - len(errors(record))


def _entry(sweep: Sweep, record: CellRecord | None) -> Entry:
    if record is None:
        return Entry(NOTHING)
    mean, low, high = log_interval(errors(record))
    if mean is None:
        return Entry("lost")
    text = significant(mean) + ("" if low is None else f" [{significant(low, 2)}, {significant(high, 2)}]")
    return Entry(text, mark="†" if _lost(sweep, record) else "")


def _rows(sweep: Sweep) -> list[dict[str, Any]]:
    rows = []
    for record in sweep.records:
        readout, exposure = _shutter(record)
        row: dict[str, Any] = {"motion": record.settings["group"], "readout_s": readout, "exposure_s": exposure}
        row |= {"method": record.method, "seeds": len(errors(record)), "lost": _lost(sweep, record)}
        for name in ERRORS:
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), log_interval(errors(record, name)), strict=True))
        rows.append(row)
    return rows
