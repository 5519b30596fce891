"""How good the loops of a track are, and whether places that look alike are taken for one.

print(loop_quality(dataset, Options(), frames=slice(None), alike=200).text())

The places may be those of another recording by the same cameras, of a room that looks the same and is another:
mirrored, or furnished with the same things elsewhere.
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
    these, wrongly. other: the other recording that those pairs are with, or nothing.
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
    other: str = ""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def text(self) -> str:
        """Two lines."""
        return (
            f"{self.name}: {self.loops} loops among {self.keyframes} keyframes in {self.seconds:.0f} s: off by "
            f"{self.median_mm:.2f} mm and {self.median_mrad:.2f} mrad (median), {self.worst_mm:.1f} mm at most, NEES/6 "
            f"{self.nees:.2f}; {self.false} false\n"
            f"{self.alike} pairs of places that look alike{self.other and ' in ' + self.other}, wherever the track has "
            f"them: {self.accepted} taken for one"
        )


def loop_quality(
    dataset: Dataset, options: Options, frames: slice, alike: int, progress: Progress = no_progress,
    other: Dataset | None = None,
) -> LoopQuality:  # fmt: skip
    """Track frames of a sequence with a true spline, look for loops, then try look-alikes: its own, or `other`'s.

    Raises UserError: no such truth, no frame, a method without a spline, or `other` with other cameras.
    """
    truth = dataset.truth
    if not isinstance(truth, Spline):
        raise UserError(f"{dataset.root}: has no true spline to compare loops with: give a sequence of rsgen's")
    if other is not None and not _same_cameras(dataset, other):
        raise UserError(f"{other.root}: its cameras are not those of {dataset.root}: render both with the same ones")
    search = _tracked(dataset, options, frames, progress)
    begin = time.perf_counter()
    loops = search.find(progress)
    seconds = time.perf_counter() - begin
    times = {k: search.archive.small(k).t for k in search.archive.indices}
    errors = np.array([_error(s.T_ref_cam, truth, times[s.keyframe], s.t) for loop in loops for s in loop.sightings])
    errors = errors.reshape(-1, 6)
    sizes = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2)
    informations = [s.information for loop in loops for s in loop.sightings]
    nees = [float(e @ information @ e) / 6.0 for e, information in zip(errors, informations, strict=True)]
    if other is None:
        tried, accepted = _look_alikes(search, truth, times, alike, progress)
    else:
        tried, accepted = _across(search, _tracked(other, options, frames, progress), alike, progress)
    nan = float("nan")
    return LoopQuality(
        dataset.name, len(times), len(loops),
        1e3 * float(np.median(sizes[:, 0])) if loops else nan, 1e3 * float(np.median(sizes[:, 1])) if loops else nan,
        1e3 * float(sizes[:, 0].max(initial=0.0)), float(np.median(nees)) if loops else nan,
        sum(_is_false(loop, truth, times) for loop in loops), tried, accepted, seconds, other.name if other else "",
    )  # fmt: skip


def _same_cameras(one: Dataset, other: Dataset) -> bool:
    a, b = one.rig, other.rig
    same = (a.depth_camera, a.color_camera) == (b.depth_camera, b.color_camera)
    return same and np.allclose(a.T_color_depth, b.T_color_depth)


def _tracked(dataset: Dataset, options: Options, frames: slice, progress: Progress) -> LoopSearch:
    """The search among the keyframes of a track without loops."""
    from rstrack.tracking.any_tracker import make_tracker
    from rstrack.tracking.loop_closing import search_of
    from rstrack.tracking.spline_tracker import Tracker

    chosen = range(len(dataset))[frames]
    interval_s, without = dataset.interval_s(chosen), replace(options, loops="off")
    tracker = make_tracker(dataset.rig, without, interval_s=interval_s, imu=dataset.imu if options.inertial else None)
    if not isinstance(tracker, Tracker) or not len(chosen):
        raise UserError(
            f"{dataset.root}: has no frame {frames.start}" if not len(chosen) else "baseline: has no spline"
        )
    for n, k in enumerate(chosen):
        tracker.feed(dataset.frame(k))
        progress("tracking", (n + 1) / len(chosen), dataset.name)
    spline = tracker.spline
    assert spline is not None
    return search_of(tracker, tracker.all_keyframes(), spline, lambda index: dataset.frame(chosen[index]))


def _across(here: LoopSearch, there: LoopSearch, most: int, progress: Progress) -> tuple[int, int]:
    """Pairs of keyframes of two recordings that were tried, those that look most alike, and those taken for one."""
    by_rank: list[tuple[int, int, int]] = []
    for late in there.archive.indices:
        ranked = here.archive.alike(there.load(late), set(), least=-1.0)
        by_rank += [(rank, early, late) for rank, early in enumerate(ranked)]
    chosen = sorted(by_rank)[:most]
    accepted = 0
    for n, (_, early, late) in enumerate(chosen):
        accepted += here.pair_across(there, early, late, _ANYWHERE)
        progress("look-alikes", (n + 1) / len(chosen), f"{accepted} taken for one place")
    return len(chosen), accepted


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
