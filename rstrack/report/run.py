"""The report of one tracking run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsgen.errors import UserError
from rstrack.metrics.evaluate import Metrics, evaluate
from rstrack.report.data import Tracked, drift, load_run, true_path
from rstrack.report.figures import (
    ESTIMATE_COLOR,
    LOST_COLOR,
    SECOND_COLOR,
    TRUE_COLOR,
    Curve,
    Path3D,
    over_time,
    path_3d,
)
from rstrack.report.page import Block, Card, CardRow, Note, Page, Plot, Section, Table
from rstrack.report.pictures import frame_panels, shutter_sliders


def run_page(run: Path, sequence: Path | None = None, camera_file: Path | None = None) -> Page:
    """Gather everything about a run folder, or a TUM file with a sequence. Raises UserError."""
    tracked = load_run(run, sequence, camera_file)
    info = tracked.estimate.info
    sections = [Section("path", "Path", (path_plot(tracked),))]
    metrics = None
    if tracked.found is not None and tracked.truth is not None:
        metrics = evaluate(tracked.truth, tracked.estimate)
        sections.insert(0, Section("errors", "Errors", (metrics_table(metrics), *_notes(metrics))))
        sections.append(Section("time", "Errors over time", error_plots(tracked)))
    if tracked.frames:
        sections.append(Section("tracker", "What the tracker said", _diagnostics(tracked)))
    warnings = list(tracked.notes)
    if tracked.dataset is not None:
        try:
            blocks = (*frame_panels(tracked, tracked.dataset), *shutter_sliders(tracked, tracked.dataset))
            sections.append(Section("images", "Images", blocks))
        except UserError as error:
            warnings.append(f"Images are left out: {error}.")
    if info.get("end") not in (None, "done"):
        warnings.insert(0, f"The run ended early: {info['end']}. {info.get('error') or ''}".strip())
    name = tracked.dataset.name if tracked.dataset else _of(info, "dataset").get("name")
    return Page(
        title=f"{name or run.resolve().stem}, tracked" + (f" with {info['method']}" if "method" in info else ""),
        subtitle=_subtitle(tracked),
        cards=(CardRow(_cards(tracked, metrics)),),
        sections=tuple(sections),
        facts=_facts(info),
        warnings=tuple(warnings),
    )


def metrics_table(m: Metrics) -> Table:
    """What `rstrack evaluate` prints."""
    ate = (m.ate_rmse_m, m.ate_mean_m, m.ate_median_m, m.ate_std_m, m.ate_max_m)
    rows = (
        ("position (ATE), mm", *(number(value, 1e3) for value in ate), f"{m.poses_compared} of {m.poses} poses"),
        ("drift, mm/s", number(m.rpe_trans_rmse_m_per_s, 1e3), *[""] * 4, f"{m.rpe_pairs} pairs 1 s apart"),
        ("drift, °/s", number(m.rpe_rot_rmse_deg_per_s), *[""] * 4, f"{m.rpe_pairs} pairs 1 s apart"),
        ("lines' position, mm", number(m.row_rmse_m, 1e3), *[""] * 4, f"{m.rows} of {m.rows_total} lines"),
        ("lines' rotation, °", number(m.row_rot_rmse_deg), *[""] * 4, f"{m.rows} of {m.rows_total} lines"),
    )
    head = ("error after rigid alignment", "RMSE", "mean", "median", "std", "max", "over")
    return Table(head, rows, "Errors against the true trajectory")


def path_plot(tracked: Tracked) -> Plot:
    """The path in 3D, coloured by its error where the truth is known."""
    stamps, T_est = tracked.path
    paths, note = [], "Drag to turn, scroll to zoom; the slider turns it too."
    if tracked.found is not None and tracked.truth is not None:
        paths.append(Path3D("true", TRUE_COLOR, *true_path(tracked.truth, stamps[0], stamps[-1])))
        index = tracked.found.index
        errors = tracked.found.position_errors_m * 1e3
        paths.append(Path3D("estimated", ESTIMATE_COLOR, stamps[index], T_est[index], errors))
        note += " The grey path is the true one; the colour of the estimated one is its distance from it."
    else:
        paths.append(Path3D("estimated", ESTIMATE_COLOR, stamps, T_est))
    return Plot("Path of the depth camera", path_3d(paths), note)


def error_plots(tracked: Tracked) -> tuple[Block, ...]:
    """Errors of position and rotation, and drift over a second, as functions of time; none without a truth."""
    found = tracked.found
    if found is None:
        return ()
    stamps = tracked.estimate.stamps[found.index]
    plots = [
        _curve("Position error after alignment", "mm", stamps, found.position_errors_m * 1e3, ESTIMATE_COLOR),
        _curve("Rotation error after alignment", "degrees", stamps, found.rotation_errors_deg, SECOND_COLOR),
    ]
    per_second = drift(tracked.estimate, found)
    if len(per_second.stamps):
        t, note = per_second.stamps, "At the time at which the second begins."
        plots.append(
            _curve("Drift in translation over one second", "mm/s", t, per_second.translation_mm, ESTIMATE_COLOR, note)
        )
        plots.append(
            _curve("Drift in rotation over one second", "degrees/s", t, per_second.rotation_deg, SECOND_COLOR, note)
        )
    return tuple(plots)


def number(value: float | None, scale: float = 1.0) -> str:
    """Four significant digits, a dash for None."""
    if value is None:
        return "–"
    scaled = value * scale
    return f"{scaled:.0f}" if abs(scaled) >= 1e4 else f"{scaled:.4g}"


# ---------------------------------------------------------------------------------------------------------------------


def _cards(tracked: Tracked, m: Metrics | None) -> tuple[Card, ...]:
    info = tracked.estimate.info
    frames, lost = len(tracked.frames), info.get("lost")
    cards = []
    if m is not None:
        at_most = f"{number(m.ate_max_m, 1e3)} mm at most"
        cards += [
            Card(f"{number(m.ate_rmse_m, 1e3)} mm", "position error (ATE, RMSE)", at_most),
            Card(f"{number(m.rpe_trans_rmse_m_per_s, 1e3)} mm/s", "drift in translation (RPE, RMSE)"),
            Card(f"{number(m.rpe_rot_rmse_deg_per_s)} °/s", "drift in rotation (RPE, RMSE)"),
        ]  # fmt: skip
        cards.append(Card(f"{m.frames_tracked} of {m.frames}", "frames tracked", "" if not lost else f"{lost} lost"))
    else:
        T = tracked.estimate.T_world_depth
        length = float(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum())
        many = f"{len(T)} of {frames}" if frames else str(len(T))
        cards += [Card(many, "poses"), Card(f"{number(length)} m", "length of the path")]
    median = _of(info, "timings").get("median_ms")
    if isinstance(median, int | float):
        cards.append(Card(f"{number(median)} ms", "to track a frame (median)"))
    return tuple(cards)


def _subtitle(tracked: Tracked) -> str:
    stamps = tracked.estimate.stamps
    text = f"{len(stamps)} poses over {stamps[-1] - stamps[0]:.1f} s"
    if tracked.dataset is not None:
        rig = tracked.dataset.rig
        shutters = " and ".join(
            f"{name} {camera.width}×{camera.height}, "
            + ("global shutter" if shutter.readout_s == 0 else f"{1e3 * shutter.readout_s:g} ms readout")
            for name, camera, shutter in (
                ("colour", rig.color_camera, rig.color_shutter), ("depth", rig.depth_camera, rig.depth_shutter),
            )
        )  # fmt: skip
        text += f"; {shutters}"
    return text


def _notes(metrics: Metrics) -> tuple[Note, ...]:
    return tuple(Note(f"{note[0].upper()}{note[1:]}.") for note in metrics.notes)


def _curve(title: str, unit: str, stamps: Any, values: Any, color: str, note: str = "") -> Plot:
    rms = float(np.sqrt(np.mean(np.square(values))))
    figure = over_time((Curve(title.lower(), color, stamps, values),), unit)
    figure["layout"]["showlegend"] = False
    line = {"color": TRUE_COLOR, "dash": "dash", "width": 1}
    figure["layout"]["shapes"] = [
        {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": rms, "y1": rms, "line": line}
    ]
    return Plot(f"{title}, {unit}", figure, f"Dashed: RMS {number(rms)}. {note}".strip())


def _diagnostics(tracked: Tracked) -> tuple[Block, ...]:
    frames = tracked.frames
    stamps = np.array([float(frame["stamp"]) for frame in frames])
    curves = []
    for key, color, name in (("inliers_depth", ESTIMATE_COLOR, "depth"), ("inliers_color", SECOND_COLOR, "colour")):
        values = 100.0 * np.array([_number(frame.get(key)) for frame in frames])
        if np.isfinite(values).any():
            curves.append(Curve(name, color, stamps, values))
    ticks = [
        Curve(name, color, stamps[[bool(frame.get(key)) for frame in frames]], np.empty(0))
        for key, color, name in (("keyframe", TRUE_COLOR, "keyframe"), ("lost", LOST_COLOR, "lost"))
    ]
    blocks: list[Block] = []
    if curves:
        note = "Pixels that counted, as part of the run's largest number; ticks: keyframes, and frames that were lost."
        blocks.append(Plot("Inliers", over_time(curves, "%", ticks=ticks), note))
    ms = _of(tracked.estimate.info, "timings").get("frame_ms")
    if isinstance(ms, list) and len(ms) == len(stamps):
        times = np.array([_number(value) for value in ms])
        # The first frames compile kernels, which would flatten all others.
        top = 1.5 * float(np.nanpercentile(times, 99)) if np.isfinite(times).any() else 1.0
        figure = over_time((Curve("time", ESTIMATE_COLOR, stamps, times),), "ms")
        figure["layout"]["showlegend"] = False
        figure["layout"]["yaxis"]["range"] = [0.0, top]
        blocks.append(Plot("Time to track a frame, ms", figure, "The first frames compile kernels and may lie above."))
    return tuple(blocks)


def _facts(info: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """Settings, machine and versions as run.json has them."""
    dataset, noise = _of(info, "dataset"), _of(info, "noise")
    facts = [
        ("method", info.get("method")),
        ("frames", ":".join(str(n) for n in dataset.get("frames") or ())),
        ("keyframes", info.get("keyframes")),
        ("added noise", _listed({k: v for k, v in noise.items() if v and k != "seed"})),
        ("settings", _listed({k: v for k, v in _of(info, "options").items() if k != "method"})),
        ("backend", info.get("backend")),
        ("machine", _listed(_of(info, "machine"))),
        ("versions", _listed(_of(info, "versions"))),
    ]
    return tuple((name, str(value)) for name, value in facts if value not in (None, ""))


def _listed(values: dict[str, Any]) -> str:
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in values.items())


def _of(info: dict[str, Any], key: str) -> dict[str, Any]:
    value = info.get(key)
    return value if isinstance(value, dict) else {}


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")
