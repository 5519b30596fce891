"""Rough tracks of the parts of a recording that move most."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset
from rstrack.data.image_files import prefetched
from rstrack.data.rig import Frame, Image
from rstrack.options import Options
from rstrack.tracking.any_tracker import AnyTracker, make_tracker

# Depth images as wide as that are thinned out: they take most of the time.
_LARGE = 480
# Frames that are tracked.
_TRACKED = 60
# Windows of the recording of which the one that moves most is taken, and the shift (part of the width, a frame) that is
# enough: images that move faster are blurred. Where it does not tell, others take its place, so many in all.
_WINDOWS, _ENOUGH, _TRIES = 8, 0.015, 3


def rough_track(dataset: Dataset, frames: range, options: Options, done: Callable[[float], None]) -> AnyTracker:
    """The tracker of options.method after it has been fed the frames, as far as it, and the images, went.

    done: called with what part (0 to 1) of the frames it has seen.
    """
    has_color = options.photometric
    step = 2 if dataset.rig.depth_camera.width >= _LARGE and not has_color else 1
    rig = replace(dataset.rig, depth_camera=_thinned(dataset.rig.depth_camera, step))
    tracker = make_tracker(rig, options, interval_s=dataset.interval_s(frames))

    def thinned(k: int) -> Frame:
        frame = dataset.frame(k, color=has_color)
        z = np.ascontiguousarray(frame.depth.pixels[::step, ::step])
        return Frame(Image(frame.depth.stamp, z), frame.colors)

    with suppress(UserError, np.linalg.LinAlgError):
        for count, frame in enumerate(prefetched(thinned, frames), 1):
            tracker.feed(frame)
            done(count / len(frames))
    return tracker


def _thinned(camera: Camera, step: int) -> Camera:
    """The camera whose pixels are every step-th of a camera's, from the first."""
    fx, fy, cx, cy = (value / step for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    width, height = -(-camera.width // step), -(-camera.height // step)
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def moving_parts(dataset: Dataset, frames: range) -> list[range]:
    """Frames to track: windows that do not overlap, the one first that moves most, though no more than is enough."""
    if len(frames) <= _TRACKED:
        return [frames]
    starts = np.linspace(0, len(frames) - _TRACKED, _WINDOWS).round().astype(int)
    motion = [min(_shift(dataset, frames[int(s) : int(s) + _TRACKED]), _ENOUGH) for s in starts]
    chosen: list[int] = []
    for n in np.argsort(-np.array(motion), kind="stable"):
        start = int(starts[n])
        if len(chosen) < _TRIES and all(abs(start - other) >= _TRACKED for other in chosen):
            chosen.append(start)
    return [frames[start : start + _TRACKED] for start in chosen]


def _shift(dataset: Dataset, frames: range) -> float:
    """Mean shift from one colour image to the next, as a part of the width, of three pairs in these frames."""
    shifts = []
    for k in frames[len(frames) // 6 :: len(frames) // 3]:
        i = [i for group in dataset.groups[k : k + 3] for i in group][:2]
        if len(i) == 2:
            a, b = (cv2.resize(dataset.images.color(n), (96, 72), interpolation=cv2.INTER_AREA) for n in i)
            window = cv2.createHanningWindow((96, 72), cv2.CV_32F)
            a, b = (np.asarray(cv2.cvtColor(x, cv2.COLOR_RGB2GRAY), np.float32) for x in (a, b))
            (du, dv), _ = cv2.phaseCorrelate(a, b, window)
            shifts.append(float(np.hypot(du, dv)) / 96)
    return float(np.mean(shifts)) if shifts else 0.0


@dataclass(frozen=True)
class GeometricTrack:
    """T_world_depth(t) of frames from depth alone, and the longest time (begin, end) in s that it covers."""

    frames: range
    spline: Spline
    begin: float
    end: float


class GeometricTracks:
    """The parts of a recording, the one that moves most first, each tracked once, when it is first asked for.

    By depth alone: a track that follows colours agrees with whatever clock and lens it takes them to have. Iterating
    raises UserError: a colour image that cannot be read.
    """

    def __init__(self, dataset: Dataset, frames: range, options: Options, progress: Progress) -> None:
        self._dataset, self._frames, self._progress = dataset, frames, progress
        self._options = Options(method="rs-g", backend=options.backend)
        self._made: dict[range, GeometricTrack | None] = {}

    @cached_property
    def _parts(self) -> list[range]:
        return moving_parts(self._dataset, self._frames)

    def __iter__(self) -> Iterator[GeometricTrack | None]:
        """None for a part that depth alone does not track."""
        for part in self._parts:
            if part not in self._made:
                self._made[part] = self._tracked(part)
            yield self._made[part]

    def _tracked(self, part: range) -> GeometricTrack | None:
        def done(share: float) -> None:
            self._progress("first look: depth", share, "tracking what moves most")

        tracker = rough_track(self._dataset, part, self._options, done)
        if not tracker.spline_valid or tracker.spline is None:
            return None
        begin, end = max(tracker.spline_valid, key=lambda span: span[1] - span[0])
        return GeometricTrack(part, tracker.spline, begin, end)
