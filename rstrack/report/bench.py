"""The report of a benchmark: tables beside the paper's, bars, and every sequence's paths and errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rstrack.bench.methods.mesh_pictures import read_picture
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.report.data import Tracked, load_run, true_path
from rstrack.report.figures import TRUE_COLOR, Curve, Path3D, bars, method_colors, over_time, path_3d
from rstrack.report.page import Block, Card, CardRow, Cell, Chooser, Note, Page, Plot, Section, Table
from rstrack.report.pictures import frame_panels, map_pictures, shutter_sliders
from rstrack.report.results import RESULTS, CellEntry, Figures, Results, read_results
from rstrack.report.run import number

OURS, BASELINE = "rs-pg", "baseline"

# Points of a path or curve, of which a page holds a hundred or so.
_POINTS = 350
_IMAGE_WIDTH, _PANEL_WIDTH, _MAP_WIDTH = 480, 300, 480

_MAPS = (
    "What depth and colour add up to along each method's own path, as rstrack map fuses them, seen from above, through "
    "ceiling and nearer walls. rs: every line is put where the camera was when it was read. gs and baseline take the "
    "shutter for a global one: where that shows, walls and floors bend and double, edges fray, and what is on them "
    "blurs. Maps are aligned as for the ATE, by the camera's positions alone, so that after a short path one may be "
    "tilted as a whole."
)


@dataclass(frozen=True)
class _Quantity:
    """name: in results.json; scale: from there to the unit."""

    name: str
    title: str
    unit: str
    scale: float

    def of(self, entry: Any) -> float | None:
        value: float | None = getattr(entry, self.name)
        return value


_QUANTITIES = (
    _Quantity("ate_m", "position error (ATE)", "mm", 1e3),
    _Quantity("rpe_m_s", "drift in translation", "mm/s", 1e3),
    _Quantity("rpe_deg_s", "drift in rotation", "°/s", 1.0),
)


def bench_page(folder: Path, progress: Progress = no_progress) -> Page:
    """Gather everything about a benchmark's folder; sequences that are gone are left out, with a warning.

    progress: called with a stage, the fraction done and a note. Raises UserError.
    """
    results = read_results(folder / RESULTS)
    groups = tuple(dict.fromkeys(entry.group for entry in results.sequences))
    warnings: list[str] = []
    sections = [Section("tables", "Results", tuple(_tables(results, groups)))]
    sections.append(Section("bars", "At a glance", (_bars(results),)))
    paths, images = _sequences(folder, results, warnings, progress)
    if paths:
        sections.append(Section("sequences", "Sequence by sequence", (Chooser("Sequence", paths),)))
    if images:
        sections.append(Section("images", "Images", (Chooser("Sequence", images),)))
    if maps := _maps(folder, results, warnings):
        sections.append(Section("maps", "Maps", (Note(_MAPS), Chooser("Sequence", maps))))
    sections.append(Section("speed", "Speed", (_speed(results),)))
    machine = results.machine
    if isinstance(machine, dict):
        machine = ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in machine.items())
    facts = [("machine", str(machine or "")), ("version", results.version)]
    return Page(
        title="Tracking benchmark",
        subtitle=", ".join(
            _counted(len(what), noun)
            for what, noun in ((results.sequences, "sequence"), (results.methods, "method"), (results.cells, "run"))
        ),
        cards=_cards(results, groups),
        sections=tuple(sections),
        facts=tuple(fact for fact in facts if fact[1]),
        warnings=tuple(warnings),
    )


# ---------------------------------------------------------------------------------------------------------------------


def _names(results: Results, group: str) -> list[str]:
    return [entry.name for entry in results.sequences if entry.group == group]


def _shown(results: Results) -> str:
    """The method in the headlines: ours if it was run."""
    return OURS if OURS in results.methods or not results.methods else results.methods[-1]


def _cards(results: Results, groups: Sequence[str]) -> tuple[CardRow, ...]:
    rows, method = [], _shown(results)
    for group in groups:
        mean, cards = results.average(group, method), []
        for q in _QUANTITIES:
            theirs = results.paper_average(mean.sequences, method, q.name)
            note = "" if theirs is None else f"paper: {number(theirs, q.scale)} {q.unit}"
            cards.append(Card(f"{number(q.of(mean), q.scale)} {q.unit}", q.title, note))
        of = _counted(len(mean.sequences), "sequence")
        rows.append(CardRow(tuple(cards), f"{method}, {group}: average of {of}"))
    return tuple(rows)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


def _tables(results: Results, groups: Sequence[str]) -> list[Block]:
    blocks: list[Block] = [_table(results, group, quantity) for quantity in _QUANTITIES for group in groups]
    blocks.append(
        Note("Green: the best of its row. Small print: the paper's figure, measured on its own recordings and "
             "renderings of such motions, in other rooms. ▲: worse than that.")
    )  # fmt: skip
    return blocks


def _table(results: Results, group: str, q: _Quantity) -> Table:
    cells = {(cell.sequence, cell.method): cell for cell in results.cells}
    paper = {(figures.sequence, figures.method): q.of(figures) for figures in results.paper}
    rows: list[tuple[Cell | str, ...]] = []
    for name in _names(results, group):
        ours = [cells.get((name, method)) for method in results.methods]
        theirs = [paper.get((name, method)) for method in results.methods]
        values = [None if cell is None else q.of(cell) for cell in ours]
        texts = [_text(cell, q) for cell in ours]
        lost = [cell.lost if cell is not None and cell.error is None else 0 for cell in ours]
        rows.append((name, *_row(values, texts, theirs, q, lost)))
    means = [results.average(group, method) for method in results.methods]
    over = len(means[0].sequences) if means else 0
    values = [q.of(mean) for mean in means]
    theirs = [results.paper_average(mean.sequences, mean.method, q.name) for mean in means]
    texts = [number(value, q.scale) for value in values]
    rows.append((Cell("average", f"of {over} of {len(rows)}"), *_row(values, texts, theirs, q, [0] * len(means))))
    better = [mean.better_pct.get(q.name) for mean in means]
    if any(better):
        rows.append(("better than baseline by", *("–" if not b else f"{b:.3g} %" for b in better)))
    return Table((group, *results.methods), tuple(rows), f"{group[0].upper()}{group[1:]}: {q.title}, {q.unit}, RMSE")


def _text(cell: CellEntry | None, q: _Quantity) -> str:
    if cell is None or q.of(cell) is not None:
        return number(None if cell is None else q.of(cell), q.scale)
    return "failed" if cell.error is not None else "lost" if cell.lost else "–"


def _row(
    values: Sequence[float | None], texts: Sequence[str], theirs: Sequence[float | None], q: _Quantity,
    lost: Sequence[int],
) -> list[Cell]:  # fmt: skip
    found = [value for value in values if value is not None]
    best = min(found) if len(found) > 1 else None
    row = []
    for value, text, paper, n in zip(values, texts, theirs, lost, strict=True):
        notes = ([] if paper is None else [f"paper {number(paper, q.scale)}"]) + ([f"{n} lost"] if n else [])
        is_worse = value is not None and paper is not None and value > paper
        row.append(Cell(text, ", ".join(notes), value is not None and value == best, is_worse))
    return row


def _bars(results: Results) -> Plot:
    colors, names = method_colors(results.methods), [entry.name for entry in results.sequences]

    def column(figures: Sequence[Figures], method: str) -> list[float | None]:
        found = {f.sequence: f.ate_m for f in figures if f.method == method}
        return [None if (v := found.get(name)) is None else 1e3 * v for name in names]

    series = [(method, colors[method], column(results.cells, method)) for method in results.methods]
    theirs = {figures.method for figures in results.paper}
    marks = [
        (f"{method}, paper", colors[method], column(results.paper, method))
        for method in results.methods
        if method in theirs
    ]
    note = "Logarithmic. Diamonds: the paper's figures for the method of that colour, in its own rooms."
    return Plot(
        "ATE by sequence and method, mm", bars(names, series, "ATE, mm", marks), note if marks else "Logarithmic."
    )


def _speed(results: Results) -> Table:
    """Milliseconds a frame, reading included."""
    rows = []
    cells = {(cell.sequence, cell.method): cell for cell in results.cells}
    for entry in results.sequences:
        found = [cells.get((entry.name, method)) for method in results.methods]
        texts = [
            "–" if cell is None or not cell.seconds or not cell.frames else f"{1e3 * cell.seconds / cell.frames:.0f}"
            for cell in found
        ]
        rows.append((f"{entry.name}, {entry.frames} frames", *texts))
    return Table(("ms a frame", *results.methods), tuple(rows), "Time of the whole run divided by its frames, ms")


def _sequences(
    folder: Path, results: Results, warnings: list[str], progress: Progress
) -> tuple[tuple[tuple[str, tuple[Block, ...]], ...], tuple[tuple[str, tuple[Block, ...]], ...]]:
    """For each sequence its plots, and its pictures; what cannot be read goes into the warnings."""
    colors, plots, images = method_colors(results.methods), [], []
    for k, entry in enumerate(results.sequences):
        progress("reading runs", k / len(results.sequences), entry.name)
        try:
            dataset = open_dataset(Path(entry.path))
        except UserError as error:
            warnings.append(f"No plots and images of {entry.name}: {error}.")
            continue
        runs = _runs(folder, results, entry.name, dataset, warnings)
        if runs:
            plots.append((entry.name, _sequence_plots(runs, colors)))
        best = runs.get(_shown(results)) or next(iter(runs.values()), None)
        if best is not None:
            try:
                blocks = (*frame_panels(best, dataset, _PANEL_WIDTH), *shutter_sliders(best, dataset, _IMAGE_WIDTH))
                images.append((entry.name, blocks))
            except UserError as error:
                warnings.append(f"No images of {entry.name}: {error}.")
    progress("reading runs", 1.0, "")
    return tuple(plots), tuple(images)


def _maps(folder: Path, results: Results, warnings: list[str]) -> tuple[tuple[str, tuple[Block, ...]], ...]:
    """For each sequence that has a picture of meshes its maps."""
    maps: list[tuple[str, tuple[Block, ...]]] = []
    for entry in results.sequences:
        picture = read_picture(folder, entry.name)
        if picture is not None:
            try:
                maps.append((entry.name, map_pictures(picture, _MAP_WIDTH)))
            except UserError as error:
                warnings.append(f"No maps of {entry.name}: {error}.")
    return tuple(maps)


def _runs(
    folder: Path, results: Results, name: str, dataset: Dataset, warnings: list[str]
) -> dict[str, Tracked]:  # fmt: skip
    """The runs of a sequence by method, in the order of the methods."""
    runs = {}
    for method in results.methods:
        for cell in results.cells:
            if (cell.sequence, cell.method) == (name, method) and cell.error is None:
                try:
                    runs[method] = load_run(folder / cell.run, dataset=dataset)
                except UserError as error:
                    warnings.append(f"No plots of {method} on {name}: {error}.")
    return runs


def _sequence_plots(runs: dict[str, Tracked], colors: dict[str, str]) -> tuple[Block, ...]:
    truth = next((run.truth for run in runs.values() if run.truth is not None), None)
    shown = {method: run for method, run in runs.items() if truth is None or run.found is not None}
    paths = []
    if truth is not None and shown:
        times = np.concatenate([run.estimate.stamps for run in shown.values()])
        paths.append(Path3D("true", TRUE_COLOR, *true_path(truth, times.min(), times.max())))
    paths += [Path3D(method, colors[method], *run.path) for method, run in shown.items()]
    if not shown:
        return (Note("No run of this sequence can be compared with the truth.", is_warning=True),)
    note = "Drag to turn; a click on a name hides its path. Paths that leave the true one far behind are cut off."
    blocks: list[Block] = [Plot("Paths", path_3d(paths, _POINTS, with_times=False), note)]
    curves = [
        Curve(method, colors[method], run.estimate.stamps[run.found.index], 1e3 * run.found.position_errors_m)
        for method, run in shown.items()
        if run.found is not None
    ]
    if curves:
        figure = over_time(curves, "mm", _POINTS)
        figure["layout"]["yaxis"] |= {"type": "log", "dtick": 1}
        blocks.append(Plot("Position error after alignment, mm", figure, "Logarithmic."))
    return tuple(blocks)
