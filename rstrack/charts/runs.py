"""Charts of runs: paths, errors over time, and what the tracker reported of its frames.

run_plot(Path("out/lr_kt2"), Path("runs/lr_kt2"), Path("run.png"))
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.tables import fixed, significant
from rsgen.geometry.so3 import FloatArray
from rstrack.charts.chart import (
    COLORS,
    LOST_COLOR,
    TRUE_COLOR,
    CameraPath,
    Chart,
    Curve,
    PathChart,
    Ticks,
    method_colors,
)
from rstrack.charts.to_file import write_charts
from rstrack.metrics.evaluate import drift, evaluate
from rstrack.metrics.run_evaluate import Tracked, load_run, true_path
from rstrack.metrics.truth_fit import TruthOffset

BLUE, ORANGE = COLORS[:2]
_TIME = "time since the first frame, s"


def run_plot(
    seq_path: Path | None, run: Path, out: Path, camera_file: Path | None = None,
    truth_offset: TruthOffset | None = None,
) -> None:  # fmt: skip
    """Draw a run folder or TUM file into a png, pdf or svg file, against the truth where there is a sequence with one.

    Always: the path seen from above. With a truth: the true path too, and errors after alignment. With frames in
    run.json: inliers, keyframes and lost frames. The label of time has the first frame's stamp. Arguments
    as in `load_run`. Raises UserError.
    """
    tracked = load_run(run, seq_path, camera_file, truth_offset=truth_offset)
    name = Path(run).resolve().stem if tracked.dataset is None else tracked.dataset.name
    time = f"time since the first frame at {tracked.begin_s:.3f} s, s"
    charts = [replace(chart, x_label=time) for chart in (*error_charts(tracked)[:2], *inlier_charts(tracked))]
    write_charts([path_chart({"estimated": tracked}), *charts], out, f"{name}: {_summary(tracked)}")


def path_chart(runs: Mapping[str, Tracked]) -> PathChart:
    """The paths of runs on one sequence, by name, and the true one; a single run is coloured by its error."""
    colors, paths, begin = method_colors(runs), [], _begin(runs)
    truth = next((run.truth for run in runs.values() if run.found is not None), None)
    note = "Drag to turn, scroll to zoom; the slider turns it too."
    if truth is not None:
        stamps = np.concatenate([run.estimate.stamps for run in runs.values()])
        t, T_true = true_path(truth, stamps.min(), stamps.max())
        paths.append(CameraPath("true", TRUE_COLOR, t - begin, T_true, is_true=True))
        note += " The grey path is the true one."
    if len(runs) > 1:
        found = {name: run.path for name, run in runs.items()}
        paths += [CameraPath(name, colors[name], t - begin, T_est) for name, (t, T_est) in found.items()]
        note += " A click on a name hides its path. Paths that leave the true one far behind are cut off."
        return PathChart("Paths", tuple(paths), note)
    ((name, run),) = runs.items()
    t, T_est = run.path[0] - begin, run.path[1]
    if run.found is None:
        paths.append(CameraPath(name, BLUE, t, T_est))
    else:
        index, errors_mm = run.found.index, 1e3 * run.found.position_errors_m
        paths.append(CameraPath(name, BLUE, t[index], T_est[index], errors_mm))
        note += " The colour of the estimated one is its distance from it."
    return PathChart("Path", tuple(paths), note)


def error_charts(tracked: Tracked) -> tuple[Chart, ...]:
    """Errors of position and rotation, and drift over a second, as functions of time; none without a truth."""
    found = tracked.found
    if found is None:
        return ()
    begin, step = tracked.begin_s, drift(tracked.estimate, found)
    t = tracked.estimate.stamps[found.index] - begin
    charts = [
        _with_rms("Position error after alignment", "mm", t, found.position_errors_m * 1e3, BLUE),
        _with_rms("Rotation error after alignment", "degrees", t, found.rotation_errors_deg, ORANGE),
    ]
    if len(step.stamps):
        note = "At the time at which the second begins."
        t, mm = step.stamps - begin, 1e3 * step.translation_m
        charts.append(_with_rms("Drift in translation over one second", "mm/s", t, mm, BLUE, note))
        charts.append(_with_rms("Drift in rotation over one second", "degrees/s", t, step.rotation_deg, ORANGE, note))
    return tuple(charts)


def compared_errors(runs: Mapping[str, Tracked]) -> Chart:
    """Position errors of runs on one sequence, by name."""
    colors, begin = method_colors(runs), _begin(runs)
    lines = tuple(
        Curve(name, colors[name], run.estimate.stamps[run.found.index] - begin, 1e3 * run.found.position_errors_m)
        for name, run in runs.items()
        if run.found is not None
    )
    return Chart("Position error after alignment", "mm", _TIME, lines, is_log=True, note="Logarithmic.")


def inlier_charts(tracked: Tracked) -> tuple[Chart, ...]:
    """Parts of the pixels that counted, keyframes and lost frames over time; none if the run does not say."""
    frames = tracked.frames
    if not frames:
        return ()
    t = np.array([float(frame["stamp"]) for frame in frames]) - tracked.begin_s
    lines = tuple(
        Curve(name, color, t, values)
        for key, color, name in (("inliers_depth", BLUE, "depth"), ("inliers_color", ORANGE, "colour"))
        if np.isfinite(values := 100.0 * np.array([_number(frame.get(key)) for frame in frames])).any()
    )
    ticks = tuple(
        Ticks(name, color, marked)
        for key, color, name in (("keyframe", TRUE_COLOR, "keyframe"), ("lost", LOST_COLOR, "lost"))
        if (marked := t[[bool(frame.get(key)) for frame in frames]]).size
    )
    note = "Pixels that counted, as part of the run's largest number; ticks: keyframes, and frames that were lost."
    return (Chart("Inliers", "%", _TIME, lines, ticks, note=note),) if lines or ticks else ()


def time_charts(tracked: Tracked) -> tuple[Chart, ...]:
    """The tracker's time for each frame; none if the run does not say."""
    timings = tracked.estimate.info.get("timings")
    frame_ms = timings.get("frame_ms") if isinstance(timings, dict) else None
    if not tracked.frames or not isinstance(frame_ms, list) or len(frame_ms) != len(tracked.frames):
        return ()
    t = np.array([float(frame["stamp"]) for frame in tracked.frames]) - tracked.begin_s
    times = np.array([_number(ms) for ms in frame_ms])
    # The first frames compile kernels, which would flatten all others.
    top = 1.5 * float(np.nanpercentile(times, 99)) if np.isfinite(times).any() else 1.0
    note = "The first frames compile kernels and may lie above."
    line = Curve("time", BLUE, t, times)
    return (Chart("Time to track a frame", "ms", _TIME, (line,), y_max=top, note=note),)


# ---------------------------------------------------------------------------------------------------------------------


def _begin(runs: Mapping[str, Tracked]) -> float:
    """Stamp of the first frame of any of the runs, s."""
    return min(run.begin_s for run in runs.values())


def _with_rms(title: str, unit: str, t: FloatArray, values: FloatArray, color: str, note: str = "") -> Chart:
    rms = float(np.sqrt(np.mean(np.square(values))))
    level = Curve(f"RMS {significant(rms)}", TRUE_COLOR, t[[0, -1]], np.array([rms, rms]), is_dashed=True)
    return Chart(title, unit, _TIME, (Curve(title.split()[0].lower(), color, t, values), level), note=note)


def _summary(tracked: Tracked) -> str:
    if tracked.truth is None:
        return f"{len(tracked.estimate.stamps)} poses"
    m = evaluate(tracked.truth, tracked.estimate)
    parts = [f"{m.frames_tracked} of {m.frames} frames tracked", f"ATE {fixed(m.ate_rmse_m, 2, 1e3)} mm"]
    if m.rpe_trans_rmse_m_per_s is not None:
        speeds = fixed(m.rpe_trans_rmse_m_per_s, 2, 1e3), fixed(m.rpe_rot_rmse_deg_per_s, 3)
        parts.append(f"drift {speeds[0]} mm/s and {speeds[1]}°/s")
    return ", ".join(parts)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")
