"""The cases of `rstrack sensitivity`: what a recording or its camera file may have wrong, one thing at a time.

for case in cases(dataset, seed=0):
    track(case.change(dataset), options, out)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.geometry.shutter import Shutter
from rstrack.bench.sensitivity.changes import (
    reduced,
    reordered,
    with_color,
    with_depth,
    with_shutter,
    with_stamps,
)
from rstrack.data.dataset import Dataset

# Blocks of missing depth are this part of an image's width.
_BLOCK = 0.05


@dataclass(frozen=True)
class Case:
    """One change. name: as the table has it."""

    name: str
    change: Callable[[Dataset], Dataset]


def cases(dataset: Dataset, seed: int = 0) -> tuple[Case, ...]:
    """All cases that a dataset can have, the untouched one first; a global shutter has no readout to tell wrongly."""
    rolling = max(dataset.rig.depth_shutter.readout_s, dataset.rig.color_shutter.readout_s) > 0.0
    readouts = [
        Case("readout told 3 ms too short", lambda d: readout_told(d, shift_s=-0.003)),
        Case("readout told 3 ms too long", lambda d: readout_told(d, shift_s=0.003)),
        Case("readout told 5 ms too long", lambda d: readout_told(d, shift_s=0.005)),
        Case("readout told x 0.7", lambda d: readout_told(d, factor=0.7)),
        Case("depth global at its stamp, as registered", depth_told_global),
    ]
    return (
        Case("untouched", lambda d: d),
        Case("colour stamps 2 ms late", lambda d: color_late(d, 0.002)),
        Case("colour stamps 5 ms late", lambda d: color_late(d, 0.005)),
        Case("colour stamps 10 ms late", lambda d: color_late(d, 0.010)),
        *(readouts if rolling else ()),
        Case("depth scale 1 % off", lambda d: with_depth(d, lambda _, z: z * np.float32(1.01))),
        Case("stamps jitter 2 ms RMS", lambda d: jittered(d, 0.002, seed)),
        Case("depth only to 2 m", lambda d: with_depth(d, lambda _, z: np.where(z > 2.0, np.float32(0), z))),
        Case("every second frame", lambda d: reordered(d, range(0, len(d), 2), d.stamps[::2])),
        Case("every third frame", lambda d: reordered(d, range(0, len(d), 3), d.stamps[::3])),
        Case("half the depth missing in blocks", lambda d: depth_in_blocks(d, seed)),
        *(Case(f"colours x {g:g} after a third", partial(darkened, factor=g)) for g in (0.92, 0.5, 2.0)),
        Case("a flash x 2 on every ninth image", flashed),
        Case("gain +-35 % in a second's sinus", lambda d: swinging_gain(d, 0.35)),
        Case("1/2 of the resolution", lambda d: reduced(d, 2)),
        Case("1/4 of the resolution", lambda d: reduced(d, 4)),
    )


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


def depth_told_global(dataset: Dataset) -> Dataset:
    """Depth taken to be of its stamp, as registered depth was without times of its rows."""
    shutter = dataset.rig.depth_shutter
    return replace(dataset, rig=replace(dataset.rig, depth_shutter=Shutter(0.0, shutter.exposure_s, shutter.scan)))


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
