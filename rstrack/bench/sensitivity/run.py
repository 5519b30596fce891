"""The table of `rstrack sensitivity`: every case tracked, and its errors beside those of the untouched sequence.

report = run_sensitivity(open_dataset(Path("out/demo")), Options(), out=Path("sensitivity.json"))
print(report.text())
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsgen.console.progress import Progress, no_progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rstrack.bench.sensitivity.cases import Case, cases
from rstrack.bench.sensitivity.changes import reordered
from rstrack.bench.sensitivity.settings import kept_results, settings_of
from rstrack.data.dataset import Dataset
from rstrack.options import Options
from rstrack.tracking.runs.run import track

_HEAD = ("case", "ATE, mm", "x untouched", "drift, mm/s", "drift, deg/s", "lost", "of frames")


@dataclass(frozen=True)
class Score:
    """What one case came to; None where too few frames were tracked. lost: of `frames`."""

    case: str
    ate_m: float | None
    drift_m_per_s: float | None
    drift_deg_per_s: float | None
    lost: int
    frames: int


@dataclass(frozen=True)
class Sensitivity:
    """Scores of all cases so far, the untouched sequence first, and what they were made with."""

    settings: dict[str, Any]
    scores: tuple[Score, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON; units are in the names."""
        return {"settings": self.settings, "scores": [dataclasses.asdict(score) for score in self.scores]}

    def text(self) -> str:
        """A table for the screen."""
        return f"{self._title()}\n\n{self._table().text()}"

    def markdown(self) -> str:
        """The same table."""
        return f"# {self._title()}\n\n{self._table().markdown()}\n"

    def _title(self) -> str:
        begin, end = self.settings["frames"]
        return f"{self.settings['options']['method']} on {self.settings['dataset']}, frames {begin} to {end - 1}"

    def _table(self) -> Table:
        base = self.scores[0].ate_m if self.scores else None
        return Table(_HEAD, tuple(_row(score, base) for score in self.scores))


def run_sensitivity(
    dataset: Dataset,
    options: Options,
    frames: slice = slice(None),
    seed: int = 0,
    out: Path | None = None,
    progress: Progress = no_progress,
) -> Sensitivity:
    """Track every case of `cases` over some frames.

    out: JSON file that is written after each case; what it has already, of the same settings, is not tracked again.
    Raises UserError: no truth, no such frames, images that cannot be read, a file that is none of ours;
    KeyboardInterrupt once a case that was interrupted has ended.
    """
    settings, chosen = settings_of(dataset, options, frames, seed)
    cut = reordered(dataset, chosen, dataset.stamps[frames])
    kept = {score["case"]: Score(**score) for score in kept_results(out, settings, "scores")}
    report = Sensitivity(settings, ())
    asked = cases(cut, seed)
    for n, case in enumerate(asked):

        def tell(_: str, fraction: float, note: str, n: int = n, case: Case = case) -> None:
            progress("sensitivity", (n + fraction) / len(asked), f"{case.name}, {note}")

        score = kept.get(case.name) or _score(case, cut, options, tell)
        report = dataclasses.replace(report, scores=(*report.scores, score))
        if out is not None and case.name not in kept:
            atomic_write(out, (json.dumps(report.as_dict(), indent=2) + "\n").encode())
    return report


# ---------------------------------------------------------------------------------------------------------------------


def _score(case: Case, dataset: Dataset, options: Options, progress: Progress) -> Score:
    changed = case.change(dataset)
    with tempfile.TemporaryDirectory(prefix="rstrack-") as folder:
        result = track(changed, options, Path(folder), progress=progress)
    if result.end == "interrupted":
        raise KeyboardInterrupt
    if result.unreadable:
        raise UserError(result.unreadable[0])
    # A tracker that broke down has lost the rest.
    lost = len(changed) - len(result.estimate.stamps)
    m = result.metrics
    if m is None:
        return Score(case.name, None, None, None, lost, len(changed))
    return Score(case.name, m.ate_rmse_m, m.rpe_trans_rmse_m_per_s, m.rpe_rot_rmse_deg_per_s, lost, len(changed))


def _row(score: Score, base: float | None) -> tuple[str, ...]:
    ratio = score.ate_m / base if score.ate_m is not None and base else None
    drift = fixed(score.drift_m_per_s, 3, 1e3), fixed(score.drift_deg_per_s, 3)
    return (score.case, fixed(score.ate_m, 3, 1e3), fixed(ratio, 2), *drift, str(score.lost), str(score.frames))
