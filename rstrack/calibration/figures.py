"""What a calibration says beside its values: how the recording moves, how images fit, where lenses put points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.camera import Camera
from rsgen.geometry.spline import Spline
from rstrack.alignment.weights import FLOOR_DEPTH, FLOOR_INTENSITY
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.pairs.window import RecordingWindow
from rstrack.calibration.parameters import LENS, Parameters, changed
from rstrack.data.dataset import Dataset

# Instants at most.
_MOST = 300
# Windows at most: an evaluation takes as long as a step of the solution.
_FEW = 3
# Fixed-point steps that are taken: what is missing then, a tenth or so, is extrapolated, to some percent.
_ROUNDS = 3
# Part of the last step that may be added to it at most.
_MOST_MORE = 2.0
# Points looked at, and those in a picture: every so many px of a 640 px wide image, in both directions.
_EVERY, _PICTURED = 20, 40
_STEP = 1e-5


@dataclass(frozen=True)
class MeanMotion:
    """Mean speeds in the windows that were used, m/s and rad/s, and the changes of the latter, rad/s²."""

    speed: float
    rotation: float
    change: float

    def text(self) -> str:
        """In plain words."""
        return (
            f"this recording moves at {self.speed:.2f} m/s and turns at {np.degrees(self.rotation):.1f} deg/s, which "
            f"changes by {np.degrees(self.change):.0f} deg/s a second"
        )


def motion_of(dataset: Dataset, parts: Sequence[range], track: Spline) -> MeanMotion:
    """Of the windows of frames that were used, by the track."""
    stamps = np.concatenate([dataset.stamps[part.start : part.stop] for part in parts])
    v, a = track.velocity(stamps), track.acceleration(stamps)
    means = [float(np.linalg.norm(x, axis=1).mean()) for x in (v[:, :3], v[:, 3:], a[:, 3:])]
    return MeanMotion(*means)


def pace_of(dataset: Dataset, followed: Sequence[range], track: Spline) -> dict[str, list[float]]:
    """For JSON, speeds in m/s and rad/s of the depth camera, at times in s since the recording's first frame: those of
    the frames that were followed, or so many of them; to a ten-thousandth."""
    frames = np.concatenate([np.arange(run.start, run.stop) for run in followed])
    frames = frames[:: -(-len(frames) // _MOST)]
    velocity = track.velocity(dataset.stamps[frames])
    speeds, rotations = (np.linalg.norm(v, axis=1) for v in (velocity[:, :3], velocity[:, 3:]))
    named = {"time_s": since_begin(dataset, frames), "m_s": speeds, "rad_s": rotations}
    return {name: np.round(values, 4).tolist() for name, values in named.items()}


def since_begin(dataset: Dataset, frames: Sequence[int] | np.ndarray) -> FloatArray:
    """Stamps (n,) of frames, s since the recording's first."""
    return np.asarray(dataset.stamps[np.asarray(frames)] - dataset.stamps[0])


@dataclass(frozen=True)
class ResidualScales:
    """Student's scales of the residuals, medians over windows: depth in m, intensity of 0 to 1."""

    depth_m: float
    intensity: float


def some_of(windows: Sequence[RecordingWindow]) -> Sequence[RecordingWindow]:
    """A few, all over the recording: those whose residuals are looked at."""
    return windows[:: -(-len(windows) // _FEW)]


def residuals_now(windows: Sequence[RecordingWindow]) -> ResidualScales:
    """Those by which the windows weight their pixels."""
    return _medians(np.array([window.sigma for window in windows]))


def residuals_at(windows: Sequence[RecordingWindow], terms: PairTerms, p: Parameters) -> ResidualScales:
    """Along the windows' splines as they are, with values `p`, on the pyramid's finest level.

    Evaluated on copies: the windows keep their scales and their brightness.
    """
    scales = np.array([_scales(replace(each, brightness=each.brightness.copy()), terms, p) for each in windows])
    return _medians(np.maximum(extrapolated(np.moveaxis(scales, 1, 0)), (FLOOR_DEPTH, FLOOR_INTENSITY)))


def extrapolated(scales: FloatArray) -> FloatArray:
    """Where steps that shrink by one factor lead (Aitken): of the last three of scales (rounds, ...)."""
    before, last = scales[-2] - scales[-3], scales[-1] - scales[-2]
    ratio = np.divide(last, before, out=np.zeros_like(last), where=before != 0.0)
    most = _MOST_MORE / (1.0 + _MOST_MORE)
    ratio = np.clip(ratio, 0.0, most)
    return np.asarray(scales[-1] + last * ratio / (1.0 - ratio))


def _medians(scales: FloatArray) -> ResidualScales:
    depth_m, intensity = np.median(scales, axis=0)
    return ResidualScales(float(depth_m), float(intensity))


def _scales(window: RecordingWindow, terms: PairTerms, p: Parameters) -> FloatArray:
    """Those of depth and intensity (rounds, 2) after each step."""
    scales = []
    for _ in range(_ROUNDS):
        window.sums(terms, p, 0)
        scales.append(window.sigma)
    return np.array(scales)


def displacement_px(before: Camera, after: Camera, every: int = _EVERY) -> FloatArray:
    """By how much (n, 2) points that `before` sees all over its image lie elsewhere in that of `after`, NaN outside."""
    pixels = _grid(before, every)
    rays = before.backproject(pixels, np.ones(len(pixels)))
    return np.asarray(after.project(rays)[0] - pixels)


def sigma_px(camera: Camera, covariance: FloatArray, every: int = _EVERY) -> FloatArray:
    """σ (n,) of where the lens puts the points of its image, both axes together, by the covariance (9, 9) of LENS."""
    pixels = _grid(camera, every)
    rays = camera.backproject(pixels, np.ones(len(pixels)))
    slopes = []
    for i in range(len(LENS)):
        step = np.zeros(len(LENS))
        step[i] = _STEP
        ends = [changed(camera, sign * step).project(rays)[0] for sign in (1.0, -1.0)]
        slopes.append((ends[0] - ends[1]) / (2.0 * _STEP))
    J = np.stack(slopes, axis=-1)
    return np.asarray(np.sqrt(np.einsum("nai,ij,naj->n", J, covariance, J)))


def rms(pixels: FloatArray) -> float:
    """Root mean square length of displacements (n, 2) or of lengths (n,), over those that there are."""
    squares = np.square(pixels) if pixels.ndim == 1 else np.square(pixels).sum(axis=1)
    return float(np.sqrt(np.nanmean(squares)))


def lens_map(before: Camera, after: Camera, covariance: FloatArray) -> dict[str, list[list[float]]]:
    """For JSON: points [x, y] of the image of `before`, how far they have moved, [x, y], and σ of that, [σ]; px."""
    moved, sigma = displacement_px(before, after, _PICTURED), sigma_px(after, covariance, _PICTURED)
    known = np.isfinite(moved).all(axis=1) & np.isfinite(sigma)
    parts = {"at_px": _grid(before, _PICTURED), "moved_px": moved, "sigma_px": sigma[:, None]}
    return {name: np.round(values[known], 3).tolist() for name, values in parts.items()}


def _grid(camera: Camera, every: int) -> FloatArray:
    step = max(1, round(every * camera.width / 640))
    return np.asarray(camera.pixel_grid()[::step, ::step].reshape(-1, 2))
