"""Changes of a recording or its camera file by name, as the cases of benchmarks have them.

dataset = changed(dataset, "darkened", seed=0, arguments={"factor": 0.5})
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.bench.changes.edits import reduced, reordered, with_color, with_depth, with_shutter, with_stamps
from rstrack.data.camera_file import usual
from rstrack.data.dataset import Dataset

# Blocks of missing depth are this part of an image's width.
_BLOCK = 0.05


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
    """Readouts of both streams told wrongly: a shutter that is global stays so, none goes below zero."""

    def told(readout_s: float) -> float:
        return max(0.0, factor * readout_s + shift_s) if readout_s > 0.0 else 0.0

    return with_shutter(dataset, told, told)


def camera_told(
    dataset: Dataset, *, focal: float = 1.0, cx_px: float = 0.0, cy_px: float = 0.0, readout_ms: float = 0.0,
    rotation_deg: float = 0.0, undistorted: bool = False, color_ms: float = 0.0,
) -> Dataset:  # fmt: skip
    """What the camera file says of both cameras is wrong by that much, and may be, as far as its user knows.

    focal: factor of focal lengths. cx_px, cy_px: added to principal points. readout_ms: added to readouts, as
    `readout_told` does. rotation_deg: the colour camera is told turned about its own y axis. undistorted: no lens
    distortion is told. color_ms: added to colour stamps. Raises UserError: a registered recording, whose two cameras
    are one, told turned; colour told late where its offset is looked for, which would undo it; a focal length that is
    not positive.
    """

    def told(camera: Camera) -> Camera:
        moved = replace(camera, fx=focal * camera.fx, fy=focal * camera.fy, cx=camera.cx + cx_px, cy=camera.cy + cy_px)
        return replace(moved, model="pinhole", distortion=()) if undistorted else moved

    rig = dataset.rig
    if rotation_deg and rig.is_registered:
        raise UserError(f"{dataset.name}: depth is registered: no rotation between its cameras could be told wrongly")
    if color_ms and dataset.timing is not None and dataset.timing.wants_color_offset:
        raise UserError(f"{dataset.name}: colour's offset is looked for: name one in a camera file to tell it wrongly")
    T_told_color = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.radians(rotation_deg), 0.0]))
    cameras = replace(rig, depth_camera=told(rig.depth_camera), color_camera=told(rig.color_camera))
    T_color_depth = T_told_color @ rig.T_color_depth if rotation_deg else rig.T_color_depth
    # A rendering's lenses count as exact, whatever its depth camera has wrong.
    sigma = usual(cameras.color_camera) if rig.sigma.focal == 0.0 else rig.sigma
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
