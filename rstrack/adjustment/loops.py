"""Places that a track has come back to: looked for among its keyframes, aligned both ways, and used only then."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.candidates import AGREE, KeyframeTrack, candidates, sizes
from rstrack.adjustment.graph import Sighting
from rstrack.adjustment.rigid import Alignment, Judge, align
from rstrack.alignment.linearise import Terms
from rstrack.data.rig import Rig
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes import coarse_search
from rstrack.keyframes.archive import Archive
from rstrack.keyframes.keyframe import Reference
from rstrack.options import Options

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

Held = TypeVar("Held")


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
    _frames: OrderedDict[int, DeviceFrame] = field(default_factory=OrderedDict)

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
        found = [self.pair(c.early, late, c.T_early_late, c.allowed) for c in candidates(track, n, alike, self.options)]
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
        here, there = replace(self, motion=other.motion), replace(other, motion=self.motion)
        one = here._aligned(other._frame(late), early, np.eye(4), allowed)
        back = None if one is None else there._back(self._frame(early), late, one, np.eye(4), allowed)
        return one is not None and back is not None and not self._differ(early, one, back)

    def _aligned(
        self, frame: DeviceFrame, at: int, T_expected: FloatArray, allowed: FloatArray
    ) -> Alignment | None:  # fmt: skip
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
    ) -> Alignment | None:  # fmt: skip
        """The other way round, other images from the place that was found: it is to hold for these too."""
        return self._aligned_from(
            se3.inverse(there.T_ref_cam), _NEARBY, frame, at, se3.inverse(T_expected), allowed
        )  # fmt: skip

    def _aligned_from(
        self, start: FloatArray, levels: Sequence[int], frame: DeviceFrame, at: int, T_expected: FloatArray,
        allowed: FloatArray,
    ) -> Alignment | None:  # fmt: skip
        self.tried += 1
        ref = self._reference(at)
        if ref.pixels == 0:
            self._refuse("a keyframe without depth")
            return None
        result = align(
            self.terms, self.options, frame, ref, self.motion, start, levels, self.judge, self.inflations
        )  # fmt: skip
        if result.fault:
            self._refuse(result.fault)
            return None
        if (sizes(se3.inverse(T_expected) @ result.T_ref_cam) > allowed).any():
            self._refuse("further off than the track may have drifted")
            return None
        return result

    def _loop(self, early: int, late: int, there: Alignment, back: Alignment) -> Loop | None:
        if self._differ(early, there, back):
            self._refuse("the two ways of aligning it differ")
            return None
        between = sizes(there.T_ref_cam @ back.T_ref_cam)
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

    def _time(self, keyframe: int) -> float:
        return self.archive.small(keyframe).t

    def _reference(self, index: int) -> Reference:
        return _held(self._references, index, self.archive.get)

    def _frame(self, index: int) -> DeviceFrame:
        return _held(self._frames, index, self.load)

    def _refuse(self, why: str) -> None:
        self.faults[why] += 1


def _held(held: OrderedDict[int, Held], index: int, make: Callable[[int], Held]) -> Held:
    """What is held under a number, made where it is not, in place of what was asked for longest ago."""
    if index not in held:
        held[index] = make(index)
    held.move_to_end(index)
    while len(held) > _HELD:
        held.popitem(last=False)
    return held[index]
