"""Measures of calibrations, with errors over their σ.

`calibration`: how far off cameras may be and still be found. `lens`: wrong lenses of a rendering. `crossed`: a track
with the camera that was found on another recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import Field

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.geometry.camera import Camera
from rsgen.sequence.camera_yaml import TRUE_CAMERAS
from rstrack.bench.cells import SequenceEntry, StrictModel
from rstrack.bench.measures.track import track_cell
from rstrack.bench.record import Figures
from rstrack.bench.task import Task, settings_of
from rstrack.calibration.figures import displacement_px, rms
from rstrack.calibration.parameters import COLOR_LENS, DRIFT, EXTRINSICS, NAMES, POSES, Parameters
from rstrack.calibration.record import camera_file_of
from rstrack.calibration.result import CameraCalibration
from rstrack.calibration.run import calibrate, parameters_of
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.rig import sigma_of_file

# How wrong cameras are stated, and multiples of it: readouts by half, colour's clock in s, extrinsics.
UNIT_READOUT, UNIT_OFFSET_S, UNIT_M, UNIT_RAD = 0.5, 0.015, 5e-3, float(np.radians(0.5))
# σ beyond which a value is wrong, whatever is reported of it; and up to which its interval of two σ holds 95 %.
_WRONG, _WITHIN = 4.0, 2.0
_DEG = 180.0 / np.pi
# The unknowns that move poses, as figures name them: unit and how many of it are in the SI unit.
_UNKNOWNS = (
    ("depth_readout", "ms", 1e3), ("color_readout", "ms", 1e3), ("color_clock", "ms", 1e3), ("color_drift", "ppm", 1e6),
    ("x", "mm", 1e3), ("y", "mm", 1e3), ("z", "mm", 1e3),
    ("rx", "deg", _DEG), ("ry", "deg", _DEG), ("rz", "deg", _DEG),
)  # fmt: skip

# How wrong lenses are stated: parts, px of 640, and σ of distortion as OpenCV counts it.
_FOCAL, _CENTER_PX, _DISTORTION = 0.03, 15.0, (0.06, 0.06, 0.002, 0.002, 0.06)


class CalibrationSettings(StrictModel):
    """starts: wrong cameras at each distance. factors: distances in units of 50 % of readouts, 15 ms, 5 mm, 0.5 deg."""

    starts: int = Field(default=5, ge=1)
    factors: tuple[float, ...] = Field(default=(0.0, 1.0, 2.0, 4.0), min_length=1)


@dataclass(frozen=True)
class CalibrationTrial:
    """One start. errors, sigmas (10,): of the unknowns that move poses, against the true cameras', in SI units; NaN
    where not determined. refused: the line that it ended with.
    """

    factor: float
    errors: FloatArray
    sigmas: FloatArray
    converged: bool = False
    refused: str = ""
    seconds: float = 0.0

    @property
    def is_wrong(self) -> bool:
        """Whether a value that is reported as found is not."""
        return self.converged and bool((np.abs(self.errors) > _WRONG * self.sigmas).any())

    @property
    def is_found(self) -> bool:
        """Whether it is found within its error."""
        return self.converged and not self.is_wrong


def calibration_cell(task: Task, progress: Progress) -> Figures:
    """Calibrate the case from cameras that are stated ever more wrongly, all values at once, each way round at random.

    The sequence's cameras are taken for the truth; of one that declares others, those in truth/cameras.yaml. The case's
    noise is another for each start. A readout is never stated below 0. Raises UserError: factors below 0.
    """
    settings = settings_of(task, CalibrationSettings)
    if min(settings.factors) < 0.0:
        raise UserError(f"factors {list(settings.factors)}: must be 0 or more")
    dataset, noise = true_dataset(task), task.noise
    truth, rng = parameters_of(dataset), np.random.default_rng(task.seed)
    units = [rng.choice((-1.0, 1.0), 3).tolist() + _directions(rng) for _ in range(settings.starts)]
    trials: list[CalibrationTrial] = []
    for factor in settings.factors:
        for k, unit in enumerate(units):
            noisy = dataset.noisy(noise.sigma_depth, noise.sigma_intensity, task.seed * settings.starts + k)
            wrong = stated_wrong(noisy, truth, factor, unit)
            trials.append(_trial(task, wrong, truth, factor))
            found = sum(trial.is_found for trial in trials)
            done = len(trials) / (len(units) * len(settings.factors))
            progress("calibrating", done, f"{found} of {len(trials)} found")
    return figures_of(trials)


def true_dataset(task: Task) -> Dataset:
    """The task's dataset with its true cameras, where its own are claims. Raises UserError."""
    entry, true = task.cell.case_entry, task.root / TRUE_CAMERAS
    if entry.camera is None and true.exists():
        task = replace(task, cell=replace(task.cell, case_entry=entry.model_copy(update={"camera": true})))
    return task.dataset


def stated_wrong(dataset: Dataset, truth: Parameters, factor: float, unit: Sequence[float]) -> Dataset:
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


def figures_of(trials: Sequence[CalibrationTrial]) -> Figures:
    """What became of the trials by factor, median errors of those that were found; and of all that converged the part
    within two σ, and the RMS of errors over σ.
    """
    figures: Figures = {}
    for factor in dict.fromkeys(trial.factor for trial in trials):
        these = [trial for trial in trials if trial.factor == factor]
        found = [trial for trial in these if trial.is_found]
        figures |= {
            f"found_pct_{factor:g}x": 100.0 * len(found) / len(these),
            f"not_converged_{factor:g}x": sum(not (trial.converged or trial.refused) for trial in these),
            f"refused_{factor:g}x": sum(bool(trial.refused) for trial in these),
            f"wrong_unnoticed_{factor:g}x": sum(trial.is_wrong for trial in these),
        }
        for i, (name, unit, scale) in enumerate(_UNKNOWNS):
            errors = [scale * abs(float(trial.errors[i])) for trial in found if np.isfinite(trial.errors[i])]
            figures[f"median_{name}_{unit}_{factor:g}x"] = float(np.median(errors)) if errors else None
    converged = [trial for trial in trials if trial.converged]
    everything: list[float] = []
    for i, (name, _, _) in enumerate(_UNKNOWNS):
        z = [float(trial.errors[i] / trial.sigmas[i]) for trial in converged if trial.sigmas[i] > 0.0]
        if i != DRIFT:
            everything += z
            figures |= _coverage(f"_{name}", z)
    seconds = [trial.seconds for trial in trials if not trial.refused]
    return figures | _coverage("", everything) | {"calibration_s": float(np.mean(seconds)) if seconds else None}


# ---------------------------------------------------------------------------------------------------------------------


def _coverage(name: str, z: Sequence[float]) -> Figures:
    """Of errors over their σ."""
    return {
        f"within_2_sigma_pct{name}": 100.0 * float(np.mean(np.abs(z) < _WITHIN)) if z else None,
        f"rms_over_sigma{name}": float(np.sqrt(np.mean(np.square(z)))) if z else None,
        f"told{name}": len(z),
    }


def _directions(rng: np.random.Generator) -> list[float]:
    """Unit vectors of a shift and of a turn (6,)."""
    vectors = rng.standard_normal((2, 3))
    flat: list[float] = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).ravel().tolist()
    return flat


def _trial(task: Task, stated: Dataset, truth: Parameters, factor: float) -> CalibrationTrial:
    try:
        found = calibrate(stated, frames=task.cell.frames, options=task.options)
    except UserError as error:
        return CalibrationTrial(factor, np.full(POSES, np.nan), np.full(POSES, np.nan), refused=str(error))
    if not found.solution.finished:
        raise KeyboardInterrupt
    sigmas = found.sigmas[:POSES]
    errors = np.where(np.isfinite(sigmas), found.values.since(truth)[:POSES], np.nan)
    sigmas = np.where(sigmas > 0.0, sigmas, np.nan)
    return CalibrationTrial(factor, errors, sigmas, found.solution.is_settled, seconds=found.seconds)


class LensSettings(StrictModel):
    """starts: wrong lenses that are tried."""

    starts: int = Field(default=2, ge=1)


class CrossedSettings(StrictModel):
    """calibrated_on: the other recording's folder in --data."""

    calibrated_on: str


def crossed_cell(task: Task, progress: Progress) -> Figures:
    """The figures of `track` with the camera that `calibrate` finds on another recording, from the same camera file."""
    other = task.sources.folder(SequenceEntry(path=Path(settings_of(task, CrossedSettings).calibrated_on)), "other")
    found = calibrate(open_dataset(other, task.cell.case_entry.camera), options=task.options, progress=progress)
    if not found.solution.finished:
        raise KeyboardInterrupt
    task.out.mkdir(parents=True, exist_ok=True)
    file = task.out / "camera.yaml"
    atomic_write(file, camera_file_of(found).encode())
    entry = task.cell.case_entry.model_copy(update={"camera": file.resolve()})
    crossed = replace(task, cell=replace(task.cell, case_entry=entry))
    return track_cell(crossed, progress) | {"calibration_s": found.seconds}


def lens_cell(task: Task, progress: Progress) -> Figures:
    """Find a lens that is stated wrong by 3 %, 15 of 640 px and distortion, and readouts that are stated as none.

    Of a rendering whose depth is registered to colour. Raises UserError: its depth is not.
    """
    rig, rng = task.noisy.rig, np.random.default_rng(task.seed)
    if not rig.is_registered:
        raise UserError(f"{task.cell.name}: depth is not registered to colour")
    before: list[float] = []
    after: list[float] = []
    z: list[float] = []
    seconds: list[float] = []
    count = settings_of(task, LensSettings).starts
    for k in range(count):
        progress("lenses", k / count, "")
        wrong = _wrong(rig.color_camera, rng)
        before.append(rms(displacement_px(rig.color_camera, wrong)))
        stated = replace(rig, depth_camera=wrong, color_camera=wrong, sigma=sigma_of_file(wrong))
        depth, color = (replace(shutter, readout_s=0.0) for shutter in (rig.depth_shutter, rig.color_shutter))
        dataset = task.noisy.seen_with(replace(stated, depth_shutter=depth, color_shutter=color))
        found = calibrate(dataset, frames=task.cell.frames, options=task.options)
        if not found.solution.finished:
            raise KeyboardInterrupt
        after.append(rms(displacement_px(rig.color_camera, found.calibrated().rig.color_camera)))
        z += _errors_over_sigma(found, rig.color_camera, task)
        seconds.append(found.seconds)
    return {
        "before_px": float(np.median(before)), "after_px": float(np.median(after)), "after_px_max": max(after),
        "within_2_sigma_pct": 100.0 * float(np.mean(np.abs(z) < _WITHIN)) if z else None,
        "rms_over_sigma": float(np.sqrt(np.mean(np.square(z)))) if z else None, "told": len(z),
        "calibration_s": float(np.mean(seconds)),
    }  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------------


def _wrong(camera: Camera, rng: np.random.Generator) -> Camera:
    sign, scale = rng.choice((-1.0, 1.0), 3), camera.width / 640
    focal = 1.0 + _FOCAL * sign[0]
    bent = tuple(float(x) for x in rng.standard_normal(5) * _DISTORTION)
    return replace(
        camera, fx=camera.fx * focal, fy=camera.fy * focal, cx=camera.cx + _CENTER_PX * scale * sign[1],
        cy=camera.cy + _CENTER_PX * scale * sign[2], model="radtan", distortion=bent,
    )  # fmt: skip


def _errors_over_sigma(found: CameraCalibration, true: Camera, task: Task) -> list[float]:
    """Of the lens, the readouts and, unless a driver's stamps hide it, colour's clock, of those that are determined."""
    lens, truth = found.calibrated().rig.color_camera, parameters_of(task.dataset)
    bent = (*true.distortion, *(0.0,) * 5)[:5]
    errors = [
        lens.fx / true.fx - 1.0, lens.fy / true.fy - 1.0, (lens.cx - true.cx) / true.fx, (lens.cy - true.cy) / true.fy,
        *(a - b for a, b in zip(lens.distortion, bent, strict=False)),
    ]  # fmt: skip
    sigmas = np.sqrt(np.diag(found.solution.covariance))[COLOR_LENS]
    timing = task.dataset.timing
    known = slice(0, 2 if timing is not None and timing.is_jittered else 3)
    clocks = found.values.since(truth)[known] / np.where(found.sigmas[known] > 0.0, found.sigmas[known], np.nan)
    return [float(x) for x in (*(np.array(errors) / sigmas), *clocks) if np.isfinite(x)]
