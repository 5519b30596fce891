"""The reports of a benchmark and of a blur stress test.

A benchmark's has tables beside the paper's, bars, and every sequence's paths and errors. A stress test's has what the
weights gain by exposure and speed, one keyframe, depth and tracking.
"""

from __future__ import annotations

from pathlib import Path

from rsgen.console.progress import Progress, no_progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rstrack.bench.experiments.method_tables import notes, sequence_table
from rstrack.bench.experiments.methods import AVERAGE, RESULTS, Results, read_results
from rstrack.bench.experiments.pictures import ate_chart, read_picture, shown_runs
from rstrack.bench.experiments.stress import PATHS, StressResult, read_stress
from rstrack.bench.experiments.stress_results import (
    color_charts,
    color_tables,
    depth_tables,
    tracking_chart,
    tracking_table,
)
from rstrack.bench.figures import figure_of
from rstrack.bench.measures.blur import PANELS, read_panels
from rstrack.bench.tables import ERRORS
from rstrack.charts.runs import compared_errors, path_chart
from rstrack.data.dataset import open_dataset
from rstrack.metrics.run_evaluate import Tracked
from rstrack.report.page import (
    Block,
    Card,
    CardRow,
    Chooser,
    ImageRow,
    Note,
    Page,
    PageImage,
    PageSection,
    Plot,
    Slider,
    number,
    plots,
)
from rstrack.report.pictures import frame_panels, jpeg_uri, map_pictures, shutter_sliders

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

# σ of the headline in px: the paper's.
_SIGMA_PX = 1.0


def bench_page(folder: Path, progress: Progress = no_progress) -> Page:
    """Gather everything about a benchmark's folder; sequences that are gone are left out, with a warning.

    progress: called with a stage, the fraction done and a note. Raises UserError.
    """
    results = read_results(folder / RESULTS)
    warnings: list[str] = []
    sections = [PageSection("tables", "Results", _tables(results))]
    sections.append(PageSection("bars", "At a glance", (Plot(ate_chart(results)),)))
    paths, images = _sequences(folder, results, warnings, progress)
    if paths:
        sections.append(PageSection("sequences", "Sequence by sequence", (Chooser("Sequence", paths),)))
    if images:
        sections.append(PageSection("images", "Images", (Chooser("Sequence", images),)))
    if maps := _maps(folder, results, warnings):
        sections.append(PageSection("maps", "Maps", (Note(_MAPS), Chooser("Sequence", maps))))
    sections.append(PageSection("speed", "Speed", (_speed(results),)))
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


def stress_page(folder: Path) -> Page:
    """Gather everything about the folder of a stress test; pictures that are gone are left out, with a warning.

    Raises UserError: its tables cannot be read.
    """
    result = read_stress(folder)
    warnings: list[str] = []
    sections = []
    if has_color := any(map(result.fused, PATHS)):
        sections.append(PageSection("color", "Fused colour against the sharp view", _color(result)))
    try:
        if result.panels is not None and result.pictured is not None:
            pictures = _pictures(folder / result.panels, result.pictured.label)
            sections.append(PageSection("keyframe", "One keyframe", pictures))
    except UserError as error:
        warnings.append(f"No pictures: {error}.")
    if depth := depth_tables(result):
        sections.append(PageSection("depth", "Depth of the keyframes", tuple(depth)))
    sections.append(PageSection("tracking", "Tracking", _tracking(result)))
    return Page(
        title="Blur stress test",
        subtitle=_subtitle(result),
        cards=(_blur_cards(result),) if has_color else (),
        sections=tuple(sections),
        facts=(("motion", result.motion),),
        warnings=(*warnings, *result.failed),
    )


# ---------------------------------------------------------------------------------------------------------------------


def _subtitle(result: StressResult) -> str:
    exposures = sorted({1e3 * cell.exposure_s for cell in result.cells})
    speeds = [f"{speed:g}×" for speed in sorted({cell.speed for cell in result.cells})]
    among = f"exposures of {', '.join(f'{ms:g}' for ms in exposures)} ms"
    return f"One motion with {among}" + (f", at {', '.join(speeds)} speed" if len(speeds) > 1 else "")


def _blur_cards(result: StressResult) -> CardRow:
    """The sequence of the longest exposure at the motion's own speed."""
    poses = next(poses for poses in PATHS if result.fused(poses))
    cell = min(result.fused(poses), key=lambda cell: (cell.speed != 1.0, -cell.exposure_s))
    sigmas, cards = [sigma for sigma in cell.sigmas_px if sigma is not None], []
    if sigmas:
        sigma = min(sigmas, key=lambda s: abs(s - _SIGMA_PX))
        psnr = [fixed(cell.score("psnr_db", poses, s), 2) for s in (None, sigma)]
        note = f"{psnr[0]} dB with constant weights, {psnr[1]} dB with σ = {sigma:g} px"
        gain = fixed(cell.gain_db(poses, sigma), 2, sign="+")
        cards.append(Card(f"{gain} dB", "fused colour, gain of blur-aware weights (PSNR)", note))
    single, fused = (cell.figures.get(f"{what}_mm_{poses}") for what in ("single", "fused"))
    if fused is not None:
        note = f"{fixed(single, 2)} mm in one frame"
        cards.append(Card(f"{fixed(fused, 2)} mm", "depth of fused keyframes (RMSE)", note))
    first, *others = [(other.figures.get("ate_mm"), other.variant) for other in result.cells if other.case == cell.case]
    note = "; ".join(f"{fixed(ate_mm, 2)} mm: {variant}" for ate_mm, variant in others)
    cards.append(Card(f"{fixed(first[0], 2)} mm", "position error of the tracker (ATE, RMSE)", note))
    return CardRow(tuple(cards), f"{cell.label} exposure, {PATHS[poses]}")


def _color(result: StressResult) -> tuple[Block | Chooser, ...]:
    options: list[tuple[str, tuple[Block, ...]]] = [
        (name, (*plots(color_charts(result, poses)), *color_tables(result, poses)))
        for poses, name in PATHS.items()
        if result.fused(poses)
    ]
    text = (
        "Colour of all frames fused into keyframes, each pixel of a frame weighted by exp(−blur/σ²), equation (13), "
        "or all alike, and compared with the sharp image from the keyframe's pose. Green: the best of its row."
    )
    return Note(text), Chooser("Frames registered along the", tuple(options))


def _tracking(result: StressResult) -> tuple[Block, ...]:
    note = Note(
        "Where in a line's exposure the photometric term takes its pose, and whether it weights pixels by their blur. "
        "Each folder in cells/ has a page of its own: rstrack report FOLDER."
    )
    table, chart = tracking_table(result), tracking_chart(result)
    return (table, note, Plot(chart)) if chart.lines else (table, note)


def _pictures(folder: Path, label: str) -> tuple[Block, ...]:
    panels = read_panels(folder)
    if panels is None:
        raise UserError(f"{folder}: is not there")
    images, at = panels.images(folder), f"frame {panels.keyframe} of the sequence {label}"
    captions = (
        "the frame that counts least of those fused, registered", f"its weights (white: {number(panels.white)})",
        "fused with constant weights", "fused with blur-aware weights", "sharp view",
    )  # fmt: skip
    shown = [(images[name], what) for name, what in zip(PANELS, captions, strict=True)]
    items = [PageImage(jpeg_uri(image), f"{what[0].upper()}{what[1:]}", f"{what}, {at}") for image, what in shown]
    return (
        Note(f"The keyframe that gains most: {at}. Black: not known."),
        ImageRow(tuple(items)),
        Slider(
            "Constant against blur-aware weights",
            PageImage(items[2].uri, "constant weights", f"constant weights, {at}"),
            PageImage(items[3].uri, "blur-aware weights", f"blur-aware weights, {at}"),
        ),
    )
