"""Charts as Plotly's figures, in plain data: values under the pointer, and paths in 3D that can be turned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.charts.chart import COLORS, TRUE_COLOR, CameraPath, Chart, Curve, PathChart, broken

PlotlyFigure = dict[str, Any]
"""{"data": [trace, ...], "layout": {...}}, with "height" (px) where it goes by the number of rows.

The page's script adds the colours of its theme.
"""

# Where the eye is, as a direction.
_EYE = (-0.5, -0.72, 0.48)
_LEGEND: dict[str, Any] = {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"}
_LEGEND_3D: dict[str, Any] = {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "top"}
# Heights of a calibration's charts, px: of a row, of an axis with its title below rows, of a curve and what is above
# it, of the margins, and of a lens.
_ROW, _AXIS, _CURVE, _GAP, _TOP, _BOTTOM, _LENS = 36, 52, 92, 20, 12, 50, 460
# Seen on white and on black, and text of the page's colour on it.
_STRIP_COLORS = [[0.0, "rgba(42,127,201,0.05)"], [1.0, "rgba(42,127,201,0.75)"]]
# Characters after which a row's name goes on in a second line.
_LONG = 18


@dataclass(frozen=True)
class PageChart:
    """A figure that only a page shows; note: what the reader has to know."""

    title: str
    figure: PlotlyFigure
    note: str = ""


AnyChart = Chart | PathChart | PageChart
"""Everything that the page shows; files are drawn of the first two."""


def figure_of(chart: AnyChart, points: int) -> PlotlyFigure:
    """points: at most so many of each line and path."""
    if isinstance(chart, PageChart):
        return dict(chart.figure)
    return _chart(chart, points) if isinstance(chart, Chart) else _paths(chart, points)


def _chart(chart: Chart, points: int) -> PlotlyFigure:
    data = [_line(line, points) for line in chart.lines]
    for ticks in chart.ticks:
        marker = {"color": ticks.color, "symbol": "line-ns", "size": 9, "line": {"width": 1.5, "color": ticks.color}}
        y = [-0.06 * chart.highest] * len(ticks.x)
        hover = f"%{{x:.3f}} s<extra>{ticks.name}</extra>"
        data.append(_scatter(ticks.name, ticks.x, y, mode="markers", marker=marker, hovertemplate=hover))
    for bars in chart.bars:
        shared = {"offsetgroup": bars.color, "hovertemplate": f"%{{x}}: %{{y:.4g}}<extra>{bars.name}</extra>"}
        values = _short(np.where(bars.values > 0.0, bars.values, np.nan), 4)
        data.append({"type": "bar", "name": bars.name, "x": list(chart.groups), "y": values,
                     "marker": {"color": bars.color}} | shared)  # fmt: skip
    for bars in chart.bars:
        if np.isfinite(bars.marks).any():
            marker = {"symbol": "diamond", "color": bars.color, "size": 8, "line": {"width": 1.5, "color": "#888888"}}
            hover = f"%{{x}}: %{{y:.4g}}<extra>{bars.name}, paper</extra>"
            data.append(
                _scatter(f"{bars.name}, paper", chart.groups, _short(bars.marks, 4), mode="markers", marker=marker,
                         offsetgroup=bars.color, showlegend=False, hovertemplate=hover)
            )  # fmt: skip
    yaxis: dict[str, Any] = {"title": {"text": chart.unit}, "zeroline": False}
    if chart.is_log:
        yaxis |= {"type": "log", "dtick": 1}
    elif chart.y_max is not None:
        yaxis["range"] = [0.0, chart.y_max]
    elif chart.from_zero:
        yaxis["rangemode"] = "normal" if chart.ticks else "tozero"
    layout = {
        "margin": {"l": 62, "r": 12, "t": 30, "b": 46}, "legend": _LEGEND, "uirevision": "keep",
        "hovermode": "closest" if chart.bars else "x unified", "showlegend": len(data) > 1,
        "xaxis": {"title": {"text": chart.x_label}, "zeroline": False}, "yaxis": yaxis,
    }  # fmt: skip
    if chart.bars:
        layout |= {"barmode": "group", "scattermode": "group", "bargap": 0.18, "scattergap": 0.18}
    return {"data": data, "layout": layout}


def _line(line: Curve, points: int) -> dict[str, Any]:
    dash, hover = "dash" if line.is_dashed else "solid", f"%{{y:.4g}}<extra>{line.name}</extra>"
    style: dict[str, Any] = {"line": {"color": line.color, "width": 1.4, "dash": dash}, "hovertemplate": hover}
    if line.has_points:
        marker = {"color": line.color, "size": 7}
        if line.low is not None and line.high is not None:
            ends = {"array": _short(line.high - line.y, 4), "arrayminus": _short(line.y - line.low, 4)}
            style["error_y"] = {"type": "data", "symmetric": False, "thickness": 1.2, **ends}
        return _scatter(line.name, _short(line.x, 6), _short(line.y, 4), mode="lines+markers", marker=marker, **style)
    index = _thinned(len(line.x), points)
    x, y = broken(line.x[index], line.y[index])
    return _scatter(line.name, _short(x), _short(y, 4), mode="lines", **style)


def _scatter(name: str, x: Any, y: Any, **style: Any) -> dict[str, Any]:
    return {"type": "scatter", "name": name, "x": list(x), "y": list(y), **style}


def _paths(chart: PathChart, points: int) -> PlotlyFigure:
    ranges = chart.ranges
    size = np.array([high - low for low, high in ranges])
    size *= 1.3 / size.max()
    distance = 0.62 + 0.72 * float(np.linalg.norm(size))
    scene: dict[str, Any] = {
        "aspectmode": "manual", "aspectratio": dict(zip("xyz", size.tolist(), strict=True)),
        "camera": {
            "eye": dict(zip("xyz", [distance * v for v in _EYE], strict=True)), "up": {"x": 0, "y": 0, "z": 1},
            # Room below for the labels of the axes.
            "center": {"x": 0, "y": 0, "z": -0.15},
        },
        "dragmode": "turntable",
    }  # fmt: skip
    labels = (*chart.labels[:2], f"{chart.labels[2]} (up)")
    for axis, label, (low, high) in zip("xyz", labels, ranges, strict=True):
        scene[f"{axis}axis"] = {"title": {"text": label}, "range": [low, high], "nticks": 5}
    data = [_path(path, chart.points(path), points) for path in chart.paths]
    layout = {"scene": scene, "margin": {"l": 0, "r": 0, "t": 0, "b": 0}, "legend": _LEGEND_3D, "uirevision": "keep"}
    return {"data": data, "layout": layout}


def _path(path: CameraPath, p_plot: FloatArray, points: int) -> dict[str, Any]:
    index = _thinned(len(path.stamps), points)
    errors = np.zeros(len(path.stamps)) if path.error_mm is None else path.error_mm
    stamps, *columns, error = broken(path.stamps[index], *p_plot[index].T, errors[index])
    line: dict[str, Any] = {"color": path.color, "width": 7 if path.is_true else 3}
    text = [f"{t:.2f} s" if np.isfinite(t) else "" for t in stamps]
    if path.error_mm is not None:
        text = [f"{t}, {mm:.3g} mm off" if t else "" for t, mm in zip(text, error, strict=True)]
        line |= {
            "color": _short(np.nan_to_num(error), 3), "colorscale": "Viridis", "cmin": 0.0,
            "cmax": float(np.nanmax(error, initial=1e-9)), "width": 5,
            "colorbar": {"title": {"text": "error, mm", "side": "top"}, "orientation": "h", "y": -0.02,
                         "yanchor": "top", "thickness": 10, "len": 0.6},
        }  # fmt: skip
    x, y, z = (_short(column) for column in columns)
    return {
        "type": "scatter3d", "mode": "lines", "name": path.name, "x": x, "y": y, "z": z, "line": line, "text": text,
        "hovertemplate": f"%{{text}}<extra>{path.name}</extra>", "opacity": 0.45 if path.is_true else 1.0,
        # A legend cannot show a line of many colours; the bar of colours explains it.
        "showlegend": path.error_mm is None,
    }  # fmt: skip


def _thinned(n: int, most: int) -> np.ndarray:
    """Indices of at most `most` of n items, evenly, the first and the last among them."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64)) if n else np.empty(0, np.int64)


def _short(values: FloatArray, digits: int | None = None) -> list[float | None]:
    """Numbers for the page, NaN as None: to tenths of a millimetre or millisecond, or to so many significant digits."""
    short = (round(v, 4) if digits is None else float(f"{v:.{digits}g}") for v in np.asarray(values, float).tolist())
    return [v if np.isfinite(v) else None for v in short]


# ---------------------------------------------------------------------------------------------------------------------
# of a calibration


def lens_figure(at: FloatArray, moved: FloatArray, two_sigma: FloatArray, magnified: float) -> PlotlyFigure:
    """Points of an image at (n, 2), how far the lens has moved them (n, 2), and their 2 σ (n,); px.

    A line from each point to where it has moved, `magnified` times as far, and a dot at its beginning with the colour
    of its 2 σ.
    """
    ends = at + magnified * moved
    between = np.full(len(at), np.nan)
    x, y = (_short(np.stack([at[:, k], ends[:, k], between], axis=1).ravel(), 5) for k in (0, 1))
    style = {"line": {"color": TRUE_COLOR, "width": 1.6}, "hoverinfo": "skip", "showlegend": False}
    length = np.linalg.norm(moved, axis=1)
    marker = {
        "size": 7, "color": _short(two_sigma, 5), "colorscale": "Viridis", "cmin": 0.0,
        "colorbar": {"title": {"text": "2 σ, px"}, "thickness": 12},
    }  # fmt: skip
    dots = _scatter(
        "", *(_short(at[:, k], 5) for k in (0, 1)), mode="markers", showlegend=False, marker=marker,
        text=[f"{a:.2f} ± {b:.2f} px" for a, b in zip(length, two_sigma, strict=True)],
        hovertemplate="(%{x:.0f}, %{y:.0f}): moved by %{text}<extra></extra>",
    )  # fmt: skip
    axis = {"zeroline": False, "fixedrange": True}
    layout = _layout(_AXIS) | {
        "xaxis": axis | {"title": {"text": "x, px"}, "constrain": "domain"},
        "yaxis": axis | {"title": {"text": "y, px"}, "autorange": "reversed", "scaleanchor": "x", "automargin": True},
    }  # fmt: skip
    return {"data": [_scatter("", x, y, mode="lines", **style), dots], "layout": layout, "height": _LENS}


@dataclass(frozen=True)
class MovedValue:
    """How far a value moved from its start, and twice its σ, NaN where undetermined; both in the chart's unit."""

    label: str
    change: float
    two_sigma: float
    hover: str

    @property
    def is_found(self) -> bool:
        """Whether the recording determines it."""
        return bool(np.isfinite(self.two_sigma))


def change_figure(by_unit: Mapping[str, Sequence[MovedValue]]) -> PlotlyFigure:
    """A dot with whiskers for each value, around the line of no change; an axis for each unit."""
    height = _TOP + sum(_ROW * len(rows) + _AXIS for rows in by_unit.values())
    inner = height - _TOP - _AXIS
    data: list[dict[str, Any]] = []
    layout, top = _layout(_AXIS), 0
    for n, (unit, rows) in enumerate(by_unit.items()):
        found = [row for row in rows if row.is_found]
        of_axis = {"xaxis": _axis("x", n), "yaxis": _axis("y", n)}
        undetermined = [row for row in rows if not row.is_found]
        data += [_dots(some, is_found) | of_axis for some, is_found in ((found, True), (undetermined, False)) if some]
        bottom = top + _ROW * len(rows)
        reach = 1.15 * max((abs(row.change) + row.two_sigma for row in found), default=0.0) or 1.0
        layout[_axis("xaxis", n)] = {
            "title": {"text": f"change, {unit}", "standoff": 4}, "anchor": _axis("y", n), "range": [-reach, reach],
            "zeroline": True, "zerolinewidth": 2, "zerolinecolor": TRUE_COLOR, "nticks": 7, "fixedrange": True,
            "showticklabels": bool(found),
        }  # fmt: skip
        layout[_axis("yaxis", n)] = _names(1.0 - bottom / inner, 1.0 - top / inner) | {
            "anchor": _axis("x", n), "range": [len(rows) - 0.5, -0.5], "categoryorder": "array",
            "categoryarray": [_two_lines(row.label) for row in rows],
        }  # fmt: skip
        top = bottom + _AXIS
    return {"data": data, "layout": layout, "height": height}


def _dots(rows: Sequence[MovedValue], is_found: bool) -> dict[str, Any]:
    """Dots with whiskers; hollow and without any where nothing was found."""
    color = COLORS[0] if is_found else TRUE_COLOR
    x, two_sigma = (_short(np.array([getattr(row, name) for row in rows]), 5) for name in ("change", "two_sigma"))
    dots = _scatter(
        "", x, [_two_lines(row.label) for row in rows], mode="markers", showlegend=False,
        text=[row.hover for row in rows], hovertemplate="%{y}: %{text}<extra></extra>",
        marker={"size": 9, "color": color, "symbol": "circle" if is_found else "circle-open"},
    )  # fmt: skip
    whiskers = {"type": "data", "array": two_sigma, "thickness": 1.6, "width": 5, "color": color}
    return dots | ({"error_x": whiskers} if is_found else {})


def strip_figure(
    names: Sequence[str], spans: FloatArray, parts: FloatArray, curves: Sequence[tuple[str, Curve]], x_label: str
) -> PlotlyFigure:
    """Rows of cells over time, the darker the larger their parts (r, s), and curves below along the same time.

    spans (s, 2): from when to when a column is, s. curves: each has an axis of its own, of this unit.
    """
    height = _TOP + len(names) * _ROW + len(curves) * (_CURVE + _GAP) + _BOTTOM
    inner = height - _TOP - _BOTTOM
    layout, bottom = _layout(_BOTTOM), 1.0 - _ROW * len(names) / inner
    data: list[dict[str, Any]] = [_cells(names, spans, parts)] if names else []
    layout["yaxis"] = _names(bottom, 1.0) | {"autorange": "reversed", "showgrid": False}
    for n, (unit, line) in enumerate(curves, 1):
        top = bottom - _GAP / inner
        bottom = top - _CURVE / inner
        style = {"line": {"color": line.color, "width": 1.4}, "yaxis": _axis("y", n)}
        hover = f"%{{y:.3g}} {unit} at %{{x:.2f}} s<extra></extra>"
        x, y = _short(line.x, 5), _short(line.y, 5)
        data.append(_scatter(line.name, x, y, mode="lines", hovertemplate=hover, **style))
        layout[_axis("yaxis", n)] = {
            "domain": [max(0.0, bottom), top], "anchor": "x", "rangemode": "tozero", "zeroline": False, "nticks": 4,
            "title": {"text": f"{line.name},<br>{unit}", "standoff": 6}, "automargin": True, "fixedrange": True,
        }  # fmt: skip
    times = np.concatenate([spans.ravel(), *(line.x[np.isfinite(line.x)] for _, line in curves)])
    layout["xaxis"] = {
        "title": {"text": x_label}, "zeroline": False, "anchor": _axis("y", len(curves)),
        "range": [float(times.min(initial=0.0)), float(times.max(initial=1.0))],
    }  # fmt: skip
    return {"data": data, "layout": layout | {"showlegend": False}, "height": height}


def _cells(names: Sequence[str], spans: FloatArray, parts: FloatArray) -> dict[str, Any]:
    """A heat map whose columns are the windows and the gaps between them, which hold nothing."""
    edges: list[float] = [float(spans[0, 0])]
    columns: list[int | None] = []
    for k, (begin, end) in enumerate(spans.tolist()):
        if begin > edges[-1]:
            edges.append(begin)
            columns.append(None)
        edges.append(end)
        columns.append(k)
    shown = [_short(np.array([np.nan if k is None else row[k] for k in columns]), 5) for row in 100.0 * parts]
    return {
        "type": "heatmap", "x": edges, "y": [_two_lines(name) for name in names], "z": shown, "zmin": 0.0,
        "zmax": float(max(1.0, 100.0 * parts.max(initial=0.0))), "colorscale": _STRIP_COLORS, "showscale": False,
        "texttemplate": "%{z:.0f}", "xgap": 1, "ygap": 3, "hoverongaps": False, "yaxis": "y", "xaxis": "x",
        "hovertemplate": "%{y}: %{z:.1f} % at %{x:.1f} s<extra></extra>",
    }  # fmt: skip


def _layout(bottom: int) -> dict[str, Any]:
    margin = {"l": 10, "r": 14, "t": _TOP, "b": bottom}
    return {"margin": margin, "hovermode": "closest", "uirevision": "keep"}


def _names(low: float, high: float) -> dict[str, Any]:
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
