"""The report of a blur stress test: what the weights gain by exposure and speed, one keyframe, depth, tracking."""

from __future__ import annotations

from pathlib import Path

from rsgen.console.tables import fixed
from rsgen.errors import UserError
from rstrack.bench.measures.blur import PANELS, read_panels
from rstrack.bench.stress.charts import color_charts, tracking_chart
from rstrack.bench.stress.results import (
    PATHS,
    StressResult,
    color_tables,
    depth_tables,
    read_stress,
    tracking_table,
)
from rstrack.report.images import jpeg_uri
from rstrack.report.page import Block, Card, CardRow, Chooser, Note, Page, Picture, Pictures, Plot, Section, Slider
from rstrack.report.run import number, plots

# σ of the headline in px: the paper's.
_SIGMA_PX = 1.0


def stress_page(folder: Path) -> Page:
    """Gather everything about the folder of a stress test; pictures that are gone are left out, with a warning.

    Raises UserError: its tables cannot be read.
    """
    result = read_stress(folder)
    warnings: list[str] = []
    sections = []
    if has_color := any(map(result.fused, PATHS)):
        sections.append(Section("color", "Fused colour against the sharp view", _color(result)))
    try:
        if result.panels is not None and result.pictured is not None:
            pictures = _pictures(folder / result.panels, result.pictured.label)
            sections.append(Section("keyframe", "One keyframe", pictures))
    except UserError as error:
        warnings.append(f"No pictures: {error}.")
    if depth := depth_tables(result):
        sections.append(Section("depth", "Depth of the keyframes", tuple(depth)))
    sections.append(Section("tracking", "Tracking", _tracking(result)))
    return Page(
        title="Blur stress test",
        subtitle=_subtitle(result),
        cards=(_cards(result),) if has_color else (),
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


def _cards(result: StressResult) -> CardRow:
    """The sequence of the longest exposure at the usual speed."""
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
    items = [Picture(jpeg_uri(image), f"{what[0].upper()}{what[1:]}", f"{what}, {at}") for image, what in shown]
    return (
        Note(f"The keyframe that gains most: {at}. Black: not known."),
        Pictures(tuple(items)),
        Slider(
            "Constant against blur-aware weights",
            Picture(items[2].uri, "constant weights", f"constant weights, {at}"),
            Picture(items[3].uri, "blur-aware weights", f"blur-aware weights, {at}"),
        ),
    )
