"""How good the loops of a track are, and whether places that look alike are taken for one.

print(loop_quality(dataset, Options(), frames=slice(None), alike=200).text())
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.loops import Loop, LoopSearch
from rstrack.data.dataset import Dataset
from rstrack.options import Options

# Two keyframes whose places are further apart than so many times where a keyframe is left behind are two places.
_APART = 2.5
# A loop that is further off is a false one, m and rad.
_FALSE = np.array([0.02, np.radians(2.0)])
# A pair of look-alikes may be anywhere, as after any drift (m, rad).
_ANYWHERE = np.array([1e3, 10.0])


@dataclass(frozen=True)
class LoopQuality:
    """Of the loops that a track has: errors of what each frame says of the other keyframe, against the truth.

    nees: squared errors over the covariances, over six (1: as large as they say), median. false: loops further off than
    20 mm or 2 degrees. alike: pairs of different places that were tried, those that look most alike; accepted: of
    these, wrongly.
    """

    name: str
    keyframes: int
    loops: int
    median_mm: float
    median_mrad: float
    worst_mm: float
    nees: float
    false: int
    alike: int
    accepted: int
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def text(self) -> str:
        """Two lines."""
        return (
            f"{self.name}: {self.loops} loops among {self.keyframes} keyframes in {self.seconds:.0f} s: off by "
            f"{self.median_mm:.2f} mm and {self.median_mrad:.2f} mrad (median), {self.worst_mm:.1f} mm at most, NEES/6 "
            f"{self.nees:.2f}; {self.false} false\n"
            f"{self.alike} pairs of places that look alike, wherever the track has them: {self.accepted} taken for one"
        )


def loop_quality(
    dataset: Dataset, options: Options, frames: slice, alike: int, progress: Progress = no_progress
) -> LoopQuality:  # fmt: skip
    """Track frames of a sequence with a true spline, look for loops, then try look-alikes.

    Raises UserError: no such truth, no frame, or a method without a spline.
    """
    from rstrack.tracking.any_tracker import make_tracker
    from rstrack.tracking.loop_closing import search_of
    from rstrack.tracking.spline_tracker import Tracker

    truth = dataset.truth
    if not isinstance(truth, Spline):
        raise UserError(f"{dataset.root}: has no true spline to compare loops with: give a sequence of rsgen's")
    chosen = range(len(dataset))[frames]
    tracker = make_tracker(dataset.rig, replace(options, loops="off"), interval_s=dataset.interval_s(chosen))
    if not isinstance(tracker, Tracker) or not len(chosen):
        raise UserError(
            f"{dataset.root}: has no frame {frames.start}" if not len(chosen) else "baseline: has no spline"
        )
    for n, k in enumerate(chosen):
        tracker.feed(dataset.frame(k))
        progress("tracking", (n + 1) / len(chosen), "")
    spline = tracker.spline
    assert spline is not None
    keyframes = tracker.all_keyframes()
    search = search_of(tracker, keyframes, spline, lambda index: dataset.frame(chosen[index]))
    begin = time.perf_counter()
    loops = search.find(progress)
    seconds = time.perf_counter() - begin
    times = {k: keyframes.small(k).t for k in keyframes.indices}
    errors = np.array([_error(s.T_ref_cam, truth, times[s.keyframe], s.t) for loop in loops for s in loop.sightings])
    errors = errors.reshape(-1, 6)
    sizes = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2)
    informations = [s.information for loop in loops for s in loop.sightings]
    nees = [float(e @ information @ e) / 6.0 for e, information in zip(errors, informations, strict=True)]
    tried, accepted = _look_alikes(search, truth, times, alike, progress)
    nan = float("nan")
    return LoopQuality(
        dataset.name, len(times), len(loops),
        1e3 * float(np.median(sizes[:, 0])) if loops else nan, 1e3 * float(np.median(sizes[:, 1])) if loops else nan,
        1e3 * float(sizes[:, 0].max(initial=0.0)), float(np.median(nees)) if loops else nan,
        sum(_is_false(loop, truth, times) for loop in loops), tried, accepted, seconds,
    )  # fmt: skip


def _look_alikes(
    search: LoopSearch, truth: Spline, times: dict[int, float], most: int, progress: Progress
) -> tuple[int, int]:  # fmt: skip
    """Pairs of keyframes of different places that were tried as if they were at one, and those taken for one."""
    by_rank: list[tuple[int, int, int]] = []
    for late in times:
        ranked = search.archive.alike(search.load(late), {late})
        apart = [k for k in ranked if search.options.remoteness(_between(truth, times[k], times[late])) > _APART]
        by_rank += [(rank, early, late) for rank, early in enumerate(apart)]
    chosen = sorted(by_rank)[:most]
    accepted = 0
    for n, (_, early, late) in enumerate(chosen):
        loop = search.pair(early, late, np.eye(4), _ANYWHERE)
        accepted += loop is not None and _is_false(loop, truth, times)
        progress("look-alikes", (n + 1) / len(chosen), f"{accepted} taken for one place")
    return len(chosen), accepted


def _is_false(loop: Loop, truth: Spline, times: dict[int, float]) -> bool:
    errors = [_error(s.T_ref_cam, truth, times[s.keyframe], s.t) for s in loop.sightings]
    return bool((np.linalg.norm(np.reshape(errors, (-1, 2, 3)), axis=2) > _FALSE).any())


def _between(truth: Spline, t_ref: float, t: float) -> FloatArray:
    return np.asarray(se3.inverse(truth.pose(t_ref)) @ truth.pose(t))


def _error(T_ref_cam: FloatArray, truth: Spline, t_ref: float, t: float) -> FloatArray:
    """Twist (6,) from the true pose at time t in the keyframe of time t_ref to T_ref_cam (4, 4)."""
    return se3.log(se3.inverse(_between(truth, t_ref, t)) @ T_ref_cam)
