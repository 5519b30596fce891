"""The report of a benchmark: tables beside the paper's, bars, and every sequence's paths and errors."""

from __future__ import annotations

from pathlib import Path

from rsgen.console.progress import Progress, no_progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rstrack.bench.methods.mesh_pictures import read_picture
from rstrack.bench.methods.plots import ate_chart, shown_runs
from rstrack.bench.methods.results import AVERAGE, RESULTS, Results, read_results
from rstrack.bench.methods.tables import notes, sequence_table
from rstrack.bench.tables.figures import figure_of
from rstrack.bench.tables.shown import ERRORS
from rstrack.charts.runs import compared_errors, path_chart
from rstrack.data.dataset import open_dataset
from rstrack.metrics.tracked import Tracked
from rstrack.report.page import Block, Card, CardRow, Chooser, Note, Page, Plot, Section
from rstrack.report.pictures import frame_panels, map_pictures, shutter_sliders
from rstrack.report.run import number, plots

OURS = "rs-pg"
_TITLES = {
    "ate_mm": "position error (ATE)", "drift_mm_s": "drift in translation", "drift_deg_s": "drift in rotation",
}  # fmt: skip

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


def bench_page(folder: Path, progress: Progress = no_progress) -> Page:
    """Gather everything about a benchmark's folder; sequences that are gone are left out, with a warning.

    progress: called with a stage, the fraction done and a note. Raises UserError.
    """
    results = read_results(folder / RESULTS)
    warnings: list[str] = []
    sections = [Section("tables", "Results", _tables(results))]
    sections.append(Section("bars", "At a glance", (Plot(ate_chart(results)),)))
    paths, images = _sequences(folder, results, warnings, progress)
    if paths:
        sections.append(Section("sequences", "Sequence by sequence", (Chooser("Sequence", paths),)))
    if images:
        sections.append(Section("images", "Images", (Chooser("Sequence", images),)))
    if maps := _maps(folder, results, warnings):
        sections.append(Section("maps", "Maps", (Note(_MAPS), Chooser("Sequence", maps))))
    sections.append(Section("speed", "Speed", (_speed(results),)))
    return Page(
        title="Tracking benchmark",
        subtitle=", ".join(
            _counted(len(what), noun)
            for what, noun in ((results.sequences, "sequence"), (results.methods, "method"), (results.records, "run"))
        ),
        cards=_cards(results),
        sections=tuple(sections),
        warnings=tuple(warnings),
    )


# ---------------------------------------------------------------------------------------------------------------------


def _shown(results: Results) -> str:
    """The method in the headlines: ours if it was run."""
    return OURS if OURS in results.methods or not results.methods else results.methods[-1]


def _cards(results: Results) -> tuple[CardRow, ...]:
    rows, method = [], _shown(results)
    for group in results.groups if results.methods else ():
        ours, theirs = results.average(group, method).figures, results.theirs(group, AVERAGE, method)
        cards = []
        for name in ERRORS:
            unit = figure_of(name).unit
            note = f"paper: {number(theirs[name])} {unit}" if theirs else ""
            cards.append(Card(f"{number(ours.get(name))} {unit}", _TITLES[name], note))
        over = _counted(len(results.averaged(group)), "sequence")
        rows.append(CardRow(tuple(cards), f"{method}, {group}: average of {over}"))
    return tuple(rows)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


def _tables(results: Results) -> tuple[Block, ...]:
    tables = [sequence_table(results, group, name) for name in ERRORS for group in results.groups]
    note = "Green: the best of its row. Small print: the paper's figure. ▲: worse than that."
    return (*tables, Note(note), *(Note(text) for text in notes(results)))


def _speed(results: Results) -> Table:
    """Milliseconds a frame, reading included."""
    rows = []
    for entry in results.sequences:
        found = [results.record(entry.name, method) for method in results.methods]
        seconds = [None if record is None else record.figures.get("total_s") for record in found]
        texts = [fixed(None if value is None else value / entry.frames, 0, 1e3) for value in seconds]
        rows.append((f"{entry.name}, {entry.frames} frames", *texts))
    return Table(("ms a frame", *results.methods), tuple(rows), "Time of the whole run divided by its frames, ms")


def _sequences(
    folder: Path, results: Results, warnings: list[str], progress: Progress
) -> tuple[tuple[tuple[str, tuple[Block, ...]], ...], tuple[tuple[str, tuple[Block, ...]], ...]]:
    """For each sequence its plots, and its pictures; what cannot be read goes into the warnings."""
    charts, images = [], []
    for k, entry in enumerate(results.sequences):
        progress("reading runs", k / len(results.sequences), entry.name)
        try:
            dataset = open_dataset(entry.path)
        except UserError as error:
            warnings.append(f"No plots and images of {entry.name}: {error}.")
            continue
        runs = shown_runs(results, entry, folder, dataset, warnings.append)
        if runs:
            charts.append((entry.name, _sequence_plots(runs)))
        best = runs.get(_shown(results)) or next(iter(runs.values()), None)
        if best is not None:
            try:
                blocks = (*frame_panels(best, dataset, _PANEL_WIDTH), *shutter_sliders(best, dataset, _IMAGE_WIDTH))
                images.append((entry.name, blocks))
            except UserError as error:
                warnings.append(f"No images of {entry.name}: {error}.")
    progress("reading runs", 1.0, "")
    return tuple(charts), tuple(images)


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


def _sequence_plots(runs: dict[str, Tracked]) -> tuple[Block, ...]:
    has_truth = any(run.truth is not None for run in runs.values())
    shown = {method: run for method, run in runs.items() if run.found is not None or not has_truth}
    if not shown:
        return (Note("No run of this sequence can be compared with the truth.", is_warning=True),)
    errors = [compared_errors(shown)] if has_truth else []
    return plots([path_chart(shown), *errors], _POINTS)
