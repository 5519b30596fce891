"""The measure `track`: one run of a method over a case, its errors against the truth, its times."""

from __future__ import annotations

import dataclasses
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rstrack.bench.cells import Cell
from rstrack.bench.record import Figures, frame_times
from rstrack.bench.task import Absent, Task
from rstrack.data.estimate import Estimate, read_estimate, write_estimate
from rstrack.metrics.association import ASSOCIATE_WITHIN_S, Truth, angles_deg, compare, truth_of
from rstrack.metrics.consistency import LEVELS, TruthNoise
from rstrack.metrics.evaluate import Metrics
from rstrack.metrics.run_evaluate import evaluate_clocks, evaluate_extrinsics
from rstrack.metrics.truth_fit import shifted
from rstrack.options import CLOUD_PEERS, SLAM_PEERS
from rstrack.peers.peer import run_command
from rstrack.tracking.runs.run import track

WRONG_M, WRONG_DEG = 0.020, 2.0
"""A pose that is given, not lost, and further off than this after alignment is silently wrong."""
_FIRST = 10
_PACKAGES = {"kiss-icp": "kiss_icp", "small-gicp": "small_gicp", "orb-slam3": "pyorbslam3"}


def track_cell(task: Task, progress: Progress) -> Figures:
    """Track the case with the method and compare with the truth. Raises UserError, and Absent."""
    estimate, times = estimated(task, progress)
    return accuracy(task, estimate) | times


def estimated(task: Task, progress: Progress) -> tuple[Estimate, Figures]:
    """The trajectory, written to the task's folder, and what it cost. Raises UserError, and Absent."""
    if task.cell.is_ours:
        return _tracked(task, progress)
    begin = time.perf_counter()
    estimate = _others(task, progress)
    seconds = time.perf_counter() - begin
    stamps = task.dataset.stamps[task.frames.start : task.frames.stop]
    kept = (estimate.stamps >= stamps[0] - ASSOCIATE_WITHIN_S) & (estimate.stamps <= stamps[-1] + ASSOCIATE_WITHIN_S)
    where = {"dataset": {"name": task.dataset.name, "frames": [task.frames.start, task.frames.stop]}}
    info = where | estimate.info | {"method": task.cell.method}
    estimate = Estimate(estimate.stamps[kept], estimate.T_world_depth[kept], estimate.spline, info)
    write_estimate(task.out, *(getattr(estimate, name) for name in ("stamps", "T_world_depth", "spline", "info")))
    is_timed = task.cell.method_entry.results is None
    return estimate, {"total_s": seconds, "mean_ms": 1e3 * seconds / len(stamps)} if is_timed else {}


def accuracy(task: Task, estimate: Estimate) -> Figures:
    """Errors over the case's frames; those of too few poses are missing, and then all frames are lost.

    The truth's own errors and extrinsics, where the case states them, count in NEES and coverage only.
    """
    chosen, case = task.frames, task.cell.case_entry
    frames = len(chosen)
    truth = truth_of(task.dataset)
    if truth is None:
        return {"frames": frames, "lost": frames - len(estimate.stamps)}
    noise = None if case.truth_noise is None else TruthNoise(*case.truth_noise)
    truth = dataclasses.replace(truth, frame_stamps=task.dataset.stamps[chosen.start : chosen.stop], noise=noise)
    offset = case.truth_offset
    try:
        evaluation = evaluate_clocks(truth, estimate, offset)
    except UserError:
        # A track too short or too bad for its clock: clocks as they are, or nothing at all.
        offset = None
        try:
            evaluation = evaluate_clocks(truth, estimate, offset)
        except UserError:
            return {"frames": frames, "lost": frames, "silent": 0}
    found = evaluation.chosen
    shift = evaluation.offset_s if evaluation.asked else None
    return errors_of(found) | {
        "silent": silent(shifted(truth, shift or 0.0), estimate),
        **consistency_of(found if case.truth_extrinsics is None else _mounted(truth, estimate, shift)),
        "truth_offset_ms": None if offset is None else _scaled(evaluation.offset_s),
    }


def errors_of(found: Metrics) -> Figures:
    """Frames and errors by the names of `rstrack.bench.figures`."""
    return {
        "frames": found.frames,
        "lost": found.frames - found.frames_tracked,
        "ate_mm": 1e3 * found.ate_rmse_m,
        "ate_max_mm": 1e3 * found.ate_max_m,
        "drift_mm_s": _scaled(found.rpe_trans_rmse_m_per_s),
        "drift_deg_s": found.rpe_rot_rmse_deg_per_s,
        "line_mm": _scaled(found.row_rmse_m),
        "line_deg": found.row_rot_rmse_deg,
    }


def consistency_of(metrics: Metrics | None) -> Figures:
    """NEES/6 over 0.1, 1 and 5 s, and shares within the regions over 1 s; None where there are no covariances."""
    horizons = {} if metrics is None else {horizon.seconds: horizon for horizon in metrics.consistency}
    named = {"nees_01": 0.1, "nees": 1.0, "nees_5": 5.0}
    nees = {name: horizons[seconds].nees if seconds in horizons else None for name, seconds in named.items()}
    within = horizons[1.0].within if 1.0 in horizons else {}
    return nees | {f"coverage_{level}": within.get(level) for level in LEVELS}


def silent(truth: Truth, estimate: Estimate) -> int:
    """Poses that are given and wrong: 0 where there are too few to compare.

    Orientations are aligned by themselves: on a short or straight path positions leave a turn about it nearly open.
    """
    try:
        found = compare(truth, estimate)
    except UserError:
        return 0
    R_true, R_est = (T[:, :3, :3] for T in (found.T_world_true, found.T_world_est))
    T_est = found.T_world_est.copy()
    T_est[:, :3, :3] = Rotation.from_matrix(R_true @ np.swapaxes(R_est, 1, 2)).mean().as_matrix() @ R_est
    wrong = angles_deg(found.T_world_true, T_est) > WRONG_DEG
    return int(((found.position_errors_m > WRONG_M) | wrong).sum())


def package_of(peer: str) -> str:
    """The Python package that a peer needs."""
    return _PACKAGES.get(peer, "open3d")


def results_path(cell: Cell) -> Path:
    """The trajectory of another tracker for a case: a TUM file, or a run folder."""
    assert cell.method_entry.results is not None
    file, run = (cell.method_entry.results / name for name in (f"{cell.case}.txt", cell.case))
    return (run if run.is_dir() and not file.is_file() else file).resolve()


# ---------------------------------------------------------------------------------------------------------------------


def _tracked(task: Task, progress: Progress) -> tuple[Estimate, Figures]:
    result = track(task.dataset, task.options, task.out, task.cell.frames, task.noise, progress)
    if result.end == "interrupted":
        raise KeyboardInterrupt
    if result.unreadable:
        raise UserError(result.unreadable[0])
    times = result.estimate.info["timings"]
    ms = np.asarray(times["frame_ms"], float)
    return result.estimate, {
        **frame_times(ms),
        "first_ms": float(ms[:_FIRST].mean()),
        "start_s": times["start_s"],
        "end_s": times.get("loops_s", 0.0),
        "total_s": times["start_s"] + times["total_s"],
        "keyframes": result.estimate.info["keyframes"],
    }


def _others(task: Task, progress: Progress) -> Estimate:
    cell, entry = task.cell, task.cell.method_entry
    if entry.results is not None:
        return read_estimate(results_path(cell))
    if entry.command:
        progress(cell.method, 0.0, "its command runs")
        return run_command(cell.method, entry.command, task.dataset.root, task.out)
    frames = slice(task.frames.start, task.frames.stop)
    if find_spec(package_of(cell.program)) is None:
        raise Absent(f"{cell.program}: {package_of(cell.program)} is not installed")
    if cell.program in CLOUD_PEERS:
        from rstrack.peers.clouds import run_cloud_peer

        return run_cloud_peer(cell.program, task.noisy, frames, progress)
    if cell.program in SLAM_PEERS:
        from rstrack.peers.orb_slam3 import run_orb_slam3

        return run_orb_slam3(task.noisy, frames, progress, seed=task.seed)
    from rstrack.peers.open3d import run_peer

    return run_peer(cell.program, task.noisy, frames, progress)


def _mounted(truth: Truth, estimate: Estimate, offset_s: float | None) -> Metrics | None:
    """With the truth's extrinsics; None: the track is too short or too bad for them, or the motion leaves them open."""
    try:
        return evaluate_extrinsics(truth, estimate, offset_s).chosen
    except UserError:
        return None


def _scaled(value: float | None) -> float | None:
    return None if value is None else 1e3 * value
