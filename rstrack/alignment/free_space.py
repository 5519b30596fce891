"""What one of two depth images sees where the other one saw through: free space that something has come into.

Each pixel of one image is moved to the other by the poses of its own line. Where it lies in front of all that is seen
about there, it stands in what was free: seen from a frame into its keyframe something has come, the other way round
something has gone. A static scene does not do that, whatever hides what; noise, edges and wrong poses do, by little.
Beside that: how far the point is from the surface there, and how far the keyframe's intensity from the colour image's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine, Kernels, recorded_with
from rsgen.device.lens import Lens
from rsgen.device.projection import TO_BASE, gather, move, project_rolling
from rsgen.geometry.spline import Spline
from rstrack.alignment.brightness import MID_GREY
from rstrack.images.device_frame import DeviceRig
from rstrack.images.line_poses import from_base, to_base
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.images.sampling import (
    PyramidLevel,
    Raster,
    bilinear_value,
    depth_of,
    grid,
    moved_to_base,
    nearest,
    pinhole_ray,
    row_of_pixel,
    surface,
)
from rstrack.keyframes.keyframe import Reference, pyramid_level, strides

# What a kernel writes where nothing is known: no metres, and no intensity, are as large.
_UNKNOWN = 1e6
# Pixels of the largest grid that is compared: what moves need not be known to the pixel.
_GRID_PX = 160 * 120

Grid = npt.NDArray[np.float32]


@dataclass(frozen=True)
class SpaceInput:
    """Device arrays of the kernels: 1/z of the image whose pixels are moved, its rays and the poses of its lines; 1/z
    of the other image and the poses of its lines."""

    inverse_depth: Any
    rays_x: Any
    rays_y: Any
    to_base: Any
    other: Any
    from_base: Any


@dataclass(frozen=True)
class MeetingInput(SpaceInput):
    """The same, and a value of each pixel of the other's grid, to be handed over."""

    values: Any


def _moved(
    e: Engine, lens: Lens, other: Lens, raster: Raster, has_rays: bool, given: SpaceInput
) -> tuple[Any, Any, Any]:  # fmt: skip
    """1/z of the pixels of `lens`, where they are seen in `other`, and whether they are within that image."""
    camera, there = lens.camera, other.camera
    index, px, py = grid(e, raster)
    rho = dr.gather(e.Float, given.inverse_depth, index)
    z, known = depth_of(rho)
    if has_rays:
        ray = dr.gather(e.Float, given.rays_x, index), dr.gather(e.Float, given.rays_y, index)
    else:
        ray = pinhole_ray(e, camera, px, py)
    line = row_of_pixel(e, lens, px, py)
    p = move(gather(given.to_base, line, TO_BASE, stride=TO_BASE), (ray[0] * z, ray[1] * z, z))
    seen = project_rolling(other, given.from_base, p, e.UInt, e.Int)
    inside = known & seen.valid
    inside &= (seen.x >= 0.0) & (seen.y >= 0.0) & (seen.x < there.width - 1.0) & (seen.y < there.height - 1.0)
    return rho, seen, inside


def free_space_kernel(e: Engine, lens: Lens, other: Lens, stride: int, has_rays: bool) -> Callable[[SpaceInput], Any]:
    """Kernel → (1/z, free) at every stride-th pixel of `lens`, see `Free`: 0 and `_UNKNOWN` where that is not known.

    has_rays: whether the image's rays are given; a rectified one's are those of its pinhole.
    """

    @recorded_with(e, SpaceInput, lens, other, Raster.of(lens.camera, stride))
    def kernel(given: SpaceInput, lens: Lens, other: Lens, raster: Raster) -> Any:
        there, reach = other.camera, e.Float(raster.stride)
        rho, seen, inside = _moved(e, lens, other, raster, has_rays, given)
        # The nearest of what is seen about there: an edge may lie a pixel or two elsewhere.
        nearest_rho = e.Float(0.0)
        for dy in (-reach, 0, reach):
            for dx in (-reach, 0, reach):
                x = dr.clip(seen.x + dx, 0.0, there.width - 1.0)
                y = dr.clip(seen.y + dy, 0.0, there.height - 1.0)
                at = nearest(e, there.width, x, y, inside)
                nearest_rho = dr.maximum(nearest_rho, dr.gather(e.Float, given.other, at, inside))
        shown = inside & (nearest_rho > 0.0)
        return rho, dr.select(shown, dr.rcp(dr.select(shown, nearest_rho, 1.0)) - seen.z, _UNKNOWN)

    return kernel


def meeting_kernel(e: Engine, lens: Lens, other: Lens, stride: int, has_rays: bool) -> Callable[[MeetingInput], Any]:
    """Kernel → (apart, value) at the same pixels, see `SeenFrom`.

    `_UNKNOWN` where that is not known; a value of twice that outside the other image.
    """

    @recorded_with(e, MeetingInput, lens, other, Raster.of(lens.camera, stride), Raster.of(other.camera, stride))
    def kernel(given: MeetingInput, lens: Lens, other: Lens, raster: Raster, there: Raster) -> Any:
        _, seen, inside = _moved(e, lens, other, raster, has_rays, given)
        value, met = surface(e, other.camera, given.other, seen.x, seen.y, inside)
        apart = dr.select(met, dr.rcp(dr.select(met, value, 1.0)) - seen.z, _UNKNOWN)
        share = dr.rcp(e.Float(there.stride))
        column, row = (e.UInt(e.Int(dr.select(inside, (v + 0.5) * share, 0.0))) for v in (seen.x, seen.y))
        value = dr.gather(e.Float, given.values, row * there.columns + column, inside)
        handed = dr.select(inside, value, 2.0 * _UNKNOWN)
        return apart, handed

    return kernel


@dataclass(frozen=True)
class IntensityInput:
    """Device arrays: points of the keyframe and their intensities as in `PhotometricInput`, the poses of its lines, the
    colour image at the level, the poses of its lines; brightness: gain and offset."""

    x: Any
    y: Any
    z: Any
    intensity: Any
    to_base: Any
    image: Any
    from_base: Any
    brightness: Any


def intensity_kernel(e: Engine, lens: Lens, ref_lens: Lens, stride: int, level: int) -> Callable[[IntensityInput], Any]:
    """Kernel → the colour image's intensity less the one expected, of each of the keyframe's points."""
    of_lenses = lens, ref_lens, Raster.of(ref_lens.camera, stride), PyramidLevel.of(lens.camera, level)

    @recorded_with(e, IntensityInput, *of_lenses)
    def kernel(given: IntensityInput, lens: Lens, ref_lens: Lens, raster: Raster, image: PyramidLevel) -> Any:
        _, x, y = grid(e, raster)
        p = moved_to_base(e, ref_lens, given.to_base, x, y, (given.x, given.y, given.z))
        seen = project_rolling(lens, given.from_base, p, e.UInt, e.Int)
        active = (given.z > 0.0) & seen.valid
        u, v = seen.x * image.shrink, seen.y * image.shrink
        value, active = bilinear_value(e, given.image, image.width, image.height, u, v, active)
        gain, offset = (dr.gather(e.Float, given.brightness, e.UInt(i)) for i in (0, 1))
        expected = given.intensity + dr.fma(gain, given.intensity - MID_GREY, offset)
        return dr.select(active & dr.isfinite(value), value - expected, _UNKNOWN)

    return kernel


@dataclass(frozen=True)
class Free:
    """Whether pixels of an image's grid (gh, gw) stand in what the other image saw through; NaN: unknown.

    z (m): the image's own depth; free (m): how far it stands in front of all that the other shows about there.
    """

    z: Grid
    free: Grid


@dataclass(frozen=True)
class SeenFrom(Free):
    """The same, and what else those pixels are, seen from the other image.

    apart (m): how far in front of the surface there; intensity: the colour image's, less that expected; outside:
    whether it is not within the other image.
    """

    apart: Grid
    intensity: Grid
    outside: npt.NDArray[np.bool_]


@dataclass
class FreeSpace:
    """Kernels of one rig. Poses of lines are those of T_world_depth(t)."""

    device: DeviceRig
    _kernel: Kernels = field(init=False)

    def __post_init__(self) -> None:
        self._kernel = Kernels(self.device.e)

    def before(self, one: Reference | DepthImage, other: Reference | DepthImage, spline: Spline) -> Free:
        """The pixels of one image before the other one."""
        with self.device.timer("what moves: compare"):
            return self._free(one, other, self._given(one, other, spline))

    def seen_from(
        self, one: Reference | DepthImage, other: Reference | DepthImage, values: Any, spline: Spline
    ) -> SeenFrom:
        """One image seen from the other. values: on the device, as `intensity` gives them at the keyframe's grid: of
        `one` if that is a keyframe, else of `other`."""
        e, lens = self.device.e, _lens(one)
        with self.device.timer("what moves: compare"):
            given = self._given(one, other, spline)
            near = self._free(one, other, given)
            has_rays = isinstance(one, DepthImage) or one.rolling is not None
            kernel = self._kernel(meeting_kernel, lens, _lens(other), grid_of(lens)[1], has_rays)
            apart, handed = kernel(MeetingInput(**vars(given), values=values))
            off, value = (e.download(each, grid_shape(lens)) for each in (apart, handed))
            own = value if isinstance(one, DepthImage) else e.download(values, grid_shape(lens))
            return SeenFrom(near.z, near.free, _known(off), _known(own), value > 1.5 * _UNKNOWN)

    def intensity(self, ref: Reference, color: ColorImage | None, brightness: FloatArray, spline: Spline) -> Any:
        """A colour image's intensities less those expected at the keyframe's grid, on the device; without one unknown.

        brightness (2,): its gain and offset against the keyframe's.
        """
        e, (level, stride) = self.device.e, grid_of(ref.lens)
        with self.device.timer("what moves: compare"):
            if color is None or not ref.points:
                return e.upload(np.full(grid_shape(ref.lens), _UNKNOWN))
            points, own_level = ref.points[level], color.level(pyramid_level(level))
            kernel = self._kernel(intensity_kernel, color.exposure.lens, ref.lens, stride, own_level)
            seen_at = to_base(e, spline, ref.T_world_base, ref.rolling)
            seen_from = from_base(e, spline, ref.T_world_base, color.exposure)
            given = points.x, points.y, points.z, points.intensity, seen_at, color.levels[own_level], seen_from
            return kernel(IntensityInput(*given, e.upload(brightness)))

    def _given(self, one: Reference | DepthImage, other: Reference | DepthImage, spline: Spline) -> SpaceInput:
        e = self.device.e
        ref = one if isinstance(one, Reference) else other
        T = ref.T_world_base if isinstance(ref, Reference) else spline.pose(ref.exposure.mid_time)
        (rho, moved), (there, seen) = (
            (image.inverse_depth, image.rolling) if isinstance(image, Reference) else (image.inverse_z, image.exposure)
            for image in (one, other)
        )
        poses = to_base(e, spline, T, moved), from_base(e, spline, T, seen)
        return SpaceInput(rho, *self.device.device_rays, poses[0], there, poses[1])

    def _free(self, one: Reference | DepthImage, other: Reference | DepthImage, given: SpaceInput) -> Free:
        lens, has_rays = _lens(one), isinstance(one, DepthImage) or one.rolling is not None
        kernel = self._kernel(free_space_kernel, lens, _lens(other), grid_of(lens)[1], has_rays)
        rho, free = (self.device.e.download(values, grid_shape(lens)) for values in kernel(given))
        z = np.divide(np.float32(1.0), rho, out=np.full_like(rho, np.nan), where=rho > 0)
        return Free(z, _known(free))


def _lens(image: Reference | DepthImage) -> Lens:
    return image.lens if isinstance(image, Reference) else image.exposure.lens


def grid_of(lens: Lens) -> tuple[int, int]:
    """Level of the keyframe's points whose grid is fine enough to find what moves, and its stride in pixels."""
    camera = lens.camera
    every = strides(camera.width, camera.height)[:-1]
    for level, stride in enumerate(every):
        if -(-camera.width // stride) * -(-camera.height // stride) <= _GRID_PX:
            return level, stride
    return len(every) - 1, every[-1]


def grid_shape(lens: Lens) -> tuple[int, int]:
    """Rows and columns of that grid."""
    _, stride = grid_of(lens)
    return -(-lens.camera.height // stride), -(-lens.camera.width // stride)


def _known(values: Grid) -> Grid:
    return np.where(values < 0.5 * _UNKNOWN, values, np.float32(np.nan))
