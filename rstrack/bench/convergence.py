"""How far off a frame may start and still be aligned to a keyframe.

print(convergence(dataset, Options(), pairs=50).text())
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.linearise import Terms
from rstrack.alignment.observation import observe
from rstrack.alignment.spline_state import SplineState
from rstrack.bench.bootstrap import generator
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import plain
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, DeviceRig
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.metrics.association import angles_deg
from rstrack.options import Options
from rstrack.tracking.judgement.lost_track import FitHistory
from rstrack.tracking.window import Window

# What a frame is moved by, in metres and degrees, and multiples of it; 0 tells how good the truth itself is as a start.
UNIT_M, UNIT_DEG = 0.02, 1.0
FACTORS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
# Errors within which a frame has converged, and part of the frames below which it is no use to move them further.
_FOUND_M, _FOUND_DEG = 1e-3, 0.05
_FEW = 0.1
_GAPS = range(1, 11)
# Knots after which the ends of a resampled spline have no influence any more (a quarter is left with every knot).
_END_KNOTS = 6


@dataclass(frozen=True)
class Pair:
    """Frames (their numbers), and the unit vectors (3,) along which, and about which, the later one is moved."""

    keyframe: int
    frame: int
    direction: FloatArray
    axis: FloatArray


@dataclass(frozen=True)
class Trial:
    """Where a moved frame ended: errors at mid readout. believed: the tracker would have gone on with it."""

    keyframe: int
    frame: int
    factor: float
    error_m: float
    error_deg: float
    steps: int
    believed: bool

    @property
    def converged(self) -> bool:
        """Whether it is back."""
        return self.error_m < _FOUND_M and self.error_deg < _FOUND_DEG


@dataclass(frozen=True)
class ConvergenceResult:
    """All trials. resampling_m: largest error of the spline that stands for the truth, at the middle of a readout."""

    name: str
    method: str
    pairs: int
    knot_spacing_s: float
    resampling_m: float
    trials: tuple[Trial, ...]

    def rows(self) -> list[dict[str, Any]]:
        """One dict for each distance, up to the first at which less than a tenth converges."""
        rows = [self.row(factor) for factor in FACTORS]
        failing = [i for i, row in enumerate(rows) if row["converged"] < _FEW]
        return rows[: failing[0] + 1] if failing else rows

    def row(self, factor: float) -> dict[str, Any]:
        """What came of the frames that were moved by a multiple of 2 cm and 1 degree."""
        trials = [t for t in self.trials if t.factor == factor]
        return {
            "moved_m": factor * UNIT_M,
            "moved_deg": factor * UNIT_DEG,
            "converged": float(np.mean([t.converged for t in trials])),
            "median_error_m": float(np.median([t.error_m for t in trials])),
            "median_error_deg": float(np.median([t.error_deg for t in trials])),
            "median_steps": float(np.median([t.steps for t in trials])),
            "wrong_but_believed": sum(t.believed and not t.converged for t in trials),
        }

    def as_dict(self) -> dict[str, Any]:
        """For JSON; units are in the names."""
        head = {"dataset": self.name, "method": self.method, "pairs": self.pairs}
        truth = {"knot_spacing_s": self.knot_spacing_s, "resampling_m": self.resampling_m}
        trials = [vars(t) | {"converged": t.converged} for t in self.trials]
        data: dict[str, Any] = plain(head | truth | {"rows": self.rows(), "trials": trials})
        return data

    def text(self) -> str:
        """A table, one line for each distance."""
        found = 100 * self.row(1.0)["converged"]
        rows = tuple(
            (
                f"{100 * row['moved_m']:g} cm, {row['moved_deg']:g} deg",
                f"{100 * row['converged']:.0f} %",
                f"{fixed(row['median_error_m'], 3, 1e3)} mm, {fixed(row['median_error_deg'], 4)} deg",
                fixed(row["median_steps"], 0),
                str(row["wrong_but_believed"]),
            )
            for row in self.rows()
        )
        head = ("moved by", "converged", "median error", "steps", "wrong, not noticed")
        lines = (
            f"{self.name}, {self.method}: {found:.0f} % of {self.pairs} frames converge from "
            f"{100 * UNIT_M:g} cm and {UNIT_DEG:g} deg, to within {1e3 * _FOUND_M:g} mm and {_FOUND_DEG:g} deg",
            f"truth resampled at knots {1e3 * self.knot_spacing_s:g} ms apart: {1e3 * self.resampling_m:.3f} mm off at "
            "most",
            "",
            Table(head, rows, words=()).text(),
        )
        return "\n".join(lines)


def convergence(
    dataset: Dataset, options: Options, pairs: int = 50, seed: int = 0, progress: Progress = no_progress
) -> ConvergenceResult:
    """Align single frames to keyframes one to ten frames older, from poses ever farther off.

    The keyframe is rectified with the true motion. The frame starts with its true motion (resampled at the tracker's
    knots), turned about its camera and shifted as a whole by multiples of 2 cm and 1 degree; the tracker then aligns it
    coarse to fine as it does when it relocalises: all control points that it touches are free, and the motion prior
    does not reach beyond them, so that it cannot pull the frame back to where the frames before it are.

    Frames at the very ends of the truth are left out. Raises UserError: no true spline, no frames to choose from, a
    method without a spline, a seed below 0, an image that cannot be read.
    """
    truth = dataset.truth
    if truth is None:
        raise UserError(f"{dataset.root}: convergence needs the true motion: use a sequence that rsgen wrote")
    if options.method == "baseline":
        raise UserError("convergence: the baseline aligns no spline: choose an rs or gs method")
    chosen = choose_pairs(dataset, truth, options, pairs, seed)
    aligner = _Aligner(dataset.rig, options)
    t0 = _span(dataset, 0)[0] - options.knot_phase * options.knots_s()
    spline = resampled(truth, t0, options.knots_s())
    trials: list[Trial] = []
    off_m = 0.0
    for done, pair in enumerate(chosen, 1):
        ref = aligner.keyframe(pair.keyframe, dataset.frame(pair.keyframe), truth)
        new = aligner.prepare(pair.frame, dataset.frame(pair.frame))
        t = new.depth.exposure.mid_time
        T_true = truth.pose(t)
        off_m = max(off_m, float(np.linalg.norm(spline.pose(t)[:3, 3] - T_true[:3, 3])))
        fits = FitHistory()
        for factor in FACTORS:
            state = moved_state(spline, new, pair, factor)
            # The start from the truth itself comes first: from it the tracker knows how well frames fit as a rule.
            steps, believed = aligner.align(new, ref, state, copy.deepcopy(fits) if factor else fits)
            T = state.spline.pose(t)
            error = float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])), float(angles_deg(T_true[None], T[None])[0])
            trials.append(Trial(pair.keyframe, pair.frame, factor, *error, steps, believed))
        found = sum(trial.converged for trial in trials if trial.factor == 1.0)
        progress("aligning", done / len(chosen), f"{found} of {done} converged")
    settings = options.method, len(chosen), options.knots_s()
    return ConvergenceResult(dataset.name, *settings, off_m, tuple(trials))


def choose_pairs(dataset: Dataset, truth: Spline, options: Options, count: int, seed: int) -> list[Pair]:
    """Random pairs of frames one to ten apart; raises UserError if there are none, or for a seed below 0."""
    rng = generator(seed)
    margin = _END_KNOTS * options.knots_s()
    usable = []
    for k in range(len(dataset)):
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
        pairs.append(Pair(k, k + gap, direction, axis))
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


def moved_state(spline: Spline, new: DeviceFrame, pair: Pair, factor: float) -> SplineState:
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


class _Aligner:
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

    def align(self, new: DeviceFrame, ref: Reference, state: SplineState, fits: FitHistory) -> tuple[int, bool]:
        """Move the state's control points that the frame touches; steps, and whether `fits` accepts the result."""
        window = Window(self._terms, self._focal, state, state.segment(new.first_time))
        fresh = observe(new, ref, self._options)
        solved = window.solve(fresh)
        return solved.iterations, not fits.fault(fresh, solved, ref.pixels)


def _span(dataset: Dataset, k: int) -> tuple[float, float]:
    """Times in s within which all lines of a frame's images are exposed."""
    stamps = [dataset.stamps[k], *dataset.color_stamps[list(dataset.groups[k])]]
    shutters = dataset.rig.depth_shutter, dataset.rig.color_shutter
    exposure_s, readout_s = max(s.exposure_s for s in shutters), max(s.readout_s for s in shutters)
    return float(min(stamps)) - exposure_s, float(max(stamps)) + readout_s
