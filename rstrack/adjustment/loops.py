"""Places that a track has come back to: looked for among its keyframes, aligned both ways, and used only then."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.graph import Sighting
from rstrack.adjustment.rigid import Alignment, Judge, align
from rstrack.alignment.linearise import Terms
from rstrack.data.rig import Rig
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes import coarse_search
from rstrack.keyframes.archive import Archive
from rstrack.keyframes.keyframe import Reference
from rstrack.options import Options

# Keyframes that follow each other see the same; so many later another place may come back.
_APART = 3
# Of the distance and angle at which a keyframe is left: older ones within so many times these see much the same.
_NEAR = 1.2
# Older keyframes that each is aligned to at most, and how far apart these must be in their order.
_MOST, _SPREAD = 3, 2
# How far a track may have drifted: so many σ of its own, and a part of the way and of the turning since.
_DRIFT_SIGMAS, _DRIFT_SHARE = 6.0, 0.02
# Known better than this (m, rad), a place need not be searched for.
_SURE = np.array([0.05, np.radians(3.0)])
# How far the two ways of aligning a pair may differ, m at one metre and rad.
_AGREE = np.array([0.01, np.radians(0.5)])
# Error of an alignment that all pixels share, in pixels, see `Uncertainty`: of keyframes that saw a place from
# elsewhere, not of the next frames.
_SYSTEMATIC_PX = 0.02
# Keyframes that are held on the device at once.
_HELD = 24
# Levels of the pyramid from a place that is known well, and from one that was searched for.
_NEARBY: tuple[int, ...] = (1, 0)
_ANYWHERE: tuple[int, ...] = (2, 1, 0)


@dataclass(frozen=True)
class Loop:
    """Keyframes `early` and `late` (their frames' numbers) that see one place, each frame aligned to the other.

    disagreement: m and rad between the two ways.
    """

    early: int
    late: int
    sightings: tuple[Sighting, Sighting]
    disagreement: tuple[float, float]


@dataclass
class LoopSearch:
    """Looks for loops of a track. load: a frame on the device by its number.

    motion: T_world_cam(t) of the track. poses: T_world_base (4, 4) of keyframes, where they are better known than the
    archive has them. drift: covariances of keyframes' poses, as in `Uncertainty`. judge, inflations: as in `align`.
    tried, faults: pairs that were aligned, and why some are none.
    """

    terms: Terms
    rig: Rig
    options: Options
    archive: Archive
    load: Callable[[int], DeviceFrame]
    motion: Spline
    drift: dict[int, FloatArray]
    judge: Judge
    inflations: tuple[float, float] = (1.0, 1.0)
    poses: Mapping[int, FloatArray] = field(default_factory=dict)
    tried: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    _references: OrderedDict[int, Reference] = field(default_factory=OrderedDict)

    def find(self, progress: Progress = no_progress) -> list[Loop]:
        """All loops among the keyframes."""
        order = sorted(self.archive.indices)
        T, way = self._track(order)
        number = {k: n for n, k in enumerate(order)}
        halves: dict[int, list[tuple[int, Alignment]]] = {}
        for n, late in enumerate(order):
            frame = self.load(late)
            for m in self._candidates(frame, n, order, T, way):
                early = order[m]
                allowed = self._allowed(early, late, way[n] - way[m])
                found = self._aligned(frame, early, se3.inverse(T[early]) @ T[late], allowed)
                if found is not None:
                    halves.setdefault(early, []).append((late, found))
            progress("loops", 0.7 * (n + 1) / len(order), f"{sum(map(len, halves.values()))} places again")
        loops = []
        for n, (early, found_there) in enumerate(halves.items()):
            frame = self.load(early)
            for late, there in found_there:
                allowed = self._allowed(early, late, way[number[late]] - way[number[early]])
                back = self._aligned(frame, late, se3.inverse(T[late]) @ T[early], allowed)
                loop = None if back is None else self._loop(early, late, there, back)
                if loop is not None:
                    loops.append(loop)
            progress("loops", 0.7 + 0.3 * (n + 1) / len(halves), f"{len(loops)} loops")
        return loops

    def find_of(self, late: int) -> list[Loop]:
        """Loops from one keyframe to those before it."""
        order = sorted(k for k in self.archive.indices if k <= late)
        T, way = self._track(order)
        n = len(order) - 1
        frame = self.load(late)
        loops = []
        for m in self._candidates(frame, n, order, T, way):
            early = order[m]
            allowed = self._allowed(early, late, way[n] - way[m])
            loop = self._pair(frame, early, late, se3.inverse(T[early]) @ T[late], allowed)
            if loop is not None:
                loops.append(loop)
        return loops

    def _track(self, order: list[int]) -> tuple[dict[int, FloatArray], FloatArray]:
        """Keyframes' poses, and metres and radians (n, 2) from the first to each along the way."""
        T = {k: self.pose(k) for k in order}
        return T, _ways([T[k] for k in order])

    def pose(self, keyframe: int) -> FloatArray:
        """T_world_base (4, 4)."""
        known = self.poses.get(keyframe)
        return self.archive.pose(keyframe) if known is None else known

    def pair(self, early: int, late: int, T_early_late: FloatArray, allowed: FloatArray) -> Loop | None:
        """Whether two keyframes see one place, at T_early_late (4, 4) from each other, up to metres and radians."""
        return self._pair(self.load(late), early, late, T_early_late, allowed)

    def _pair(
        self, frame: DeviceFrame, early: int, late: int, T_early_late: FloatArray, allowed: FloatArray
    ) -> Loop | None:  # fmt: skip
        there = self._aligned(frame, early, T_early_late, allowed)
        back = None if there is None else self._aligned(self.load(early), late, se3.inverse(T_early_late), allowed)
        return None if there is None or back is None else self._loop(early, late, there, back)

    def pair_across(self, other: LoopSearch, early: int, late: int, allowed: FloatArray) -> bool:
        """Whether a keyframe of this recording and one (`late`) of another by the same cameras are taken for one place.

        Both are tried from where they were taken at one pose, up to metres and radians (2,).
        """
        here, there = replace(self, motion=other.motion), replace(other, motion=self.motion)
        one = here._aligned(other.load(late), early, np.eye(4), allowed)
        back = None if one is None else there._aligned(self.load(early), late, np.eye(4), allowed)
        return one is not None and back is not None and not self._differ(early, one, back)

    def _candidates(
        self, frame: DeviceFrame, n: int, order: list[int], T: dict[int, FloatArray], way: FloatArray
    ) -> list[int]:
        """Numbers in the order of older keyframes that may see what the nth sees, the most promising first."""
        late = order[n]
        alike = {k: rank for rank, k in enumerate(self.archive.alike(frame, set(order[max(0, n - _APART + 1) :])))}
        rated = []
        for m in range(n - _APART + 1):
            early = order[m]
            if early not in alike:
                continue
            T_rel = se3.inverse(T[early]) @ T[late]
            remote = self.options.remoteness(T_rel)
            allowed = self._allowed(early, late, way[n] - way[m])
            # As near as the drift may have hidden.
            hidden = self.options.remoteness(se3.exp(np.array([allowed[0], 0, 0, 0, 0, min(allowed[1], 1.0)])))
            if remote < _NEAR or (remote < _NEAR + hidden and alike[early] < _MOST):
                rated.append((remote, m))
        chosen: list[int] = []
        for _, m in sorted(rated):
            if len(chosen) < _MOST and all(abs(m - other) >= _SPREAD for other in chosen):
                chosen.append(m)
        return chosen

    def _allowed(self, early: int, late: int, way: FloatArray) -> FloatArray:
        """Metres and radians by which a track may be off between two keyframes; way (2,): metres and radians since."""
        nothing = np.zeros((6, 6))
        spread = self.drift.get(late, nothing) - self.drift.get(early, nothing)
        T_late = self.pose(late)
        Ad = se3.adjoint(se3.inverse(T_late))
        own = Ad @ spread @ Ad.T
        sigma = np.sqrt(np.abs([np.trace(own[:3, :3]), np.trace(own[3:, 3:])]))
        return np.asarray(_DRIFT_SIGMAS * sigma + _DRIFT_SHARE * way + _AGREE)

    def _aligned(
        self, frame: DeviceFrame, at: int, T_expected: FloatArray, allowed: FloatArray
    ) -> Alignment | None:  # fmt: skip
        """A frame against the keyframe `at`, if it is found there, no further off than is allowed (m, rad)."""
        self.tried += 1
        ref = self._reference(at)
        start, levels = T_expected, _NEARBY
        if (allowed > _SURE).any():
            small = coarse_search.small_frame(frame, self.rig, self.options.geometric)
            found, score = coarse_search.search(small, coarse_search.small_keyframe(ref), T_expected[None])
            start, levels = (found if score > 0.0 else T_expected), _ANYWHERE
        if ref.pixels == 0:
            self._refuse("a keyframe without depth")
            return None
        result = align(
            self.terms, self.options, frame, ref, self.motion, start, levels, self.judge, self.inflations
        )  # fmt: skip
        if result.fault:
            self._refuse(result.fault)
            return None
        if (_sizes(se3.inverse(T_expected) @ result.T_ref_cam) > allowed).any():
            self._refuse("further off than the track may have drifted")
            return None
        return result

    def _loop(self, early: int, late: int, there: Alignment, back: Alignment) -> Loop | None:
        if self._differ(early, there, back):
            self._refuse("the two ways of aligning it differ")
            return None
        between = _sizes(there.T_ref_cam @ back.T_ref_cam)
        # Their difference shows more of their errors than either's noise.
        off = se3.log(there.T_ref_cam @ back.T_ref_cam)
        Ad = se3.adjoint(there.T_ref_cam)
        spread = Ad @ self._covariance(there) @ Ad.T + self._covariance(back)
        excess = max(1.0, float(off @ np.linalg.solve(spread, off)) / 6.0)
        # They share their images: together they count as one.
        one, other = (
            Sighting(
                at,
                self._time(number),
                found.T_ref_cam,
                np.asarray(np.linalg.inv(self._covariance(found)) / (2.0 * excess)),
            )
            for at, number, found in ((early, late, there), (late, early, back))
        )
        return Loop(early, late, (one, other), (float(between[0]), float(between[1])))

    def _differ(self, early: int, there: Alignment, back: Alignment) -> bool:
        depth = max(1.0, self._reference(early).median_depth)
        return bool((_sizes(there.T_ref_cam @ back.T_ref_cam) > _AGREE * np.array([depth, 1.0])).any())

    def _covariance(self, found: Alignment) -> FloatArray:
        turn = _SYSTEMATIC_PX / self.rig.depth_camera.fx
        systematic = np.diag(np.repeat([turn * self.median_depth, turn], 3) ** 2)
        # Directions that the images leave open get a large, finite one.
        return np.asarray(np.linalg.inv(found.information + np.diag(np.repeat([1.0, 1.0], 3))) + systematic)

    @cached_property
    def median_depth(self) -> float:
        """Median distance (m) of what the keyframes see."""
        return float(np.median([self.archive.small(k).median_depth for k in self.archive.indices]))

    def _time(self, keyframe: int) -> float:
        return self.archive.small(keyframe).t

    def _reference(self, index: int) -> Reference:
        if index not in self._references:
            self._references[index] = self.archive.get(index)
        self._references.move_to_end(index)
        while len(self._references) > _HELD:
            self._references.popitem(last=False)
        return self._references[index]

    def _refuse(self, why: str) -> None:
        self.faults[why] += 1


def _sizes(T: FloatArray) -> FloatArray:
    """Metres and radians of a motion (4, 4)."""
    return np.linalg.norm(se3.log(T).reshape(2, 3), axis=1)


def _ways(poses: list[FloatArray]) -> FloatArray:
    """Metres and radians (n, 2) from the first pose to each, along all between."""
    steps = [_sizes(se3.inverse(a) @ b) for a, b in pairwise(poses)]
    return np.cumsum(np.array([np.zeros(2), *steps]), axis=0)
