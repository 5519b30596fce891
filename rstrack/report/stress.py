"""The report of a blur stress test: what the weights gain by exposure and speed, one keyframe, depth, tracking."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from rsgen.console.tables import Entry, Table, best_marked, fixed
from rsgen.errors import UserError
from rstrack.bench.measures.blur import PANELS, read_panels
from rstrack.bench.stress.charts import color_charts, tracking_chart
from rstrack.bench.stress.results import (
    ColorScore,
    StressResult,
    gain_db,
    gains_db,
    ratio,
    read_stress,
    weights_name,
)
from rstrack.report.images import jpeg_uri
from rstrack.report.page import Block, Card, CardRow, Chooser, Note, Page, Picture, Pictures, Plot, Section, Slider
from rstrack.report.run import number, plots

# σ of the headline in px: the paper's.
_SIGMA_PX = 1.0
# What a score is, its digits after the point, and the value that none is better than.
_SCORES = (
    ("psnr_db", "PSNR, dB: mean over the keyframes; small print: gain over constant weights", 2, math.inf),
    ("psnr_db_least", "PSNR of the worst keyframe, dB", 2, math.inf),
    ("ssim", "Structural similarity (SSIM)", 4, 1.0),
    ("gradient", "Gradient energy over that of the sharp view", 3, 1.0),
)
_POSES = {"true": "true path", "estimated": "estimated path"}


def stress_page(folder: Path) -> Page:
    """Gather everything about the folder of a stress test; pictures that are gone are left out, with a warning.

    Raises UserError: its tables cannot be read.
    """
    result = read_stress(folder)
    labels = _labels(result)
    warnings: list[str] = []
    sections = []
    if result.color:
        sections.append(Section("color", "Fused colour against the sharp view", _color(result, labels)))
    try:
        if result.panels is not None:
            pictures = _pictures(folder / result.panels, labels[result.panels_case])
            sections.append(Section("keyframe", "One keyframe", pictures))
    except UserError as error:
        warnings.append(f"No pictures: {error}.")
    if result.depth:
        sections.append(Section("depth", "Depth of the keyframes", _depth(result, labels)))
    sections.append(Section("tracking", "Tracking", _tracking(result, labels)))
    return Page(
        title="Blur stress test",
        subtitle=_subtitle(result),
        cards=(_cards(result, labels),) if result.color else (),
        sections=tuple(sections),
        facts=(("motion", result.motion),),
        warnings=(*warnings, *(f"Failed: {line}." for line in result.failed)),
    )


# ---------------------------------------------------------------------------------------------------------------------


def _labels(result: StressResult) -> dict[str, str]:
    """What a sequence is called on the page, by its name."""
    return {
        row.case: f"{1e3 * row.exposure_s:g} ms" + ("" if row.speed == 1.0 else f", {row.speed:g}× speed")
        for row in result.tracking
    }


def _subtitle(result: StressResult) -> str:
    exposures = sorted({1e3 * row.exposure_s for row in result.tracking})
    speeds = [f"{speed:g}×" for speed in sorted({row.speed for row in result.tracking})]
    among = f"exposures of {', '.join(f'{ms:g}' for ms in exposures)} ms"
    return f"One motion with {among}" + (f", at {', '.join(speeds)} speed" if len(speeds) > 1 else "")


def _cards(result: StressResult, labels: dict[str, str]) -> CardRow:
    """The sequence of the longest exposure at the usual speed."""
    first = min(result.color, key=lambda row: (row.poses != "true", row.speed != 1.0, -row.exposure_s))
    case, poses = first.case, first.poses
    sigmas = {row.sigma_px for row in result.color if row.sigma_px is not None}
    cards = []
    if sigmas:
        sigma = min(sigmas, key=lambda s: abs(s - _SIGMA_PX))
        gain = gains_db(result, sigma, poses).get(case)
        found = {row.sigma_px: row.psnr_db for row in result.color if (row.case, row.poses) == (case, poses)}
        psnr = [fixed(found.get(s), 2) for s in (None, sigma)]
        note = f"{psnr[0]} dB with constant weights, {psnr[1]} dB with σ = {sigma:g} px"
        cards.append(Card(f"{fixed(gain, 2, sign='+')} dB", "fused colour, gain of blur-aware weights (PSNR)", note))
    for depth in result.depth:
        if (depth.case, depth.poses) == (case, poses):
            note = f"{fixed(depth.single_mm, 2)} mm in one frame"
            cards.append(Card(f"{fixed(depth.fused_mm, 2)} mm", "depth of fused keyframes (RMSE)", note))
    tracked = [row for row in result.tracking if row.case == case]
    if tracked:
        note = "; ".join(f"{fixed(row.ate_mm, 2)} mm: {row.variant}" for row in tracked[1:])
        cards.append(Card(f"{fixed(tracked[0].ate_mm, 2)} mm", "position error of the tracker (ATE, RMSE)", note))
    return CardRow(tuple(cards), f"{labels[case]} exposure, {_POSES[poses]}")


def _color(result: StressResult, labels: dict[str, str]) -> tuple[Block | Chooser, ...]:
    options: list[tuple[str, tuple[Block, ...]]] = []
    for poses, name in _POSES.items():
        rows = [row for row in result.color if row.poses == poses]
        if rows:
            tables = [_score_table(rows, labels, *score) for score in _SCORES]
            options.append((name, (*plots(color_charts(result, poses)), *tables)))
    text = (
        "Colour of all frames fused into keyframes, each pixel of a frame weighted by exp(−blur/σ²), equation (13), "
        "or all alike, and compared with the sharp image from the keyframe's pose. Green: the best of its row."
    )
    return Note(text), Chooser("Frames registered along the", tuple(options))


def _score_table(
    rows: Sequence[ColorScore], labels: dict[str, str], name: str, title: str, digits: int, ideal: float
) -> Table:
    found = {(row.case, row.sigma_px): row for row in rows}
    sigmas = sorted({row.sigma_px for row in rows}, key=lambda sigma: -1.0 if sigma is None else sigma)
    lines: list[tuple[Entry | str, ...]] = []
    for case in dict.fromkeys(row.case for row in rows):
        scores = [found.get((case, sigma)) for sigma in sigmas]
        values = [None if score is None else getattr(score, name) for score in scores]
        gains = [gain_db(rows, score) if score is not None and name == "psnr_db" else None for score in scores]
        notes = ["" if gain is None else fixed(gain, 2, sign="+") for gain in gains]
        count = max(score.keyframes for score in scores if score is not None)
        heading = Entry(labels[case], note=f"{count} keyframe{'' if count == 1 else 's'}" if name == "psnr_db" else "")
        lines.append((heading, *_row(values, notes, digits, ideal)))
    return Table(("sequence", *map(weights_name, sigmas)), tuple(lines), title)


def _row(values: Sequence[float | None], notes: Sequence[str], digits: int, ideal: float) -> list[Entry]:
    entries = [Entry(fixed(v, digits), note=note) for v, note in zip(values, notes, strict=True)]
    return best_marked(entries, values, ideal)


def _depth(result: StressResult, labels: dict[str, str]) -> tuple[Block, ...]:
    tables = []
    for poses, name in _POSES.items():
        rows = []
        for row in result.depth:
            if row.poses == poses:
                errors = fixed(row.single_mm, 2), fixed(row.fused_mm, 2)
                rows.append((labels[row.case], *errors, fixed(ratio(row), 2)))
        if rows:
            head = ("sequence", "one frame, mm", "fused, mm", "ratio")
            tables.append(Table(head, tuple(rows), f"Depth against the noise-free depth, RMSE, {name}"))
    return tuple(tables)


def _tracking(result: StressResult, labels: dict[str, str]) -> tuple[Block, ...]:
    found = {(row.case, row.variant): row for row in result.tracking}
    variants = list(dict.fromkeys(row.variant for row in result.tracking))
    rows: list[tuple[Entry | str, ...]] = []
    for case in dict.fromkeys(row.case for row in result.tracking):
        runs = [found.get((case, variant)) for variant in variants]
        notes = []
        for run in runs:
            drift = [f"{fixed(run.drift_mm_s, 2)} mm/s"] if run and run.drift_mm_s is not None else []
            notes.append(", ".join(drift + ([f"{run.lost} lost"] if run and run.lost else [])))
        values = [None if run is None else run.ate_mm for run in runs]
        rows.append((labels[case], *_row(values, notes, 2, 0.0)))
    table = Table(
        ("sequence", *variants), tuple(rows), "Position error (ATE, RMSE), mm; small print: drift a second, lost frames"
    )
    note = Note(
        "Where in a line's exposure the photometric term takes its pose, and whether it weights pixels by their blur. "
        "Each folder in cells/ has a page of its own: rstrack report FOLDER."
    )
    chart = tracking_chart(result)
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
