"""Charts as Plotly's figures, in plain data: values under the pointer, and paths in 3D that can be turned."""

from __future__ import annotations

from typing import Any

import numpy as np

from rsgen.geometry.so3 import FloatArray
from rstrack.charts.calibration import ChangeChart, LensChart, StripChart
from rstrack.charts.calibration_to_page import change_figure, lens_figure, strip_figure
from rstrack.charts.chart import CameraPath, Chart, Line, PathChart, broken

Figure = dict[str, Any]
"""{"data": [trace, ...], "layout": {...}}; the page's script adds the colours of its theme."""

# Where the eye is, as a direction.
_EYE = (-0.5, -0.72, 0.48)
_LEGEND: dict[str, Any] = {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"}
_LEGEND_3D: dict[str, Any] = {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "top"}


def figure_of(chart: Chart | PathChart | ChangeChart | StripChart | LensChart, points: int) -> Figure:
    """points: at most so many of each line and path."""
    if isinstance(chart, ChangeChart):
        return change_figure(chart)
    if isinstance(chart, StripChart):
        return strip_figure(chart)
    if isinstance(chart, LensChart):
        return lens_figure(chart)
    return _paths(chart, points) if isinstance(chart, PathChart) else _chart(chart, points)


def _chart(chart: Chart, points: int) -> Figure:
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


def _line(line: Line, points: int) -> dict[str, Any]:
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


def _paths(chart: PathChart, points: int) -> Figure:
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
        # A legend cannot show a line of many colours; the bar of colours says what it is.
        "showlegend": path.error_mm is None,
    }  # fmt: skip


def _thinned(n: int, most: int) -> np.ndarray:
    """Indices of at most `most` of n items, evenly, the first and the last among them."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64)) if n else np.empty(0, np.int64)


def _short(values: FloatArray, digits: int | None = None) -> list[float | None]:
    """Numbers for the page, NaN as None: to tenths of a millimetre or millisecond, or to so many significant digits."""
    short = (round(v, 4) if digits is None else float(f"{v:.{digits}g}") for v in np.asarray(values, float).tolist())
    return [v if np.isfinite(v) else None for v in short]
