"""The measure `bootstrap`: which starts of a recording succeed, the tracker begun at many random frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rstrack.bench.cells import StrictModel
from rstrack.bench.measures.track import WRONG_M
from rstrack.bench.record import Figures
from rstrack.bench.task import Task, settings_of
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import Truth, compare, truth_of
from rstrack.options import Options
from rstrack.tracking.any_tracker import make_tracker

_LIMITS_MM = (1, 5)
_MIN_POSES = 3


class BootstrapSettings(StrictModel):
    """How many starts, and frames of each."""

    starts: int = Field(default=50, ge=1)
    frames: int = Field(default=20, ge=_MIN_POSES)


@dataclass(frozen=True)
class Start:
    """One run. lost: numbers of its lost frames. error: why it broke down.

    ate_m, worst_m: of positions after alignment; None with too few poses. wrong: poses that are given and further off
    than `WRONG_M`; how far they are turned is not asked, as so short a path may be straight, which aligns no rotation.
    """

    frame: int
    lost: tuple[int, ...]
    ate_m: float | None
    worst_m: float | None
    wrong: int
    keyframes: int
    error: str

    @property
    def failed(self) -> bool:
        """Whether any frame was lost."""
        return bool(self.lost or self.error)


def bootstrap_cell(task: Task, progress: Progress) -> Figures:
    """Track the case from random frames of it, the seed's, a new tracker each; fewer where there are not so many.

    Raises UserError: no truth, too few frames, an image that cannot be read.
    """
    settings, dataset = settings_of(task, BootstrapSettings), task.noisy
    truth = truth_of(dataset)
    if truth is None:
        raise UserError(f"{dataset.root}: has no ground truth to compare with: add a groundtruth.txt")
    possible = len(task.frames) - settings.frames + 1
    if possible < 1:
        raise UserError(f"{dataset.root}: has {len(task.frames)} frames, too few for starts of {settings.frames}")
    rng = np.random.default_rng(task.seed)
    chosen = sorted(rng.choice(possible, min(settings.starts, possible), replace=False).tolist())
    starts: list[Start] = []
    for done, first in enumerate(chosen, 1):
        frames = task.frames[first : first + settings.frames]
        starts.append(started(dataset, truth, task.options, frames))
        progress("starting", done / len(chosen), f"{sum(start.failed for start in starts)} of {done} lost")
    return figures_of(starts)


def started(dataset: Dataset, truth: Truth, options: Options, frames: range) -> Start:
    """Track frames on their own. Raises UserError: the tracker cannot be made."""
    tracker = make_tracker(
        dataset.rig, options, interval_s=dataset.interval_s(frames), imu=dataset.imu if options.inertial else None
    )
    error = ""
    for k, frame in zip(frames, dataset.frames(frames.start, frames.stop), strict=True):
        try:
            tracker.feed(frame)
        except (UserError, np.linalg.LinAlgError) as problem:
            error = f"frame {k}: {problem}"
            break
    lost = tuple(k for k, report in zip(frames, tracker.reports, strict=False) if report.lost)
    try:
        errors = compare(truth, Estimate(*tracker.trajectory)).position_errors_m
    except UserError:
        return Start(frames.start, lost, None, None, 0, tracker.keyframes, error)
    ate_m, wrong = float(np.sqrt(np.mean(errors**2))), int((errors > WRONG_M).sum())
    return Start(frames.start, lost, ate_m, float(errors.max()), wrong, tracker.keyframes, error)


def figures_of(starts: Sequence[Start]) -> Figures:
    """Counts, and errors of the starts that lost no frame. silent: of these, with a pose that is wrong."""
    good = [start for start in starts if not start.failed]
    ate_mm = np.array([1e3 * start.ate_m for start in good if start.ate_m is not None])
    worst = [1e3 * start.worst_m for start in good if start.worst_m is not None]
    return {
        "starts": len(starts),
        "failed": len(starts) - len(good),
        "broken": sum(bool(start.error) for start in starts),
        "lost": sum(len(start.lost) for start in starts),
        "silent": sum(start.wrong > 0 for start in good),
        "ate_mm": float(np.median(ate_mm)) if ate_mm.size else None,
        "ate_p95_mm": float(np.percentile(ate_mm, 95)) if ate_mm.size else None,
        "ate_max_mm": float(ate_mm.max()) if ate_mm.size else None,
        "pose_max_mm": max(worst, default=None),
        **{f"over_{limit}_mm": int((ate_mm > limit).sum()) for limit in _LIMITS_MM},
        "keyframes": float(np.mean([start.keyframes for start in starts])),
    }
