"""Datasets with something changed: pure functions from a dataset to one that says or shows something else.

dataset = with_color(dataset, lambda k, pixels: gained(pixels, 0.92))
dataset = reordered(dataset, shown=range(0, len(dataset), 2), stamps=dataset.stamps[::2])

Images are changed when they are read. What is random depends on a seed and on the image's number alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.dataset import Dataset, ImageReader, group_colors
from rstrack.data.rig import Rig
from rstrack.metrics.association import true_poses, truth_of

ColorChange = Callable[[int, ByteArray], ByteArray]
DepthChange = Callable[[int, Float32Array], Float32Array]


@dataclass(frozen=True)
class _Changed:
    """Images of another reader: its k-th is the source's shown_*[k]-th, after a change that is told k."""

    source: ImageReader
    change_color: ColorChange
    change_depth: DepthChange
    shown_color: tuple[int, ...]
    shown_depth: tuple[int, ...]

    def color(self, k: int) -> ByteArray:
        return self.change_color(k, self.source.color(self.shown_color[k]))

    def depth(self, k: int) -> Float32Array:
        return self.change_depth(k, self.source.depth(self.shown_depth[k]))


def _same_color(_: int, pixels: ByteArray) -> ByteArray:
    return pixels


def _same_depth(_: int, z: Float32Array) -> Float32Array:
    return z


def with_color(dataset: Dataset, change: ColorChange) -> Dataset:
    """With every colour image k (h, w, 3) replaced by change(k, pixels)."""
    return _with_images(dataset, change_color=change)


def with_depth(dataset: Dataset, change: DepthChange) -> Dataset:
    """With every depth image k (h, w), metres, replaced by change(k, z)."""
    return _with_images(dataset, change_depth=change)


def with_stamps(dataset: Dataset, depth: FloatArray, color: FloatArray) -> Dataset:
    """The same images said to be of other times (n,) and (m,) in s, grouped by these.

    The truth stays that of the images: poses are compared by frame, so that what is measured is the track, not that the
    camera was elsewhere at the wrong time. Raises UserError if stamps do not increase.
    """
    if (np.diff(depth) <= 0).any() or (np.diff(color) <= 0).any():
        raise UserError(f"{dataset.name}: its stamps are closer than they would be moved: they must increase")
    moved = _with_truth(dataset, dataset.stamps, depth)
    return replace(moved, stamps=depth, color_stamps=color, groups=group_colors(depth, color))


def with_shutter(dataset: Dataset, depth: Callable[[float], float], color: Callable[[float], float]) -> Dataset:
    """Readouts, s, said to be others. Raises UserError for one below zero."""
    rig = dataset.rig
    depth_shutter = replace(rig.depth_shutter, readout_s=depth(rig.depth_shutter.readout_s))
    color_shutter = replace(rig.color_shutter, readout_s=color(rig.color_shutter.readout_s))
    return replace(dataset, rig=replace(rig, depth_shutter=depth_shutter, color_shutter=color_shutter))


def reordered(
    dataset: Dataset, shown: Sequence[int], stamps: FloatArray, colors: Sequence[int] | None = None
) -> Dataset:
    """Frames shown (n,) of a dataset, any number of times and in any order, under new stamps (n,) that increase, s.

    A frame's colour images go with it, as long before or after its depth image as they were. colors: frames (n,) whose
    colour images are taken instead. The truth of a frame is that of its depth image, wherever that was taken.
    """
    colors = shown if colors is None else colors
    chosen: list[int] = []
    color_stamps: list[float] = []
    groups: list[tuple[int, ...]] = []
    for source, stamp in zip(colors, stamps, strict=True):
        group = dataset.groups[source]
        groups.append(tuple(range(len(chosen), len(chosen) + len(group))))
        chosen += list(group)
        color_stamps += [stamp + dataset.color_stamps[i] - dataset.stamps[source] for i in group]
    images = _Changed(dataset.images, _same_color, _same_depth, tuple(chosen), tuple(shown))
    moved = _with_truth(dataset, dataset.stamps[np.asarray(shown, int)], stamps)
    return replace(
        moved,
        stamps=np.asarray(stamps, float),
        color_stamps=np.array(color_stamps),
        groups=tuple(groups),
        images=images,
    )


def reduced(dataset: Dataset, factor: int) -> Dataset:
    """With images 1/factor as wide and high: depth loses pixels, as an edge must stay one; colour is averaged.

    What does not fill a pixel at the right and lower border is cut off. Lines keep their times: those of the depth
    pixels that stay, the mean of the colour pixels that are averaged. Raises UserError if too little is left.
    """
    rig = dataset.rig
    centre = 0.5 * (factor - 1)
    depth_camera, depth_shutter, depth_late = _reduced(rig.depth_camera, rig.depth_shutter, factor, 0.0)
    color_camera, color_shutter, color_late = _reduced(rig.color_camera, rig.color_shutter, factor, centre)

    def fewer(_: int, z: Float32Array) -> Float32Array:
        return np.ascontiguousarray(z[::factor, ::factor][: depth_camera.height, : depth_camera.width])

    def mean(_: int, pixels: ByteArray) -> ByteArray:
        h, w = color_camera.height, color_camera.width
        blocks = pixels[: h * factor, : w * factor].reshape(h, factor, w, factor, 3)
        return np.rint(blocks.mean(axis=(1, 3), dtype=np.float32)).astype(np.uint8)

    small = Rig(depth_camera, depth_shutter, color_camera, color_shutter, rig.T_color_depth)
    changed = with_color(with_depth(dataset, fewer), mean)
    changed = _with_truth(changed, dataset.stamps + depth_late, dataset.stamps + depth_late)
    stamps, color_stamps = dataset.stamps + depth_late, dataset.color_stamps + color_late
    return replace(changed, rig=small, stamps=stamps, color_stamps=color_stamps)


# ---------------------------------------------------------------------------------------------------------------------


def _with_images(
    dataset: Dataset, change_color: ColorChange = _same_color, change_depth: DepthChange = _same_depth
) -> Dataset:
    everything = tuple(range(len(dataset.color_stamps))), tuple(range(len(dataset.stamps)))
    images = _Changed(dataset.images, change_color, change_depth, *everything)
    return replace(dataset, images=images)


def _with_truth(dataset: Dataset, taken: FloatArray, stamps: FloatArray) -> Dataset:
    """With the true poses of times `taken` (n,) as those of stamps (n,), s; no truth where there was none there."""
    truth = truth_of(dataset)
    poses = None
    if truth is not None:
        index, T = true_poses(truth.motion, np.asarray(taken), interpolate=True)
        poses = Trajectory(np.asarray(stamps, float)[index], T)
    return replace(dataset, truth=None, truth_poses=poses, sequence=None)


def _reduced(camera: Camera, shutter: Shutter, factor: int, centre: float) -> tuple[Camera, Shutter, float]:
    """A camera and shutter of the pixels factor · k + centre, and how much later their first line is, s."""
    width, height = camera.width // factor, camera.height // factor
    if min(width, height) < 8:
        raise UserError(f"images of {camera.width}x{camera.height} cannot be reduced to 1/{factor}")
    small = replace(
        camera, width=width, height=height, fx=camera.fx / factor, fy=camera.fy / factor,
        cx=(camera.cx - centre) / factor, cy=(camera.cy - centre) / factor,
    )  # fmt: skip
    delay = shutter.line_delay(camera)
    slow = replace(shutter, readout_s=delay * factor * shutter.line_count(small))
    corners = centre + factor * np.array([[0.0, 0.0], [width - 1.0, height - 1.0]])
    return small, slow, float(delay * shutter.line_of_pixel(corners, camera).min())
