"""The kernels of a rig, compiled once, and what they take and give."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.device.arrays import Engine, Kernels, aligned
from rsgen.device.lens import Lens
from rsgen.geometry.camera import Camera
from rstrack.alignment.block_sums import BlockSums, Scaling, block_counts, sizes
from rstrack.alignment.weights import FLOOR_DEPTH, GATE_INTENSITY, GATE_SIGMAS
from rstrack.calibration.pairs.images import LinePoses, WindowImages, pair_lens
from rstrack.calibration.pairs.kernels import ColorPairInput, DepthPairInput, color_pair_kernel, depth_pair_kernel
from rstrack.calibration.pairs.optics import Asked, Optics, camera_table, units
from rstrack.calibration.parameters import COLOR_LENS, DEPTH, DEPTH_ERROR, DEPTH_LENS, LENS, Parameters, changed
from rstrack.data.dataset import Dataset
from rstrack.data.rig import DepthError

# Part of σ by which the averaging may have bent a pixel's surface.
_SMOOTH = 0.25
# Points of a depth image that are compared, about: what a calibration does not know is far more than their noise.
_POINTS = 4800
# Pixels that may fall into a block of lines, over its share.
_CROWDED = 4


@dataclass(frozen=True)
class PairSums:
    """Sums of p pairs of images, of those u pairs of their blocks that have pixels.

    blocks: see `BlockSums`, the pairs of blocks as current ones. begin (p + 1,): where a pair of images begins among
    these. current, reference (u,): numbers of the blocks among those of all images. coupling (u, 6, n), own_H (p, n, n)
    and own_g (p, n): further columns', see `ColumnSums`, the latter two of each pair, or (1, ...) of all together.
    """

    blocks: BlockSums
    begin: IntArray
    current: IntArray
    reference: IntArray
    coupling: FloatArray
    own_H: FloatArray
    own_g: FloatArray


class PairTerms:
    """The kernels of a dataset's rig. depth, color: lenses of `pair_lens`; asked: what of them is unknown."""

    def __init__(self, e: Engine, dataset: Dataset, free: BoolArray) -> None:
        """With columns for those lens and depth unknowns (31,) that are free."""
        rig = dataset.rig
        self.depth = pair_lens(rig.depth_camera, rig.depth_shutter)
        self.color = pair_lens(rig.color_camera, rig.color_shutter)
        self.e, self.asked, self._kernel = e, _asked(dataset, free), Kernels(e)
        self._optics: tuple[tuple[Camera, Camera, DepthError], Optics] | None = None

    def optics(self, p: Parameters) -> Optics:
        """Rays of the pixels that are compared, cameras and depth's error, on the device."""
        now = *self.cameras(p), p.error
        if self._optics is None or self._optics[0] != now:
            e, (depth, color, _) = self.e, now
            rays = np.nan_to_num(depth.unproject(depth.pixel_grid()[:: self.stride, :: self.stride])[..., :2])
            tables = camera_table(depth), camera_table(color), p.depth_error
            found = Optics(*(e.upload(given) for given in (rays[..., 0], rays[..., 1], *tables)))
            self._optics = now, found
        return self._optics[1]

    def cameras(self, p: Parameters) -> tuple[Camera, Camera]:
        """Depth camera and colour camera."""
        depth = p.color_lens if self.asked.is_one_lens else p.depth_lens
        return changed(self.depth.camera, depth), changed(self.color.camera, p.color_lens)

    def by_depth(
        self, images: WindowImages, pairs: IntArray, lines: LinePoses, optics: Optics, sigma: float, lever: float
    ) -> Callable[[], PairSums]:
        """Depth images against surfaces, of pairs (n, 2): current view and reference.

        sigma: m; lever: m, see `Scaling`. The device works until what this returns is called.
        """
        scaling = self._scaling(lever, images.bounds[0], self.depth)
        unit = units(self.asked.depth, lever) * scaling.bound
        given = self.depth_input(images, pairs, lines, optics, sigma, scaling)
        what = depth_pair_kernel, self.depth, self.stride, self.asked
        return self._in_launches(given, what, pairs, scaling, self.depth, unit)

    def by_color(
        self, images: WindowImages, level: int, pairs: IntArray, lines: tuple[LinePoses, LinePoses], optics: Optics,
        brightness: FloatArray, sigma: float, lever: float,
    ) -> Callable[[], PairSums]:  # fmt: skip
        """Colour images of a level against the references', likewise.

        lines: of depth images and of colour images, the latter by view too. brightness (views, views, 2): gain and
        offset of each against each. sigma: of intensities.
        """
        scaling = self._scaling(lever, images.bounds[1], self.color)
        unit = np.concatenate([units(self.asked.color, lever) * scaling.bound, np.ones(2)])
        given = self.color_input(images, level, pairs, lines, optics, brightness, sigma, scaling)
        what = color_pair_kernel, self.color, self.depth, self.stride, level, self.asked
        return self._in_launches(given, what, pairs, scaling, self.color, unit)

    def depth_input(
        self, images: WindowImages, pairs: IntArray, lines: LinePoses, optics: Optics, sigma: float, scaling: Scaling
    ) -> DepthPairInput:
        """What the depth kernel takes; see `by_depth`."""
        gate = max(GATE_SIGMAS * sigma, 10.0 * FLOOR_DEPTH)
        unit = units(self.asked.depth, scaling.median_depth)
        constants = np.concatenate([scaling.parameters(sigma, gate), [_SMOOTH * sigma, 0.0], unit])
        given = self._of_pairs(images, pairs, (lines, lines), optics, np.zeros((len(pairs), 2)), constants)
        surfaces = images.inverse_depth, images.slope_x, images.slope_y, images.roughness
        return DepthPairInput(*(images.z, optics.depth_camera, *given, *surfaces))

    def color_input(
        self, images: WindowImages, level: int, pairs: IntArray, lines: tuple[LinePoses, LinePoses], optics: Optics,
        brightness: FloatArray, sigma: float, scaling: Scaling,
    ) -> ColorPairInput:  # fmt: skip
        """What the colour kernel takes; see `by_color`."""
        unit = units(self.asked.color, scaling.median_depth)
        constants = np.concatenate([scaling.parameters(sigma, GATE_INTENSITY), [0.0, 0.0], unit])
        given = self._of_pairs(images, pairs, lines, optics, brightness[pairs[:, 0], pairs[:, 1]], constants)
        return ColorPairInput(*(images.shown_z, optics.color_camera, *given, images.levels[level]))

    def _of_pairs(
        self, images: WindowImages, pairs: IntArray, lines: tuple[LinePoses, LinePoses], optics: Optics,
        brightness: FloatArray, constants: FloatArray,
    ) -> tuple[Any, ...]:  # fmt: skip
        """What `PairInput` has from rays_x on, all pairs in one launch; lines: of depth and of what is looked into."""
        e, own = self.e, np.column_stack([1.0 / images.median_depth[pairs[:, 1]], brightness])
        launch, of = (e.UInt(aligned(numbers, np.uint32)) for numbers in ([0, len(pairs) - 1], pairs))
        placed = optics.rays_x, optics.rays_y, e.upload(lines[0].to_base), e.upload(lines[1].from_base)
        return *placed, launch, of, e.upload(own), optics.error, e.upload(constants)

    def _in_launches(
        self, given: DepthPairInput | ColorPairInput, what: tuple[Any, ...], pairs: IntArray, scaling: Scaling,
        lens: Lens, unit: FloatArray,
    ) -> Callable[[], PairSums]:  # fmt: skip
        """The sums of all pairs, by launches of as many as Dr.Jit may keep sums of for each thread."""
        size = sizes(lens, lens, len(unit))[0]
        count = -(-len(pairs) * size // dr.expand_threshold())
        each = -(-len(pairs) // count)
        kernel = self._kernel(*what, each)
        launches = (aligned([k * each, len(pairs) - 1], np.uint32) for k in range(count))
        raw = [kernel(replace(given, launch=self.e.UInt(launch))) for launch in launches]

        def found() -> PairSums:
            whole = np.concatenate([one.numpy()[: each * size] for one in raw])[: len(pairs) * size]
            apart = what[0] is color_pair_kernel
            return _pair_sums(whole, scaling, pairs, block_counts(lens, lens)[0], unit, apart)

        return found

    @property
    def stride(self) -> int:
        """Of the pixels of depth images that count."""
        return max(1, math.isqrt(self.depth.camera.width * self.depth.camera.height // _POINTS))

    def _scaling(self, lever: float, bound: float, lens: Lens) -> Scaling:
        camera = self.depth.camera
        pixels = -(-camera.width // self.stride) * -(-camera.height // self.stride)
        blocks = block_counts(lens, lens)[0]
        return Scaling(lever, bound, min(pixels, -(-_CROWDED * pixels // blocks)))


def _asked(dataset: Dataset, free: BoolArray) -> Asked:
    one = dataset.rig.is_registered
    color = tuple(name for name, asked in zip(LENS, free[COLOR_LENS], strict=True) if asked)
    depth = color if one else tuple(name for name, asked in zip(LENS, free[DEPTH_LENS], strict=True) if asked)
    depth += tuple(name for name, asked in zip(DEPTH, free[DEPTH_ERROR], strict=True) if asked)
    has_error = any(getattr(dataset.depth_error, name) for name in DEPTH)
    return Asked(depth, color, bool(free[DEPTH_ERROR].any()) or has_error, one)


def _pair_sums(raw: IntArray, scaling: Scaling, pairs: IntArray, count: int, unit: FloatArray, apart: bool) -> PairSums:
    """Integers (p, ...) as summed on the device, of pairs (p, 2) of images, current and reference, with `count` blocks.

    unit (n,): what 1 of the further columns stands for. apart: some of these belong to one pair alone.
    """
    p, n = len(pairs), len(unit)
    rows = raw.reshape(p * count**2, -1)
    used = np.flatnonzero(rows.any(axis=1))
    pair, of = used // count**2, used % count**2
    blocks = scaling.unpack(rows[used], len(used), 1, n)
    coupling = np.zeros((len(used), 6, 0)) if blocks.columns is None else blocks.columns.coupling[:, 0] * unit
    totals = rows.reshape(p if apart else 1, -1, rows.shape[1]).sum(axis=1)
    own = [each for total in totals if (each := scaling.unpack(total, 1, 1, n).columns) is not None]
    own_H = np.array([each.H for each in own]).reshape(len(totals), n, n) * np.outer(unit, unit)
    own_g = np.array([each.g for each in own]).reshape(len(totals), n) * unit
    begin = np.searchsorted(pair, np.arange(p + 1))
    current, reference = pairs[pair, 0] * count + of // count, pairs[pair, 1] * count + of % count
    return PairSums(blocks, begin, current, reference, coupling, own_H, own_g)
