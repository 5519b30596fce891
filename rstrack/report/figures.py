"""Plotly figures as plain data: the path in 3D and from above, curves over time or anything else, bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.report.page import Figure

TRUE_COLOR = "#8a919e"
ESTIMATE_COLOR = "#2a7fc9"
SECOND_COLOR = "#e08a1e"
LOST_COLOR = "#d1432f"

_METHOD_COLORS = {
    "baseline": "#a8742a", "gs-g": "#7cc4ea", "rs-g": "#2a7fc9", "gs-pg": "#f0b13c", "rs-pg": "#d9531e",
    "gs-p": "#b9a5e0", "rs-p": "#7d5cc4",
}  # fmt: skip
_OTHER_COLORS = ("#1f9e77", "#66c29a", "#c9579b", "#8fae2b", "#5c8a8a", "#b06a6a")

# A line is broken where poses are missing for so many times the usual step.
_GAP_STEPS = 3.0
# Where the eye is, as a direction.
_EYE = (-0.5, -0.72, 0.48)
# A path may leave the true one's box by this part of the box's size before it is cut off.
_ROOM = 0.35


@dataclass(frozen=True)
class Path3D:
    """A path: stamps (n,) s, T_world_cam (n, 4, 4); error_mm (n,) colours it where given."""

    name: str
    color: str
    stamps: FloatArray
    T_world_cam: FloatArray
    error_mm: FloatArray | None = None


@dataclass(frozen=True)
class Curve:
    """Values (n,) at stamps (n,) s."""

    name: str
    color: str
    stamps: FloatArray
    values: FloatArray


@dataclass(frozen=True)
class Series:
    """Values (n,) at x (n,), NaN where there is none."""

    name: str
    color: str
    x: Sequence[float]
    values: Sequence[float]
    is_dashed: bool = False


def method_colors(methods: Sequence[str]) -> dict[str, str]:
    """A colour for each method, always the same for ours."""
    others = [method for method in methods if method not in _METHOD_COLORS]
    return _METHOD_COLORS | {method: _OTHER_COLORS[k % len(_OTHER_COLORS)] for k, method in enumerate(others)}


def path_3d(paths: Sequence[Path3D], points: int = 1000, with_times: bool = True) -> Figure:
    """Paths in metres in a view that can be turned, the first path under the others; z of the plot points upwards.

    points: at most so many of each path. with_times: pointing at a path says when.
    """
    axes = upright_axes(paths[-1].T_world_cam)
    data = [_trace_3d(path, axes, points, with_times, is_first=k == 0 < len(paths) - 1) for k, path in enumerate(paths)]
    ranges = _ranges([_along(path, axes) for path in paths])
    size = np.array([high - low for low, high in ranges])
    size *= 1.3 / size.max()
    distance = 0.62 + 0.72 * float(np.linalg.norm(size))
    names = [f"{sign}{'xyz'[k]}, m" for k, sign in axes]
    names[2] += " (up)"
    scene: dict[str, Any] = {
        "aspectmode": "manual", "aspectratio": dict(zip("xyz", size.tolist(), strict=True)),
        "camera": {"eye": dict(zip("xyz", [distance * v for v in _EYE], strict=True)), "up": {"x": 0, "y": 0, "z": 1}},
        "dragmode": "turntable",
    }  # fmt: skip
    for axis, name, (low, high) in zip("xyz", names, ranges, strict=True):
        scene[f"{axis}axis"] = {"title": {"text": name}, "range": [low, high], "nticks": 5}
    layout = {"scene": scene, "margin": {"l": 0, "r": 0, "t": 0, "b": 0}, "legend": _LEGEND_3D, "uirevision": "keep"}
    return {"data": data, "layout": layout}


def over_time(curves: Sequence[Curve], label: str, points: int = 1500, ticks: Sequence[Curve] = ()) -> Figure:
    """Curves over time; label: of the value axis, with its unit. ticks: instants, drawn below zero; values ignored."""
    data: list[dict[str, Any]] = []
    for curve in curves:
        index = thinned(len(curve.stamps), points)
        stamps, values = broken(curve.stamps[index], curve.values[index])
        data.append(
            {
                "type": "scatter", "mode": "lines", "name": curve.name, "x": _short(stamps, 6), "y": _short(values, 4),
                "line": {"color": curve.color, "width": 1.4},
                "hovertemplate": f"%{{y:.4g}} at %{{x:.3f}} s<extra>{curve.name}</extra>",
            }
        )  # fmt: skip
    highest = max((float(np.nanmax(c.values)) for c in curves if np.isfinite(c.values).any()), default=1.0)
    for tick in ticks:
        if len(tick.stamps):
            marker = {"color": tick.color, "symbol": "line-ns", "size": 9, "line": {"width": 1.5, "color": tick.color}}
            y = [-0.06 * highest] * len(tick.stamps)
            data.append(
                {
                    "type": "scatter", "mode": "markers", "name": tick.name, "x": _short(tick.stamps, 6), "y": y,
                    "marker": marker, "hovertemplate": f"%{{x:.3f}} s<extra>{tick.name}</extra>",
                }
            )  # fmt: skip
    layout = _layout(label, "time, s")
    layout["yaxis"]["rangemode"] = "normal" if ticks else "tozero"
    return {"data": data, "layout": layout}


def against(series: Sequence[Series], x_label: str, y_label: str) -> Figure:
    """Measured points joined by lines; labels with units."""
    data = [
        {
            "type": "scatter", "mode": "lines+markers", "name": one.name, "x": _short(np.array(one.x, np.float64), 6),
            "y": _short(np.array(one.values, np.float64), 4), "marker": {"color": one.color, "size": 7},
            "line": {"color": one.color, "width": 2, "dash": "dash" if one.is_dashed else "solid"},
            "hovertemplate": f"%{{y:.4g}}<extra>{one.name}</extra>",
        }
        for one in series
    ]  # fmt: skip
    return {"data": data, "layout": _layout(y_label, x_label)}


def bars(
    groups: Sequence[str], series: Sequence[tuple[str, str, Sequence[float | None]]], label: str,
    marks: Sequence[tuple[str, str, Sequence[float | None]]] = (),
) -> Figure:  # fmt: skip
    """Bars side by side on a logarithmic axis: series (name, colour, a value for each group).

    marks: the same, drawn as diamonds over the bars of the series of the same colour (what others have reached).
    """
    data: list[dict[str, Any]] = [
        {
            "type": "bar", "name": name, "x": list(groups), "y": _positive(values), "marker": {"color": color},
            "offsetgroup": color, "hovertemplate": f"%{{x}}: %{{y:.4g}}<extra>{name}</extra>",
        }
        for name, color, values in series
    ]  # fmt: skip
    for name, color, values in marks:
        marker = {"symbol": "diamond", "color": color, "size": 8, "line": {"width": 1.5, "color": "#888888"}}
        data.append(
            {
                "type": "scatter", "mode": "markers", "name": name, "x": list(groups), "y": _positive(values),
                "marker": marker, "offsetgroup": color, "showlegend": False,
                "hovertemplate": f"%{{x}}: %{{y:.4g}}<extra>{name}</extra>",
            }
        )  # fmt: skip
    layout = _layout(label, "")
    layout |= {"barmode": "group", "scattermode": "group", "bargap": 0.18, "scattergap": 0.18}
    layout["yaxis"] |= {"type": "log", "dtick": 1}
    layout["hovermode"] = "closest"
    return {"data": data, "layout": layout}


def upright_axes(T_world_cam: FloatArray) -> tuple[tuple[int, Literal["", "−"]], ...]:
    """World axes, each with its sign, to draw as x, y and z of a plot whose z points up: a right-handed system.

    Up is the world axis that the camera's −y is nearest to in the mean: nothing else tells which way is up.
    """
    up = -T_world_cam[:, :3, 1].mean(axis=0)
    k = int(np.argmax(np.abs(up)))
    a, b = (k + 1) % 3, (k + 2) % 3
    if up[k] > 0.0:
        return (a, ""), (b, ""), (k, "")
    return (b, ""), (a, ""), (k, "−")


def thinned(n: int, most: int) -> np.ndarray:
    """Indices of at most `most` of n items, evenly, the first and the last among them."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64)) if n else np.empty(0, np.int64)


def broken(stamps: FloatArray, *values: FloatArray) -> tuple[FloatArray, ...]:
    """Stamps and values (n,) with a NaN in every gap, where a line then breaks off."""
    steps = np.diff(stamps)
    gaps = np.flatnonzero(steps > _GAP_STEPS * np.median(steps)) + 1 if steps.size else np.empty(0, np.int64)
    return tuple(np.insert(np.asarray(array, np.float64), gaps, np.nan) for array in (stamps, *values))


# ---------------------------------------------------------------------------------------------------------------------

_LEGEND: dict[str, Any] = {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"}
_LEGEND_3D: dict[str, Any] = {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "top"}


def _layout(y_label: str, x_label: str) -> dict[str, Any]:
    return {
        "margin": {"l": 62, "r": 12, "t": 30, "b": 46}, "legend": dict(_LEGEND), "hovermode": "x unified",
        "showlegend": True, "xaxis": {"title": {"text": x_label}, "zeroline": False},
        "yaxis": {"title": {"text": y_label}, "zeroline": False}, "uirevision": "keep",
    }  # fmt: skip


def _trace_3d(
    path: Path3D, axes: tuple[tuple[int, str], ...], points: int, with_times: bool, is_first: bool
) -> dict[str, Any]:  # fmt: skip
    index = thinned(len(path.stamps), points)
    errors = np.zeros(len(path.stamps)) if path.error_mm is None else path.error_mm
    stamps, *columns, error = broken(path.stamps[index], *_along(path, axes)[index].T, errors[index])
    line: dict[str, Any] = {"color": path.color, "width": 7 if is_first else 3}
    text = [f"{t:.2f} s" if np.isfinite(t) else "" for t in stamps] if with_times else path.name
    if path.error_mm is not None:
        text = [f"{t:.2f} s, {mm:.3g} mm off" if np.isfinite(t) else "" for t, mm in zip(stamps, error, strict=True)]
        line |= {
            "color": _short(np.nan_to_num(error), 3), "colorscale": "Viridis", "cmin": 0.0,
            "cmax": float(np.nanmax(error, initial=1e-9)), "width": 5,
            "colorbar": {"title": {"text": "error, mm", "side": "top"}, "orientation": "h", "y": -0.02,
                         "yanchor": "top", "thickness": 10, "len": 0.6},
        }  # fmt: skip
    x, y, z = (_short(column) for column in columns)
    return {
        "type": "scatter3d", "mode": "lines", "name": path.name, "x": x, "y": y, "z": z, "line": line, "text": text,
        "hovertemplate": f"%{{text}}<extra>{path.name}</extra>", "opacity": 0.45 if is_first else 1.0,
        # A legend cannot show a line of many colours; the bar of colours says what it is.
        "showlegend": path.error_mm is None,
    }  # fmt: skip


def _along(path: Path3D, axes: tuple[tuple[int, str], ...]) -> FloatArray:
    """Positions (n, 3) in the plot's axes, m."""
    p_world = path.T_world_cam[:, :3, 3]
    return np.stack([-p_world[:, k] if sign else p_world[:, k] for k, sign in axes], axis=-1)


def _ranges(p_plot: Sequence[FloatArray]) -> list[tuple[float, float]]:
    """Range of each axis: all paths, unless one leaves the first one's box far behind; none of them is flat."""
    low, high = p_plot[0].min(axis=0), p_plot[0].max(axis=0)
    room = _ROOM * float((high - low).max())
    everything = np.concatenate(p_plot)
    low, high = np.maximum(everything.min(axis=0), low - room), np.minimum(everything.max(axis=0), high + room)
    size = np.maximum(high - low, max(0.2 * float((high - low).max()), 1e-3))
    middle = (low + high) / 2
    return [(float(m - 0.53 * s), float(m + 0.53 * s)) for m, s in zip(middle, size, strict=True)]


def _positive(values: Sequence[float | None]) -> list[float | None]:
    """Values for a logarithmic axis."""
    return [value if value is not None and value > 0.0 else None for value in values]


def _short(values: FloatArray, digits: int | None = None) -> list[float | None]:
    """Numbers for the page, NaN as None: to a tenth of a millimetre, or to so many significant digits."""
    short = (round(v, 4) if digits is None else float(f"{v:.{digits}g}") for v in values.tolist())
    return [v if np.isfinite(v) else None for v in short]
