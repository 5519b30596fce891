"""The parts of a recording that move most, each tracked by depth alone when it is first asked for."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np

from rsgen.console.progress import Progress
from rstrack.data.dataset import Dataset
from rstrack.tracking.first_look.depth_track import DepthTrack, depth_track

# Frames of a part.
_TRACKED = 60
# Windows of the recording of which the one that moves most is taken, and the shift (part of the width, a frame) that is
# enough: images that move faster are blurred. Where it does not tell, others take its place, so many in all.
_WINDOWS, _ENOUGH, _TRIES = 8, 0.015, 3


class DepthTracks:
    """The parts of a recording, the one that moves most first, each tracked once, when it is first asked for.

    By depth alone: a track that follows colours agrees with whatever clock and lens it takes them to have. Iterating
    raises UserError: a colour image that cannot be read.
    """

    def __init__(self, dataset: Dataset, frames: range, progress: Progress) -> None:
        self._dataset, self._frames, self._progress = dataset, frames, progress
        self._made: dict[range, DepthTrack | None] = {}

    @cached_property
    def _parts(self) -> list[range]:
        return moving_parts(self._dataset, self._frames, self._progress)

    def __iter__(self) -> Iterator[DepthTrack | None]:
        """None for a part that depth alone does not track."""
        for part in self._parts:
            if part not in self._made:
                self._made[part] = self._tracked(part)
            yield self._made[part]

    def _tracked(self, part: range) -> DepthTrack | None:
        where = f"frames {part.start} to {part.stop - 1}"
        return depth_track(self._dataset, part, lambda share: self._progress("first look: depth", share, where))


def moving_parts(dataset: Dataset, frames: range, progress: Progress) -> list[range]:
    """Frames to track: windows that do not overlap, the one first that moves most, though no more than is enough."""
    if len(frames) <= _TRACKED:
        return [frames]
    starts = np.linspace(0, len(frames) - _TRACKED, _WINDOWS).round().astype(int)
    motion = []
    for n, s in enumerate(starts, 1):
        motion.append(min(_shift(dataset, frames[int(s) : int(s) + _TRACKED]), _ENOUGH))
        progress("first look: motion", n / len(starts), "where the camera moves most")
    chosen: list[int] = []
    for n in np.argsort(-np.array(motion), kind="stable"):
        start = int(starts[n])
        if len(chosen) < _TRIES and all(abs(start - other) >= _TRACKED for other in chosen):
            chosen.append(start)
    return [frames[start : start + _TRACKED] for start in chosen]


def _shift(dataset: Dataset, frames: range) -> float:
    """Mean shift from one colour image to the next, as a part of the width, of three in a row in the middle."""
    k = frames[len(frames) // 2]
    near = [i for group in dataset.groups[k : k + 5] for i in group][:3]
    small = [cv2.resize(dataset.images.color(i), (96, 72), interpolation=cv2.INTER_AREA) for i in near]
    grey = [np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.float32) for image in small]
    window = cv2.createHanningWindow((96, 72), cv2.CV_32F)
    shifts = [math.hypot(*cv2.phaseCorrelate(a, b, window)[0]) / 96 for a, b in pairwise(grey)]
    return float(np.mean(shifts)) if shifts else 0.0
