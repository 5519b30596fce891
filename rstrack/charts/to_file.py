"""Charts drawn by Matplotlib into a file: PNG, PDF or SVG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rstrack.charts.chart import Chart, PathChart, broken

# `rsgen.figures.save` writes 130 dots an inch.
_DPI, _WIDTH_PX = 130, 1600
# Characters above the axes, where no curve can run into them: longer titles and names get lines of their own.
_LINE, _HANDLE = 72, 6


def write_charts(
    charts: Sequence[Chart | PathChart], path: Path, title: str = "", columns: int = 0, one_legend: bool = False
) -> None:
    """Draw charts side by side: a path, seen from above, takes the left half.

    columns: of charts without a path, which then share their y axes; 0: two of them. one_legend: below all charts, of
    what the first one shows. Raises UserError: the file's type, or it cannot be written.
    """
    from matplotlib.figure import Figure  # half a second to import, and only drawing needs it

    from rsgen.figures import save

    paths = [chart for chart in charts if isinstance(chart, PathChart)]
    others = [chart for chart in charts if isinstance(chart, Chart)]
    share = columns > 0 and not paths
    columns = columns if share else 2 if len(charts) > 1 else 1
    rows = max(1, len(others)) if paths else -(-len(others) // columns)
    width = _WIDTH_PX / _DPI if paths or columns > 1 else max(6.0, 2.2 + 1.15 * len(others[0].groups))
    figure = Figure(figsize=(width, 6.6 if paths else 1.0 + 3.8 * rows), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.06)  # type: ignore[union-attr, call-arg]
    grid = figure.add_gridspec(rows, columns, width_ratios=[1.0, 1.25] if paths and columns == 2 else None)
    for path_chart in paths:
        _draw_path(figure.add_subplot(grid[:, 0]), path_chart)
    first: Any = None
    for k, chart in enumerate(others):
        place = grid[k, 1] if paths else grid[k // columns, k % columns]
        beside = figure.axes[0] if share and k else None
        axis = figure.add_subplot(place, sharex=first, sharey=beside)
        _draw_chart(axis, chart, with_legend=not one_legend)
        if paths:  # one above the other, along the same time
            first, is_last = first or axis, k == len(others) - 1
            axis.tick_params(labelbottom=is_last)
            axis.set_xlabel(chart.x_label if is_last else "")
    if one_legend and others:
        named = figure.axes[0].get_legend_handles_labels()
        figure.legend(*named, loc="outside lower center", ncols=max(1, int(width / 2)), frameon=False, fontsize=9)
    if title:
        figure.suptitle(title, fontsize=13)
    save(figure, Path(path))


def _draw_path(axis: Any, chart: PathChart) -> None:
    for path in chart.paths:
        points = chart.points(path)
        style = {"linewidth": 2.4, "alpha": 0.6} if path.is_true else {"linewidth": 1.1}
        axis.plot(*broken(path.stamps, *points[:, :2].T)[1:], color=path.color, label=path.name, **style)
    is_single = not any(path.is_true for path in chart.paths[1:]) and len(chart.paths) <= 2
    if is_single:
        axis.plot(*points[0, :2], "o", color=path.color, markersize=5, label="first pose")
    axis.set_aspect("equal", adjustable="datalim")
    axis.set(xlabel=chart.labels[0], ylabel=chart.labels[1])
    _finish(axis, f"{chart.title} from above")


def _draw_chart(axis: Any, chart: Chart, with_legend: bool = True) -> None:
    for line in chart.lines:
        if line.low is not None and line.high is not None:
            axis.fill_between(line.x, line.low, line.high, color=line.color, alpha=0.18, linewidth=0)
        style: dict[str, Any] = {"color": line.color, "label": line.name, "linestyle": "--" if line.is_dashed else "-"}
        style |= {"marker": "o", "markersize": 4} if line.has_points else {"linewidth": 0.9}
        axis.plot(*((line.x, line.y) if line.has_points else broken(line.x, line.y)), **style)
    for ticks in chart.ticks:
        low, high = -0.12 * chart.highest, -0.04 * chart.highest
        axis.vlines(ticks.x, low, high, color=ticks.color, linewidth=1.2, label=ticks.name)
    x, width = np.arange(len(chart.groups)), 0.84 / max(1, len(chart.bars))
    for k, bars in enumerate(chart.bars):
        at = x + (k - (len(chart.bars) - 1) / 2) * width
        axis.bar(at, bars.values, 0.92 * width, color=bars.color, label=bars.name)
        label = "the paper's" if k == 0 and any(np.isfinite(b.marks).any() for b in chart.bars) else None
        axis.hlines(bars.marks, at - 0.46 * width, at + 0.46 * width, color="0.1", linewidth=1.6, label=label)
    if chart.groups:
        axis.set_xticks(x, chart.groups)
    if chart.is_log:
        axis.set_yscale("log")
        low, high = axis.get_ylim()
        axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")  # no powers of ten
        axis.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if high < 10.0 * low else "")
    elif chart.from_zero:
        axis.set_ylim(bottom=-0.14 * chart.highest if chart.ticks else 0.0, top=chart.y_max)
    axis.margins(x=0.01 if not any(line.has_points for line in chart.lines) else 0.05)
    axis.set_xlabel(chart.x_label)
    _finish(axis, chart.heading, with_legend)


def _finish(axis: Any, title: str, with_legend: bool = True) -> None:
    axis.grid(True, axis="y" if axis.containers else "both", color="0.9", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    names = axis.get_legend_handles_labels()[1] if with_legend else []
    lengths = [len(name) + _HANDLE for name in names]
    style: dict[str, Any] = {"frameon": False, "fontsize": 9, "borderaxespad": 0.2}
    lines = 0
    if len(title) + sum(lengths) > _LINE:
        columns = max(1, _LINE // max(lengths))
        lines = -(-len(lengths) // columns)
        axis.legend(loc="lower left", bbox_to_anchor=(0.0, 0.99), ncols=columns, **style)
    elif len(lengths) > 1:
        axis.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=len(lengths), **style)
    axis.set_title(title, loc="left", fontsize=10, pad=6 + 16 * lines)
