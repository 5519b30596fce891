"""The report of a blur stress test: what the weights gain by exposure and speed, one keyframe, depth, tracking."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from rsgen.errors import UserError
from rstrack.bench.stress.run import ColorScore, Panels, StressResult
from rstrack.bench.stress.tables import gain_db, gains_db, read_panels, read_stress, shade
from rstrack.report.figures import ESTIMATE_COLOR, SECOND_COLOR, TRUE_COLOR, Series, against
from rstrack.report.images import jpeg_uri
from rstrack.report.page import (
    Block,
    Card,
    CardRow,
    Cell,
    Chooser,
    Note,
    Page,
    Picture,
    Pictures,
    Plot,
    Section,
    Slider,
    Table,
)
from rstrack.report.run import number

# σ of the headline in px: the paper's.
_SIGMA_PX = 1.0
_COLORS = (ESTIMATE_COLOR, SECOND_COLOR, "#1f9e77", "#c9579b", "#7d5cc4", "#8fae2b")
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
    report = read_stress(folder)
    labels = _labels(report)
    warnings: list[str] = []
    sections = [Section("color", "Fused colour against the sharp view", _color(report, labels))]
    try:
        panels = read_panels(folder)
        if panels is not None:
            sections.append(Section("keyframe", "One keyframe", _pictures(panels, labels)))
    except UserError as error:
        warnings.append(f"No pictures: {error}.")
    if report.depth:
        sections.append(Section("depth", "Depth of the keyframes", _depth(report, labels)))
    sections.append(Section("tracking", "Tracking", _tracking(report, labels)))
    return Page(
        title="Blur stress test",
        subtitle=_subtitle(report),
        cards=(_cards(report, labels),),
        sections=tuple(sections),
        facts=(("motion", report.config),),
        warnings=tuple(warnings),
    )


# ---------------------------------------------------------------------------------------------------------------------


def _labels(report: StressResult) -> dict[str, str]:
    """What a sequence is called on the page, by its name."""
    cases = {row.case: (row.exposure_s, row.speed) for row in report.color}
    cases |= {row.case: (row.exposure_s, row.speed) for row in report.tracking}
    return {
        case: f"{1e3 * exposure:g} ms" + ("" if speed == 1.0 else f", {speed:g}× speed")
        for case, (exposure, speed) in cases.items()
    }


def _subtitle(report: StressResult) -> str:
    exposures = sorted({1e3 * row.exposure_s for row in report.tracking})
    speeds = [f"{speed:g}×" for speed in sorted({row.speed for row in report.tracking})]
    among = f"exposures of {', '.join(f'{ms:g}' for ms in exposures)} ms"
    return f"One motion with {among}" + (f", at {', '.join(speeds)} speed" if len(speeds) > 1 else "")


def _cards(report: StressResult, labels: dict[str, str]) -> CardRow:
    """The sequence of the longest exposure at the usual speed."""
    first = min(report.color, key=lambda row: (row.poses != "true", row.speed != 1.0, -row.exposure_s))
    case, poses = first.case, first.poses
    sigmas = {row.sigma_px for row in report.color if row.sigma_px is not None}
    cards = []
    if sigmas:
        sigma = min(sigmas, key=lambda s: abs(s - _SIGMA_PX))
        gain = gains_db(report, sigma, poses).get(case)
        found = {row.sigma_px: row.psnr_db for row in report.color if (row.case, row.poses) == (case, poses)}
        psnr = [_fixed(found.get(s), 2) for s in (None, sigma)]
        note = f"{psnr[0]} dB with constant weights, {psnr[1]} dB with σ = {sigma:g} px"
        cards.append(Card(f"{_signed(gain)} dB", "fused colour, gain of blur-aware weights (PSNR)", note))
    for depth in report.depth:
        if (depth.case, depth.poses) == (case, poses):
            note = f"{_fixed(depth.single_m, 2, 1e3)} mm in one frame"
            cards.append(Card(f"{_fixed(depth.fused_m, 2, 1e3)} mm", "depth of fused keyframes (RMSE)", note))
    tracked = [row for row in report.tracking if row.case == case]
    if tracked:
        note = "; ".join(f"{_fixed(row.ate_m, 2, 1e3)} mm: {row.variant}" for row in tracked[1:])
        cards.append(Card(f"{_fixed(tracked[0].ate_m, 2, 1e3)} mm", "position error of the tracker (ATE, RMSE)", note))
    return CardRow(tuple(cards), f"{labels[case]} exposure, {_POSES[poses]}")


def _color(report: StressResult, labels: dict[str, str]) -> tuple[Block | Chooser, ...]:
    options = []
    for poses, name in _POSES.items():
        rows = [row for row in report.color if row.poses == poses]
        if rows:
            tables = [_score_table(rows, labels, *score) for score in _SCORES]
            options.append((name, (*_gain_plots(rows), *tables)))
    text = (
        "Colour of all frames fused into keyframes, each pixel of a frame weighted by exp(−blur/σ²), equation (13), "
        "or all alike, and compared with the sharp image from the keyframe's pose. Green: the best of its row."
    )
    return Note(text), Chooser("Frames registered along the", tuple(options))


def _gain_plots(rows: Sequence[ColorScore]) -> list[Block]:
    """Gain and PSNR by exposure at the usual speed; gain by speed at the exposure of the others."""
    slow = sorted((row for row in rows if row.speed == 1.0), key=lambda row: row.exposure_s)
    fast = {row.exposure_s for row in rows if row.speed != 1.0}
    by_speed = sorted((row for row in rows if row.exposure_s in fast), key=lambda row: row.speed)
    plots: list[Block] = []
    if slow:
        note = "Gain in PSNR of blur-aware over constant weights, at the motion's own speed."
        curves = _series(rows, slow, "exposure_s", is_gain=True)
        plots.append(Plot("Gain by exposure, dB", against(curves, "exposure, ms", "gain, dB"), note))
        curves = _series(rows, slow, "exposure_s", is_gain=False)
        plots.append(Plot("PSNR by exposure, dB", against(curves, "exposure, ms", "PSNR, dB")))
    if by_speed:
        at = ", ".join(f"{1e3 * exposure:g}" for exposure in sorted(fast))
        note = f"The same path, travelled faster, at {at} ms exposure."
        curves = _series(rows, by_speed, "speed", is_gain=True)
        plots.append(Plot("Gain by speed, dB", against(curves, "speed, times", "gain, dB"), note))
    return plots


def _series(rows: Sequence[ColorScore], along: Sequence[ColorScore], x: str, is_gain: bool) -> list[Series]:
    """One curve for each σ. along: the rows that are drawn; rows: those among which constant weights are found."""
    series = []
    for sigma, color in _sigma_colors(rows).items():
        mine = [row for row in along if row.sigma_px == sigma]
        gains = [gain_db(rows, row) for row in mine]
        values = [math.nan if gain is None else gain for gain in gains] if is_gain else [row.psnr_db for row in mine]
        if mine and not (is_gain and sigma is None):
            at = [1e3 * row.exposure_s if x == "exposure_s" else row.speed for row in mine]
            series.append(Series(_weights(sigma), color, at, values, is_dashed=sigma is None))
    return series


def _sigma_colors(rows: Sequence[ColorScore]) -> dict[float | None, str]:
    sigmas = sorted({row.sigma_px for row in rows if row.sigma_px is not None})
    return {None: TRUE_COLOR} | {sigma: _COLORS[k % len(_COLORS)] for k, sigma in enumerate(sigmas)}


def _score_table(
    rows: Sequence[ColorScore], labels: dict[str, str], name: str, title: str, digits: int, ideal: float
) -> Table:
    found = {(row.case, row.sigma_px): row for row in rows}
    sigmas = [sigma for sigma in _sigma_colors(rows) if any(row.sigma_px == sigma for row in rows)]
    lines: list[tuple[Cell | str, ...]] = []
    for case in dict.fromkeys(row.case for row in rows):
        scores = [found.get((case, sigma)) for sigma in sigmas]
        values = [None if score is None else float(getattr(score, name)) for score in scores]
        gains = [gain_db(rows, score) if score is not None and name == "psnr_db" else None for score in scores]
        notes = ["" if gain is None else _signed(gain) for gain in gains]
        count = max(score.keyframes for score in scores if score is not None)
        heading = Cell(labels[case], f"{count} keyframe{'' if count == 1 else 's'}" if name == "psnr_db" else "")
        lines.append((heading, *_row(values, notes, digits, ideal)))
    return Table(("sequence", *map(_weights, sigmas)), tuple(lines), title)


def _row(
    values: Sequence[float | None], notes: Sequence[str], digits: int, ideal: float, scale: float = 1.0
) -> list[Cell]:
    """Cells, those best that read as the value nearest to the ideal, if not all of them do."""
    texts = [_fixed(value, digits, scale) for value in values]
    known = [(v, text) for v, text in zip(values, texts, strict=True) if v is not None and math.isfinite(v)]
    nearest = max if ideal == math.inf else min
    best = nearest(known, key=lambda item: item[0] if ideal == math.inf else abs(item[0] - ideal))[1] if known else ""
    differ = len({text for _, text in known}) > 1
    return [Cell(text, note, is_best=differ and text == best) for text, note in zip(texts, notes, strict=True)]


def _depth(report: StressResult, labels: dict[str, str]) -> tuple[Block, ...]:
    tables = []
    for poses, name in _POSES.items():
        rows = []
        for row in report.depth:
            if row.poses == poses:
                ratio = row.fused_m / row.single_m if row.single_m else None
                errors = (_fixed(row.single_m, 2, 1e3), _fixed(row.fused_m, 2, 1e3))
                rows.append((labels.get(row.case, row.case), *errors, _fixed(ratio, 2)))
        if rows:
            head = ("sequence", "one frame, mm", "fused, mm", "ratio")
            tables.append(Table(head, tuple(rows), f"Depth against the noise-free depth, RMSE, {name}"))
    return tuple(tables)


def _tracking(report: StressResult, labels: dict[str, str]) -> tuple[Block, ...]:
    found = {(row.case, row.variant): row for row in report.tracking}
    variants = list(dict.fromkeys(row.variant for row in report.tracking))
    rows: list[tuple[Cell | str, ...]] = []
    for case in dict.fromkeys(row.case for row in report.tracking):
        runs = [found.get((case, variant)) for variant in variants]
        notes = []
        for run in runs:
            drift = [f"{_fixed(run.drift_m_per_s, 2, 1e3)} mm/s"] if run and run.drift_m_per_s is not None else []
            notes.append(", ".join(drift + ([f"{run.lost} lost"] if run and run.lost else [])))
        values = [None if run is None else run.ate_m for run in runs]
        rows.append((labels[case], *_row(values, notes, 2, 0.0, 1e3)))
    table = Table(
        ("sequence", *variants), tuple(rows), "Position error (ATE, RMSE), mm; small print: drift a second, lost frames"
    )
    curves = []
    for k, variant in enumerate(variants):
        mine = [row for row in report.tracking if row.variant == variant and row.speed == 1.0]
        mine.sort(key=lambda row: row.exposure_s)
        if mine:
            at = [1e3 * row.exposure_s for row in mine]
            ate_mm = [math.nan if row.ate_m is None else 1e3 * row.ate_m for row in mine]
            curves.append(Series(variant, _COLORS[k % len(_COLORS)], at, ate_mm))
    note = Note(
        "Where in a line's exposure the photometric term takes its pose, and whether it weights pixels by their blur. "
        "Each folder in runs/ has a page of its own: rstrack report runs/NAME."
    )
    if not curves:
        return (table, note)
    return (table, note, Plot("Position error by exposure, mm", against(curves, "exposure, ms", "ATE, mm")))


def _pictures(panels: Panels, labels: dict[str, str]) -> tuple[Block, ...]:
    picture, white = shade(panels.weights)
    at = f"frame {panels.index} of the sequence {labels.get(panels.case, panels.case)}"
    shown = (
        (panels.blurred, "the frame that counts least of those fused, registered"),
        (picture, f"its weights (white: {number(white)})"),
        (panels.constant, "fused with constant weights"),
        (panels.aware, "fused with blur-aware weights"),
        (panels.truth, "sharp view"),
    )
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


def _weights(sigma_px: float | None) -> str:
    return "constant" if sigma_px is None else f"σ {sigma_px:g} px"


def _fixed(value: float | None, digits: int, scale: float = 1.0) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value * scale:.{digits}f}"


def _signed(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:+.2f}"
