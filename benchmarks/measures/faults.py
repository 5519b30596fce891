"""The measure `faults`: one injected fault a run, and what the tracker reports and does about it.

Kinds take turns: the run of seed n has the kind n modulo their number. A pose is wrong silently where it is given, not
lost, though it is more than 20 mm or 2° off: at once or in the end. The estimate's world is aligned to the truth's by
the frames before the fault, and stays so.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.measures.injected import KINDS, InjectedFault, random_fault
from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.bench.changes import reordered
from rstrack.bench.measures.track import WRONG_DEG, WRONG_M
from rstrack.bench.record import Figures
from rstrack.bench.task import Task
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import angles_deg, true_poses, truth_of
from rstrack.options import Options
from rstrack.tracking.any_tracker import make_tracker
from rstrack.tracking.runs.segments import segments_beside

# Frames within which a camera has to be found again, and after which a pose moves no more.
_AGAIN, _CONVERGED = 5, 10


def fault_cell(task: Task, progress: Progress) -> Figures:
    """Track the case's frames with the fault of the task's seed in them; see `judged` for the figures.

    Raises UserError: no method of ours, frames without a true pose, too few frames, images that cannot be read.
    """
    if not task.cell.is_ours:
        raise UserError(f"{task.cell.name}: faults are for methods of ours, which are watched frame by frame")
    chosen = task.frames
    cut = reordered(task.noisy, chosen, task.dataset.stamps[chosen.start : chosen.stop])
    kind = list(KINDS)[task.seed % len(KINDS)]
    progress("tracking", 0.0, kind)
    return judged(random_fault(cut, task.seed, kind), task.options)


def judged(fault: InjectedFault, options: Options) -> Figures:
    """Track a recording with a fault and compare every pose with the truth, when it is given and in the end.

    silent: frames given though wrong; silent_fault: whether there is any (0 or 1). lost: of all `frames`. worst_mm,
    worst_deg: of the frames given from the fault on. place_known: some frame was lost until the fault's end, and the
    frame there is where a keyframe is; found_in_5: then, whether one of the five frames from there on is right.
    moved_mm: largest change of a position ten frames after it was first given; rewritten_mm: largest change of any
    position when a new segment of the track began. lost_ms, tracked_ms: median time of such frames. kind: its number in
    `KINDS`.
    """
    dataset, first, last = fault.dataset, fault.first, fault.last
    watched = _watch(dataset, options)
    T_true = _truth(dataset)
    at_once = {k for k, T in enumerate(watched.at_once) if T is not None}
    final = watched.final
    given = sorted(at_once | final.keys())
    before = [k for k in given if k < first]
    if not before:
        raise UserError(f"{dataset.name}: its first {first} frames were all lost: take another sequence")
    T_true_est = mean_pose(np.array([T_true[k] @ se3.inverse(final[k]) for k in before]))
    errors = {k: _errors(T_true[k], [T_true_est @ T for T in (watched.at_once[k], final[k]) if T is not None])
              for k in given if k >= first}  # fmt: skip
    silent = {k for k, (m, deg) in errors.items() if m > WRONG_M or deg > WRONG_DEG}
    lost = [k for k in range(len(dataset)) if k not in final]
    near = [options.remoteness(se3.inverse(T_true[k]) @ T_true[last]) for k in watched.keyframes if k < last]
    is_place_known = any(first <= k <= last for k in lost) and min(near, default=np.inf) < 1.0
    is_found = any(last <= k < last + _AGAIN for k in at_once & (errors.keys() - silent))
    tracked = [s for k, s in enumerate(watched.seconds) if k not in lost and k > first // 2]
    return {
        "silent": len(silent),
        "silent_fault": int(bool(silent)),
        "lost": len(lost),
        "frames": len(dataset),
        "worst_mm": 1e3 * max((m for m, _ in errors.values()), default=0.0),
        "worst_deg": max((deg for _, deg in errors.values()), default=0.0),
        "place_known": int(is_place_known),
        "found_in_5": int(is_found) if is_place_known else None,
        "moved_mm": 1e3 * watched.moved_m,
        "rewritten_mm": 1e3 * watched.rewritten_m,
        "lost_ms": 1e3 * float(np.median([watched.seconds[k] for k in lost])) if lost else None,
        "tracked_ms": 1e3 * float(np.median(tracked)),
        "kind": list(KINDS).index(fault.kind),
    }


def mean_pose(T: FloatArray) -> FloatArray:
    """Mean (4, 4) of poses (n, 4, 4): that of positions, and the rotation nearest to the mean one (chordal)."""
    U, _, Vt = np.linalg.svd(T[:, :3, :3].mean(axis=0))
    out = np.eye(4)
    out[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    out[:3, 3] = T[:, :3, 3].mean(axis=0)
    return out


# ---------------------------------------------------------------------------------------------------------------------


@dataclass
class _Watched:
    """A tracker's words: the pose (4, 4) of every frame when it was fed, None where it was lost, and its seconds.

    final: poses in the end, segments' with them. keyframes: frames at which one was made. moved_m, rewritten_m: see
    `judged`.
    """

    at_once: list[FloatArray | None] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    final: dict[int, FloatArray] = field(default_factory=dict)
    keyframes: tuple[int, ...] = ()
    moved_m: float = 0.0
    rewritten_m: float = 0.0


def _watch(dataset: Dataset, options: Options) -> _Watched:
    interval_s = dataset.interval_s(range(len(dataset)))
    tracker = make_tracker(dataset.rig, options, interval_s=interval_s, imu=dataset.imu if options.inertial else None)
    segments = segments_beside(tracker, dataset.rig, options, dataset.frame, interval_s)
    seen = _Watched()
    settled: dict[int, FloatArray] = {}
    for k, frame in enumerate(dataset.frames()):
        begin, segments_before = time.perf_counter(), len(tracker.spline_valid)
        tracker.feed(frame)
        seen.seconds.append(time.perf_counter() - begin)
        segments.feed(frame, tracker.reports)
        now = _poses(dataset, *tracker.trajectory)
        seen.at_once.append(now.get(k))
        if len(tracker.spline_valid) > segments_before:
            seen.rewritten_m = max(seen.rewritten_m, _largest_move(seen.final, now))
        seen.final = now
        if k >= _CONVERGED and k - _CONVERGED in now:
            settled[k - _CONVERGED] = now[k - _CONVERGED]
    # Frames that the start gave up were never converged.
    seen.moved_m = _largest_move(settled, seen.final)
    segments.end(tracker.reports)
    joined = segments.joined(Estimate(*tracker.trajectory))
    seen.final = _poses(dataset, joined.stamps, joined.T_world_depth)
    seen.keyframes = tuple(k for k, report in enumerate(tracker.reports) if report.keyframe)
    return seen


def _poses(dataset: Dataset, stamps: FloatArray, T: FloatArray) -> dict[int, FloatArray]:
    """Poses T (n, 4, 4) at stamps (n,) by their frames."""
    return dict(zip(np.searchsorted(dataset.stamps, stamps).tolist(), T, strict=True))


def _largest_move(before: dict[int, FloatArray], after: dict[int, FloatArray]) -> float:
    moves = [np.linalg.norm(after[k][:3, 3] - T[:3, 3]) for k, T in before.items() if k in after]
    return float(max(moves, default=0.0))


def _truth(dataset: Dataset) -> FloatArray:
    """True poses (n, 4, 4) of all frames. Raises UserError if some frame has none."""
    truth = truth_of(dataset)
    index, T = (np.empty(0, int), None) if truth is None else true_poses(truth.motion, dataset.stamps, True)
    if T is None or len(index) < len(dataset):
        raise UserError(f"{dataset.root}: faults need the true pose of every frame: {len(index)} have one")
    return T


def _errors(T_true: FloatArray, T_world_est: Sequence[FloatArray]) -> tuple[float, float]:
    """Largest errors of estimates (4, 4) of one pose, m and degrees."""
    est = np.array(T_world_est)
    metres = np.linalg.norm(est[:, :3, 3] - T_true[:3, 3], axis=1)
    return float(metres.max()), float(angles_deg(np.broadcast_to(T_true, est.shape), est).max())
