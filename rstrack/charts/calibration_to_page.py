"""Charts of a calibration as Plotly's figures, in plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.charts.calibration import ChangeChart, LensChart, Moved, StripChart
from rstrack.charts.chart import COLORS, TRUE_COLOR

# Heights in pixels: of a row, of an axis with its title below rows, of a curve and what is above it, and the margins.
_ROW, _AXIS, _CURVE, _GAP, _TOP, _BOTTOM = 36, 52, 92, 20, 12, 50
# Seen on white and on black, and text of the page's colour on it.
_STRIP_COLORS = [[0.0, "rgba(42,127,201,0.05)"], [1.0, "rgba(42,127,201,0.75)"]]
# Height of the picture of a lens, px.
LENS_HEIGHT = 460
# Characters after which a row's name goes on in a second line.
_LONG = 18


def change_height(chart: ChangeChart) -> int:
    """Of its figure, px."""
    return _TOP + chart.rows * _ROW + len(chart.by_unit) * _AXIS


def strip_height(chart: StripChart) -> int:
    """Of its figure, px."""
    return _TOP + len(chart.names) * _ROW + len(chart.curves) * (_CURVE + _GAP) + _BOTTOM


def lens_figure(chart: LensChart) -> dict[str, Any]:
    """A line from each point to where it has moved, and a dot at its beginning with the colour of its 2 σ."""
    ends = chart.at + chart.magnified * chart.moved
    between = np.full(len(chart.at), np.nan)
    x, y = (np.stack([chart.at[:, k], ends[:, k], between], axis=1).ravel() for k in (0, 1))
    lines = {
        "type": "scatter", "mode": "lines", "x": _gaps(x), "y": _gaps(y), "hoverinfo": "skip", "showlegend": False,
        "line": {"color": TRUE_COLOR, "width": 1.6},
    }  # fmt: skip
    length = np.linalg.norm(chart.moved, axis=1)
    dots = {
        "type": "scatter", "mode": "markers", "x": _gaps(chart.at[:, 0]), "y": _gaps(chart.at[:, 1]),
        "showlegend": False,
        "marker": {"size": 7, "color": _gaps(chart.two_sigma), "colorscale": "Viridis", "cmin": 0.0,
                   "colorbar": {"title": {"text": "2 σ, px"}, "thickness": 12}},
        "text": [f"{a:.2f} ± {b:.2f} px" for a, b in zip(length, chart.two_sigma, strict=True)],
        "hovertemplate": "(%{x:.0f}, %{y:.0f}): moved by %{text}<extra></extra>",
    }  # fmt: skip
    layout = _layout()
    layout["xaxis"] = {"title": {"text": "x, px"}, "zeroline": False, "fixedrange": True, "constrain": "domain"}
    layout["yaxis"] = {
        "title": {"text": "y, px"}, "zeroline": False, "fixedrange": True, "autorange": "reversed", "scaleanchor": "x",
        "automargin": True,
    }  # fmt: skip
    return {"data": [lines, dots], "layout": layout}


def change_figure(chart: ChangeChart) -> dict[str, Any]:
    """A dot with whiskers for each value, around the line of no change."""
    inner = change_height(chart) - _TOP - _AXIS
    data: list[dict[str, Any]] = []
    layout, top = _layout(), 0
    for n, (unit, rows) in enumerate(chart.by_unit):
        found = [row for row in rows if row.is_found]
        on = {"xaxis": _axis("x", n), "yaxis": _axis("y", n)}
        data += [_dots(which, is_found) | on for is_found, which in _split(rows) if which]
        bottom = top + _ROW * len(rows)
        reach = 1.15 * max((abs(row.change) + row.two_sigma for row in found), default=0.0) or 1.0
        layout[_axis("xaxis", n)] = {
            "title": {"text": f"change, {unit}", "standoff": 4}, "anchor": _axis("y", n), "range": [-reach, reach],
            "zeroline": True, "zerolinewidth": 2, "zerolinecolor": TRUE_COLOR, "nticks": 7, "fixedrange": True,
            "showticklabels": bool(found),
        }  # fmt: skip
        layout[_axis("yaxis", n)] = _rows(1.0 - bottom / inner, 1.0 - top / inner) | {
            "anchor": _axis("x", n), "range": [len(rows) - 0.5, -0.5], "categoryorder": "array",
            "categoryarray": [_two_lines(row.label) for row in rows],
        }  # fmt: skip
        top = bottom + _AXIS
    layout["margin"] |= {"b": _AXIS}
    return {"data": data, "layout": layout}


def strip_figure(chart: StripChart) -> dict[str, Any]:
    """Cells above, curves below, all over one time."""
    inner = strip_height(chart) - _TOP - _BOTTOM
    layout, bottom = _layout(), 1.0 - _ROW * len(chart.names) / inner
    data: list[dict[str, Any]] = [_cells(chart)] if chart.names else []
    layout["yaxis"] = _rows(bottom, 1.0) | {"autorange": "reversed", "showgrid": False}
    for n, (unit, line) in enumerate(chart.curves, 1):
        top = bottom - _GAP / inner
        bottom = top - _CURVE / inner
        x, y = _gaps(line.x), _gaps(line.y)
        data.append({
            "type": "scatter", "mode": "lines", "name": line.name, "x": x, "y": y, "yaxis": _axis("y", n),
            "line": {"color": line.color, "width": 1.4},
            "hovertemplate": f"%{{y:.3g}} {unit} at %{{x:.2f}} s<extra></extra>",
        })  # fmt: skip
        title = {"text": f"{line.name},<br>{unit}", "standoff": 6}
        layout[_axis("yaxis", n)] = {
            "domain": [max(0.0, bottom), top], "anchor": "x", "rangemode": "tozero", "zeroline": False, "nticks": 4,
            "title": title, "automargin": True, "fixedrange": True,
        }  # fmt: skip
    times = np.concatenate([chart.spans.ravel(), *(line.x[np.isfinite(line.x)] for _, line in chart.curves)])
    layout["xaxis"] = {
        "title": {"text": chart.x_label}, "zeroline": False, "anchor": _axis("y", len(chart.curves)),
        "range": [float(times.min(initial=0.0)), float(times.max(initial=1.0))],
    }  # fmt: skip
    layout["margin"] |= {"b": _BOTTOM}
    layout["showlegend"] = False
    return {"data": data, "layout": layout}


# ---------------------------------------------------------------------------------------------------------------------


def _split(rows: Sequence[Moved]) -> tuple[tuple[bool, list[Moved]], ...]:
    """Those that were found, and the others."""
    return tuple((is_found, [row for row in rows if row.is_found == is_found]) for is_found in (True, False))


def _dots(rows: Sequence[Moved], is_found: bool) -> dict[str, Any]:
    """Dots with whiskers; hollow and without any where nothing was found."""
    color = COLORS[0] if is_found else TRUE_COLOR
    dots = {
        "type": "scatter", "mode": "markers", "x": [_short(row.change) for row in rows], "showlegend": False,
        "y": [_two_lines(row.label) for row in rows], "text": [row.hover for row in rows],
        "marker": {"size": 9, "color": color, "symbol": "circle" if is_found else "circle-open"},
        "hovertemplate": "%{y}: %{text}<extra></extra>",
    }  # fmt: skip
    whiskers = {"type": "data", "array": [_short(row.two_sigma) for row in rows], "thickness": 1.6, "width": 5}
    return dots | ({"error_x": whiskers | {"color": color}} if is_found else {})


def _cells(chart: StripChart) -> dict[str, Any]:
    """A heat map whose columns are the stretches and the gaps between them, which hold nothing."""
    edges, columns = _columns(chart.spans)
    parts = [[None if k is None else _short(row[k]) for k in columns] for row in 100.0 * chart.parts]
    return {
        "type": "heatmap", "x": edges, "y": [_two_lines(name) for name in chart.names], "z": parts, "zmin": 0.0,
        "zmax": float(max(1.0, 100.0 * chart.parts.max(initial=0.0))), "colorscale": _STRIP_COLORS, "showscale": False,
        "texttemplate": "%{z:.0f}", "xgap": 1, "ygap": 3, "hoverongaps": False, "yaxis": "y", "xaxis": "x",
        "hovertemplate": "%{y}: %{z:.1f} % told at %{x:.1f} s<extra></extra>",
    }  # fmt: skip


def _columns(spans: FloatArray) -> tuple[list[float], list[int | None]]:
    """Edges (c + 1) of columns in order of time, and the stretch in each, None where there is none."""
    edges: list[float] = [float(spans[0, 0])]
    columns: list[int | None] = []
    for k, (begin, end) in enumerate(spans.tolist()):
        if begin > edges[-1]:
            edges.append(begin)
            columns.append(None)
        edges.append(end)
        columns.append(k)
    return edges, columns


def _layout() -> dict[str, Any]:
    return {
        "margin": {"l": 10, "r": 14, "t": _TOP, "b": _AXIS}, "hovermode": "closest", "uirevision": "keep",
    }  # fmt: skip


def _rows(low: float, high: float) -> dict[str, Any]:
    """An axis of names, beside which there is room for them."""
    return {
        "domain": [max(0.0, low), min(1.0, high)], "type": "category", "automargin": True, "fixedrange": True,
        "ticks": "", "zeroline": False,
    }  # fmt: skip


def _axis(name: str, n: int) -> str:
    """The n-th axis as Plotly calls it: x, x2, x3."""
    return name if n == 0 else f"{name}{n + 1}"


def _two_lines(name: str) -> str:
    head, comma, rest = name.partition(", ")
    return f"{head},<br>{rest}" if comma and len(name) > _LONG else name


def _gaps(values: FloatArray) -> list[float | None]:
    return [_short(v) if np.isfinite(v) else None for v in values.tolist()]


def _short(value: float) -> float:
    return float(f"{value:.5g}")
