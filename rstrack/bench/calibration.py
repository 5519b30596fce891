"""How far off cameras may be and still be found, and whether what is said of the errors is true.

print(calibrations(dataset, slice(0, 300), starts=10).text())
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rstrack.bench.bootstrap import generator
from rstrack.calibration.run import calibrate, parameters_of
from rstrack.calibration.unknowns.parameters import DRIFT, EXTRINSICS, NAMES, POSES, Parameters
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import plain
from rstrack.data.noise import NoisyImages
from rstrack.options import Options

# What cameras are told wrong by, and multiples of it: readouts by half, colour's clock in s, extrinsics.
UNIT_READOUT, UNIT_OFFSET_S, UNIT_M, UNIT_RAD = 0.5, 0.015, 5e-3, float(np.radians(0.5))
FACTORS = (0.0, 1.0, 2.0, 4.0)
# σ beyond which a value is wrong, whatever is said of it; and up to which its interval of two σ holds 95 %.
_WRONG, _WITHIN = 4.0, 2.0
_SHOWN = tuple(i for i in range(POSES) if i != DRIFT)


@dataclass(frozen=True)
class Trial:
    """One start. errors, sigmas (10,): of the unknowns that move poses, against the true cameras', in SI units; NaN
    where not told. refused: the line that it ended with.
    """

    factor: float
    start: int
    errors: FloatArray
    sigmas: FloatArray
    converged: bool = False
    refused: str = ""

    @property
    def is_wrong(self) -> bool:
        """Whether a value that is said to be found is not."""
        return self.converged and bool((np.abs(self.errors) > _WRONG * self.sigmas).any())


@dataclass(frozen=True)
class CalibrationTrials:
    """All trials, those of a factor together."""

    name: str
    frames: int
    trials: tuple[Trial, ...]

    def of(self, factor: float) -> list[Trial]:
        """Those that started so far off."""
        return [trial for trial in self.trials if trial.factor == factor]

    def basin(self) -> list[dict[str, Any]]:
        """For each distance: how many were found, and how well; NaN where nothing was."""
        return [self._row(factor) for factor in dict.fromkeys(trial.factor for trial in self.trials)]

    def _row(self, factor: float) -> dict[str, Any]:
        trials = self.of(factor)
        found = [trial for trial in trials if trial.converged and not trial.is_wrong]
        errors = np.abs([trial.errors for trial in found]) if found else np.full((1, POSES), np.nan)
        median = np.array([np.median(e[np.isfinite(e)]) if np.isfinite(e).any() else np.nan for e in errors.T])
        return {
            "factor": factor, "starts": len(trials), "found": len(found),
            "not_converged": sum(not (trial.converged or trial.refused) for trial in trials),
            "refused": sum(bool(trial.refused) for trial in trials), "wrong": sum(trial.is_wrong for trial in trials),
            "median_errors": dict(zip(NAMES, median.tolist(), strict=False)),
        }  # fmt: skip

    def coverage(self) -> dict[str, dict[str, float]]:
        """For each unknown, over all converged trials: part within two σ, RMS of errors over σ, and how many."""
        trials = [trial for trial in self.trials if trial.converged]
        found = {}
        for i in _SHOWN:
            z = np.array([trial.errors[i] / trial.sigmas[i] for trial in trials if trial.sigmas[i] > 0.0])
            if len(z):
                within, rms = float(np.mean(np.abs(z) < _WITHIN)), float(np.sqrt(np.mean(z**2)))
                found[NAMES[i]] = {"within": within, "rms": rms, "trials": float(len(z))}
        return found

    def as_dict(self) -> dict[str, Any]:
        """For JSON; SI units."""
        trials = [vars(trial) | {"wrong": trial.is_wrong} for trial in self.trials]
        head = {"dataset": self.name, "frames": self.frames, "unknowns": NAMES[:POSES]}
        data: dict[str, Any] = plain(head | {"basin": self.basin(), "coverage": self.coverage(), "trials": trials})
        return data

    def text(self) -> str:
        """Two tables: from where cameras are found, and how often errors are within what is said of them."""
        rows = []
        for row in self.basin():
            f, median = row["factor"], row["median_errors"]
            clocks = " ".join(fixed(median[name], 0, 1e6) for name in NAMES[:DRIFT])
            names = NAMES[EXTRINSICS]
            shifts = " ".join(fixed(median[name], 2, 1e3) for name in names[:3])
            turns = " ".join(fixed(median[name], 3, float(np.degrees(1.0))) for name in names[3:])
            counts = (
                f"{row['found']} of {row['starts']}",
                *(str(row[k]) for k in ("not_converged", "refused", "wrong")),
            )
            rows.append((_distance(f), *counts, clocks, shifts, turns))
        head = "told wrong by", "found", "not converged", "refused", "wrong, not noticed", "median us", "mm", "deg"
        known = [
            (name, f"{100 * found['within']:.0f} %", fixed(found["rms"], 2), f"{found['trials']:.0f}")
            for name, found in self.coverage().items()
        ]
        intervals = Table(("", "within 2 sigma", "RMS of errors over sigma", "of"), tuple(known)).text()
        return "\n".join([
            f"{self.name}, {self.frames} frames; errors of depth's and colour's readout and of colour's clock in us",
            "", Table(head, tuple(rows)).text(), "", intervals,
        ])  # fmt: skip


def _distance(factor: float) -> str:
    if not factor:
        return "nothing"
    readout = f"readouts {100 * UNIT_READOUT * factor:.0f} %"
    turn = f"{np.degrees(factor * UNIT_RAD):g} deg"
    return f"{readout}, {1e3 * factor * UNIT_OFFSET_S:g} ms, {1e3 * factor * UNIT_M:g} mm, {turn}"


def calibrations(
    dataset: Dataset, frames: slice = slice(None), starts: int = 5, factors: Sequence[float] = FACTORS,
    noise: tuple[float, float] = (0.0, 0.0), seed: int = 0, options: Options | None = None,
    progress: Progress = no_progress,
) -> CalibrationTrials:  # fmt: skip
    """Calibrate from cameras that are told ever more wrongly, all values at once, each way round at random.

    dataset: with its true cameras. noise: of depth and intensity, see `rstrack.data.noise`, other for each start. A
    readout is never told below 0. Raises UserError: no starts, or factors below 0.
    """
    if starts < 1 or min(factors, default=-1.0) < 0.0:
        raise UserError(f"{starts} starts from {list(factors)}: give 1 or more starts, and factors of 0 or more")
    truth, rng = parameters_of(dataset), generator(seed)
    units = [rng.choice((-1.0, 1.0), 3).tolist() + _directions(rng) for _ in range(starts)]
    trials: list[Trial] = []
    for factor in factors:
        for k, unit in enumerate(units):
            images = NoisyImages(dataset.images, *noise, seed + k) if any(noise) else dataset.images
            told = told_wrong(replace(dataset, images=images), truth, factor, unit)
            trials.append(_trial(told, truth, frames, options, factor, k))
            done = len(trials) / (starts * len(factors))
            progress(
                "calibrating", done, f"{sum(t.converged and not t.is_wrong for t in trials)} of {len(trials)} found"
            )
    return CalibrationTrials(dataset.name, len(range(len(dataset))[frames]), tuple(trials))


def _directions(rng: np.random.Generator) -> list[float]:
    """Unit vectors of a shift and of a turn (6,)."""
    vectors = rng.standard_normal((2, 3))
    flat: list[float] = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).ravel().tolist()
    return flat


def told_wrong(dataset: Dataset, truth: Parameters, factor: float, unit: Sequence[float]) -> Dataset:
    """The dataset with cameras that are off by `factor` units along `unit` (9,): clocks (±1), shift and turn."""
    scales = [UNIT_READOUT * truth.depth_readout_s, UNIT_READOUT * truth.color_readout_s, UNIT_OFFSET_S]
    step = np.zeros(len(NAMES))
    step[:DRIFT] = factor * np.array(scales) * unit[:3]
    step[EXTRINSICS] = factor * np.repeat([UNIT_M, UNIT_RAD], 3) * unit[3:]
    p, rig = truth.moved(step), dataset.rig
    depth, color = (
        replace(shutter, readout_s=max(0.0, readout))
        for shutter, readout in ((rig.depth_shutter, p.depth_readout_s), (rig.color_shutter, p.color_readout_s))
    )
    seen = dataset.seen_with(replace(rig, depth_shutter=depth, color_shutter=color, T_color_depth=p.T_color_depth))
    return seen.with_color_offset(p.color_offset_s)


def _trial(
    told: Dataset, truth: Parameters, frames: slice, options: Options | None, factor: float, start: int
) -> Trial:  # fmt: skip
    nothing = np.full(POSES, np.nan)
    try:
        found = calibrate(told, frames=frames, options=options)
    except UserError as error:
        return Trial(factor, start, nothing, nothing, refused=str(error))
    if not found.solution.finished:
        raise KeyboardInterrupt
    sigmas = found.sigmas[:POSES]
    errors = np.where(np.isfinite(sigmas), found.values.since(truth)[:POSES], np.nan)
    return Trial(factor, start, errors, np.where(sigmas > 0.0, sigmas, np.nan), found.solution.is_settled)
