"""Calibrate a recording's cameras from the recording itself.

found = calibrate(open_dataset(Path("recording")))
print(found.text())
Path("camera.yaml").write_text(camera_file_of(found))
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from rsgen.array_types import BoolArray
from rsgen.console.progress import Progress, no_progress
from rsgen.device.arrays import Engine, engine
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan
from rsgen.geometry.spline import Spline
from rstrack.calibration.depth_pattern import pattern_by
from rstrack.calibration.devices import Device, device_notes
from rstrack.calibration.figures import motion_of, pace_of, residuals_at, residuals_now, some_of
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.pairs.trust import trust_in
from rstrack.calibration.pairs.window import RecordingWindow
from rstrack.calibration.parameters import (
    COLOR_LENS,
    DEPTH,
    DEPTH_LENS,
    DRIFT,
    GROUPS,
    LENSES,
    Known,
    Parameters,
    free_of,
)
from rstrack.calibration.result import CameraCalibration
from rstrack.calibration.solve import solve
from rstrack.calibration.stages import StageResult, in_stages, progress_watch
from rstrack.calibration.start import TrackedSpline, first_track, load_window
from rstrack.data.dataset import Dataset
from rstrack.options import Options
from rstrack.tracking.first_look import wants_pattern

# Frames of a window, the fewest that one may have, and how many windows there are at least and at most.
_FRAMES, _FEWEST_FRAMES, _FEWEST, _MOST = 30, 14, 3, 12
# Seconds over which colour's clock must be seen for its drift to be asked for.
_DRIFT_S = 4.0
# Windows that short recordings are cut into.
_SEVERAL = 6
# Levels of the pyramid that it begins on.
_COARSE = (2,)
# See `trust_in`: 0.83 to 0.99 where there is something to see, with a Kinect's noise too, below 0.3 on bare walls.
_TRUST = 0.5
# Ways in which images may be read, windows with which they are tried, and steps at most.
_AXES: tuple[Scan, ...] = ("top-bottom", "left-right")
_TRIED, _TRIED_STEPS = 2, 5
# Unknowns of a lens that are its distortion, of radial-tangential ones.
_COEFFICIENTS = 5


def calibrate(
    dataset: Dataset, groups: Sequence[str] | None = None, frames: slice = slice(None), options: Options | None = None,
    progress: Progress = no_progress, device: Device | None = None,
) -> CameraCalibration:  # fmt: skip
    """Readouts, colour's clock, extrinsics, lenses and depth of a dataset, from the values of its cameras on.

    groups: of GROUPS, what may change; by default the first three, but where depth is registered to colour the lens in
    place of extrinsics, unless it is exact.
    device: what is published of its readouts is where they start and what they are drawn to, unless the recording
    contradicts it.
    Where Ctrl-C is pressed while it solves, the best so far is returned, marked so. Raises UserError: too few frames,
    or too few that can be followed; unknown groups; an image that cannot be read.
    """
    begun = time.perf_counter()
    options = options or Options()
    groups = _usual(dataset) if groups is None else groups
    _check(dataset, groups, frames)
    chosen = range(len(dataset))[frames]
    e = engine(options.backend)  # before anything else imports Dr.Jit, which then would choose a libLLVM itself
    if "intrinsics" in groups:
        dataset = _bent(dataset)
    before = device.known(parameters_of(dataset)) if device else Known.nothing(parameters_of(dataset))
    start = before.values
    track = first_track(dataset, chosen, options, progress)
    parts = _windows(dataset, chosen, track)
    free = _free(dataset, groups, parts)
    terms = PairTerms(e, dataset, free)
    windows = _loaded(dataset, terms, parts, track.spline, start, options, progress)
    if not dataset.scan_named and "readout" in groups:
        dataset = _oriented(e, dataset, windows, start, progress)
        terms = PairTerms(e, dataset, free)
        windows = [each.read_by(terms) for each in windows]
    residuals = residuals_at(some_of(windows), terms, start)
    known = before.with_lenses() if "intrinsics" in groups else before
    rough = [replace(each, is_rough=True) for each in windows]
    coarse = solve(rough, terms, start, free, _COARSE, progress_watch(progress, 0.15), known)
    windows = [replace(each, is_rough=False) for each in rough]
    stage = StageResult(windows, coarse, True, False)
    if coarse.finished:
        kept = _trusted(dataset, windows, terms, coarse.values)
        parts, windows = [parts[k] for k in kept], [windows[k] for k in kept]

        def staged(known: Known, p: Parameters) -> StageResult:
            is_exact = not dataset.rig.sigma.depth_inverse_offset
            return in_stages(windows, partial(PairTerms, e, dataset), known, p, free, is_exact, progress)

        stage = staged(known, coarse.values)
        contradicted = before.contradicted(stage.solution.values, stage.solution.sigmas)
        if stage.solution.finished and contradicted.any():
            known = known.without(contradicted)
            stage = staged(known, stage.solution.values)
    solution, keeps_file_lens = stage.solution, stage.keeps_file_lens
    free[LENSES] &= not keeps_file_lens
    pattern_note = ""
    if solution.finished and wants_pattern(dataset):
        pattern = pattern_by(dataset, parts, stage.windows, solution.values, progress)
        pattern_note = pattern.text()
        if pattern.pattern:  # else it stays open, and 'track' looks for it
            dataset = dataset.with_depth_pattern(pattern.pattern)
    progress("calibrating", 1.0, "done")
    free[DRIFT] &= stage.drifts
    motion = motion_of(dataset, parts, track.spline)
    notes = device_notes(device, before, known, solution.sigmas) if device else ()
    pace = pace_of(dataset, track.frames(dataset, chosen), track.spline)
    both, seconds = (residuals, residuals_now(some_of(stage.windows))), time.perf_counter() - begun
    return CameraCalibration(
        dataset, start, solution, free, tuple(parts), motion, seconds, both, pace, notes, keeps_file_lens,
        pattern_note=pattern_note,
    )  # fmt: skip


def _loaded(
    dataset: Dataset, terms: PairTerms, parts: Sequence[range], track: Spline, start: Parameters, options: Options,
    progress: Progress,
) -> list[RecordingWindow]:  # fmt: skip
    """Knots of every other window lie half a spacing later.

    No spline follows a hand quite, and what it leaves passes for other clocks: one way for these knots, another way for
    those. So it averages out, and the windows' scatter has it.
    """
    base, windows = dataset.with_color_offset(0.0, drift=0.0), []
    for n, part in enumerate(parts):
        progress("calibrating", 0.15 * n / len(parts), "reading images")
        phase = replace(options, knot_phase=(options.knot_phase + 0.5 * (n % 2)) % 1.0)
        windows.append(load_window(terms, base, part, track, start, phase))
    return windows


def _oriented(
    e: Engine, dataset: Dataset, windows: Sequence[RecordingWindow], start: Parameters, progress: Progress
) -> Dataset:
    """The dataset with images that are read by rows or by columns, whichever fits better after some steps.

    Which of the two ways round follows from the readout's sign.
    """
    few = [replace(each, is_rough=True) for each in windows[:: -(-len(windows) // _TRIED)]]
    free, found = free_of(("readout", "offset")), []
    free[DRIFT] = False
    for count, scan in enumerate(_AXES):
        progress("scan direction", count / len(_AXES), scan)
        turned = _scanned(dataset, scan)
        terms = PairTerms(e, turned, free)
        tried = solve([each.read_by(terms) for each in few], terms, start, free, _COARSE, steps=_TRIED_STEPS)
        found.append((tried.cost, turned))
    progress("scan direction", 1.0, "")
    return min(found, key=lambda each: each[0])[1]


def _scanned(dataset: Dataset, scan: Scan) -> Dataset:
    rig = dataset.rig
    depth, color = (replace(shutter, scan=scan) for shutter in (rig.depth_shutter, rig.color_shutter))
    return replace(dataset, rig=replace(rig, depth_shutter=depth, color_shutter=color))


def parameters_of(dataset: Dataset) -> Parameters:
    """The values that a dataset's camera file has."""
    rig = dataset.rig
    offset = 0.0 if dataset.timing is None else dataset.timing.color_offset_s or 0.0
    readouts = rig.depth_shutter.readout_s, rig.color_shutter.readout_s
    error = np.array([getattr(dataset.depth_error, name) for name in DEPTH])
    T = rig.T_color_depth
    return Parameters(*readouts, offset, dataset.color_drift, T, dataset.middle, depth_error=error)


def _bent(dataset: Dataset) -> Dataset:
    """The dataset with cameras that may be distorted, as OpenCV has it, where they are pinholes."""

    def bent(camera: Camera) -> Camera:
        return replace(camera, model="radtan", distortion=(0.0,) * 5) if camera.model == "pinhole" else camera

    rig = dataset.rig
    return replace(dataset, rig=replace(rig, depth_camera=bent(rig.depth_camera), color_camera=bent(rig.color_camera)))


def _trusted(dataset: Dataset, windows: Sequence[RecordingWindow], terms: PairTerms, p: Parameters) -> list[int]:
    """Those windows (counted from 0) of whose motion more is known than noise makes up. Raises UserError: too few."""
    kept = [k for k, window in enumerate(windows) if trust_in(window, terms, p) > _TRUST]
    if len(kept) < _FEWEST:
        raise UserError(
            f"{dataset.root}: in {len(windows) - len(kept)} of {len(windows)} windows what seems to be known of "
            "the motion is noise: choose --frames with more shape and print, or a --camera that is less far off"
        )
    return kept


def _windows(dataset: Dataset, chosen: range, track: TrackedSpline) -> list[range]:
    """Frames in a row that were followed, with colour images; of many those that move most."""
    runs = track.frames(dataset, chosen)
    total = sum(len(run) for run in runs)
    size = min(_FRAMES, max(_FEWEST_FRAMES, total // _SEVERAL))
    parts = [run[i : i + size] for run in runs for i in range(0, len(run) - size + 1, size)]
    parts = [part for part in parts if sum(bool(dataset.groups[k]) for k in part) >= _FEWEST_FRAMES // 2]
    if len(parts) < _FEWEST:
        raise UserError(
            f"{dataset.root}: {total} frames only can be followed in a row, too few to calibrate from: choose --frames "
            "with more to see"
        )
    by_motion = sorted(parts, key=lambda part: _motion(dataset, part, track.spline), reverse=True)
    return sorted(by_motion[:_MOST], key=lambda part: part.start)


def _motion(dataset: Dataset, part: range, track: Spline) -> float:
    """How fast points a metre and a half away move, m/s, in the mean."""
    twist = track.velocity(dataset.stamps[part.start : part.stop])
    return float((np.linalg.norm(twist[:, :3], axis=1) + 1.5 * np.linalg.norm(twist[:, 3:], axis=1)).mean())


def _free(dataset: Dataset, groups: Sequence[str], parts: Sequence[range]) -> BoolArray:
    """What may change (31,).

    Drift only where colour's clock is seen for long enough, and of lenses what our distortion has: of registered
    depth's only the colour camera's.
    """
    free, rig = free_of(groups), dataset.rig
    if rig.is_registered:
        free[DEPTH_LENS] = False
    for camera, lens in ((rig.depth_camera, DEPTH_LENS), (rig.color_camera, COLOR_LENS)):
        if camera.model in ("fisheye", "rational", "double_sphere"):
            free[lens.stop - _COEFFICIENTS : lens.stop] = False
    free[DRIFT] &= dataset.stamps[parts[-1].stop - 1] - dataset.stamps[parts[0].start] >= _DRIFT_S
    return free


def _usual(dataset: Dataset) -> tuple[str, ...]:
    """What a recording determines: of registered depth, which the driver has moved, nothing about where it was.

    Its lens then, where it is not exact as a rendering's is. Two lenses, which makers measure, and depth on request.
    """
    if dataset.rig.is_registered:
        return "readout", "offset", *(() if dataset.rig.sigma.is_exact else ("intrinsics",))
    return GROUPS[:3]


def _check(dataset: Dataset, groups: Sequence[str], frames: slice) -> None:
    unknown = [group for group in groups if group not in GROUPS]
    if unknown or not groups:
        raise UserError(f"--free {','.join(unknown)}: choose one or more of {', '.join(GROUPS)}")
    count = len(range(len(dataset))[frames])
    needed = _FEWEST * _FEWEST_FRAMES
    if count < needed:
        raise UserError(
            f"{dataset.root}: {count} frames are too few to calibrate from: {needed} or more are needed, 300 are good"
        )
    if not any(dataset.groups[k] for k in range(len(dataset))[frames]):
        raise UserError(f"{dataset.root}: these frames have no colour images, which determine clocks and extrinsics")
