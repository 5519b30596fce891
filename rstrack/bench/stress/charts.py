"""Charts and files of a blur stress test: what the weights gain by exposure and speed, and the error by exposure.

write_stress(outcome.records.values(), Path("runs/stress"))
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

from rsgen.console.tables import csv_text
from rsgen.files import atomic_write
from rstrack.bench.measures.blur import PANELS, read_panels
from rstrack.bench.record import Record, write_records
from rstrack.bench.stress.results import (
    STRESS,
    ColorScore,
    StressResult,
    gain_db,
    stress_result,
    stress_text,
    weights_name,
)
from rstrack.charts.chart import COLORS, TRUE_COLOR, Chart, Line, numbers
from rstrack.charts.to_file import write_charts


def write_stress(records: Iterable[Record], out: Path) -> StressResult:
    """Write stress.txt, stress.json (the records), stress_color.csv, _depth.csv, _tracking.csv, stress.png, panels.png.

    Raises UserError if that cannot be done.
    """
    records = tuple(records)
    result = stress_result(records)
    write_records(out / STRESS, records)
    atomic_write(out / "stress.txt", (stress_text(result) + "\n").encode())
    for name in ("color", "depth", "tracking"):
        atomic_write(out / f"stress_{name}.csv", csv_text([asdict(row) for row in getattr(result, name)]).encode())
    title = f"{result.motion}: fused colour along the true path, and tracking"
    write_charts([*color_charts(result, "true"), tracking_chart(result)], out / "stress.png", title)
    _draw_panels(result, out)
    return result


def color_charts(result: StressResult, poses: str) -> list[Chart]:
    """Of the fused colour along the 'true' or 'estimated' path; fewer where only one speed was tested."""
    rows = [row for row in result.color if row.poses == poses]
    slow = sorted((row for row in rows if row.speed == 1.0), key=lambda row: row.exposure_s)
    fast = {row.exposure_s for row in rows if row.speed != 1.0}
    by_speed = sorted((row for row in rows if row.exposure_s in fast), key=lambda row: row.speed)

    def gain(row: ColorScore) -> float | None:
        return gain_db(rows, row)

    def chart(title: str, unit: str, along: Sequence[ColorScore], value: _Value, note: str = "") -> Chart:
        lines = _lines(along, [row.speed if along is by_speed else 1e3 * row.exposure_s for row in along], value)
        x_label = "speed, times" if along is by_speed else "exposure, ms"
        return Chart(title, unit, x_label, lines, from_zero=False, note=note)

    charts = []
    if slow:
        note = "Gain in PSNR of blur-aware over constant weights, at the motion's own speed."
        charts += [chart("Gain by exposure", "dB", slow, gain, note)]
        charts += [chart("PSNR by exposure", "dB", slow, lambda row: row.psnr_db)]
        charts += [chart("Gradient energy by exposure", "of the sharp view's", slow, lambda row: row.gradient)]
    if by_speed:
        at = ", ".join(f"{1e3 * exposure:g}" for exposure in sorted(fast))
        note = f"The same path, travelled faster, at {at} ms exposure."
        charts += [chart("Gain by speed", "dB", by_speed, gain, note)]
    return charts


def tracking_chart(result: StressResult) -> Chart:
    """The tracker's position error at the motion's own speed."""
    lines = []
    for k, variant in enumerate(dict.fromkeys(row.variant for row in result.tracking)):
        mine = [row for row in result.tracking if row.variant == variant and row.speed == 1.0]
        mine.sort(key=lambda row: row.exposure_s)
        x, y = numbers([row.exposure_s for row in mine], 1e3), numbers([row.ate_mm for row in mine])
        if mine:
            lines.append(Line(variant, COLORS[k % len(COLORS)], x, y, has_points=True))
    return Chart("Position error (ATE) by exposure", "mm", "exposure, ms", tuple(lines), from_zero=False)


_Value = Callable[[ColorScore], float | None]


def _lines(along: Sequence[ColorScore], x: Sequence[float], value: _Value) -> tuple[Line, ...]:
    """One for each σ that has values."""
    lines = []
    for k, sigma in enumerate(sorted({row.sigma_px for row in along}, key=lambda s: -1.0 if s is None else s)):
        at = numbers([at for at, row in zip(x, along, strict=True) if row.sigma_px == sigma])
        values = [value(row) for row in along if row.sigma_px == sigma]
        if any(v is not None for v in values):
            color = TRUE_COLOR if sigma is None else COLORS[(k - 1) % len(COLORS)]
            lines.append(Line(weights_name(sigma), color, at, numbers(values), sigma is None, has_points=True))
    return tuple(lines)


def _draw_panels(result: StressResult, out: Path) -> None:
    folder = None if result.panels is None else out / result.panels
    panels = None if folder is None else read_panels(folder)
    if folder is None or panels is None:
        return
    names = dict(zip(PANELS, ("registered blurred input", f"weights (white: {panels.white:.2g})", "constant weights",
                              "blur-aware weights", "sharp view (truth)"), strict=True))  # fmt: skip
    from rsgen.figures import save_grid

    save_grid([[image / 255.0 for image in panels.images(folder).values()]], tuple(names.values()), out / "panels.png")
