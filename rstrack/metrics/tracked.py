"""A run beside the truth of its sequence: what pictures and pages of it are made from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset, open_tracked
from rstrack.data.estimate import Estimate, read_estimate
from rstrack.metrics.association import Comparison, Truth, compare, truth_of
from rstrack.metrics.clock import TruthOffset
from rstrack.metrics.run_evaluate import aligned_clock

# Points of the true path, of which there is one at any time.
_PATH_POINTS = 1000


@dataclass(frozen=True)
class Tracked:
    """One estimate and what it is compared with; dataset, truth, found: None where they cannot be had.

    notes: why not.
    """

    estimate: Estimate
    dataset: Dataset | None = None
    truth: Truth | None = None
    found: Comparison | None = None
    notes: tuple[str, ...] = ()

    @property
    def path(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) s and T_world_depth (n, 4, 4) of the estimate, in the truth's world where there is one."""
        T = self.estimate.T_world_depth
        return self.estimate.stamps, T if self.found is None else self.found.T_true_est @ T

    @property
    def begin_s(self) -> float:
        """Stamp of the first frame, s; of the first pose where the run does not list its frames."""
        return float(self.frames[0]["stamp"] if self.frames else self.estimate.stamps[0])

    @property
    def frames(self) -> list[dict[str, Any]]:
        """The tracker's diagnostics, one dict a frame."""
        frames = self.estimate.info.get("frames")
        if not isinstance(frames, list):
            return []
        return [f for f in frames if isinstance(f, dict) and isinstance(f.get("stamp"), int | float)]


def load_run(
    run: Path, sequence: Path | None = None, camera_file: Path | None = None, dataset: Dataset | None = None,
    truth_offset: TruthOffset | None = None,
) -> Tracked:  # fmt: skip
    """Read a run folder and compare it with the truth of its sequence.

    sequence: the folder where the sequence is; by default the one that run.json names, and if that is gone there is no
    comparison. camera_file: see `rstrack.data.dataset.open_tracked`. dataset: the same, already open. truth_offset: of
    the truth's clock, see `run_evaluate.aligned_clock`. Raises UserError: no run, a given sequence cannot be read, no
    such offset is found.
    """
    estimate = read_estimate(run)
    notes: list[str] = []
    if dataset is None:
        dataset = _dataset(run, estimate, sequence, camera_file, notes)
    if dataset is None:
        return Tracked(estimate, notes=tuple(notes))
    truth = truth_of(dataset)
    if truth is None:
        notes.append(f"The sequence {dataset.name} has no ground truth, so there are no errors to show.")
        return Tracked(estimate, dataset, notes=tuple(notes))
    truth = aligned_clock(truth, estimate, truth_offset)
    try:
        found = compare(truth, estimate)
    except UserError as error:
        return Tracked(estimate, dataset, truth, notes=(*notes, f"No errors: {error}."))
    return Tracked(estimate, dataset, truth, found, tuple(notes))


def true_path(truth: Truth, begin: float, end: float) -> tuple[FloatArray, FloatArray]:
    """Times (n,) s within [begin, end] and poses T_world_depth (n, 4, 4) of the true path there."""
    motion = truth.motion
    if not isinstance(motion, Spline):
        inside = (motion.stamps >= begin - 1e-6) & (motion.stamps <= end + 1e-6)
        return motion.stamps[inside], motion.T_world_cam[inside]
    t = np.linspace(max(begin, motion.t_begin), min(end, motion.t_end), _PATH_POINTS)
    return t, motion.pose(t)


# ---------------------------------------------------------------------------------------------------------------------


def _dataset(
    run: Path, estimate: Estimate, sequence: Path | None, camera_file: Path | None, notes: list[str]
) -> Dataset | None:
    if sequence is not None:
        return open_tracked(sequence, run, estimate.info, camera_file)
    recorded = estimate.info.get("dataset")
    path = recorded.get("path") if isinstance(recorded, dict) else None
    if not isinstance(path, str):
        notes.append("The run does not state where its sequence is, so there are no errors and no images: name it with "
                     "--sequence.")  # fmt: skip
        return None
    try:
        return open_tracked(Path(path), run, estimate.info, camera_file)
    except UserError as error:
        notes.append(f"No errors and no images: {error}. If the sequence has moved, name it with --sequence.")
        return None
