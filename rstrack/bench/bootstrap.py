"""Which starts of a recording succeed: the tracker begun at many random frames.

print(bootstraps(dataset, Options(), starts=50, frames=20).text())
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate, plain
from rstrack.metrics.association import Truth, compare, truth_of
from rstrack.options import Options
from rstrack.tracking.any_tracker import make_tracker

_LIMITS_M = (1e-3, 5e-3)
_MIN_POSES = 3


@dataclass(frozen=True)
class Start:
    """One run. lost: numbers of its lost frames. ate_m, worst_m: None with too few poses. error: why it broke down."""

    frame: int
    lost: tuple[int, ...]
    ate_m: float | None
    worst_m: float | None
    keyframes: int
    error: str

    @property
    def failed(self) -> bool:
        """Whether any frame was lost."""
        return bool(self.lost or self.error)

    @property
    def fate(self) -> str:
        """What became of it, in words; empty if nothing went wrong."""
        lost = [f"lost: {_numbers(self.lost)}"] if self.lost else []
        return "  ".join(lost + ([f"broke down: {self.error}"] if self.error else []))


@dataclass(frozen=True)
class BootstrapResult:
    """Runs of `frames` frames each, in order of their first frame."""

    name: str
    method: str
    frames: int
    starts: tuple[Start, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON; statistics are over the runs that lost no frame."""
        ate = self._ate()
        some = {"median_ate_m": float(np.median(ate)), "worst_ate_m": float(ate.max())} if ate.size else {}
        over = {f"over_{1e3 * limit:g}_mm": int((ate > limit).sum()) for limit in _LIMITS_M}
        head = {"dataset": self.name, "method": self.method, "frames": self.frames, "starts": len(self.starts)}
        lost = sum(s.failed for s in self.starts)
        runs = [vars(s) | {"failed": s.failed} for s in self.starts]
        data: dict[str, Any] = plain(head | {"lost": lost} | some | over | {"runs": runs})
        return data

    def text(self) -> str:
        """A line for each run, worst last, and a summary."""
        rows = tuple(
            (str(s.frame), fixed(s.ate_m, 3, 1e3), fixed(s.worst_m, 3, 1e3), str(s.keyframes), s.fate)
            for s in sorted(self.starts, key=lambda s: (s.failed, s.ate_m or 0.0))
        )
        lines = [Table(("start", "ATE, mm", "max, mm", "keyframes", ""), rows, words=(4,)).text()]
        ate = self._ate()
        lost = sum(s.failed for s in self.starts)
        lines += ["", f"{self.name}, {self.method}: {len(self.starts)} starts, {self.frames} frames each: {lost} lost"]
        if ate.size:
            over = ", ".join(f"{int((ate > limit).sum())} above {1e3 * limit:g} mm" for limit in _LIMITS_M)
            best = f"median {1e3 * np.median(ate):.3f} mm, worst {1e3 * ate.max():.3f} mm"
            lines.append(f"ATE of the others: {best}; {over}")
        return "\n".join(lines)

    def _ate(self) -> FloatArray:
        return np.array([s.ate_m for s in self.starts if not s.failed and s.ate_m is not None])


def bootstraps(
    dataset: Dataset, options: Options, starts: int = 50, frames: int = 20, seed: int = 0,
    progress: Progress = no_progress,
) -> BootstrapResult:  # fmt: skip
    """Track `frames` frames from each of `starts` random frames (fewer if there are not so many), a new tracker each.

    Errors are those of positions after alignment over the run's own frames (`association.compare`). Raises
    UserError: no truth, too few frames, a seed below 0, an image that cannot be read.
    """
    truth = truth_of(dataset)
    if truth is None:
        raise UserError(f"{dataset.root}: has no ground truth to compare with: add a groundtruth.txt")
    if not _MIN_POSES <= frames <= len(dataset):
        raise UserError(
            f"{dataset.root}: --frames {frames}: a start can be judged by {_MIN_POSES} to {len(dataset)} frames"
        )
    possible = len(dataset) - frames + 1
    chosen = sorted(generator(seed).choice(possible, min(starts, possible), replace=False).tolist())
    runs: list[Start] = []
    for done, first in enumerate(chosen, 1):
        runs.append(_run(dataset, truth, options, range(first, first + frames)))
        failed = sum(run.failed for run in runs)
        progress("starting", done / len(chosen), f"{failed} of {done} lost")
    return BootstrapResult(dataset.name, options.method, frames, tuple(runs))


def generator(seed: int) -> np.random.Generator:
    """Random numbers of a seed. Raises UserError for a seed below 0."""
    if seed < 0:
        raise UserError(f"--seed {seed}: must be 0 or more")
    return np.random.default_rng(seed)


# ---------------------------------------------------------------------------------------------------------------------


def _run(dataset: Dataset, truth: Truth, options: Options, frames: range) -> Start:
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
        return Start(frames.start, lost, None, None, tracker.keyframes, error)
    ate_m = float(np.sqrt(np.mean(errors**2)))
    return Start(frames.start, lost, ate_m, float(errors.max()), tracker.keyframes, error)


def _numbers(frames: Sequence[int]) -> str:
    """Increasing numbers with runs of them as 'a to b'."""
    runs: list[list[int]] = []
    for k in frames:
        if runs and k == runs[-1][-1] + 1:
            runs[-1].append(k)
        else:
            runs.append([k])
    return ", ".join(f"{r[0]}" if len(r) == 1 else f"{r[0]} to {r[-1]}" for r in runs)
