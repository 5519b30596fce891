"""The pictures of `rstrack bench`: bars of the ATE, and for each sequence the paths and the errors over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.geometry.spline import Spline
from rstrack.bench.methods import paper
from rstrack.bench.methods.grid import Results, SequenceInfo
from rstrack.data.dataset import open_dataset
from rstrack.data.estimate import read_estimate
from rstrack.metrics.association import Comparison, Truth, compare, truth_of
from rstrack.metrics.plot import broken, view_from_above

_COLORS = {
    "baseline": "0.55", "gs-g": "#7fb3e6", "gs-p": "#8fd0c0", "gs-pg": "#2a6fbb", "rs-g": "#f0ad66", "rs-p": "#c9a0dc",
    "rs-pg": "#c0392b",
}  # fmt: skip
_OTHERS = ("#2e8b57", "#8e6bbf", "#8c6d3f", "#c45a9a", "#4a4a4a", "#9aa82e")
_TRUE = "0.1"


def draw_plots(results: Results, out: Path, progress: Progress = no_progress) -> list[Path]:
    """Write plots/ate.png and plots/SEQUENCE.png into `out`; returns what was written. Raises UserError."""
    count = 1 + len(results.sequences)
    written = [out / "plots" / "ate.png"]
    draw_ate_bars(results, written[0])
    for k, sequence in enumerate(results.sequences, 1):
        progress("plots", k / count, sequence.name)
        path = out / "plots" / f"{sequence.name}.png"
        if draw_sequence(results, sequence, out, path):
            written.append(path)
    progress("plots", 1.0, f"{len(written)} pictures")
    return written


def colors(methods: tuple[str, ...]) -> dict[str, str]:
    """A colour for each method: greys and blues take the shutter for a global one, reds model it, others follow."""
    others = [method for method in methods if method not in _COLORS]
    return {m: _COLORS.get(m) or _OTHERS[others.index(m) % len(_OTHERS)] for m in methods}


def draw_ate_bars(results: Results, path: Path) -> None:
    """The ATE of every cell as a bar on a logarithmic scale, the paper's as a black mark on it."""
    from matplotlib.figure import Figure  # half a second to import

    from rsgen.figures import save

    names, methods, color = [s.name for s in results.sequences], results.methods, colors(results.methods)
    figure = Figure(figsize=(max(6.0, 2.2 + 1.15 * len(names)), 4.8), layout="constrained")
    axis: Any = figure.add_subplot()
    width = 0.84 / len(methods)
    for k, method in enumerate(methods):
        x = np.arange(len(names)) + (k - (len(methods) - 1) / 2) * width
        cells = [results.cell(name, method) for name in names]
        values = [cell.figure("ate_rmse_m") if cell is not None else None for cell in cells]
        mm = np.array([np.nan if value is None else 1e3 * value for value in values])
        axis.bar(x, mm, 0.92 * width, color=color[method], label=method)
        theirs = [paper.FIGURES.get((name, method)) for name in names]
        marks = np.array([np.nan if f is None else 1e3 * f.ate_m for f in theirs])
        label = "the paper's" if k == 0 else None
        axis.hlines(marks, x - 0.46 * width, x + 0.46 * width, color=_TRUE, linewidth=1.6, label=label)
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter(_plain)
    axis.margins(x=0.01)
    axis.set_xticks(np.arange(len(names)), names)
    axis.set_ylabel("ATE (RMSE), mm")
    axis.grid(True, axis="y", color="0.9", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=min(len(methods) + 1, 6), frameon=False)
    save(figure, path)


def draw_sequence(results: Results, sequence: SequenceInfo, out: Path, path: Path) -> bool:
    """Paths from above and position errors over time of all methods on one sequence; False if there is none to draw."""
    from matplotlib.figure import Figure

    from rsgen.figures import save

    truth = truth_of(open_dataset(sequence.path))
    if truth is None:
        return False
    found = {}
    for method in results.methods:
        cell = results.cell(sequence.name, method)
        if cell is not None and cell.metrics is not None:
            estimate = read_estimate(out / "cells" / sequence.name / method)
            comparison = compare(truth, estimate)
            found[method] = (estimate.stamps[comparison.index], comparison)
    if not found:
        return False
    color = colors(results.methods)
    figure = Figure(figsize=(12.3, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.35])
    true_stamps, T_true = _true_path(truth, list(found.values()))
    a, b, is_flipped = view_from_above(T_true)
    left.plot(*broken(true_stamps, T_true[:, a, 3], T_true[:, b, 3])[1:], color=_TRUE, linewidth=2.6, alpha=0.35)
    for method, (stamps, comparison) in found.items():
        T = comparison.T_world_est
        left.plot(*broken(stamps, T[:, a, 3], T[:, b, 3])[1:], color=color[method], linewidth=1.0)
        error = broken(stamps, 1e3 * comparison.position_errors_m)
        right.plot(*error, color=color[method], linewidth=0.9, label=method)
    left.set_aspect("equal", adjustable="datalim")
    if is_flipped:
        left.invert_yaxis()
    left.set(xlabel=f"{'xyz'[a]}, m", ylabel=f"{'xyz'[b]}, m")
    left.set_title("path from above, the true one broad and grey", loc="left", fontsize=10)
    right.set(xlabel="time, s", yscale="log")
    right.yaxis.set_major_formatter(_plain)
    right.set_title("position error after alignment, mm", loc="left", fontsize=10)
    for axis in (left, right):
        axis.grid(True, color="0.9", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=len(found), frameon=False)
    figure.suptitle(sequence.name, fontsize=13)
    save(figure, path)
    return True


def _plain(value: float, _: int) -> str:
    """A tick's label without powers of ten."""
    return f"{value:g}"


def _true_path(truth: Truth, found: list[tuple[FloatArray, Comparison]]) -> tuple[FloatArray, FloatArray]:
    """Stamps (n,) and true poses (n, 4, 4) over the time of the estimates."""
    if isinstance(truth.motion, Spline):
        begin, end = min(stamps[0] for stamps, _ in found), max(stamps[-1] for stamps, _ in found)
        begin, end = np.clip([begin, end], truth.motion.t_begin, truth.motion.t_end)
        stamps = np.linspace(begin, end, int(np.clip((end - begin) / truth.motion.dt * 8, 100, 100_000)))
        return stamps, truth.motion.pose(stamps)
    stamps, longest = max(found, key=lambda one: len(one[0]))
    return stamps, longest.T_world_true
