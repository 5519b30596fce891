"""Places that a track has come back to: looked for among its keyframes, aligned both ways, and used only then."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from rsgen.array_types import FloatArray, IntArray
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
AGREE = np.array([0.01, np.radians(0.5)])
"""How far the two ways of aligning a pair may differ, m at one metre and rad."""
# Known better than this (m, rad), a place need not be searched for.
_SURE = np.array([0.05, np.radians(3.0)])
# Error of an alignment that all pixels share, in pixels, see `Uncertainty`: of keyframes that saw a place from
# elsewhere, not of the next frames.
_SYSTEMATIC_PX = 0.02
# Keyframes that are held on the device at once, and as many frames.
_HELD = 24
# Levels of the pyramid from a place that is known well, and from one that was searched for.
_NEARBY: tuple[int, ...] = (1, 0)
_ANYWHERE: tuple[int, ...] = (2, 1, 0)


@dataclass(frozen=True)
class KeyframeTrack:
    """Keyframes' numbers in their order (n), their poses T (n, 4, 4) in the world and the covariances (n, 6, 6) of
    these, as in `Uncertainty`."""

    order: list[int]
    T: FloatArray
    drift: FloatArray

    @cached_property
    def way(self) -> FloatArray:
        """Metres and radians (n, 2) from the first keyframe to each, along all between."""
        steps = sizes(se3.inverse(self.T[:-1]) @ self.T[1:])
        return np.cumsum(np.concatenate([np.zeros((1, 2)), steps]), axis=0)

    def older(self, n: int) -> list[int]:
        """Numbers of those so much older than the nth that they do not merely see the same still."""
        return self.order[: max(0, n - _APART + 1)]

    def allowed(self, early: IntArray, late: int) -> FloatArray:
        """Metres and radians (k, 2) by which the track may be off between the early ones (k,) and the late one."""
        Ad = se3.adjoint(se3.inverse(self.T[late]))
        own = Ad @ (self.drift[late] - self.drift[early]) @ Ad.T
        variances = np.stack([np.trace(own[:, at, at], axis1=1, axis2=2) for at in (slice(3), slice(3, 6))], axis=1)
        return np.asarray(
            _DRIFT_SIGMAS * np.sqrt(np.abs(variances)) + _DRIFT_SHARE * (self.way[late] - self.way[early]) + AGREE
        )


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
    _reference: Callable[[int], Reference] = field(init=False)
    _frame: Callable[[int], DeviceFrame] = field(init=False)

    def __post_init__(self) -> None:
        self._reference, self._frame = lru_cache(_HELD)(self.archive.get), lru_cache(_HELD)(self.load)

    def find(self, progress: Progress = no_progress) -> list[Loop]:
        """All loops among the keyframes."""
        track = self._track(self.archive.indices)
        loops: list[Loop] = []
        progress("loops", 0.0, f"{len(track.order)} keyframes")
        for n in range(len(track.order)):
            loops += self._loops_of(track, n)
            progress("loops", (n + 1) / len(track.order), f"{len(loops)} loops")
        return loops

    def find_of(self, late: int) -> list[Loop]:
        """Loops from one keyframe to those before it."""
        track = self._track([k for k in self.archive.indices if k <= late])
        return self._loops_of(track, len(track.order) - 1)

    def _track(self, keyframes: list[int]) -> KeyframeTrack:
        order = sorted(keyframes)
        nothing = np.zeros((6, 6))
        drift = np.array([self.drift.get(k, nothing) for k in order])
        return KeyframeTrack(order, np.array([self.pose(k) for k in order]), drift)

    def _loops_of(self, track: KeyframeTrack, n: int) -> list[Loop]:
        late = track.order[n]
        alike = self.archive.alike(self._frame(late), set(self.archive.indices).difference(track.older(n)))
        found = (self.pair(early, late, *where) for early, *where in candidates(track, n, alike, self.options))
        return [loop for loop in found if loop is not None]

    def pose(self, keyframe: int) -> FloatArray:
        """T_world_base (4, 4)."""
        known = self.poses.get(keyframe)
        return self.archive.pose(keyframe) if known is None else known

    def pair(self, early: int, late: int, T_early_late: FloatArray, allowed: FloatArray) -> Loop | None:
        """Whether two keyframes see one place, at T_early_late (4, 4) from each other, up to metres and radians."""
        there = self._aligned(self._frame(late), early, T_early_late, allowed)
        if there is None:
            return None
        back = self._back(self._frame(early), late, there, T_early_late, allowed)
        return None if back is None else self._loop(early, late, there, back)

    def pair_across(self, other: LoopSearch, early: int, late: int, allowed: FloatArray) -> bool:
        """Whether a keyframe of this recording and one (`late`) of another by the same cameras are taken for one place.

        Both are tried from where they were taken at one pose, up to metres and radians (2,).
        """
        here, there = copy(self), copy(other)
        here.motion, there.motion = other.motion, self.motion
        one = here._aligned(other._frame(late), early, np.eye(4), allowed)
        back = None if one is None else there._back(self._frame(early), late, one, np.eye(4), allowed)
        return one is not None and back is not None and not self._differ(early, one, back)

    def _aligned(self, frame: DeviceFrame, at: int, T_expected: FloatArray, allowed: FloatArray) -> Alignment | None:
        """A frame against the keyframe `at`, if it is found there, no further off than is allowed (m, rad)."""
        start, levels = T_expected, _NEARBY
        if (allowed > _SURE).any():
            small = coarse_search.small_frame(frame, self.rig, self.options.geometric)
            keyframe = coarse_search.small_keyframe(self._reference(at))
            found, score = coarse_search.search(small, keyframe, T_expected[None])
            start, levels = (found if score > 0.0 else T_expected), _ANYWHERE
        return self._aligned_from(start, levels, frame, at, T_expected, allowed)

    def _back(
        self, frame: DeviceFrame, at: int, there: Alignment, T_expected: FloatArray, allowed: FloatArray
    ) -> Alignment | None:
        """The other way round, other images from the place that was found: it is to hold for these too."""
        return self._aligned_from(se3.inverse(there.T_ref_cam), _NEARBY, frame, at, se3.inverse(T_expected), allowed)

    def _aligned_from(
        self, start: FloatArray, levels: Sequence[int], frame: DeviceFrame, at: int, T_expected: FloatArray,
        allowed: FloatArray,
    ) -> Alignment | None:  # fmt: skip
        self.tried += 1
        ref = self._reference(at)
        if ref.pixels == 0:
            self.faults["a keyframe without depth"] += 1
            return None
        result = align(self.terms, self.options, frame, ref, self.motion, start, levels, self.judge, self.inflations)
        if result.fault:
            self.faults[result.fault] += 1
            return None
        if (sizes(se3.inverse(T_expected) @ result.T_ref_cam) > allowed).any():
            self.faults["further off than the track may have drifted"] += 1
            return None
        return result

    def _loop(self, early: int, late: int, there: Alignment, back: Alignment) -> Loop | None:
        if self._differ(early, there, back):
            self.faults["the two ways of aligning it differ"] += 1
            return None
        between = sizes(there.T_ref_cam @ back.T_ref_cam)
        # Their difference shows more of their errors than either's noise.
        off = se3.log(there.T_ref_cam @ back.T_ref_cam)
        Ad = se3.adjoint(there.T_ref_cam)
        spread = Ad @ self._covariance(there) @ Ad.T + self._covariance(back)
        excess = max(1.0, float(off @ np.linalg.solve(spread, off)) / 6.0)

        def sighting(at: int, number: int, found: Alignment) -> Sighting:
            # They share their images: together they count as one.
            information = np.asarray(np.linalg.inv(self._covariance(found)) / (2.0 * excess))
            return Sighting(at, self.archive.small(number).t, found.T_ref_cam, information)

        both = sighting(early, late, there), sighting(late, early, back)
        return Loop(early, late, both, (float(between[0]), float(between[1])))

    def _differ(self, early: int, there: Alignment, back: Alignment) -> bool:
        depth = max(1.0, self._reference(early).median_depth)
        return bool((sizes(there.T_ref_cam @ back.T_ref_cam) > AGREE * np.array([depth, 1.0])).any())

    def _covariance(self, found: Alignment) -> FloatArray:
        turn = _SYSTEMATIC_PX / self.rig.depth_camera.fx
        systematic = np.diag(np.repeat([turn * self.median_depth, turn], 3) ** 2)
        # Directions that the images leave open get a large, finite one.
        return np.asarray(np.linalg.inv(found.information + np.diag(np.repeat([1.0, 1.0], 3))) + systematic)

    @cached_property
    def median_depth(self) -> float:
        """Median distance (m) of what the keyframes see."""
        return float(np.median([self.archive.small(k).median_depth for k in self.archive.indices]))


def candidates(
    track: KeyframeTrack, n: int, alike: Sequence[int], options: Options
) -> list[tuple[int, FloatArray, FloatArray]]:
    """Older keyframes that may see what the nth of a track sees, the most promising first, by their frames' numbers.

    With each T_early_late (4, 4) as the track has it, and by how many metres and radians (2,) that may be off.
    alike: of the older ones those that look like it, the best first.
    """
    rank = {k: at for at, k in enumerate(alike)}
    early = np.array([m for m, k in enumerate(track.older(n)) if k in rank], int)
    if not len(early):
        return []
    T_early_late = se3.inverse(track.T[early]) @ track.T[n]
    remote, allowed = options.remoteness_of_each(T_early_late), track.allowed(early, n)
    off = np.zeros((len(early), 6))
    off[:, 0], off[:, 5] = allowed[:, 0], np.minimum(allowed[:, 1], 1.0)
    # As near as the drift may have hidden.
    hidden = options.remoteness_of_each(se3.exp(off))
    is_first = np.array([rank[track.order[m]] < _MOST for m in early])
    may_be = (remote < _NEAR) | (is_first & (remote < _NEAR + hidden))
    chosen: list[int] = []
    for c in np.lexsort((early, remote)):
        if may_be[c] and len(chosen) < _MOST and all(abs(early[c] - early[other]) >= _SPREAD for other in chosen):
            chosen.append(int(c))
    return [(track.order[early[c]], T_early_late[c], allowed[c]) for c in chosen]


def sizes(T: FloatArray) -> FloatArray:
    """Metres and radians (..., 2) of motions (..., 4, 4)."""
    return np.asarray(np.linalg.norm(se3.log(T).reshape(*T.shape[:-2], 2, 3), axis=-1))
