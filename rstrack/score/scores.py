"""Scores of methods on the sequences of a suite: errors, frames tracked, NEES, times. What is missing is told.

scores = score_suite(read_suite(Path("suite")), find_methods([Path("results")], names))
atomic_write(out, scores.json_text().encode())
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.images import Sequence as RsgenSequence
from rstrack.bench.measures.track import consistency_of, errors_of
from rstrack.bench.record import Figures, counts
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import Estimate, plain, read_estimate
from rstrack.metrics.association import Truth, compare, truth_of
from rstrack.metrics.consistency import against_first, covariances, horizon_of, motion_errors, turned
from rstrack.metrics.evaluate import evaluate
from rstrack.score.suite import About, MethodResults, Result, Suite, SuiteEntry, read_covariances, read_times

FORMAT = "rstrack-scores/1"
FIGURES = (
    "ate_mm", "drift_mm_s", "drift_deg_s", "line_mm", "line_deg", "tracked_pct", "nees", "nees_first", "median_ms",
)  # fmt: skip
"""What is shown, by the names of `rstrack.bench.figures`, and averaged over a tier."""
_OF_LINES = ("line_mm", "line_deg")
# What a track that is lost still has.
_OF_ANY_TRACK = ("tracked_pct", "median_ms", "p95_ms")

Status = Literal["scored", "lost", "missing", "failed"]


@dataclass(frozen=True)
class SequenceScored:
    """A sequence of the suite. readout_ms: of colour; None with `problem`, why nothing can be scored on it.

    has_lines: its truth is a spline, which the stamps of some real cameras rule out.
    """

    entry: SuiteEntry
    frames: int = 0
    readout_ms: float | None = None
    problem: str = ""
    has_lines: bool = True


@dataclass(frozen=True)
class Score:
    """One method on one sequence.

    status: lost: fewer than half of the frames have a pose; missing: there is no result, or the sequence itself cannot
    be scored on; failed: the result cannot be read or compared. reason: why it is not scored. notes: what was left out
    or assumed.
    """

    status: Status
    reason: str = ""
    figures: Figures = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def value(self, name: str) -> float | None:
        """A figure; errors count of tracks that are kept only."""
        return self.figures.get(name) if self.status == "scored" or name in _OF_ANY_TRACK else None


@dataclass(frozen=True)
class Scores:
    """All of them, by sequence and method; every method has one for every sequence."""

    suite: Suite
    sequences: tuple[SequenceScored, ...]
    methods: tuple[MethodResults, ...]
    by_name: dict[tuple[str, str], Score]

    def of(self, sequence: str, method: str) -> Score:
        """Of a method, by its key."""
        return self.by_name[sequence, method]

    def within(self, tier: str, method: str, status: Status) -> list[str]:
        """The sequences of a tier on which a method has this status."""
        return [e.name for e in self.suite.tier(tier) if self.of(e.name, method).status == status]

    def mean(self, tier: str, method: str, name: str) -> float | None:
        """Of a figure over a whole tier: None if one of its sequences has none, whatever the reason.

        Errors of lines are over those sequences whose truth is a spline.
        """
        poses_only = {s.entry.name for s in self.sequences if not s.problem and not s.has_lines}
        entries = [e for e in self.suite.tier(tier) if name not in _OF_LINES or e.name not in poses_only]
        values = [self.of(entry.name, method).value(name) for entry in entries]
        known = [value for value in values if value is not None]
        return math.fsum(known) / len(known) if known and len(known) == len(values) else None

    @property
    def gaps(self) -> list[str]:
        """What is not scored and why, and what belongs to no sequence: a line each."""
        lines = [f"{s.entry.name}: {s.problem}" for s in self.sequences if s.problem]
        bad = {s.entry.name for s in self.sequences if s.problem}
        for method in self.methods:
            for sequence in (s.entry.name for s in self.sequences if s.entry.name not in bad):
                score = self.of(sequence, method.key)
                lines += [f"{method.name}, {sequence}: {score.reason}"] if score.reason else []
            lines += [f"{path}: holds no trajectory of a sequence of the suite" for path in method.unknown]
        return lines

    def as_dict(self) -> dict[str, Any]:
        """For scores.json: sequences, methods, all scores, and the means of tiers; units are in the names."""
        tiers = {
            tier: {
                method.key: {name: self.mean(tier, method.key, name) for name in FIGURES}
                | {s: self.within(tier, method.key, s) for s in ("scored", "lost", "missing", "failed")}
                for method in self.methods
            }
            for tier in self.suite.tiers
        }
        data: dict[str, Any] = plain({
            "format": FORMAT,
            "suite": {"name": self.suite.name, "version": self.suite.version},
            "sequences": [
                s.entry.model_dump() | {"frames": s.frames, "readout_ms": s.readout_ms, "problem": s.problem}
                for s in self.sequences
            ],
            "methods": {method.key: method.about.model_dump() | {"name": method.name} for method in self.methods},
            "scores": [{"sequence": s, "method": m} | asdict(score) for (s, m), score in self.by_name.items()],
            "means": tiers,
            "gaps": self.gaps,
        })  # fmt: skip
        return data

    def json_text(self) -> str:
        """The file scores.json."""
        return json.dumps(self.as_dict(), indent=1, allow_nan=False) + "\n"


def score_suite(suite: Suite, methods: Sequence[MethodResults], progress: Progress = no_progress) -> Scores:
    """Score every method on every sequence. Problems of a sequence or a result become reasons, and end nothing."""
    sequences, found = [], {}
    for k, entry in enumerate(suite.entries):
        progress("scoring", k / len(suite.entries), entry.name)
        scored, dataset, truth = _opened(suite.root / entry.name, entry)
        sequences.append(scored)
        for method in methods:
            result = method.results.get(entry.name)
            if dataset is None or truth is None:
                score = Score("missing", scored.problem)
            elif result is None:
                score = Score("missing", "no result")
            else:
                try:
                    score = score_result(dataset, truth, result, method.about)
                except (UserError, np.linalg.LinAlgError) as error:  # a covariance that is singular
                    score = Score("failed", str(error))
            found[entry.name, method.key] = score
    progress("scoring", 1.0, "")
    return Scores(suite, tuple(sequences), tuple(methods), found)


def score_result(dataset: Dataset, truth: Truth, result: Result, about: About) -> Score:
    """The errors of `rstrack evaluate`, and what the files beside the trajectory add. Raises UserError."""
    read = read_estimate(result.path)
    # Run folders hold the depth camera's poses, whatever a method's files hold.
    is_color = about.camera == "color" and result.path.is_file()
    T_given_depth = camera_from_depth(dataset) if is_color else np.eye(4)
    estimate = replace(read, T_world_depth=se3.orthonormalise(read.T_world_depth @ T_given_depth))
    notes: list[str] = []
    if about.alignment == "sim3":
        scale = fitted_scale(truth, estimate)
        estimate = Estimate(estimate.stamps, _scaled(estimate.T_world_depth, scale))
        notes.append(f"positions times {scale:.4g}, the scale that fits best")
    found = evaluate(truth, estimate)
    figures = errors_of(found) | consistency_of(found) | {"tracked_pct": 100.0 * found.coverage}
    figures |= _nees_first(truth, estimate, result, T_given_depth, about) | _times(estimate, result, about)
    reason = "" if counts(figures) else f"{found.frames_tracked} of {found.frames} frames have a pose"
    return Score("lost" if reason else "scored", reason, figures, (*found.notes, *notes))


def camera_from_depth(dataset: Dataset) -> FloatArray:
    """T_color_depth (4, 4) between the true cameras of the images: the identity where depth is registered."""
    if not isinstance(dataset.images, RsgenSequence):
        return dataset.rig.T_color_depth
    true = dataset.images.as_taken
    return true.T_color_depth @ se3.inverse(true.T_image_depth)


def fitted_scale(truth: Truth, estimate: Estimate) -> float:
    """What positions are to be multiplied by to fit best after alignment (Umeyama, PAMI 13(4), 1991).

    Raises UserError: fewer than three poses to compare, or all of them in one point.
    """
    found = compare(truth, estimate)
    true, est = (T[:, :3, 3] - T[:, :3, 3].mean(axis=0) for T in (found.T_world_true, found.T_world_est))
    scale = float((true * est).sum() / max((est * est).sum(), np.finfo(float).tiny))
    if not (found.is_determined and scale > 0.0):
        raise UserError("estimate: its scale cannot be fitted: positions lie on a line, or oppose the truth's")
    return scale


# ---------------------------------------------------------------------------------------------------------------------


def _opened(path: Path, entry: SuiteEntry) -> tuple[SequenceScored, Dataset | None, Truth | None]:
    if not path.is_dir():
        return SequenceScored(entry, problem="is not in this folder"), None, None
    try:
        dataset = open_dataset(path)
    except UserError as error:
        return SequenceScored(entry, problem=str(error)), None, None
    shutter = dataset.rig.color_shutter
    if isinstance(dataset.images, RsgenSequence):
        shutter = dataset.images.as_taken.streams["color"].shutter
    truth = truth_of(dataset)
    problem = "has no ground truth here" if truth is None else ""
    # Poses of a truth are looked up between its stamps: a colour camera's need not be a depth frame's.
    truth = truth and replace(truth, interpolate=True)
    has_lines = truth is not None and isinstance(truth.motion, Spline)
    return SequenceScored(entry, len(dataset), 1e3 * shutter.readout_s, problem, has_lines), dataset, truth


def _nees_first(truth: Truth, estimate: Estimate, result: Result, T_given_depth: FloatArray, about: About) -> Figures:
    """NEES/6 of the poses against the first, and the share within the 90 % region; nothing without covariances.

    Scaled positions have other covariances: those are not compared. Raises UserError.
    """
    if about.alignment == "sim3":
        return {}
    if result.covariances is not None:
        posed, covariance = read_covariances(result.covariances)
        posed = replace(posed, T_world_depth=se3.orthonormalise(posed.T_world_depth @ T_given_depth))
        covariance = turned(se3.adjoint(se3.inverse(T_given_depth))[None], covariance)
    else:
        known = covariances(estimate)
        index = np.flatnonzero(np.isfinite(known.pose).all(axis=(1, 2)))
        posed = Estimate(estimate.stamps[index], estimate.T_world_depth[index])
        covariance = against_first(posed.T_world_depth, known.at(index)) if len(index) else np.empty((0, 6, 6))
    if len(posed.stamps) < 2:
        return {}
    found = compare(truth, posed)
    if found.index[0] != 0:
        raise UserError("estimate: the first pose, which covariances refer to, has no true one at its stamp")
    first, later = np.zeros(len(found.index) - 1, np.int64), np.arange(1, len(found.index))
    errors = motion_errors(found.T_world_true, found.T_world_est, first, later)
    horizon = horizon_of(math.inf, errors, covariance[found.index[1:]])
    return {} if horizon is None else {"nees_first": horizon.nees, "within_90_pct": 100.0 * horizon.within[90]}


def _times(estimate: Estimate, result: Result, about: About) -> Figures:
    """Time of a frame, ms: of SEQUENCE.times, else of the run, else as the method states it. Raises UserError."""
    timings = estimate.info.get("timings")
    ms = read_times(result.times) if result.times is not None else None
    if ms is None and isinstance(timings, dict) and timings.get("frame_ms"):
        ms = np.asarray(timings["frame_ms"], float)
    if ms is None:
        return {} if about.ms_per_frame is None else {"median_ms": about.ms_per_frame}
    return {"median_ms": float(np.median(ms)), "p95_ms": float(np.percentile(ms, 95))}


def _scaled(T: FloatArray, scale: float) -> FloatArray:
    out = T.copy()
    out[:, :3, 3] *= scale
    return out
