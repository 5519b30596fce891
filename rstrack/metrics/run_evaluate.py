"""`rstrack evaluate`: a run against the truth of its sequence or a file of poses, and what clock and extrinsics change.

evaluation = run_evaluate(Path("fr1_rpy"), Path("runs/fr1_rpy"), truth_offset="auto")
print(evaluation.text())
tracked = load_run(Path("runs/fr1_rpy"))       # what pictures and pages are made from
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import read_trajectory
from rstrack.data.dataset import Dataset, open_tracked
from rstrack.data.estimate import Estimate, read_estimate, write_info
from rstrack.metrics.association import Comparison, Truth, compare, truth_of
from rstrack.metrics.consistency import TruthNoise
from rstrack.metrics.evaluate import Metrics, evaluate
from rstrack.metrics.truth_fit import (
    ClockFit,
    ExtrinsicsFit,
    TruthExtrinsics,
    TruthOffset,
    fit_clock,
    fit_extrinsics,
    mounted,
    shifted,
)

Found = TypeVar("Found")

# Points of the true path, of which there is one at any time.
_PATH_POINTS = 1000


@dataclass(frozen=True)
class RunEvaluation:
    """Errors with the clocks as they are, and with the truth `offset_s` after the stamps.

    moved: errors there; None with offset_s where nothing was asked and nothing was found. fit: how the offset was
    found; None if it was given. asked: whether it was asked for; else it is a hint. mount, mounted: the truth's
    extrinsics and the errors with them, at the offset where one was asked for; None where they were not.
    """

    metrics: Metrics
    offset_s: float | None = None
    moved: Metrics | None = None
    fit: ClockFit | None = None
    asked: bool = False
    mount: ExtrinsicsFit | None = None
    mounted: Metrics | None = None

    @property
    def chosen(self) -> Metrics:
        """The errors that were asked for."""
        return self.mounted or (self.moved if self.asked and self.moved is not None else self.metrics)

    @property
    def truth_offset(self) -> dict[str, Any] | None:
        """For JSON: offset, how it was found, and the errors there; None without one."""
        if self.moved is None:
            return None
        how = {"sigma_s": None, "criterion": None, "least_s": None} if self.fit is None else self.fit.as_dict()
        return how | {"offset_s": self.offset_s, "metrics": self.moved.as_dict()}

    @property
    def truth_extrinsics(self) -> dict[str, Any] | None:
        """For JSON: extrinsics and the errors with them; None where they were not asked for."""
        if self.mount is None or self.mounted is None:
            return None
        return self.mount.as_dict() | {"metrics": self.mounted.as_dict()}

    def as_dict(self) -> dict[str, Any]:
        """For JSON: the errors with the truth as it is, and beside them those with its offset and its extrinsics."""
        return self.metrics.as_dict() | {
            "truth_offset": self.truth_offset, "truth_extrinsics": self.truth_extrinsics
        }  # fmt: skip

    @property
    def hint(self) -> str | None:
        """One line on an offset that nobody asked for; None without one."""
        if self.moved is None or self.asked:
            return None
        return f"errors are least with {self._clock()}: {_short(self.moved)} (rstrack evaluate ... --truth-offset auto)"

    def text(self) -> str:
        """Tables; a mere hint is one line under them."""
        before = [*self.clocks]
        if self.mount is not None and self.mounted is not None:
            before += [] if before else [f"the truth as it is: {_short(self.metrics)}"]
            before.append(f"{self.mount.text()}: {_short(self.mounted)}")
        hint = [f"hint: {self.hint}"] if self.hint is not None else []
        return "\n".join([*before, *([""] if before else []), self.chosen.text(), *hint])

    @property
    def clocks(self) -> tuple[str, ...]:
        """Where an offset was asked for: errors with and without it, and how it was found, one line each."""
        if self.moved is None or not self.asked:
            return ()
        lines = [f"clocks as they are: {_short(self.metrics)}", f"{self._clock()}: {_short(self.moved)}"]
        if self.fit is not None:
            where = ", ".join(f"{name} {1e3 * tau:+.1f}" for name, tau in self.fit.least_s.items())
            lines.append(f"least by {self.fit.criterion}; each error is least at, ms: {where}")
        return tuple(lines)

    @property
    def by_clock(self) -> tuple[tuple[str, Metrics], ...]:
        """The truth's clock in words, and the errors with it: as stored, and with its offset where there is one."""
        stored = ("truth's clock as stored", self.metrics)
        if self.moved is None or self.offset_s is None:
            return (stored,)
        if self.fit is None:
            return stored, (f"truth's clock moved, {1e3 * self.offset_s:+.1f} ms", self.moved)
        offset = f"{1e3 * self.offset_s:+.1f} ± {1e3 * self.fit.sigma_s:.1f} ms"
        return stored, (f"truth's clock fitted, {offset}", self.moved)

    def _clock(self) -> str:
        assert self.offset_s is not None
        size, side = f"{abs(1e3 * self.offset_s):.1f}", "after" if self.offset_s > 0 else "before"
        spread = f" ± {1e3 * self.fit.sigma_s:.1f}" if self.fit else ""
        return f"the truth {size}{spread} ms {side} the stamps"


def error_note(truth: Truth | None, stamps: FloatArray, T_world_depth: FloatArray) -> str:
    """The error of poses (n, 4, 4) at stamps (n,) so far, for a progress line; empty if it cannot be told."""
    try:
        errors = None if truth is None else compare(truth, Estimate(stamps, T_world_depth)).position_errors_m
    except UserError:
        return ""  # fewer than three poses
    return "" if errors is None else f", ATE {1e3 * np.sqrt(np.mean(errors**2)):.2f} mm"


def add_errors(run: Path, truth: Truth | None, estimate: Estimate, online: Estimate | None = None) -> str:
    """Add the errors of a run that has just been written to its run.json; in words, empty without a truth.

    online: the track before it was corrected. Raises UserError.
    """
    evaluation = evaluated(truth, estimate)
    before = None if online is None else _or_none(evaluate, truth, online)
    errors: dict[str, Any] = {
        "metrics": None if evaluation is None else evaluation.metrics.as_dict(),
        "truth_offset": None if evaluation is None else evaluation.truth_offset,
    }
    if online is not None:
        errors["metrics_online"] = None if before is None else before.as_dict()
    write_info(run, estimate.info | errors)
    lines = [] if before is None else [f"ATE before loops were closed: {1e3 * before.ate_rmse_m:.3f} mm"]
    return "\n".join(lines if evaluation is None else [*lines, "", evaluation.text()])


def evaluated(truth: Truth | None, estimate: Estimate) -> RunEvaluation | None:
    """`evaluate_clocks`; None without a truth, and where fewer than three poses have a true counterpart."""
    return _or_none(evaluate_clocks, truth, estimate)


def evaluate_clocks(truth: Truth, estimate: Estimate, offset: TruthOffset | None = None) -> RunEvaluation:
    """Evaluate with the clocks as they are, and with an offset: given, found, or None.

    None: a truth of poses, which may have a clock of its own, is tried with the best offset, and the result kept if it
    is clear (`ClockFit.is_clear`). A spline is of the same clock as the images. Raises UserError, for an offset only
    if it was asked for.
    """
    metrics = evaluate(truth, estimate)
    if offset is None:
        fit = None if isinstance(truth.motion, Spline) else _or_none(fit_clock, truth, estimate)
        if fit is None or not fit.is_clear:
            return RunEvaluation(metrics)
        return RunEvaluation(metrics, fit.offset_s, evaluate(shifted(truth, fit.offset_s), estimate), fit)
    fit = fit_clock(truth, estimate) if offset == "auto" else None
    tau = float(offset) if fit is None else fit.offset_s
    return RunEvaluation(metrics, tau, evaluate(shifted(truth, tau), estimate), fit, asked=True)


def evaluate_extrinsics(truth: Truth, estimate: Estimate, offset: TruthOffset | None = None) -> RunEvaluation:
    """As `evaluate_clocks`, and with the truth's extrinsics, found at the offset that was asked for. Raises UserError.

    They change the clock by less than its standard deviation: it is not fitted again.
    """
    clocks = evaluate_clocks(truth, estimate, offset)
    if clocks.asked and clocks.offset_s is not None:
        truth = shifted(truth, clocks.offset_s)
    fit = fit_extrinsics(truth, estimate)
    return replace(clocks, mount=fit, mounted=evaluate(mounted(truth, fit.T_body_camera), estimate))


def aligned_clock(truth: Truth, estimate: Estimate, offset: TruthOffset | None) -> Truth:
    """The truth with an offset given or found; None: as it is. Raises UserError."""
    if offset is None:
        return truth
    return shifted(truth, fit_clock(truth, estimate).offset_s if offset == "auto" else float(offset))


def run_evaluate(
    truth_path: Path, estimate_path: Path, camera_file: Path | None = None, truth_offset: TruthOffset | None = None,
    truth_extrinsics: TruthExtrinsics | None = None, truth_noise: TruthNoise | None = None,
) -> RunEvaluation:  # fmt: skip
    """Evaluate a run folder or TUM file against the truth of a sequence folder, or against another TUM file.

    Arguments as in `read_estimate`, `rstrack.data.dataset.open_tracked`, `evaluate_clocks`, `evaluate_extrinsics` and
    `Truth`. Raises UserError.
    """
    estimate = read_estimate(estimate_path)
    truth = replace(_truth(truth_path, estimate_path, estimate, camera_file), noise=truth_noise)
    try:
        how = evaluate_clocks if truth_extrinsics is None else evaluate_extrinsics
        return how(truth, estimate, truth_offset)
    except UserError as error:
        raise UserError(f"{estimate_path}: {error}") from None


# ---------------------------------------------------------------------------------------------------------------------


def _truth(path: Path, run: Path, estimate: Estimate, camera_file: Path | None) -> Truth:
    if Path(path).is_file():
        if camera_file is not None:
            raise UserError(f"{path}: a file of poses needs no cameras: leave the camera file {camera_file} out")
        return Truth(read_trajectory(path, max_gap_s=math.inf), np.empty(0))
    truth = truth_of(open_tracked(path, run, estimate.info, camera_file))
    if truth is None:
        raise UserError(
            f"{path}: has no ground truth to compare with: add a groundtruth.txt, or only plot the estimate"
        )
    return truth


def _or_none(compared: Callable[[Truth, Estimate], Found], truth: Truth | None, estimate: Estimate) -> Found | None:
    """What a comparison finds; None without a truth, and where it raises UserError."""
    try:
        return None if truth is None else compared(truth, estimate)
    except UserError:
        return None


def _short(m: Metrics) -> str:
    parts = [f"ATE {1e3 * m.ate_rmse_m:.2f} mm"]
    if m.rpe_trans_rmse_m_per_s is not None and m.rpe_rot_rmse_deg_per_s is not None:
        parts += [f"{1e3 * m.rpe_trans_rmse_m_per_s:.2f} mm/s", f"{m.rpe_rot_rmse_deg_per_s:.3f} deg/s"]
    return ", ".join(parts)


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
    the truth's clock, see `aligned_clock`. Raises UserError: no run, a given sequence cannot be read, no
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
