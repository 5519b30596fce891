"""Measures of calibrations with the lens: `lens`, wrong lenses of a rendering; `crossed`, a track with the camera that
was found on another recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.geometry.camera import Camera
from rstrack.bench.definitions import SequenceEntry
from rstrack.bench.measures.track import track_cell
from rstrack.bench.record import Figures
from rstrack.bench.settings import Settings, settings_of
from rstrack.bench.task import Task
from rstrack.calibration.findings.lens_pixels import displacement_px, rms
from rstrack.calibration.findings.result import Calibration
from rstrack.calibration.run import calibrate, parameters_of
from rstrack.calibration.unknowns.parameters import COLOR_LENS
from rstrack.data.camera_file import usual
from rstrack.data.dataset import open_dataset

# How far lenses are told wrong: parts, px of 640, and σ of distortion as OpenCV counts it.
_FOCAL, _CENTER_PX, _DISTORTION = 0.03, 15.0, (0.06, 0.06, 0.002, 0.002, 0.06)
_WITHIN = 2.0


class LensSettings(Settings):
    """starts: wrong lenses that are tried."""

    starts: int = Field(default=2, ge=1)


class CrossedSettings(Settings):
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
    atomic_write(file, found.camera_file().encode())
    entry = task.cell.case_entry.model_copy(update={"camera": file.resolve()})
    crossed = replace(task, cell=replace(task.cell, case_entry=entry))
    return track_cell(crossed, progress) | {"calibration_s": found.seconds}


def lens_cell(task: Task, progress: Progress) -> Figures:
    """Find a lens that is told wrong by 3 %, 15 of 640 px and distortion, and readouts that are told to be none.

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
        told = replace(rig, depth_camera=wrong, color_camera=wrong, sigma=usual(wrong))
        depth, color = (replace(shutter, readout_s=0.0) for shutter in (rig.depth_shutter, rig.color_shutter))
        dataset = task.noisy.seen_with(replace(told, depth_shutter=depth, color_shutter=color))
        found = calibrate(dataset, frames=task.cell.piece, options=task.options)
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


def _errors_over_sigma(found: Calibration, true: Camera, task: Task) -> list[float]:
    """Of the lens, the readouts and, unless a driver's stamps hide it, colour's clock, of those that are told."""
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
