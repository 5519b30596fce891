"""Recordings with something changed, in their images, stamps or cameras, as the cases of benchmarks have it.

dataset = changed(dataset, "darkened", seed=0, arguments={"factor": 0.5})
dataset = reordered(dataset, shown=range(0, len(dataset), 2), stamps=dataset.stamps[::2])

All are pure functions of a dataset. Images are changed when they are read. What is random depends on a seed and on the
image's number alone.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.dataset import Dataset, ImageReader, group_colors
from rstrack.data.rig import Rig, sigma_of_file
from rstrack.metrics.association import true_poses, truth_of

ColorChange = Callable[[int, ByteArray], ByteArray]
DepthChange = Callable[[int, Float32Array], Float32Array]
# Blocks of missing depth are this part of an image's width.
_BLOCK = 0.05


@dataclass(frozen=True)
class _ChangedImages:
    """Images of another reader: its k-th is the source's shown_*[k]-th, after a change that is given k."""

    source: ImageReader
    shown_color: Sequence[int]
    shown_depth: Sequence[int]
    change_color: ColorChange = lambda _, pixels: pixels
    change_depth: DepthChange = lambda _, z: z

    def color(self, k: int) -> ByteArray:
        return self.change_color(k, self.source.color(self.shown_color[k]))

    def depth(self, k: int) -> Float32Array:
        return self.change_depth(k, self.source.depth(self.shown_depth[k]))


def with_color(dataset: Dataset, change: ColorChange) -> Dataset:
    """With every colour image k (h, w, 3) replaced by change(k, pixels)."""
    return replace(dataset, images=replace(_all_images(dataset), change_color=change))


def with_depth(dataset: Dataset, change: DepthChange) -> Dataset:
    """With every depth image k (h, w), metres, replaced by change(k, z)."""
    return replace(dataset, images=replace(_all_images(dataset), change_depth=change))


def with_stamps(dataset: Dataset, depth: FloatArray, color: FloatArray) -> Dataset:
    """The same images, stated to be of other times (n,) and (m,) in s, grouped by these.

    The truth stays that of the images: poses are compared by frame, so that what is measured is the track, not that the
    camera was elsewhere at the wrong time. Raises UserError if stamps do not increase.
    """
    if (np.diff(depth) <= 0).any() or (np.diff(color) <= 0).any():
        raise UserError(f"{dataset.name}: its stamps are closer than they would be moved: they must increase")
    moved = _with_truth(dataset, dataset.stamps, depth)
    return replace(moved, stamps=depth, color_stamps=color, groups=group_colors(depth, color))


def reordered(
    dataset: Dataset, shown: Sequence[int], stamps: FloatArray, colors: Sequence[int] | None = None
) -> Dataset:
    """Frames shown (n,) of a dataset, any number of times and in any order, under new stamps (n,) that increase, s.

    A frame's colour images go with it, as long before or after its depth image as they were; colors: frames (n,) whose
    ones are taken instead. The truth of a frame is that of its depth image, wherever that was taken.
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
    images = _ChangedImages(dataset.images, tuple(chosen), tuple(shown))
    moved = _with_truth(dataset, dataset.stamps[np.asarray(shown, int)], stamps)
    times = np.asarray(stamps, float)
    return replace(moved, stamps=times, color_stamps=np.array(color_stamps), groups=tuple(groups), images=images)


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


def _all_images(dataset: Dataset) -> _ChangedImages:
    return _ChangedImages(dataset.images, range(len(dataset.color_stamps)), range(len(dataset.stamps)))


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


def changed(dataset: Dataset, name: str, seed: int, arguments: Mapping[str, Any]) -> Dataset:
    """The dataset with one of `CHANGES`; those that are random take the seed. Raises UserError."""
    if name not in CHANGES:
        raise UserError(f"no change '{name}': choose {', '.join(CHANGES)}")
    change = CHANGES[name]
    drawn = {"seed": seed} if "seed" in inspect.signature(change).parameters else {}
    try:
        return change(dataset, **(drawn | dict(arguments)))
    except TypeError as error:
        raise UserError(f"change {name}: {error}") from None


def color_late(dataset: Dataset, seconds: float) -> Dataset:
    """Colour stamps that are `seconds` too late."""
    return with_stamps(dataset, dataset.stamps, dataset.color_stamps + seconds)


def jittered(dataset: Dataset, rms_s: float, seed: int) -> Dataset:
    """Stamps of both streams with independent Gaussian errors; none passes another: at most 0.4 of the least step."""

    def noise(stamps: FloatArray, stream: int) -> FloatArray:
        most = 0.4 * float(np.diff(stamps).min(initial=np.inf)) if len(stamps) > 1 else np.inf
        errors = np.random.default_rng([seed, stream]).normal(0.0, rms_s, len(stamps))
        return np.asarray(stamps + np.clip(errors, -most, most))

    return with_stamps(dataset, noise(dataset.stamps, 0), noise(dataset.color_stamps, 1))


def readout_told(dataset: Dataset, shift_s: float = 0.0, factor: float = 1.0) -> Dataset:
    """Readouts of both streams stated wrongly: a shutter that is global stays so, none goes below zero."""

    def stated(shutter: Shutter) -> Shutter:
        readout_s = shutter.readout_s
        return replace(shutter, readout_s=max(0.0, factor * readout_s + shift_s) if readout_s > 0.0 else 0.0)

    rig = dataset.rig
    depth, color = stated(rig.depth_shutter), stated(rig.color_shutter)
    return replace(dataset, rig=replace(rig, depth_shutter=depth, color_shutter=color))


def camera_told(
    dataset: Dataset, *, focal: float = 1.0, cx_px: float = 0.0, cy_px: float = 0.0, readout_ms: float = 0.0,
    rotation_deg: float = 0.0, undistorted: bool = False, color_ms: float = 0.0,
) -> Dataset:  # fmt: skip
    """What the camera file states of both cameras is wrong by that much, and may be, as far as its user knows.

    focal: factor of focal lengths. cx_px, cy_px: added to principal points. readout_ms: as of `readout_told`.
    rotation_deg: of the colour camera about its own y axis. undistorted: without lens distortion. color_ms: added to
    colour stamps. Raises UserError: a registered recording, whose two cameras are one, is turned; colour's offset is
    looked for, which would undo a later one; a focal length that is not positive.
    """

    def stated(camera: Camera) -> Camera:
        moved = replace(camera, fx=focal * camera.fx, fy=focal * camera.fy, cx=camera.cx + cx_px, cy=camera.cy + cy_px)
        return replace(moved, model="pinhole", distortion=()) if undistorted else moved

    rig = dataset.rig
    if rotation_deg and rig.is_registered:
        raise UserError(f"{dataset.name}: depth is registered: no rotation between its cameras could be stated wrongly")
    if color_ms and dataset.timing is not None and dataset.timing.wants_color_offset:
        raise UserError(f"{dataset.name}: colour's offset is looked for: name one in a camera file to tell it wrongly")
    T_stated_color = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.radians(rotation_deg), 0.0]))
    cameras = replace(rig, depth_camera=stated(rig.depth_camera), color_camera=stated(rig.color_camera))
    T_color_depth = T_stated_color @ rig.T_color_depth if rotation_deg else rig.T_color_depth
    # A rendering's lenses count as exact, whatever its depth camera has wrong.
    sigma = sigma_of_file(cameras.color_camera) if rig.sigma.focal == 0.0 else rig.sigma
    cameras = replace(cameras, T_color_depth=T_color_depth, sigma=sigma)
    made = readout_told(replace(dataset, rig=cameras), shift_s=1e-3 * readout_ms)
    return color_late(made, 1e-3 * color_ms) if color_ms else made


def depth_told_global(dataset: Dataset) -> Dataset:
    """Depth taken to be of its stamp, as registered depth was without times of its rows."""
    shutter = dataset.rig.depth_shutter
    return replace(dataset, rig=replace(dataset.rig, depth_shutter=Shutter(0.0, shutter.exposure_s, shutter.scan)))


def color_told_sharp(dataset: Dataset) -> Dataset:
    """Colour taken to have no exposure: lines' poses are then those at its end."""
    shutter = dataset.rig.color_shutter
    return replace(dataset, rig=replace(dataset.rig, color_shutter=Shutter(shutter.readout_s, 0.0, shutter.scan)))


def depth_in_blocks(dataset: Dataset, seed: int) -> Dataset:
    """Every block of depth missing with a chance of one half, others in every frame."""

    def holed(k: int, z: Float32Array) -> Float32Array:
        size = max(1, round(_BLOCK * z.shape[1]))
        shape = -(-z.shape[0] // size), -(-z.shape[1] // size)
        kept = np.random.default_rng([seed, k, 2]).random(shape) < 0.5
        return np.where(kept.repeat(size, 0).repeat(size, 1)[: z.shape[0], : z.shape[1]], z, np.float32(0))

    return with_depth(dataset, holed)


def darkened(dataset: Dataset, factor: float = 0.92, after: float = 1 / 3) -> Dataset:
    """Colours times a factor after a part of the colour images."""
    first = round(after * len(dataset.color_stamps))
    return with_color(dataset, lambda k, pixels: gained(pixels, factor) if k >= first else pixels)


def flashed(dataset: Dataset, gain: float = 2.0, every: int = 9) -> Dataset:
    """Colours times a gain in the last image of every `every`."""
    return with_color(dataset, lambda k, pixels: gained(pixels, gain) if k % every == every - 1 else pixels)


def swinging_gain(dataset: Dataset, swing: float, period_s: float = 1.0) -> Dataset:
    """Colours times 1 + swing · sin(2π t / period), t from the first image's stamp."""
    stamps = dataset.color_stamps

    def change(k: int, pixels: ByteArray) -> ByteArray:
        return gained(pixels, 1.0 + swing * float(np.sin(2.0 * np.pi * (stamps[k] - stamps[0]) / period_s)))

    return with_color(dataset, change)


def gained(pixels: ByteArray, gain: float) -> ByteArray:
    """Grey values times a gain, rounded and saturated."""
    return np.clip(np.rint(pixels * np.float32(gain)), 0, 255).astype(np.uint8)


def depth_scaled(dataset: Dataset, factor: float) -> Dataset:
    """Depth times a factor."""
    return with_depth(dataset, lambda _, z: z * np.float32(factor))


def depth_to(dataset: Dataset, metres: float) -> Dataset:
    """No depth beyond so many metres."""
    return with_depth(dataset, lambda _, z: np.where(z > metres, np.float32(0), z))


def every(dataset: Dataset, nth: int) -> Dataset:
    """Every nth frame."""
    return reordered(dataset, range(0, len(dataset), nth), dataset.stamps[::nth])


CHANGES: dict[str, Callable[..., Dataset]] = {
    change.__name__: change
    for change in (
        color_late, jittered, readout_told, camera_told, depth_told_global, depth_in_blocks, darkened, flashed,
        swinging_gain, depth_scaled, depth_to, every, reduced, color_told_sharp,
    )
}  # fmt: skip
"""What can be done, by name; each is a pure function of a dataset and its arguments."""
