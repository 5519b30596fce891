"""One picture of a run: path, errors over time, and what the tracker said of its frames.

run_plot(Path("out/lr_kt2"), Path("runs/lr_kt2"), Path("run.png"))
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.data.estimate import Estimate, read_estimate
from rstrack.metrics.association import Comparison, Truth, compare, truth_of
from rstrack.metrics.evaluate import Metrics, evaluate

# `rsgen.figures.save` writes 130 dots an inch.
_DPI, _WIDTH_PX = 130, 1600
_TRUE, _ESTIMATED, _ORANGE, _RED, _GREY = "0.25", "#2a6fbb", "#d9822b", "#c0392b", "0.45"
# Above the axes, where no curve can run into it.
_LEGEND: Any = dict(
    loc="lower right", bbox_to_anchor=(1.0, 0.99), frameon=False, ncols=4, fontsize=9, borderaxespad=0.2
)
# A line is broken where poses are missing for so many times the usual step.
_GAP_STEPS = 3.0


def plot_run(truth: Truth | None, estimate: Estimate, metrics: Metrics | None, out: Path, title: str = "") -> None:
    """Draw a run into a png, pdf or svg file, 1600 pixels wide.

    Always: the path seen from above. With a truth: the true path too, and errors of position and rotation after
    alignment. With `estimate.info["frames"]`, a list of dicts: inlier fractions, keyframes and lost frames.
    metrics: of the same pair, named in the headings. Raises UserError if the file cannot be written, or nothing of the
    estimate can be compared with the truth.
    """
    from matplotlib.figure import Figure  # half a second to import, and only this function needs it

    from rsgen.figures import save

    found = None if truth is None else compare(truth, estimate)
    frames = _frames(estimate)
    panels = ([] if found is None else ["position", "rotation"]) + (["frames"] if frames else [])
    figure = Figure(figsize=(_WIDTH_PX / _DPI, 6.6), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.06)  # type: ignore[union-attr, call-arg]
    columns = figure.add_gridspec(max(1, len(panels)), 2 if panels else 1, width_ratios=[1.0, 1.25] if panels else None)
    _draw_path(figure.add_subplot(columns[:, 0]), truth, estimate, found)
    first: Any = None
    for k, panel in enumerate(panels):
        axis = figure.add_subplot(columns[k, 1], sharex=first)
        first = first or axis
        if panel == "frames":
            _draw_frames(axis, frames)
        elif found is not None:
            _draw_errors(axis, panel, estimate.stamps[found.index], found)
        axis.grid(True, color="0.9", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.01)
        axis.tick_params(labelbottom=k == len(panels) - 1)
        if k == len(panels) - 1:
            axis.set_xlabel("time, s")
    figure.suptitle(": ".join(text for text in (title, _summary(estimate, metrics)) if text), fontsize=13)
    save(figure, Path(out))


def run_plot(seq_path: Path | None, estimate_path: Path, out: Path, camera_file: Path | None = None) -> None:
    """Plot a run folder or TUM file, against the truth of a sequence folder where that has one.

    Arguments as in `read_estimate` and `rstrack.data.dataset.open_dataset`. Raises UserError.
    """
    from rstrack.data.dataset import open_dataset

    estimate = read_estimate(estimate_path)
    dataset = None if seq_path is None else open_dataset(seq_path, camera_file)
    truth = None if dataset is None else truth_of(dataset)
    metrics = None if truth is None else evaluate(truth, estimate)
    plot_run(truth, estimate, metrics, out, Path(estimate_path).resolve().stem if dataset is None else dataset.name)


def _summary(estimate: Estimate, metrics: Metrics | None) -> str:
    if metrics is None:
        return f"{len(estimate.stamps)} poses"
    drift = metrics.rpe_trans_rmse_m_per_s
    parts = [f"{metrics.frames_tracked} of {metrics.frames} frames tracked", f"ATE {metrics.ate_rmse_m * 1e3:.2f} mm"]
    if drift is not None and metrics.rpe_rot_rmse_deg_per_s is not None:
        parts.append(f"drift {drift * 1e3:.2f} mm/s and {metrics.rpe_rot_rmse_deg_per_s:.3f}°/s")
    return ", ".join(parts)


def _frames(estimate: Estimate) -> list[dict[str, Any]]:
    """The run's diagnostics, one dict a frame; what is not that is left out."""
    frames = estimate.info.get("frames")
    if not isinstance(frames, list):
        return []
    return [frame for frame in frames if isinstance(frame, dict) and isinstance(frame.get("stamp"), int | float)]


def _draw_path(axis: Any, truth: Truth | None, estimate: Estimate, found: Comparison | None) -> None:
    T_est = estimate.T_world_depth if found is None else found.T_true_est @ estimate.T_world_depth
    drawn = []
    if found is not None and truth is not None:
        stamps, T_true = estimate.stamps[found.index], found.T_world_true
        if isinstance(truth.motion, Spline):
            begin, end = np.clip(truth.frame_stamps[[0, -1]], truth.motion.t_begin, truth.motion.t_end)
            stamps = np.linspace(begin, end, int(np.clip((end - begin) / truth.motion.dt * 8, 100, 100_000)))
            T_true = truth.motion.pose(stamps)
        drawn.append((stamps, T_true, {"color": _TRUE, "linewidth": 2.2, "alpha": 0.45, "label": "true"}))
    drawn.append((estimate.stamps, T_est, {"color": _ESTIMATED, "linewidth": 1.1, "label": "estimated"}))
    a, b, is_flipped = view_from_above(T_est)
    for stamps, T, style in drawn:
        axis.plot(*broken(stamps, T[:, a, 3], T[:, b, 3])[1:], **style)
    axis.plot(*T_est[0, [a, b], 3], "o", color=_ESTIMATED, markersize=5, label="first pose")
    axis.set_aspect("equal", adjustable="datalim")
    if is_flipped:
        axis.invert_yaxis()
    axis.set_xlabel(f"{'xyz'[a]}, m")
    axis.set_ylabel(f"{'xyz'[b]}, m")
    axis.set_title("path from above", loc="left", fontsize=10)
    axis.grid(True, color="0.9", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(**_LEGEND)


def _draw_errors(axis: Any, panel: str, stamps: FloatArray, found: Comparison) -> None:
    is_position = panel == "position"
    values = found.position_errors_m * 1e3 if is_position else found.rotation_errors_deg
    rms = float(np.sqrt(np.mean(values**2)))
    axis.plot(*broken(stamps, values), color=_ESTIMATED if is_position else _ORANGE, linewidth=0.9)
    axis.axhline(rms, color=_GREY, linewidth=1.0, linestyle="--", label=f"RMS {rms:.3g}")
    axis.set_title("position error, mm" if is_position else "rotation error, degrees", loc="left", fontsize=10)
    axis.set_ylim(bottom=0.0)
    axis.legend(**_LEGEND)


def _draw_frames(axis: Any, frames: Sequence[dict[str, Any]]) -> None:
    stamps = np.array([float(frame["stamp"]) for frame in frames])
    for key, color, label in (("inliers_depth", _ESTIMATED, "depth"), ("inliers_color", _ORANGE, "colour")):
        values = np.array([_number(frame.get(key)) for frame in frames])
        if np.isfinite(values).any():
            axis.plot(*broken(stamps, 100.0 * values), color=color, linewidth=0.9, label=label)
    # Room below 0 % for the ticks, which no curve can run into.
    axis.set_ylim(-14.0, 103.0)
    axis.set_yticks([0, 25, 50, 75, 100])
    for key, color, label in (("keyframe", _TRUE, "keyframe"), ("lost", _RED, "lost")):
        marked = stamps[[bool(frame.get(key)) for frame in frames]]
        if marked.size:
            axis.vlines(marked, -12.0, -4.0, color=color, linewidth=1.2, label=label)
    axis.set_title("inliers, %", loc="left", fontsize=10)
    if axis.get_legend_handles_labels()[0]:
        axis.legend(**_LEGEND)


def view_from_above(T_world_depth: FloatArray) -> tuple[int, int, bool]:
    """World axes to the right and upwards of a picture from above, and whether the upward one points down there.

    Up is the world axis that the camera's −y is nearest to in the mean: nothing else tells which way is up.
    """
    up = -T_world_depth[:, :3, 1].mean(axis=0)
    k = int(np.argmax(np.abs(up)))
    a, b = ((1, 2), (0, 2), (0, 1))[k]
    # right × upwards points at the viewer; x × z is −y.
    towards_viewer = -1.0 if k == 1 else 1.0
    return a, b, bool(up[k] * towards_viewer < 0.0)


def broken(stamps: FloatArray, *values: FloatArray) -> tuple[FloatArray, ...]:
    """Stamps and values (n,) with a NaN in every gap, where a line then breaks off."""
    steps = np.diff(stamps)
    gaps = np.flatnonzero(steps > _GAP_STEPS * np.median(steps)) + 1 if steps.size else np.empty(0, np.int64)
    return tuple(np.insert(np.asarray(array, np.float64), gaps, np.nan) for array in (stamps, *values))


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")
