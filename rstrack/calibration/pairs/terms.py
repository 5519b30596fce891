"""The kernels of a rig, compiled once, and what they take and give."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rsgen.device.arrays import Engine, Kernels
from rsgen.device.lens import Lens
from rsgen.geometry.camera import Camera
from rstrack.alignment.block_sums import BlockSums, Scaling, block_counts
from rstrack.alignment.weights import FLOOR_DEPTH, GATE_INTENSITY, GATE_SIGMAS
from rstrack.calibration.pairs.images import DepthSurface, pair_lens
from rstrack.calibration.pairs.kernels import ColorPairInput, DepthPairInput, color_pair_kernel, depth_pair_kernel
from rstrack.calibration.pairs.optics import Asked, Optics, camera_table, error_table, in_units, units
from rstrack.calibration.parameters import COLOR_LENS, COUNT, DEPTH, DEPTH_ERROR, DEPTH_LENS, LENS, Parameters, changed
from rstrack.data.dataset import Dataset
from rstrack.data.rig import NO_DEPTH_ERROR, DepthError
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import camera_rays

# Part of σ by which the averaging may have bent a pixel's surface.
_SMOOTH = 0.25
# Points of a depth image that are compared, about: what a calibration does not know is far more than their noise.
_POINTS = 4800
# Pixels that may fall into a block of lines, over its share.
_CROWDED = 4


@dataclass
class PairTerms:
    """The kernels of one rig. depth, color: lenses of `pair_lens`; asked: what of them is unknown."""

    e: Engine
    depth: Lens
    color: Lens
    asked: Asked
    _kernel: Kernels = field(init=False)
    _optics: tuple[tuple[Camera, Camera, DepthError], Optics] | None = None

    def __post_init__(self) -> None:
        self._kernel = Kernels(self.e)

    def optics(self, p: Parameters) -> Optics:
        """Rays, cameras and depth's error, on the device."""
        now = *self.cameras(p), p.error
        if self._optics is None or self._optics[0] != now:
            e, (depth, color, error) = self.e, now
            rays = camera_rays(Exposure(Lens(depth, self.depth.shutter), 0.0, np.eye(4)))
            tables = camera_table(depth), camera_table(color), error_table(error)
            found = Optics(*(e.upload(given) for given in (rays[..., 0], rays[..., 1], *tables)))
            self._optics = now, found
        return self._optics[1]

    def cameras(self, p: Parameters) -> tuple[Camera, Camera]:
        """Depth camera and colour camera."""
        depth = p.color_lens if self.asked.is_one_lens else p.depth_lens
        return changed(self.depth.camera, depth), changed(self.color.camera, p.color_lens)

    def by_depth(
        self,
        z: Any,
        surface: DepthSurface,
        to_base: FloatArray,
        ref_from_base: FloatArray,
        optics: Optics,
        sigma: float,
    ) -> Callable[[], BlockSums]:
        """A depth image's z against a surface; σ in m. The device works until what this returns is called."""
        asked, stride, bound = self.asked, self.stride, surface.bound
        scaling = self._scaling(surface.median_depth, bound, stride, self.depth)
        given = self.depth_input(z, surface, to_base, ref_from_base, optics, sigma, scaling)
        raw = self._kernel(depth_pair_kernel, self.depth, stride, asked)(given)
        current, reference, _, _ = block_counts(self.depth, self.depth)
        unit = units(asked.depth, surface.median_depth) * bound
        return lambda: in_units(scaling.unpack(raw.numpy(), current, reference, len(unit)), unit)

    def by_color(
        self, images: tuple[Any, Any], surface: DepthSurface, to_base: FloatArray, from_base: FloatArray,
        ref_from_base: FloatArray, optics: Optics, bound: float, brightness: FloatArray, sigma: float, level: int,
    ) -> Callable[[], BlockSums]:  # fmt: skip
        """A colour image against the reference's, both given as intensities of a level.

        bound: see `Scaling`, from the reference's gradients. brightness (2,): gain and offset; σ: of intensities.
        """
        asked, stride = self.asked, self.stride
        scaling = self._scaling(surface.median_depth, bound, stride, self.color)
        lines = to_base, from_base, ref_from_base
        given = self.color_input(images, surface, lines, optics, brightness, sigma, scaling)
        raw = self._kernel(color_pair_kernel, self.color, self.depth, stride, level, asked)(given)
        current, reference, _, _ = block_counts(self.color, self.color)
        unit = np.concatenate([units(asked.color, surface.median_depth) * bound, np.ones(2)])
        return lambda: in_units(scaling.unpack(raw.numpy(), current, reference, len(unit)), unit)

    def depth_input(
        self, z: Any, surface: DepthSurface, to_base: FloatArray, ref_from_base: FloatArray, optics: Optics,
        sigma: float, scaling: Scaling,
    ) -> DepthPairInput:  # fmt: skip
        """What the depth kernel takes; see `by_depth`."""
        gate = max(GATE_SIGMAS * sigma, 10.0 * FLOOR_DEPTH)
        unit = units(self.asked.depth, surface.median_depth)
        constants = np.concatenate([scaling.parameters(sigma, gate), [_SMOOTH * sigma, 0.0], unit])
        to, of = self.e.upload(to_base), self.e.upload(ref_from_base)
        ref = surface.inverse_depth, surface.slope_x, surface.slope_y, surface.roughness
        own = self.e.upload(constants), optics.depth_camera, optics.error
        return DepthPairInput(z, optics.rays_x, optics.rays_y, to, *ref, of, *own)

    def color_input(
        self, images: tuple[Any, Any], surface: DepthSurface, lines: tuple[FloatArray, FloatArray, FloatArray],
        optics: Optics, brightness: FloatArray, sigma: float, scaling: Scaling,
    ) -> ColorPairInput:  # fmt: skip
        """What the colour kernel takes; see `by_color`. lines: to_base, from_base, ref_from_base."""
        unit = units(self.asked.color, surface.median_depth)
        constants = np.concatenate([scaling.parameters(sigma, GATE_INTENSITY), brightness, unit])
        to, own, other = (self.e.upload(table) for table in lines)
        points = surface.shown_z, optics.rays_x, optics.rays_y, to, optics.error
        seen = images[0], own, images[1], other, optics.color_camera
        return ColorPairInput(*points, *seen, self.e.upload(constants))

    @property
    def stride(self) -> int:
        """Of the pixels of depth images that count."""
        return max(1, math.isqrt(self.depth.camera.width * self.depth.camera.height // _POINTS))

    def _scaling(self, median_depth: float, bound: float, stride: int, lens: Lens) -> Scaling:
        camera = self.depth.camera
        pixels = -(-camera.width // stride) * -(-camera.height // stride)
        blocks = block_counts(lens, lens)[0]
        return Scaling(median_depth, bound, min(pixels, -(-_CROWDED * pixels // blocks)))


def pair_terms(e: Engine, dataset: Dataset, free: BoolArray | None = None) -> PairTerms:
    """The kernels of a dataset's rig, with columns for those lens and depth unknowns (31,) that are free."""
    rig = dataset.rig
    depth, color = pair_lens(rig.depth_camera, rig.depth_shutter), pair_lens(rig.color_camera, rig.color_shutter)
    return PairTerms(e, depth, color, _asked(dataset, np.zeros(COUNT, bool) if free is None else free))


def _asked(dataset: Dataset, free: BoolArray) -> Asked:
    one = dataset.rig.is_registered
    color = tuple(name for name, asked in zip(LENS, free[COLOR_LENS], strict=True) if asked)
    depth = color if one else tuple(name for name, asked in zip(LENS, free[DEPTH_LENS], strict=True) if asked)
    depth += tuple(name for name, asked in zip(DEPTH, free[DEPTH_ERROR], strict=True) if asked)
    return Asked(depth, color, bool(free[DEPTH_ERROR].any()) or dataset.depth_error != NO_DEPTH_ERROR, one)
