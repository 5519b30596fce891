"""The measure `loops`: how good the loops of a track are, and whether places that look alike are taken for one.

The places may be those of another recording by the same cameras, of a room that looks the same and is another:
mirrored, or furnished with the same things elsewhere.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.loops import Loop, LoopSearch
from rstrack.bench.cells import SequenceEntry, StrictModel
from rstrack.bench.changes import with_color, with_depth
from rstrack.bench.record import Figures
from rstrack.bench.task import Task, settings_of
from rstrack.data.dataset import Dataset
from rstrack.options import Options
from rstrack.tracking.any_tracker import make_tracker
from rstrack.tracking.loop_closing import search_of
from rstrack.tracking.spline_tracker import Tracker

# Two keyframes whose places are further apart than so many times where a keyframe is left behind are two places.
_APART = 2.5
# A loop that is further off is a false one, m and rad.
_FALSE = np.array([0.02, np.radians(2.0)])
# A pair of look-alikes may be anywhere, as after any drift (m, rad).
_ANYWHERE = np.array([1e3, 10.0])


class LoopsSettings(StrictModel):
    """alike: pairs of different places that look alike to try. other: try those with another room.

    That is another sequence, defined as they are in `sequences`, or the same one with left and right exchanged.
    """

    alike: int = Field(default=200, ge=0)
    other: Literal["mirrored"] | SequenceEntry | None = None


def loops_cell(task: Task, progress: Progress) -> Figures:
    """Track the case, look for loops, then try look-alikes, its own or another recording's.

    median_mm, median_mrad, worst_mm: errors of each frame's pose in the other keyframe, against the truth. nees:
    squared errors over the covariances, over six (1: as large as they say), median. false: loops further off than 20 mm
    or 2 degrees. alike: pairs of different places that were tried, those that look most alike; accepted: of these,
    taken for one. Raises UserError: no true spline, no frame, a method without a spline, another recording by other
    cameras; Absent: that recording is not there.
    """
    settings, dataset = settings_of(task, LoopsSettings), task.noisy
    truth = dataset.truth
    if not isinstance(truth, Spline):
        raise UserError(f"{dataset.root}: has no true spline to compare loops with: give a sequence of rsgen's")
    other = None if settings.other is None else _other(task, settings.other)
    search = _tracked(dataset, task.options, task.frames, progress)
    begin = time.perf_counter()
    loops = search.find(progress)
    seconds = time.perf_counter() - begin
    times = {k: search.archive.small(k).t for k in search.archive.indices}
    if other is None:
        tried, accepted = _look_alikes(search, truth, times, settings.alike, progress)
    else:
        there = _tracked(other, task.options, range(len(other))[task.cell.frames], progress)
        tried, accepted = _across(search, there, settings.alike, progress)
    return {
        "keyframes": len(times), "loops": len(loops), **_accuracy(loops, truth, times),
        "false": sum(_is_false(loop, truth, times) for loop in loops), "alike": tried, "accepted": accepted,
        "search_s": seconds,
    }  # fmt: skip


def mirrored(dataset: Dataset) -> Dataset:
    """A room whose left is the other's right, by the same cameras, if these see it alike left and right."""
    return with_color(with_depth(dataset, lambda _, z: z[:, ::-1].copy()), lambda _, pixels: pixels[:, ::-1].copy())


# ---------------------------------------------------------------------------------------------------------------------


def _other(task: Task, other: Literal["mirrored"] | SequenceEntry) -> Dataset:
    if other == "mirrored":
        return mirrored(task.noisy)
    there = replace(task, cell=replace(task.cell, sequence=other))
    a, b = task.dataset.rig, there.dataset.rig
    same = (a.depth_camera, a.color_camera) == (b.depth_camera, b.color_camera)
    if not (same and np.allclose(a.T_color_depth, b.T_color_depth)):
        raise UserError(f"{there.root}: its cameras are not those of {task.root}: render both with the same ones")
    return there.noisy


def _tracked(dataset: Dataset, options: Options, frames: range, progress: Progress) -> LoopSearch:
    """The search among the keyframes of a track without loops."""
    if not len(frames):
        raise UserError(f"{dataset.root}: has no frame {frames.start}")
    interval_s, without = dataset.interval_s(frames), replace(options, loops="off")
    tracker = make_tracker(dataset.rig, without, interval_s=interval_s, imu=dataset.imu if options.inertial else None)
    if not isinstance(tracker, Tracker):
        raise UserError("loops: the baseline has no spline: choose an rs or gs method")
    for n, k in enumerate(frames):
        tracker.feed(dataset.frame(k))
        progress("tracking", (n + 1) / len(frames), dataset.name)
    spline = tracker.spline
    assert spline is not None
    return search_of(tracker, tracker.track.all_keyframes(), spline, lambda index: dataset.frame(frames[index]))


def _accuracy(loops: Sequence[Loop], truth: Spline, times: dict[int, float]) -> Figures:
    if not loops:
        return dict.fromkeys(("median_mm", "median_mrad", "worst_mm", "nees"))
    sightings = [s for loop in loops for s in loop.sightings]
    errors = np.array([_error(s.T_ref_cam, truth, times[s.keyframe], s.t) for s in sightings])
    sizes = 1e3 * np.linalg.norm(errors.reshape(-1, 2, 3), axis=2)
    nees = [float(e @ s.information @ e) / 6.0 for e, s in zip(errors, sightings, strict=True)]
    mm, mrad = np.median(sizes, axis=0).tolist()
    return {"median_mm": mm, "median_mrad": mrad, "worst_mm": float(sizes[:, 0].max()), "nees": float(np.median(nees))}


def _across(here: LoopSearch, there: LoopSearch, most: int, progress: Progress) -> tuple[int, int]:
    """Pairs of keyframes of two recordings that were tried, and those taken for one place."""
    ranked = {late: here.archive.alike(there.load(late), set(), least=-1.0) for late in there.archive.indices}
    return _tried(ranked, most, lambda early, late: here.pair_across(there, early, late, _ANYWHERE), progress)


def _look_alikes(
    search: LoopSearch, truth: Spline, times: dict[int, float], most: int, progress: Progress
) -> tuple[int, int]:  # fmt: skip
    """Pairs of keyframes of different places that were tried as if they were at one, and those taken for one."""

    def is_apart(early: int, late: int) -> bool:
        return search.options.remoteness(_between(truth, times[early], times[late])) > _APART

    def is_taken(early: int, late: int) -> bool:
        loop = search.pair(early, late, np.eye(4), _ANYWHERE)
        return loop is not None and _is_false(loop, truth, times)

    alike = {late: search.archive.alike(search.load(late), {late}) for late in times}
    ranked = {late: [early for early in earlier if is_apart(early, late)] for late, earlier in alike.items()}
    return _tried(ranked, most, is_taken, progress)


def _tried(
    ranked: Mapping[int, Sequence[int]], most: int, is_taken: Callable[[int, int], bool], progress: Progress
) -> tuple[int, int]:
    """How many pairs were tried, those that look most alike of each keyframe first, and how many were taken for one."""
    by_rank = sorted((rank, early, late) for late, found in ranked.items() for rank, early in enumerate(found))[:most]
    taken = 0
    for n, (_, early, late) in enumerate(by_rank):
        taken += is_taken(early, late)
        progress("look-alikes", (n + 1) / len(by_rank), f"{taken} taken for one place")
    return len(by_rank), taken


def _is_false(loop: Loop, truth: Spline, times: dict[int, float]) -> bool:
    errors = [_error(s.T_ref_cam, truth, times[s.keyframe], s.t) for s in loop.sightings]
    return bool((np.linalg.norm(np.reshape(errors, (-1, 2, 3)), axis=2) > _FALSE).any())


def _between(truth: Spline, t_ref: float, t: float) -> FloatArray:
    return np.asarray(se3.inverse(truth.pose(t_ref)) @ truth.pose(t))


def _error(T_ref_cam: FloatArray, truth: Spline, t_ref: float, t: float) -> FloatArray:
    """Twist (6,) from the true pose at time t in the keyframe of time t_ref to T_ref_cam (4, 4)."""
    return se3.log(se3.inverse(_between(truth, t_ref, t)) @ T_ref_cam)
