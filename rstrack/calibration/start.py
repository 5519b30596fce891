"""Where a calibration begins: a rough track, and windows of the recording with splines like that of the track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.calibration.pairs.images import (
    DepthSurface,
    Float32Image,
    ImageTiming,
    averaged,
    intensity_bound,
    span,
    surface_of,
    window_images,
)
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.pairs.window import RecordingWindow, WindowFrame
from rstrack.calibration.parameters import Parameters
from rstrack.data.dataset import Dataset
from rstrack.data.image_files import prefetched
from rstrack.data.rig import DepthError
from rstrack.images.pyramid import in_range, intensity, pyramid
from rstrack.options import Method, Options
from rstrack.tracking.first_look.rough_track import rough_track

# How frames are followed. The second is rougher, but takes more: where the readout is far off, what the first makes of
# depth does not fit together. The third needs colour's clock to be about right, but no shapes. Part of the time that
# must be followed.
_METHODS: tuple[Method, ...] = ("rs-g", "baseline", "rs-pg")
_LONG_ENOUGH = 0.9
# Periods between frames from which on they are not in a row.
_GAP = 2.5
# Seconds before the first and after the last line for which a window has spline: times move while they are estimated.
_MARGIN_S = 0.08
# What the colour camera may be further away than the file states, m.
_BASELINE_M = 0.01
# Rounds of correction of a spline that is to pass through poses.
_ROUNDS = 6


@dataclass(frozen=True)
class TrackedSpline:
    """T_world_depth(t), and the times (begin, end) in s within which it was followed."""

    spline: Spline
    valid: tuple[tuple[float, float], ...]

    @property
    def seconds(self) -> float:
        """How much was followed."""
        return sum(end - begin for begin, end in self.valid)

    def frames(self, dataset: Dataset, chosen: range) -> list[range]:
        """Frames in a row that are stamped within one of these times, without a gap between them."""
        longest = _GAP * float(np.median(np.diff(dataset.stamps)))
        runs: list[range] = []
        for begin, end in self.valid:
            before = -np.inf
            for k in chosen:
                t = float(dataset.stamps[k])
                if not begin <= t <= end:
                    continue
                if t - before < longest:
                    runs[-1] = range(runs[-1].start, k + 1)
                else:
                    runs.append(range(k, k + 1))
                before = t
        return runs


def first_track(dataset: Dataset, chosen: range, options: Options, progress: Progress) -> TrackedSpline:
    """Of the frames of a dataset. Raises UserError: nothing can be followed."""
    whole, best = dataset.stamps[chosen[-1]] - dataset.stamps[chosen[0]], None
    for method in _METHODS:
        found = tracked(dataset, chosen, replace(options, method=method), progress)
        if found is not None and (best is None or found.seconds > best.seconds):
            best = found
        if best is not None and best.seconds > _LONG_ENOUGH * whole:
            break
    if best is None:
        raise UserError(f"{dataset.root}: these frames give no track to begin with: choose --frames with more to see")
    return best


def tracked(dataset: Dataset, chosen: range, options: Options, progress: Progress) -> TrackedSpline | None:
    """Frames followed roughly by the options' method; None if they cannot be."""
    tracker = rough_track(dataset, chosen, options, lambda done: progress(f"first track ({options.method})", done, ""))
    if tracker.spline is not None and tracker.spline_valid:
        return TrackedSpline(tracker.spline, tuple(tracker.spline_valid))
    stamps, poses = tracker.trajectory
    if len(stamps) < 2:
        return None
    # A pose a frame: the baseline's.
    period = float(np.median(np.diff(dataset.stamps)))
    dt = min(options.knots_s(period), period)
    t0 = float(stamps[0]) - dt
    knots = np.asarray(t0 + (np.arange(int((stamps[-1] - t0) / dt) + 5) - 1) * dt, np.float64)
    breaks = np.flatnonzero(np.diff(stamps) > _GAP * period) + 1
    spans = tuple((float(part[0]), float(part[-1])) for part in np.split(stamps, breaks))
    return TrackedSpline(through(se3.interpolated(stamps, poses, knots), t0, dt), spans)


def load_window(
    terms: PairTerms, dataset: Dataset, frames: Sequence[int], track: Spline, p: Parameters, options: Options
) -> RecordingWindow:
    """Frames of a dataset, with a spline like that of the track but with knots as the options want them.

    Raises UserError: an image that cannot be read.
    """

    def decoded(k: int) -> tuple[Float32Image, list[Float32Image]] | None:
        """Intensities and their levels; None where there is no image."""
        if not dataset.groups[k]:
            return None
        color = dataset.images.color(dataset.groups[k][0])
        grey = intensity(color)
        return grey, in_range(pyramid(grey), color)

    surfaces, bounds = [], []
    colors: list[list[Float32Image]] = []
    for k, seen in zip(frames, prefetched(decoded, frames), strict=True):
        surfaces.append(_surface(dataset, k, options.max_depth))
        colors.append([] if seen is None else seen[1])
        if seen is not None:
            bounds.append(intensity_bound(seen[0], dataset.rig.color_camera.fx, surfaces[-1].median_depth))
    images = window_images(terms.e, surfaces, colors, max(bounds), terms.stride)
    views = [_view(terms, dataset, k) for k in frames]
    begin, end = span([taken for view in views for taken in (view.depth, view.color)], p)
    knot_s = options.knots_s()
    t0 = begin - _MARGIN_S - options.knot_phase * knot_s
    count = int(np.ceil((end + _MARGIN_S - t0) / knot_s)) + 3
    return RecordingWindow(views, images, like(track, t0, knot_s, count), np.zeros((len(views), len(views), 2)))


def like(track: Spline, t0: float, dt: float, count: int) -> Spline:
    """A spline of `count` control points through the poses of another, which goes on with constant velocity."""
    knots = t0 + (np.arange(count) - 1) * dt
    inside = np.clip(knots, track.t_begin, track.t_end)
    poses, velocity = track.pose_and_velocity(inside)
    return through(poses @ se3.exp((knots - inside)[:, None] * velocity), t0, dt)


def through(poses: FloatArray, t0: float, dt: float) -> Spline:
    """The spline that passes at its knots through poses (n, 4, 4), but for the first and the last.

    Cubic B-splines blur a little what their control points are laid through: a few rounds of correction.
    """
    wanted = se3.orthonormalise(poses)
    points = wanted
    knots = t0 + (np.arange(len(poses))[1:-1] - 1) * dt
    for _ in range(_ROUNDS):
        off = se3.log(wanted[1:-1] @ se3.inverse(Spline(points, t0, dt).pose(knots)))
        points = np.concatenate([wanted[:1], se3.orthonormalise(se3.exp(off) @ points[1:-1]), wanted[-1:]])
    return Spline(points, t0, dt)


def _view(terms: PairTerms, dataset: Dataset, k: int) -> WindowFrame:
    rig, stamp = dataset.rig, float(dataset.stamps[k])
    taken = float(dataset.color_stamps[dataset.groups[k][0]]) if dataset.groups[k] else stamp
    depth = ImageTiming(terms.depth, stamp, rig.depth_shutter.exposure_s, True)
    color = ImageTiming(terms.color, taken, rig.color_shutter.exposure_s, False)
    return WindowFrame(depth, color, bool(dataset.groups[k]))


def _surface(dataset: Dataset, k: int, max_depth: float) -> DepthSurface:
    # The rest of depth's error is among what is estimated.
    pattern, rig = DepthError(pattern=dataset.depth_error.pattern), dataset.rig
    z = pattern.corrected(dataset.images.depth(k), rig.depth_camera)
    rho = averaged(np.divide(np.float32(1.0), z, out=np.zeros_like(z), where=(z > 0.0) & (z < max_depth)))
    baseline = _BASELINE_M + float(np.linalg.norm(rig.T_color_depth[:3, 3]))
    return surface_of(rho, rig.depth_camera.fx, rig.depth_camera.fy, baseline)
