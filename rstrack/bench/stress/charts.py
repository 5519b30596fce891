"""Charts and files of a blur stress test: what the weights gain by exposure and speed, and the error by exposure.

write_stress(outcome.records.values(), Path("runs/stress"))
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from rstrack.bench.measures.blur import PANELS, read_panels
from rstrack.bench.record import Record, write_records
from rstrack.bench.stress.results import (
    STRESS,
    StressResult,
    Tested,
    csv_rows,
    stress_notes,
    stress_result,
    stress_tables,
    weights_name,
)
from rstrack.bench.tables.files import write_tables
from rstrack.charts.chart import COLORS, TRUE_COLOR, Chart, Line, numbers
from rstrack.charts.to_file import write_charts


def write_stress(records: Iterable[Record], out: Path) -> tuple[StressResult, str]:
    """Write stress.json (the records), stress.txt, .md and .csv, stress.png and panels.png; returns the text too.

    Raises UserError if that cannot be done.
    """
    records = tuple(records)
    result = stress_result(records)
    write_records(out / STRESS, records)
    text = write_tables(out, stress_tables(result), stress_notes(result), csv_rows(result), "stress")
    title = f"{result.motion}: fused colour along the true path, and tracking"
    write_charts([*color_charts(result, "true"), tracking_chart(result)], out / "stress.png", title)
    _draw_panels(result, out)
    return result, text


def color_charts(result: StressResult, poses: str) -> list[Chart]:
    """Of the fused colour along the 'true' or 'estimated' path; fewer where only one speed was tested."""
    cells = result.fused(poses)
    slow = [cell for cell in cells if cell.speed == 1.0]
    fast = {cell.exposure_s for cell in cells if cell.speed != 1.0}
    by_speed = [cell for cell in cells if cell.exposure_s in fast]

    def chart(title: str, unit: str, along: Sequence[Tested], value: _Value, note: str = "") -> Chart:
        x = numbers([cell.speed if along is by_speed else 1e3 * cell.exposure_s for cell in along])
        lines = []
        for k, sigma in enumerate(result.sigmas_px):
            values = [value(cell, sigma) for cell in along]
            if any(v is not None for v in values):
                color = TRUE_COLOR if sigma is None else COLORS[(k - 1) % len(COLORS)]
                lines.append(Line(weights_name(sigma), color, x, numbers(values), sigma is None, has_points=True))
        x_label = "speed, times" if along is by_speed else "exposure, ms"
        return Chart(title, unit, x_label, tuple(lines), from_zero=False, note=note)

    def gain(cell: Tested, sigma_px: float | None) -> float | None:
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
            lines.append(Line(variant, COLORS[k % len(COLORS)], x, y, has_points=True))
    return Chart("Position error (ATE) by exposure", "mm", "exposure, ms", tuple(lines), from_zero=False)


_Value = Callable[[Tested, float | None], float | None]


def _draw_panels(result: StressResult, out: Path) -> None:
    folder = None if result.panels is None else out / result.panels
    panels = None if folder is None else read_panels(folder)
    if folder is None or panels is None:
        return
    names = dict(zip(PANELS, ("registered blurred input", f"weights (white: {panels.white:.2g})", "constant weights",
                              "blur-aware weights", "sharp view (truth)"), strict=True))  # fmt: skip
    from rsgen.figures import save_grid

    save_grid([[image / 255.0 for image in panels.images(folder).values()]], tuple(names.values()), out / "panels.png")
