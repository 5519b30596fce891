"""The measure `convergence`: how far off a frame may start and still be aligned to a keyframe."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.linearise import Terms
from rstrack.alignment.observation import observe
from rstrack.alignment.spline_state import SplineState
from rstrack.bench.cells import StrictModel
from rstrack.bench.record import Figures
from rstrack.bench.task import Task, settings_of
from rstrack.data.dataset import Dataset
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, DeviceRig
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.metrics.association import angles_deg
from rstrack.options import Options
from rstrack.tracking.judgement.lost_track import lost
from rstrack.tracking.window import Window

# What a frame is moved by, in metres and degrees, and multiples of it; 0 shows how good the truth itself is as a start.
UNIT_M, UNIT_DEG = 0.02, 1.0
FACTORS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
# Errors within which a frame has converged.
_FOUND_M, _FOUND_DEG = 1e-3, 0.05
_GAPS = range(1, 11)
# Knots after which the ends of a resampled spline have no influence any more (a quarter is left with every knot).
_END_KNOTS = 6


class ConvergenceSettings(StrictModel):
    """How many keyframes with a frame."""

    pairs: int = Field(default=50, ge=1)


@dataclass(frozen=True)
class FramePair:
    """Frames (their numbers), and the unit vectors (3,) along which, and about which, the later one is moved."""

    keyframe: int
    frame: int
    direction: FloatArray
    axis: FloatArray


@dataclass(frozen=True)
class AlignmentTrial:
    """Where a moved frame ended: errors at mid readout. accepted: the tracker would have gone on with it."""

    factor: float
    error_m: float
    error_deg: float
    steps: int
    accepted: bool

    @property
    def converged(self) -> bool:
        """Whether it is back."""
        return self.error_m < _FOUND_M and self.error_deg < _FOUND_DEG


def convergence_cell(task: Task, progress: Progress) -> Figures:
    """Align single frames to keyframes one to ten frames older, from poses ever farther off.

    The keyframe is rectified with the true motion. The frame starts with its true motion (resampled at the tracker's
    knots), turned about its camera and shifted as a whole by multiples of 2 cm and 1 degree; the tracker then aligns it
    coarse to fine as it does when it relocalises: all control points that it touches are free, and the motion prior
    does not reach beyond them, so that it cannot pull the frame back to where the frames before it are.

    A frame has converged within 1 mm and 0.05 degrees. resampling_mm: largest error of the spline that stands for the
    truth, at the middle of a readout. Frames at the very ends of the truth are left out. Raises UserError: no true
    spline, no frames to choose from, a method without a spline, an image that cannot be read.
    """
    pairs, options, dataset = settings_of(task, ConvergenceSettings).pairs, task.options, task.noisy
    truth = dataset.truth
    if truth is None:
        raise UserError(f"{dataset.root}: convergence needs the true motion: use a sequence that rsgen wrote")
    if options.method == "baseline":
        raise UserError("convergence: the baseline aligns no spline: choose an rs or gs method")
    chosen = choose_pairs(dataset, task.frames, truth, options, pairs, task.seed)
    trials, off_m = run_trials(dataset, truth, options, chosen, progress)
    return figures_of(trials) | {"pairs": pairs, "knots_ms": 1e3 * options.knots_s(), "resampling_mm": 1e3 * off_m}


def run_trials(
    dataset: Dataset, truth: Spline, options: Options, pairs: Sequence[FramePair], progress: Progress
) -> tuple[list[AlignmentTrial], float]:
    """All pairs from all distances; and the largest error (m) of the spline that stands for the truth."""
    aligner = Aligner(dataset.rig, options)
    t0 = _span(dataset, 0)[0] - options.knot_phase * options.knots_s()
    spline = resampled(truth, t0, options.knots_s())
    trials: list[AlignmentTrial] = []
    off_m = 0.0
    for done, pair in enumerate(pairs, 1):
        ref = aligner.keyframe(pair.keyframe, dataset.frame(pair.keyframe), truth)
        new = aligner.prepare(pair.frame, dataset.frame(pair.frame))
        t = new.depth.exposure.mid_time
        T_true = truth.pose(t)
        off_m = max(off_m, float(np.linalg.norm(spline.pose(t)[:3, 3] - T_true[:3, 3])))
        for factor in FACTORS:
            state = moved_state(spline, new, pair, factor)
            steps, accepted = aligner.align(new, ref, state)
            T = state.spline.pose(t)
            error = float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])), float(angles_deg(T_true[None], T[None])[0])
            trials.append(AlignmentTrial(factor, *error, steps, accepted))
        found = sum(trial.converged for trial in trials if trial.factor == 1.0)
        progress("aligning", done / len(pairs), f"{found} of {done} converged")
    return trials, off_m


def figures_of(trials: Sequence[AlignmentTrial]) -> Figures:
    """By factor; wrong_unnoticed: trials that have not converged, with which the tracker would have gone on."""
    figures: Figures = {}
    for factor in dict.fromkeys(trial.factor for trial in trials):
        these = [trial for trial in trials if trial.factor == factor]
        figures |= {
            f"converged_pct_{factor:g}x": 100.0 * float(np.mean([trial.converged for trial in these])),
            f"wrong_unnoticed_{factor:g}x": sum(trial.accepted and not trial.converged for trial in these),
            f"median_error_mm_{factor:g}x": 1e3 * float(np.median([trial.error_m for trial in these])),
            f"median_error_deg_{factor:g}x": float(np.median([trial.error_deg for trial in these])),
            f"median_steps_{factor:g}x": float(np.median([trial.steps for trial in these])),
        }
    return figures


def choose_pairs(
    dataset: Dataset, frames: range, truth: Spline, options: Options, count: int, seed: int
) -> list[FramePair]:  # fmt: skip
    """Random pairs of `frames` one to ten apart. Raises UserError if there are none."""
    rng = np.random.default_rng(seed)
    margin = _END_KNOTS * options.knots_s()
    usable = []
    for k in frames:
        begin, end = _span(dataset, k)
        inside = begin - margin >= truth.t_begin and end + margin <= truth.t_end
        if inside and (dataset.groups[k] or not options.photometric):
            usable.append(k)
    known = set(usable)
    starts = {gap: [k for k in usable if k + gap in known] for gap in _GAPS}
    gaps = [gap for gap in _GAPS if starts[gap]]
    if not gaps:
        raise UserError(
            f"{dataset.root}: has no two frames less than {_GAPS.stop} apart that are {margin:.2f} s away from the "
            f"truth's ends at {truth.t_begin:.2f} and {truth.t_end:.2f} s: use a longer sequence"
        )
    pairs = []
    for _ in range(count):
        gap = int(rng.choice(gaps))
        k = int(rng.choice(starts[gap]))
        direction, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        pairs.append(FramePair(k, k + gap, direction, axis))
    return pairs


def resampled(truth: Spline, t0: float, dt: float) -> Spline:
    """The spline with knots t0 + i dt (s) through the truth's poses there; at rest beyond the truth's ends.

    Each control point is moved by what its knot's pose lacks: as a knot's pose weighs its own control point 2/3, that
    leaves a third of the error at least and two thirds at most.
    """
    count = math.ceil((truth.t_end - t0) / dt) + 3
    knots = t0 + dt * np.arange(count - 2)
    T = truth.pose(np.clip(np.concatenate([[t0 - dt], knots, [knots[-1] + dt]]), truth.t_begin, truth.t_end))
    points = T.copy()
    for _ in range(40):
        lacking = T[1:-1] @ se3.inverse(Spline(points, t0, dt).pose(knots))
        points[1:-1] = se3.orthonormalise(lacking @ points[1:-1])
    return Spline(points, t0, dt)


def moved_state(spline: Spline, new: DeviceFrame, pair: FramePair, factor: float) -> SplineState:
    """The spline up to a frame, whose control points are all moved so that its camera has turned and shifted.

    Pose at mid readout: T_world_cam D with D = (rotation about pair.axis, shift along pair.direction).
    """
    first, last = (int(spline.locate(t)[0]) for t in (new.first_time, new.last_time))
    D = se3.exp(np.concatenate([np.zeros(3), math.radians(factor * UNIT_DEG) * pair.axis]))
    D[:3, 3] = factor * UNIT_M * pair.direction
    T_world_cam = spline.pose(new.depth.exposure.mid_time)
    points = spline.control_points[: last + 4].copy()
    points[first:] = se3.orthonormalise(T_world_cam @ D @ se3.inverse(T_world_cam) @ points[first:])
    return SplineState(Spline(points, spline.t0, spline.dt))


class Aligner:
    """Aligns single frames as the tracker does, without a track."""

    def __init__(self, rig: Rig, options: Options) -> None:
        self._options, self._focal = options, rig.depth_camera.fx
        self._device = DeviceRig(rig, options)
        self._terms = Terms.of(self._device, options)
        self._maker = KeyframeMaker.of(self._device)

    def keyframe(self, k: int, frame: Frame, motion: Spline) -> Reference:
        """A frame rectified with a known motion."""
        new = self.prepare(k, frame)
        return self._maker.rectified(k, new.depth, new.colors, motion, None)

    def prepare(self, k: int, frame: Frame) -> DeviceFrame:
        """Onto the device."""
        return self._device.upload(k, frame)

    def align(self, new: DeviceFrame, ref: Reference, state: SplineState) -> tuple[int, bool]:
        """Move the state's control points that the frame touches; steps, and whether the tracker accepts the result."""
        window = Window(self._terms, self._focal, state, state.segment(new.first_time))
        fresh = observe(new, ref, self._options)
        solved = window.solve(fresh)
        return solved.iterations, not lost(fresh, solved, ref.pixels)


def _span(dataset: Dataset, k: int) -> tuple[float, float]:
    """Times in s within which all lines of a frame's images are exposed."""
    stamps = [dataset.stamps[k], *dataset.color_stamps[list(dataset.groups[k])]]
    shutters = dataset.rig.depth_shutter, dataset.rig.color_shutter
    exposure_s, readout_s = max(s.exposure_s for s in shutters), max(s.readout_s for s in shutters)
    return float(min(stamps)) - exposure_s, float(max(stamps)) + readout_s
