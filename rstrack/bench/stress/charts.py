"""Charts of a blur stress test: what the weights gain by exposure and speed, and the tracking error by exposure."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rstrack.bench.stress.run import ColorScore, StressResult
from rstrack.charts.chart import COLORS, TRUE_COLOR, Chart, Line, numbers


def color_charts(result: StressResult, poses: str) -> list[Chart]:
    """Of the fused colour along the 'true' or 'estimated' path; fewer where only one speed was tested."""
    rows = [row for row in result.color if row.poses == poses]
    slow = sorted((row for row in rows if row.speed == 1.0), key=lambda row: row.exposure_s)
    fast = {row.exposure_s for row in rows if row.speed != 1.0}
    by_speed = sorted((row for row in rows if row.exposure_s in fast), key=lambda row: row.speed)

    def gain(row: ColorScore) -> float | None:
        return gain_db(rows, row)

    def chart(title: str, unit: str, along: Sequence[ColorScore], value: _Value, note: str = "") -> Chart:
        lines = _lines(along, _speed if along is by_speed else _exposure_ms, value)
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
        x, y = numbers([row.exposure_s for row in mine], 1e3), numbers([row.ate_m for row in mine], 1e3)
        if mine:
            lines.append(Line(variant, COLORS[k % len(COLORS)], x, y, has_points=True))
    return Chart("Position error (ATE) by exposure", "mm", "exposure, ms", tuple(lines), from_zero=False)


def gains_db(result: StressResult, sigma_px: float = 1.0, poses: str = "true") -> dict[str, float]:
    """PSNR of blur-aware over that of constant weights in dB, by sequence."""
    rows = [row for row in result.color if (row.sigma_px, row.poses) == (sigma_px, poses)]
    return {row.case: gain for row in rows if (gain := gain_db(result.color, row)) is not None}


def gain_db(rows: Sequence[ColorScore], row: ColorScore) -> float | None:
    """PSNR of `row` over that of constant weights, among `rows`, in dB; None if it is of constant weights itself."""
    same = (r for r in rows if r.sigma_px is None and (r.case, r.poses) == (row.case, row.poses))
    base = next(same, None)
    return None if row.sigma_px is None or base is None else row.psnr_db - base.psnr_db


def weights_name(sigma_px: float | None) -> str:
    """What the weights of a σ are called; None: constant ones."""
    return "constant" if sigma_px is None else f"σ {sigma_px:g} px"


_Value = Callable[[ColorScore], float | None]


def _exposure_ms(row: ColorScore) -> float:
    return 1e3 * row.exposure_s


def _speed(row: ColorScore) -> float:
    return row.speed


def _lines(along: Sequence[ColorScore], x: Callable[[ColorScore], float], value: _Value) -> tuple[Line, ...]:
    """One for each σ that has values."""
    lines = []
    for k, sigma in enumerate(sorted({row.sigma_px for row in along}, key=lambda s: -1.0 if s is None else s)):
        mine = [row for row in along if row.sigma_px == sigma]
        values = [value(row) for row in mine]
        if any(v is not None for v in values):
            color = TRUE_COLOR if sigma is None else COLORS[(k - 1) % len(COLORS)]
            at = numbers([x(row) for row in mine])
            lines.append(Line(weights_name(sigma), color, at, numbers(values), sigma is None, has_points=True))
    return tuple(lines)
