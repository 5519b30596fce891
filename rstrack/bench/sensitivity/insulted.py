"""The table of `rstrack sensitivity --insults`: seeded insults, and what the tracker says and does about them.

report = run_insults(open_dataset(Path("out/demo")), Options(), count=90, out=Path("insults.json"))
print(report.text())

A pose is wrong silently where it is given, not lost, though it is more than 20 mm or 2° off: at once or in the end. The
estimate's world is aligned to the truth's by the frames before the insult, and stays so.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.geometry import se3
from rstrack.bench.changes.edits import reordered
from rstrack.bench.sensitivity.insults import KINDS, Insult, random_insult
from rstrack.bench.sensitivity.settings import kept_results, settings_of
from rstrack.data.dataset import Dataset
from rstrack.metrics.association import angles_deg, true_poses, truth_of
from rstrack.options import Options
from rstrack.tracking.any_tracker import AnyTracker, make_tracker

_WRONG_M, _WRONG_DEG = 0.020, 2.0
# Frames within which a camera has to be found again, and after which a pose moves no more.
_AGAIN, _CONVERGED = 5, 10
_HEAD = (
    "insult", "of them", "silently wrong", "frames of", "worst, mm", "worst, deg", "lost", "place known", "found in 5",
    "moved, mm", "rewritten, mm", "lost/tracked",
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What came of one insult.

    frames first to last - 1 were touched, see `Insult`. lost: frames that were. silent: frames given though wrong.
    worst_m, worst_deg: of the frames given from `first` on. is_place_known: some frame was lost until `last`, and frame
    `last` is where a keyframe is; found_after: frames from there to the first that is right, None if none is.
    moved_m: largest change of a position ten frames after it was first given; rewritten_m: largest change of any
    position when a new piece of the track began. lost_ms, tracked_ms: median time of such frames.
    """

    seed: int
    kind: str
    first: int
    last: int
    frames: int
    lost: int
    silent: tuple[int, ...]
    worst_m: float
    worst_deg: float
    is_place_known: bool
    found_after: int | None
    moved_m: float
    rewritten_m: float
    lost_ms: float | None
    tracked_ms: float

    @property
    def is_found(self) -> bool:
        """Whether the camera was found again in time."""
        return self.found_after is not None and self.found_after < _AGAIN


@dataclass(frozen=True)
class InsultReport:
    """Outcomes of all insults so far, and what they were made with."""

    settings: dict[str, Any]
    outcomes: tuple[Outcome, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON; units are in the names."""
        return {"settings": self.settings, "outcomes": [dataclasses.asdict(outcome) for outcome in self.outcomes]}

    def text(self) -> str:
        """A table for the screen, and a line for every insult with a silent error."""
        wrong = [f"wrong without a word: {_described(outcome)}" for outcome in self.outcomes if outcome.silent]
        return "\n".join([self._title(), "", self._table().text(), *wrong])

    def markdown(self) -> str:
        """The same table."""
        return f"# {self._title()}\n\n{self._table().markdown()}\n"

    def _title(self) -> str:
        begin, end = self.settings["frames"]
        name = f"{self.settings['options']['method']} on {self.settings['dataset']}, frames {begin} to {end - 1}"
        return f"{name}, insults of seeds {self.settings['seed']} and on"

    def _table(self) -> Table:
        kinds = sorted({outcome.kind for outcome in self.outcomes}, key=list(KINDS).index)
        rows = [_row(kind, [o for o in self.outcomes if o.kind == kind]) for kind in kinds]
        return Table(_HEAD, (*rows, _row("all", self.outcomes)))


def run_insults(
    dataset: Dataset,
    options: Options,
    count: int,
    frames: slice = slice(None),
    seed: int = 0,
    out: Path | None = None,
    progress: Progress = no_progress,
) -> InsultReport:
    """Track a sequence `count` times, each time with another insult; kinds take turns, seeds go up from `seed`.

    out: JSON file that is written after each; what it has already, of the same settings, is not tracked again. Raises
    UserError: no truth, no such frames or too few, images that cannot be read, a file that is none of ours.
    """
    settings, chosen = settings_of(dataset, options, frames, seed)
    cut = reordered(dataset, chosen, dataset.stamps[frames])
    known = {o["seed"]: _outcome(o) for o in kept_results(out, settings, "outcomes")}
    report = InsultReport(settings, ())
    kinds = list(KINDS)
    for n in range(count):
        kind = kinds[n % len(kinds)]
        outcome = known.get(seed + n) or judged(random_insult(cut, seed + n, kind), options, seed + n)
        report = dataclasses.replace(report, outcomes=(*report.outcomes, outcome))
        if out is not None and seed + n not in known:
            atomic_write(out, (json.dumps(report.as_dict(), indent=1) + "\n").encode())
        wrong = sum(bool(o.silent) for o in report.outcomes)
        progress("insults", (n + 1) / count, f"{kind}, {wrong} wrong without a word")
    return report


def judged(insult: Insult, options: Options, seed: int) -> Outcome:
    """Track an insulted recording and compare every pose with the truth, when it is given and in the end."""
    dataset, first, last = insult.dataset, insult.first, insult.last
    watched = _watch(dataset, options)
    T_true = _truth(dataset)
    given = [k for k, T in enumerate(watched.at_once) if T is not None]
    final = watched.final
    before = [k for k in given if k < first]
    if not before:
        raise UserError(f"{dataset.name}: its first {first} frames were all lost: insult another sequence")
    T_true_est = mean_pose(np.array([T_true[k] @ se3.inverse(final[k]) for k in before]))
    errors = {k: _errors(T_true[k], [T_true_est @ T for T in (watched.at_once[k], final[k]) if T is not None])
              for k in given if k >= first}  # fmt: skip
    silent = tuple(k for k, (m, deg) in errors.items() if m > _WRONG_M or deg > _WRONG_DEG)
    lost = [k for k in range(len(dataset)) if k not in final]
    near = [options.remoteness(se3.inverse(T_true[k]) @ T_true[last]) for k in watched.keyframes if k < last]
    right = [k for k in errors if k >= last and k not in silent]
    tracked = [s for k, s in enumerate(watched.seconds) if k not in lost and k > first // 2]
    return Outcome(
        seed=seed,
        kind=insult.kind,
        first=first,
        last=last,
        frames=len(dataset),
        lost=len(lost),
        silent=silent,
        worst_m=max((m for m, _ in errors.values()), default=0.0),
        worst_deg=max((deg for _, deg in errors.values()), default=0.0),
        is_place_known=any(first <= k <= last for k in lost) and min(near, default=np.inf) < 1.0,
        found_after=min(right) - last if right else None,
        moved_m=watched.moved_m,
        rewritten_m=watched.rewritten_m,
        lost_ms=1e3 * float(np.median([watched.seconds[k] for k in lost])) if lost else None,
        tracked_ms=1e3 * float(np.median(tracked)),
    )


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

    final: poses in the end. keyframes: frames at which one was made. moved_m, rewritten_m: as of an `Outcome`.
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
    seen = _Watched()
    settled: dict[int, FloatArray] = {}
    for k, frame in enumerate(dataset.frames()):
        begin, pieces = time.perf_counter(), len(tracker.spline_valid)
        tracker.feed(frame)
        seen.seconds.append(time.perf_counter() - begin)
        now = _poses(dataset, tracker)
        seen.at_once.append(now.get(k))
        if len(tracker.spline_valid) > pieces:
            seen.rewritten_m = max(seen.rewritten_m, _largest_move(seen.final, now))
        seen.final = now
        if k >= _CONVERGED and k - _CONVERGED in now:
            settled[k - _CONVERGED] = now[k - _CONVERGED]
    # Frames that the start gave up were never converged.
    seen.moved_m = _largest_move(settled, seen.final)
    seen.keyframes = tuple(k for k, report in enumerate(tracker.reports) if report.keyframe)
    return seen


def _poses(dataset: Dataset, tracker: AnyTracker) -> dict[int, FloatArray]:
    """Poses (4, 4) so far by their frames."""
    stamps, T = tracker.trajectory
    return dict(zip(np.searchsorted(dataset.stamps, stamps).tolist(), T, strict=True))


def _largest_move(before: dict[int, FloatArray], after: dict[int, FloatArray]) -> float:
    moves = [np.linalg.norm(after[k][:3, 3] - T[:3, 3]) for k, T in before.items() if k in after]
    return float(max(moves, default=0.0))


def _truth(dataset: Dataset) -> FloatArray:
    """True poses (n, 4, 4) of all frames. Raises UserError if some frame has none."""
    truth = truth_of(dataset)
    index, T = (np.empty(0, int), None) if truth is None else true_poses(truth.motion, dataset.stamps, True)
    if T is None or len(index) < len(dataset):
        raise UserError(f"{dataset.root}: insults need the true pose of every frame: {len(index)} have one")
    return T


def _errors(T_true: FloatArray, T_world_est: Sequence[FloatArray]) -> tuple[float, float]:
    """Largest errors of estimates (4, 4) of one pose, m and degrees."""
    est = np.array(T_world_est)
    metres = np.linalg.norm(est[:, :3, 3] - T_true[:3, 3], axis=1)
    return float(metres.max()), float(angles_deg(np.broadcast_to(T_true, est.shape), est).max())


def _described(outcome: Outcome) -> str:
    o = outcome
    return (
        f"seed {o.seed}, {o.kind} in frames {o.first} to {o.last - 1}: {len(o.silent)} frames from {o.silent[0]} to "
        f"{o.silent[-1]}, {1e3 * o.worst_m:.0f} mm and {o.worst_deg:.1f} degrees at worst"
    )


def _row(kind: str, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    known = [o for o in outcomes if o.is_place_known]
    ratios = [o.lost_ms / o.tracked_ms for o in outcomes if o.lost_ms is not None]
    return (
        kind,
        str(len(outcomes)),
        str(sum(bool(o.silent) for o in outcomes)),
        str(sum(len(o.silent) for o in outcomes)),
        fixed(max((o.worst_m for o in outcomes), default=0.0), 1, 1e3),
        fixed(max((o.worst_deg for o in outcomes), default=0.0), 2),
        str(sum(o.lost for o in outcomes)),
        str(len(known)),
        str(sum(o.is_found for o in known)),
        fixed(max((o.moved_m for o in outcomes), default=0.0), 3, 1e3),
        fixed(max((o.rewritten_m for o in outcomes), default=0.0), 3, 1e3),
        fixed(float(np.median(ratios)) if ratios else None, 2),
    )


def _outcome(data: dict[str, Any]) -> Outcome:
    return Outcome(**{**data, "silent": tuple(data["silent"])})
