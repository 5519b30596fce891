"""The report of a calibration: values with their errors, residuals, its charts, and the camera file."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from rsgen.console.tables import Entry, Table, fixed, significant
from rstrack.calibration.record import CalibrationRecord, Change, LensMap, Parameter
from rstrack.charts.chart import COLORS, Curve, broken
from rstrack.charts.to_page import MovedValue, PageChart, change_figure, lens_figure, strip_figure
from rstrack.report.page import Block, Card, CardRow, Note, Page, PageSection, Plot, TextFile

_BEFORE = (
    "Scales of the residuals (Student's, medians over a few windows; those before to some percent). Before: with the "
    "values that it began with, along the first rough track; so a part of what is gained is the track's, which is "
    "refined together with the values."
)
_SIGMA = (
    "σ is measured from how far windows of the recording disagree: of what is wrong and was not estimated, it covers "
    "only a part."
)


def calibration_page(record: CalibrationRecord) -> Page:
    """A page of its own."""
    count, frames = len(record.stretches), sum(end - begin for begin, end in record.stretches)
    return Page(
        title=f"{record.dataset}, calibrated",
        subtitle=f"from {count} windows of the recording, {frames} frames in all, in {record.seconds:.0f} s",
        cards=(CardRow(calibration_cards(record)),),
        sections=(
            PageSection("values", "Values", _values(record)),
            *((PageSection("undetermined", "Undetermined", _undetermined(record)),) if record.undetermined else ()),
            PageSection("residuals", "Residuals", _residuals(record)),
            PageSection("where", "Where values were found", _where(record)),
            PageSection("camera", "Camera file", _camera_file(record)),
        ),
        warnings=calibration_warnings(record),
    )  # fmt: skip


def calibration_section(record: CalibrationRecord) -> PageSection:
    """All of it but the warnings as one part of a run's page."""
    blocks = (*_values(record), *_undetermined(record), *_residuals(record), *_where(record), *_camera_file(record))
    return PageSection("calibration", "Calibration", blocks)


def calibration_cards(record: CalibrationRecord) -> tuple[Card, ...]:
    """Whether it converged, what was found, and by how much residuals fell."""
    found, asked = len(record.parameters) - len(record.undetermined), len(record.parameters)
    depth, intensity = record.residuals.depth_m, record.residuals.intensity
    names = _names(record.undetermined.values())
    return (
        _verdict(record),
        Card(f"{found} of {asked}", "values found", f"not {names}" if names else "", "bad" if names else "good"),
        _residual_card("depth", depth, 1e3, "mm"),
        _residual_card("intensity", intensity, 1e2, "%"),
    )  # fmt: skip


def calibration_warnings(record: CalibrationRecord) -> tuple[str, ...]:
    """What must not be overlooked."""
    warnings = []
    if not record.finished:
        warnings.append("Interrupted before it had converged: these are the best values so far, and σ means little.")
    elif not record.converged:
        warnings.append("Not converged: the last step still moved values by more than their error. Do not use them.")
    if record.undetermined:
        names = _names(record.undetermined.values())
        warnings.append(f"This recording does not determine {names}: kept as given, see what is needed below.")
    return tuple(warnings)


# ---------------------------------------------------------------------------------------------------------------------


def _verdict(record: CalibrationRecord) -> Card:
    if not record.finished:
        return Card("Interrupted", "before it had converged", "best values so far", "bad")
    if not record.converged:
        return Card("Not converged", "do not use these values", "the last step was larger than their errors", "bad")
    return Card("Converged", "the last step was within the errors", "", "good")


def _residual_card(name: str, change: Change, factor: float, unit: str) -> Card:
    after, before = (f"{significant(x, 3, factor)} {unit}" for x in (change.after, change.before))
    return Card(after, f"residual of {name}", f"{before} before")


def _names(parameters: Iterable[Parameter]) -> str:
    """Those of one label but for what follows its comma together: colour from depth, x, y and z."""
    by_head: dict[str, list[str]] = {}
    for p in parameters:
        head, _, rest = p.shown.label.partition(", ")
        by_head.setdefault(head, []).append(rest)
    return "; ".join(f"{head} ({', '.join(rest)})" if rest != [""] else head for head, rest in by_head.items())


def _values(record: CalibrationRecord) -> tuple[Block, ...]:
    if not record.parameters:
        return (Note("Nothing was asked for."),)
    head = ("value", "found", "± 2 σ", "began at", "change", "unit")
    rows = tuple(_row(p) for p in record.parameters.values())
    notes = (Note(f"{text[0].upper()}{text[1:]}.") for text in record.notes)
    lenses = (Note(f"{name.capitalize()} lens: {text}.") for name, text in record.lenses_px.items())
    pictures = (Plot(_lens_chart(name, lens)) for name, lens in record.lens_maps.items() if lens.at_px)
    table = Table(head, rows, "Found, and where it began")
    return table, Note(_SIGMA), *lenses, *notes, Plot(change_chart(record)), *pictures


def _row(p: Parameter) -> tuple[Entry | str, ...]:
    factor, start = p.shown.factor, p.shown.factor * p.start
    if p.sigma is None:
        return p.shown.label, "undetermined", "–", significant(start, 4), "kept", p.shown.unit
    digits = _digits(2.0 * factor * p.sigma)
    shown = (fixed(x, digits, factor) for x in (p.value, 2.0 * p.sigma, p.start))
    return p.shown.label, *shown, fixed(p.value - p.start, digits, factor, sign="+"), p.shown.unit


def _digits(error: float) -> int:
    """After the point, so that two of an error's count."""
    return min(6, max(0, 1 - math.floor(math.log10(error)))) if error > 0.0 else 3


def _undetermined(record: CalibrationRecord) -> tuple[Block, ...]:
    if not record.undetermined:
        return ()
    rows = tuple(
        (p.shown.label, f"{significant(p.shown.factor * p.value, 4)} {p.shown.unit}",
         f"{significant(p.shown.factor * p.useful_sigma, 2)} {p.shown.unit}", p.needs)
        for p in record.undetermined.values()
    )  # fmt: skip
    head = ("value", "kept at", "σ was above", "what the recording would need")
    t = record.pace
    seen = Note("")
    if t.m_s:
        mean, turning = sum(t.m_s) / len(t.m_s), math.degrees(sum(t.rad_s) / len(t.rad_s))
        seen = Note(f"This recording moves at {mean:.2f} m/s and turns at {turning:.1f} deg/s in the mean.")
    return Table(head, rows, "Not determined by this recording", words=(0, 3)), seen


def _residuals(record: CalibrationRecord) -> tuple[Block, ...]:
    depth, intensity = record.residuals.depth_m, record.residuals.intensity
    rows = (_fall("depth, mm", depth, 1e3), _fall("intensity, % of white", intensity, 1e2))
    return Table(("residual", "before", "after", "change"), rows, "Residuals before and after"), Note(_BEFORE)


def _fall(name: str, change: Change, factor: float) -> tuple[str, ...]:
    part = 100.0 * (change.after / change.before - 1.0) if change.before else 0.0
    return name, significant(change.before, 3, factor), significant(change.after, 3, factor), f"{part:+.0f} %"


def _where(record: CalibrationRecord) -> tuple[Block, ...]:
    return (Plot(strip_chart(record)),) if record.stretches else ()


def _camera_file(record: CalibrationRecord) -> tuple[Block, ...]:
    warning = () if record.finished and record.converged else (
        Note("Not converged: do not use this file.", is_warning=True),)  # fmt: skip
    return *warning, TextFile("camera.yaml", record.camera_file), Note(
        "rstrack track RECORDING --camera camera.yaml --out RUN tracks with it.")  # fmt: skip


def _lens_chart(name: str, lens: LensMap) -> PageChart:
    """Where a lens that was looked for puts points, against what it began with."""
    at, moved = np.array(lens.at_px), np.array(lens.moved_px)
    longest = float(np.linalg.norm(moved, axis=1).max())
    spacing = float(np.diff(np.unique(at[:, 0])).min(initial=np.inf))
    magnified = spacing / longest if np.isfinite(spacing) and longest > 0.0 else 1.0
    note = (
        f"From where the lens before had a point of the scene, a dot, to where the new one has it: {longest:.2g} px at "
        f"most, drawn {magnified:.2g} times as long. Colour: 2 σ of that place."
    )
    figure = lens_figure(at, moved, 2.0 * np.array(lens.sigma_px)[:, 0], magnified)
    return PageChart(f"The {name} camera's lens", figure, note)


def change_chart(record: CalibrationRecord) -> PageChart:
    """Values against what they were before."""
    by_unit: dict[str, list[MovedValue]] = {}
    for p in record.parameters.values():
        by_unit.setdefault(p.shown.unit, []).append(_moved(p))
    note = (
        "Zero is where a value began; whiskers are 2 σ, often narrower than the dot. Hollow: undetermined, it has "
        "stayed where it was."
    )
    return PageChart("How far values moved from their starts", change_figure(by_unit), note)


def strip_chart(record: CalibrationRecord) -> PageChart:
    """Which windows of the recording determine each value, and how the camera moved there."""
    found = [p for p in record.parameters.values() if p.is_found]
    parts = np.array([p.told_by_stretch for p in found]).reshape(len(found), len(record.stretches))
    t, speed, turning = broken(
        *(np.array(values) for values in (record.pace.time_s, record.pace.m_s, record.pace.rad_s))
    )
    curves = (
        ("m/s", Curve("speed", COLORS[0], t, speed)), ("deg/s", Curve("turning", COLORS[1], t, np.degrees(turning))),
    )  # fmt: skip
    note = (
        "Each row is one value: the part of what is known of it that a window adds, in percent, all other values "
        "known. Between the windows nothing was used. Below, how fast the camera moves and turns, by the first rough "
        "track; it is broken where that was lost."
    )
    names, spans = [p.shown.label for p in found], np.array(record.stretch_times_s).reshape(-1, 2)
    figure = strip_figure(names, spans, parts, curves, "time since the first frame, s")
    return PageChart("Where in the recording values are determined", figure, note)


def _moved(p: Parameter) -> MovedValue:
    shown, factor = p.shown, p.shown.factor
    if p.sigma is None:
        return MovedValue(shown.label, 0.0, float("nan"), f"undetermined, kept at {factor * p.value:.4g} {shown.unit}")
    hover = f"{factor * p.value:.4g} ± {2.0 * factor * p.sigma:.2g} {shown.unit}, from {factor * p.start:.4g}"
    return MovedValue(shown.label, factor * (p.value - p.start), 2.0 * factor * p.sigma, hover)
