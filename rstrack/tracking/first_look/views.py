"""Points of a rough track's depth images, looked up in pairs of its colour images.

views = Views(dataset, track.spline)
for k, i, j in pairs_in(dataset, track.frames, track.begin, track.end):
    pixels = pixels_of(dataset, track.spline, views.points(k), dataset.color_stamps[i : i + 1])
    seen = looked_up(views.image(i), pixels)
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import Float32Array, FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset
from rstrack.images.pyramid import intensity

# Of the tracked frames every so manieth has its depth looked up in pairs of images so many frames apart.
_EVERY, _APART = 4, (4, 8)
# Depth pixels looked up in a line.
_ACROSS = 106
# 8-bit values that are clipped, and their neighbours; in any channel, since how bright images are is compared here.
_BLACK, _WHITE = 4, 250
_ROUNDS = 3
# A depth image shows a point where it is no further off than this and this part of its distance: noise, and a pixel.
_SAME_M, _SAME = 0.02, 0.02


class Views:
    """Depth's points and colours of a track's frames, each made once."""

    def __init__(self, dataset: Dataset, spline: Spline) -> None:
        self._dataset, self._spline = dataset, spline
        self._depths: dict[int, Float32Array] = {}
        self._points: dict[int, FloatArray] = {}
        self._images: dict[int, npt.NDArray[np.float32]] = {}

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) of frame k. Raises UserError: it cannot be read, as all of these do."""
        if k not in self._depths:
            self._depths[k] = self._dataset.depth(k)
        return self._depths[k]

    def points(self, k: int) -> FloatArray:
        """Points (n, 3) in the world of frame k's depth, each line with its own pose."""
        if k not in self._points:
            self._points[k] = _points_of(self._dataset, self._spline, k, self.depth(k))
        return self._points[k]

    def image(self, i: int) -> npt.NDArray[np.float32]:
        """Intensities (h/2, w/2) of colour image i, NaN near clipped pixels."""
        if i not in self._images:
            self._images[i] = _image_of(self._dataset.images.color(i))
        return self._images[i]


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


def _points_of(dataset: Dataset, spline: Spline, k: int, depth: Float32Array) -> FloatArray:
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    step = max(round(camera.width / _ACROSS), 1)
    pixels = camera.pixel_grid()[::step, ::step].reshape(-1, 2)
    z = depth[::step, ::step].reshape(-1)
    rays = camera.unproject(pixels)
    known = (z > 0.0) & np.isfinite(rays).all(axis=1)
    lines = shutter.line_of_pixel(pixels[known], camera)
    T = spline.pose(shutter.line_mid_time(dataset.stamps[k], np.arange(shutter.line_count(camera)), camera))
    return se3.transform(T[lines.astype(np.int64)], rays[known] * z[known, None])


def rests(
    dataset: Dataset, spline: Spline, p_world: FloatArray, k: int, depth: Float32Array
) -> npt.NDArray[np.bool_]:  # fmt: skip
    """Which of points (n, 3) depth image k (h, w) shows where they were: not what moves by itself, or what it hides."""
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    times = shutter.line_mid_time(dataset.stamps[k], np.arange(shutter.line_count(camera)), camera)
    uv, p_cam, _ = projected(camera, shutter, se3.inverse(spline.pose(times)), p_world)
    seen = camera.contains(uv)
    u, v = np.rint(np.where(seen[:, None], uv, 0.0)).astype(np.int64).T
    z = depth[np.minimum(v, camera.height - 1), np.minimum(u, camera.width - 1)]
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


def _image_of(color: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    grey = np.asarray(cv2.pyrDown(intensity(color)))
    clipped = ((color.max(axis=2) >= _WHITE) | (color.max(axis=2) <= _BLACK)).astype(np.uint8)
    near = cv2.dilate(clipped, np.ones((7, 7), np.uint8))[::2, ::2]
    return np.where(near > 0, np.float32(np.nan), grey)


def pixels_of(dataset: Dataset, spline: Spline, p_world: FloatArray, stamps: FloatArray) -> npt.NDArray[np.float32]:
    """Pixels (m, n, 2) of `Views.image` at which colour images stamped `stamps` (m,) have points (n, 3).

    -10 where unseen. stamps: in steps in which points move by a few lines at most.
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
