"""A rough track to begin from, by depth alone if possible: however wrongly colour is stamped."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.calibration.pairs.load import through
from rstrack.data.dataset import Dataset
from rstrack.options import Method, Options
from rstrack.tracking.first_look.rough_track import rough_track

# How frames are followed. The second is rougher, but takes more: where the readout is far off, what the first makes of
# depth does not fit together. The third needs colour's clock to be about right, but no shapes. Part of the time that
# must be followed.
_METHODS: tuple[Method, ...] = ("rs-g", "baseline", "rs-pg")
_LONG_ENOUGH = 0.9
# Periods between frames from which on they are not in a row.
_GAP = 2.5


@dataclass(frozen=True)
class Track:
    """A rough T_world_depth(t), and the times (begin, end) in s within which it was followed."""

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


def first_track(dataset: Dataset, chosen: range, options: Options, progress: Progress) -> Track:
    """Of the frames of a dataset. Raises UserError: nothing can be followed."""
    whole, best = dataset.stamps[chosen[-1]] - dataset.stamps[chosen[0]], None
    for method in _METHODS:
        found = _tracked(dataset, chosen, replace(options, method=method), progress)
        if found is not None and (best is None or found.seconds > best.seconds):
            best = found
        if best is not None and best.seconds > _LONG_ENOUGH * whole:
            break
    if best is None:
        raise UserError(f"{dataset.root}: these frames give no track to begin with: choose --frames with more to see")
    return best


def _tracked(dataset: Dataset, chosen: range, options: Options, progress: Progress) -> Track | None:
    tracker = rough_track(dataset, chosen, options, lambda done: progress(f"first track ({options.method})", done, ""))
    if tracker.spline is not None and tracker.spline_valid:
        return Track(tracker.spline, tuple(tracker.spline_valid))
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
    return Track(through(se3.interpolated(stamps, poses, knots), t0, dt), spans)
