"""Rough tracks of parts of a recording, and points of their depth images looked up in pairs of colour images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset
from rstrack.data.rig import Frame, Image
from rstrack.images.pyramid import intensity
from rstrack.options import Options
from rstrack.tracking.any_tracker import AnyTracker, make_tracker

# Depth images as wide as that are thinned out: they take most of the time.
_LARGE = 480
# Frames that are tracked; of these, every so manieth has its depth looked up in pairs of images so many frames apart.
_TRACKED, _EVERY, _APART = 60, 4, (4, 8)
# Windows of the recording of which the one that moves most is taken, and the shift (part of the width, a frame) that is
# enough: images that move faster are blurred. Where it does not tell, others take its place, so many in all.
_WINDOWS, _ENOUGH, _TRIES = 8, 0.015, 3
# Depth pixels looked up in a line.
_ACROSS = 106
# 8-bit values that are clipped, and their neighbours; in any channel, since how bright images are is compared here.
_BLACK, _WHITE = 4, 250
_ROUNDS = 3
# A depth image shows a point where it is no further off than this and this part of its distance: noise, and a pixel.
_SAME_M, _SAME = 0.02, 0.02


def rough_track(dataset: Dataset, frames: range, options: Options, done: Callable[[float], None]) -> AnyTracker:
    """The tracker of options.method after it has been fed the frames, as far as it, and the images, went.

    done: called with what part (0 to 1) of the frames it has seen.
    """
    has_color = options.photometric
    step = 2 if dataset.rig.depth_camera.width >= _LARGE and not has_color else 1
    rig = replace(dataset.rig, depth_camera=_thinned(dataset.rig.depth_camera, step))
    tracker = make_tracker(rig, options, interval_s=dataset.interval_s(frames))
    for count, k in enumerate(frames, 1):
        try:
            frame = dataset.frame(k, color=has_color)
            z = np.ascontiguousarray(frame.depth.pixels[::step, ::step])
            tracker.feed(Frame(Image(frame.depth.stamp, z), frame.colors))
        except (UserError, np.linalg.LinAlgError):
            break
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


def pairs_in(dataset: Dataset, frames: range, begin: float, end: float) -> list[tuple[int, int, int]]:
    """(frame, colour image, colour image) whose lines lie in [begin, end] seconds."""
    readout = max(dataset.rig.depth_shutter.readout_s, dataset.rig.color_shutter.readout_s)
    latest = end - readout

    def color(k: int) -> int | None:
        group = dataset.groups[k] if k in frames else ()
        return next((i for i in group if begin <= dataset.color_stamps[i] <= latest), None)

    pairs = []
    for k in frames[::_EVERY]:
        for apart in _APART:
            i, j = color(k), color(k + apart)
            if i is not None and j is not None and begin <= dataset.stamps[k] <= latest:
                pairs.append((k, i, j))
    return pairs


def points_of(dataset: Dataset, spline: Spline, k: int) -> FloatArray:
    """Points (n, 3) in the world of frame k's depth, each line with its own pose."""
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    step = max(round(camera.width / _ACROSS), 1)
    pixels = camera.pixel_grid()[::step, ::step].reshape(-1, 2)
    z = dataset.depth(k)[::step, ::step].reshape(-1)
    rays = camera.unproject(pixels)
    known = (z > 0.0) & np.isfinite(rays).all(axis=1)
    lines = shutter.line_of_pixel(pixels[known], camera)
    T = spline.pose(shutter.line_mid_time(dataset.stamps[k], np.arange(shutter.line_count(camera)), camera))
    return se3.transform(T[lines.astype(np.int64)], rays[known] * z[known, None])


def rests(dataset: Dataset, spline: Spline, p_world: FloatArray, k: int) -> npt.NDArray[np.bool_]:
    """Which of points (n, 3) depth image k shows where they were: not what moves by itself, or what it hides."""
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    times = shutter.line_mid_time(dataset.stamps[k], np.arange(shutter.line_count(camera)), camera)
    uv, p_cam, _ = projected(camera, shutter, se3.inverse(spline.pose(times)), p_world)
    seen = camera.contains(uv)
    u, v = np.rint(np.where(seen[:, None], uv, 0.0)).astype(np.int64).T
    z = dataset.depth(k)[np.minimum(v, camera.height - 1), np.minimum(u, camera.width - 1)]
    off = np.abs(z - p_cam[:, 2])
    return np.asarray(seen & (z > 0.0) & (off < _SAME_M + _SAME * p_cam[:, 2]))


def projected(
    camera: Camera,
    shutter: Shutter,
    T_cam_world: FloatArray,
    p_world: FloatArray,
    line: npt.NDArray[np.int64] | None = None,
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64]]:
    """Pixels (n, 2), points (n, 3) in the camera and lines (n,) of points (n, 3), whose lines have poses (lines, 4, 4).

    Equation (3) by fixed-point iteration, with the pose of the nearest line. line (n,): a start that is a few lines off
    at most, from which one iteration is enough; without it, the image's middle.
    """
    rounds = _ROUNDS if line is None else 1
    line = np.full(len(p_world), len(T_cam_world) // 2) if line is None else line
    for _ in range(rounds):
        p_cam = se3.transform(T_cam_world[line], p_world)
        uv, _ = camera.project(p_cam)
        at = np.nan_to_num(shutter.line_of_pixel(uv, camera))
        line = np.clip(np.rint(at), 0, len(T_cam_world) - 1).astype(np.int64)
    return uv, p_cam, line


def image_of(color: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Intensities (h/2, w/2), NaN near clipped pixels."""
    grey = np.asarray(cv2.pyrDown(intensity(color)))
    clipped = ((color.max(axis=2) >= _WHITE) | (color.max(axis=2) <= _BLACK)).astype(np.uint8)
    near = cv2.dilate(clipped, np.ones((7, 7), np.uint8))[::2, ::2]
    return np.where(near > 0, np.float32(np.nan), grey)


def pixels_of(dataset: Dataset, spline: Spline, p_world: FloatArray, stamps: FloatArray) -> npt.NDArray[np.float32]:
    """Pixels (m, n, 2) of `image_of` at which colour images stamped `stamps` (m,) have points (n, 3); -10 where unseen.

    stamps: in steps in which points move by a few lines at most.
    """
    camera, shutter, T_color_depth = dataset.rig.color_camera, dataset.rig.color_shutter, dataset.rig.T_color_depth
    lines, line = np.arange(shutter.line_count(camera)), None
    found = np.empty((len(stamps), len(p_world), 2), np.float32)
    for m, stamp in enumerate(stamps):
        T = T_color_depth @ se3.inverse(spline.pose(shutter.line_mid_time(stamp, lines, camera)))
        uv, _, line = projected(camera, shutter, T, p_world, line)
        found[m] = np.where(camera.contains(uv)[:, None], 0.5 * uv, -10.0)
    return found


def looked_up(image: npt.NDArray[np.float32], pixels: npt.NDArray[np.float32]) -> FloatArray:
    """Values (m, n) of an image at pixels (m, n, 2), between pixels linearly; NaN outside and beside NaN."""
    u, v = (np.ascontiguousarray(x) for x in np.moveaxis(pixels, 2, 0))
    return np.asarray(
        cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")), np.float64
    )
