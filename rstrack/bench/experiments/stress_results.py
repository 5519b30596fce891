"""What the blur stress test found: tables, charts and files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsgen.console.progress import Progress
from rsgen.console.tables import Entry, Table, fixed
from rstrack.bench.cells import Benchmark
from rstrack.bench.experiments.stress import (
    PATHS,
    STRESS,
    StressCell,
    StressOptions,
    StressResult,
    stress_benchmark,
    stress_result,
)
from rstrack.bench.measures.blur import read_panels
from rstrack.bench.record import CellRecord, write_records
from rstrack.bench.runner import Outcome, Written
from rstrack.bench.tables import pivot, provenance, write_tables
from rstrack.bench.task import Sources
from rstrack.charts.chart import COLORS, TRUE_COLOR, Chart, Curve, numbers
from rstrack.charts.to_file import write_charts

# What a score is, its digits after the point, and the value that none is better than.
_SCORES = (
    ("psnr_db", "PSNR, dB: mean over the keyframes; small print: gain over constant weights", 2, math.inf),
    ("psnr_db_least", "PSNR of the worst keyframe, dB", 2, math.inf),
    ("ssim", "Structural similarity (SSIM)", 4, 1.0),
    ("gradient", "Gradient energy over that of the sharp view", 3, 1.0),
)
_Value = Callable[["StressCell", float | None], float | None]


def color_tables(result: StressResult, poses: str) -> list[Table]:
    """The fused colour's scores: a row for each sequence, a column for each σ; none without keyframes."""
    cells = {cell.label: cell for cell in result.fused(poses)}
    sigmas = {weights_name(sigma): sigma for sigma in result.sigmas_px}
    return [_color_table(cells, sigmas, poses, *score) for score in (_SCORES if cells else ())]


def _color_table(
    cells: Mapping[str, StressCell], sigmas: Mapping[str, float | None], poses: str, score: str, title: str,
    digits: int, ideal: float,
) -> Table:  # fmt: skip
    def value(label: str, weights: str) -> float | None:
        return cells[label].score(score, poses, sigmas[weights])

    def entry(label: str, weights: str) -> Entry:
        gain = cells[label].gain_db(poses, sigmas[weights]) if score == "psnr_db" else None
        return Entry(fixed(value(label, weights), digits), note="" if gain is None else fixed(gain, 2, sign="+"))

    def head(label: str) -> Entry:
        count = f"{cells[label].figures[f'keyframes_{poses}']:.0f} keyframe"
        return Entry(label, note=count + "s" * (count != "1 keyframe") if score == "psnr_db" else "")

    title = f"{title}; {PATHS[poses]}"
    return pivot("sequence", list(cells), list(sigmas), entry, value, title, name=head, ideal=ideal, by_row=True)


def depth_tables(result: StressResult) -> list[Table]:
    """Depth errors of one frame and of the fused ones, a table for each path that has some."""
    tables = []
    for poses, name in PATHS.items():
        rows = []
        for cell in result.cells:
            single, fused = (cell.figures.get(f"{what}_mm_{poses}") for what in ("single", "fused"))
            if fused is not None:
                ratio = fused / single if single else None
                rows.append((cell.label, fixed(single, 2), fixed(fused, 2), fixed(ratio, 2)))
        if rows:
            head = ("sequence", "one frame, mm", "fused, mm", "ratio")
            tables.append(Table(head, tuple(rows), f"Depth against the noise-free depth, RMSE, {name}"))
    return tables


def tracking_table(result: StressResult) -> Table:
    """The tracker's errors: a row for each sequence, a column for each photometric term."""
    found = {(cell.label, cell.variant): cell.figures for cell in result.cells}
    labels, variants = (list(dict.fromkeys(getattr(c, name) for c in result.cells)) for name in ("label", "variant"))

    def value(*at: str) -> float | None:
        return found.get((at[0], at[1]), {}).get("ate_mm")

    def entry(*at: str) -> Entry:
        run = found.get((at[0], at[1]), {})
        drift = [f"{fixed(run['drift_mm_s'], 2)} mm/s"] if "drift_mm_s" in run else []
        lost = [f"{run['lost']:.0f} lost"] if run.get("lost") else []
        return Entry(fixed(value(*at), 2), note=", ".join(drift + lost))

    title = "Position error (ATE, RMSE), mm; small print: drift a second, lost frames"
    return pivot("sequence", labels, variants, entry, value, title, by_row=True)


def csv_rows(result: StressResult) -> list[dict[str, Any]]:
    """One a cell, with all its figures."""
    names = dict.fromkeys(name for cell in result.cells for name in cell.figures)
    return [
        {"sequence": c.case, "speed": c.speed, "exposure_s": c.exposure_s, "variant": c.variant}
        | {name: c.figures.get(name) for name in names} | {"error": c.record.error}
        for c in result.cells
    ]  # fmt: skip


def weights_name(sigma_px: float | None) -> str:
    """What the weights of a σ are called; None: constant ones."""
    return "constant" if sigma_px is None else f"σ {sigma_px:g} px"


@dataclass(frozen=True)
class StressExperiment:
    """One motion at several exposures and speeds; constant against blur-aware weights."""

    config: Path
    options: StressOptions

    def benchmark(self, sources: Sources, progress: Progress) -> Benchmark:
        """See `stress_benchmark`."""
        return stress_benchmark(self.config, sources, self.options, progress)

    def write(self, outcome: Outcome, out: Path) -> Written:
        """See `Experiment`."""
        result, text = write_stress(outcome.records.values(), out)
        files = "stress.txt, .md, .csv, .json, .png, panels.png and cells/MEASURE/CASE/METHOD"
        return Written(text, files, not result.failed)

    def draw(self, outcome: Outcome, out: Path, progress: Progress, warn: Callable[[str], None]) -> None:
        """See `Experiment`."""
        draw_stress(stress_result(outcome.records.values()), out)


def write_stress(records: Iterable[CellRecord], out: Path) -> tuple[StressResult, str]:
    """Write stress.json (the records), stress.txt, .md and .csv; returns the text too. Raises UserError."""
    records = tuple(records)
    result = stress_result(records)
    write_records(out / STRESS, records)
    color = [table for poses in PATHS for table in color_tables(result, poses)]
    tables = [*color, *depth_tables(result), tracking_table(result)]
    about = f"blur stress test of {result.motion}: colour against the sharp view, means over keyframes"
    notes = [about, *result.failed, provenance(cell.record for cell in result.cells)]
    return result, write_tables(out, tables, notes, csv_rows(result), "stress")


def draw_stress(result: StressResult, out: Path) -> None:
    """Write stress.png and, of one keyframe, panels.png. Raises UserError."""
    title = f"{result.motion}: fused colour along the true path, and tracking"
    write_charts([*color_charts(result, "true"), tracking_chart(result)], out / "stress.png", title)
    if result.panels is None or (panels := read_panels(out / result.panels)) is None:
        return
    names = (
        "registered blurred input", f"weights (white: {panels.white:.2g})", "constant weights", "blur-aware weights",
        "sharp view (truth)",
    )  # fmt: skip
    from rsgen.figures import save_grid

    save_grid([[image / 255.0 for image in panels.images(out / result.panels).values()]], names, out / "panels.png")


def color_charts(result: StressResult, poses: str) -> list[Chart]:
    """Of the fused colour along the 'true' or 'estimated' path; fewer where only one speed was tested."""
    cells = result.fused(poses)
    slow = [cell for cell in cells if cell.speed == 1.0]
    fast = {cell.exposure_s for cell in cells if cell.speed != 1.0}
    by_speed = [cell for cell in cells if cell.exposure_s in fast]

    def chart(title: str, unit: str, along: Sequence[StressCell], value: _Value, note: str = "") -> Chart:
        x = numbers([cell.speed if along is by_speed else 1e3 * cell.exposure_s for cell in along])
        lines = []
        for k, sigma in enumerate(result.sigmas_px):
            values = [value(cell, sigma) for cell in along]
            if any(v is not None for v in values):
                color = TRUE_COLOR if sigma is None else COLORS[(k - 1) % len(COLORS)]
                lines.append(Curve(weights_name(sigma), color, x, numbers(values), sigma is None, has_points=True))
        x_label = "speed, times" if along is by_speed else "exposure, ms"
        return Chart(title, unit, x_label, tuple(lines), from_zero=False, note=note)

    def gain(cell: StressCell, sigma_px: float | None) -> float | None:
        return cell.gain_db(poses, sigma_px)

    charts = []
    if slow:
        note = "Gain in PSNR of blur-aware over constant weights, at the motion's own speed."
        charts += [chart("Gain by exposure", "dB", slow, gain, note)]
        charts += [chart("PSNR by exposure", "dB", slow, lambda cell, sigma: cell.score("psnr_db", poses, sigma))]
        energy = "Gradient energy by exposure", "of the sharp view's"
        charts += [chart(*energy, slow, lambda cell, sigma: cell.score("gradient", poses, sigma))]
    if fast:
        at = ", ".join(f"{1e3 * exposure:g}" for exposure in sorted(fast))
        note = f"The same path, travelled faster, at {at} ms exposure."
        charts += [chart("Gain by speed", "dB", by_speed, gain, note)]
    return charts


def tracking_chart(result: StressResult) -> Chart:
    """The tracker's position error at the motion's own speed."""
    lines = []
    for k, variant in enumerate(dict.fromkeys(cell.variant for cell in result.cells)):
        mine = [cell for cell in result.cells if cell.variant == variant and cell.speed == 1.0]
        x, y = numbers([cell.exposure_s for cell in mine], 1e3), numbers([c.figures.get("ate_mm") for c in mine])
        if mine:
            lines.append(Curve(variant, COLORS[k % len(COLORS)], x, y, has_points=True))
    return Chart("Position error (ATE) by exposure", "mm", "exposure, ms", tuple(lines), from_zero=False)
