"""Two frames against each other, both with their own rolling shutters: depth by depth, colour by colour.

Depth: the geometric term of `alignment.residuals` against a reference that keeps its rows' times. Colour: points of the
reference's depth looked up in both colour images, each by its own lines. How the point itself was placed hardly matters
then, since both images see it move alike, and the derivative is taken half from each image (as in efficient
second-order minimisation, Benhimane and Malis, IROS 2004): the noise of one image's gradient alone would pass for
information about the extrinsics. What lenses and depth do, where they are unknown, is told by how the same unknown
moves a point in either camera (`optics.moves`); depth's own error by depth alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import drjit as dr
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine, Kernels
from rsgen.device.lens import Lens
from rsgen.device.projection import TO_BASE, gather, move, project, project_rolling
from rsgen.device.recording import recorded_from
from rsgen.geometry.camera import Camera
from rstrack.alignment.block_sums import BlockSums, Scaling, accumulate, block_counts, block_slot
from rstrack.alignment.brightness import MID_GREY
from rstrack.alignment.residuals import GeometricInput, evened, plane_distance
from rstrack.calibration.optics import (
    Asked,
    Optics,
    camera_table,
    error_table,
    in_units,
    moves,
    traced,
    turned_round,
    units,
    unknown_columns,
    without_error,
)
from rstrack.calibration.parameters import Parameters, changed
from rstrack.data.depth_error import DepthError
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import camera_rays
from rstrack.images.sampling import EDGE, grid, level_size, surface, value_and_slope
from rstrack.keyframes.keyframe import depth_scaling, strides, surface_bends, surface_slopes

# Part of the width over which inverse depth is averaged, to either side.
_WINDOW = 1.0 / 160.0
# Gates: residuals beyond are outliers for certain, in σ (depth) and intensity; and smallest credible σ (m, intensity).
GATE_SIGMAS, GATE_INTENSITY = 5.0, 0.3
FLOOR_DEPTH, FLOOR_INTENSITY = 2e-4, 1.0 / 255.0
# Part of σ by which the averaging may have bent a pixel's surface.
_SMOOTH = 0.25
# Inverse depth larger by this part may hide a point from the colour camera.
_HIDES = 0.2

# Pixels that may fall into a block of lines, over its share.
_CROWDED = 4

Float32Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Surface:
    """A depth image that others are compared with, on the device: inverse depth (1/m, 0 missing) averaged over a
    window, its slopes by normalised coordinates, how far averaging may have moved it (m), and z (m) of what the colour
    camera can see of it, else 0. median_depth, bound: see `Scaling`.
    """

    inverse_depth: Any
    slope_x: Any
    slope_y: Any
    roughness: Any
    shown_z: Any
    median_depth: float
    bound: float


def surface_of(e: Engine, rho: Float32Image, fx: float, fy: float, baseline_m: float = 0.0) -> Surface:
    """Of `averaged` inverse depth (h, w).

    baseline_m: at most so far is the colour camera away, from where nearer things hide some of what is seen.
    """
    width = rho.shape[1]
    slope_x, slope_y = surface_slopes(rho, fx, fy)
    z = np.divide(np.float32(1.0), rho, out=np.zeros_like(rho), where=rho > 0)
    bend_x, bend_y = surface_bends(slope_x, slope_y, fx, fy)
    # A parabola's mean over the window is off by that.
    roughness = (_window(width) ** 2 - 1) / 24.0 * z * z * (bend_x + bend_y)
    reach = max(1, math.ceil(baseline_m * fx * float(np.percentile(rho[rho > 0], 90.0)))) if (rho > 0).any() else 1
    nearest = np.asarray(cv2.dilate(rho, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)))
    shown = np.where((z > 0) & (nearest < np.float32(1.0 + _HIDES) * rho), z, np.float32(0.0))
    on_device = e.upload(rho), e.upload(slope_x), e.upload(slope_y), e.upload(roughness), e.upload(shown)
    return Surface(*on_device, *depth_scaling(rho))


def averaged(rho: Float32Image) -> Float32Image:
    """Inverse depth (h, w) averaged over windows on one surface, 0 elsewhere: exact on planes, where it is affine.

    Noise of single pixels bends surfaces, and steps of the camera's resolution move with it, not with the scene: raw
    depth gives readouts of a Kinect's images four times as badly.
    """
    window = _window(rho.shape[1])
    size = np.ones((window, window), np.uint8)
    most, least = np.asarray(cv2.dilate(rho, size)), np.asarray(cv2.erode(rho, size))
    mean = np.asarray(cv2.boxFilter(rho, cv2.CV_32F, (window, window)))
    inside = np.zeros(rho.shape, bool)
    half = window // 2
    inside[half : rho.shape[0] - half, half : rho.shape[1] - half] = True
    is_smooth = inside & (least > 0) & (most - least < np.float32(EDGE * max(1.0, window / 4.0)) * most)
    return np.where(is_smooth, mean, np.float32(0.0))


def _window(width: int) -> int:
    return 2 * max(1, round(width * _WINDOW)) + 1


@dataclass(frozen=True)
class DepthPairInput(GeometricInput):
    """Device arrays of the depth kernel: see `GeometricInput`; camera: `camera_table`; error: `error_table`."""

    camera: Any
    error: Any


@dataclass(frozen=True)
class ColorPairInput:
    """Device arrays of the colour kernel.

    depth: z of the reference's depth image (m, 0: none); rays_*: its normalised coordinates; to_base: poses of its
    lines; error: `error_table`. image, from_base: current intensities, NaN where they tell nothing, and the colour
    camera's lines; ref_*: the reference's; camera: `camera_table`. constants: those of `Scaling`, gain and offset of
    the current image against the reference's, units of the unknown lens.
    """

    depth: Any
    rays_x: Any
    rays_y: Any
    to_base: Any
    error: Any
    image: Any
    from_base: Any
    ref_image: Any
    ref_from_base: Any
    camera: Any
    constants: Any


def depth_pair_kernel(e: Engine, depth: Lens, stride: int, asked: Asked) -> Callable[[DepthPairInput], Any]:
    """Kernel of the depth term: sums over pairs of blocks (current, reference) of depth lines."""
    names = asked.depth

    @recorded_from(DepthPairInput)
    def kernel(given: DepthPairInput) -> Any:
        parameters = [dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(7)]
        lens = traced(e, depth, given.camera)
        pixel, px, py = grid(e, lens.camera.width, lens.camera.height, stride)
        z, xn, yn = (dr.gather(e.Float, image, pixel) for image in (given.depth, given.rays_x, given.rays_y))
        active = z > 0.0
        z = without_error(e, asked, z, xn, yn, given.error)
        q = xn * z, yn * z, z
        line = e.UInt(depth.line_of(e.Int(px), e.Int(py)))
        T_base_cam = gather(given.to_base, line, TO_BASE, stride=TO_BASE)
        p = move(T_base_cam, q)
        seen = project_rolling(lens, given.from_base, p, e.UInt, e.Int)
        rho, active = surface(e, lens.camera, given.inverse_depth, seen.x, seen.y, active & seen.valid)
        if asked.corrects:
            rho = dr.rcp(without_error(e, asked, dr.rcp(rho), seen.at.xn, seen.at.yn, given.error))
        even = evened(z, parameters[2])
        r, g, is_smooth = plane_distance(e, given, lens.camera, seen, rho, active, even)
        columns = []
        if names:
            here, there = (moves(names, lens.camera, at) for at in (project(lens.camera, q), seen.at))
            columns = unknown_columns(e, g, zip(there, here, strict=True), seen.M, T_base_cam, given.constants)
        slot, size = block_slot(line, seen.row, depth, depth, py, len(names))
        return accumulate(e, g, p, 1.0, r, active, parameters, slot, size, columns, is_smooth)

    return kernel


def color_pair_kernel(
    e: Engine, color: Lens, depth: Lens, stride: int, level: int, asked: Asked
) -> Callable[[ColorPairInput], Any]:
    """Kernel of the colour term: sums over pairs of blocks (current, reference) of *colour* lines.

    Its further columns: what is asked of the colour camera's lens, then gain and offset of the current image.
    """
    width, height = level_size(color.camera.width, level), level_size(color.camera.height, level)
    shrink, names = 0.5**level, asked.color

    def looked_up(image: Any, seen: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        x, y = seen.x * shrink, seen.y * shrink
        value, dx, dy, active = value_and_slope(e, image, width, height, x, y, active & seen.valid)
        return value, dx * shrink, dy * shrink, active

    @recorded_from(ColorPairInput)
    def kernel(given: ColorPairInput) -> Any:
        parameters = [dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(7)]
        lens = traced(e, color, given.camera)
        pixel, x, y = grid(e, depth.camera.width, depth.camera.height, stride)
        z, xn, yn = (dr.gather(e.Float, image, pixel) for image in (given.depth, given.rays_x, given.rays_y))
        active = z > 0.0
        z = without_error(e, asked, z, xn, yn, given.error)
        line = e.UInt(depth.line_of(e.Int(x), e.Int(y)))
        p = move(gather(given.to_base, line, TO_BASE, stride=TO_BASE), (xn * z, yn * z, z))
        here = project_rolling(lens, given.from_base, p, e.UInt, e.Int)
        there = project_rolling(lens, given.ref_from_base, p, e.UInt, e.Int)
        value, dx, dy, active = looked_up(given.image, here, active)
        ref, ref_dx, ref_dy, active = looked_up(given.ref_image, there, active)
        gain, offset = (dr.gather(e.Float, given.constants, e.UInt(i)) for i in (7, 8))
        contrast = ref - MID_GREY
        r = value - (ref + dr.fma(gain, contrast, offset))
        own, other = here.chain(dx, dy, 0.0), there.chain(ref_dx, ref_dy, 0.0)
        g = tuple(0.5 * dr.fma(1.0 + gain, b, a) for a, b in zip(own, other, strict=True))
        columns = []
        if names:
            pairs = zip(*(moves(names, lens.camera, seen.at) for seen in (here, there)), strict=True)
            columns = unknown_columns(e, g, pairs, here.M, turned_round(there.M), given.constants)
        columns += [-contrast, e.Float(-1.0)]
        slot, size = block_slot(here.row, there.row, color, color, here.y, len(columns))
        # A twist of the camera moves the point the other way.
        return accumulate(e, g, p, -1.0, r, active, parameters, slot, size, columns)

    return kernel


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
        self, z: Any, surface: Surface, to_base: FloatArray, ref_from_base: FloatArray, optics: Optics, sigma: float,
        level: int,
    ) -> Callable[[], BlockSums]:  # fmt: skip
        """A depth image's z against a surface; σ in m. The device works until what this returns is called."""
        e, camera, asked = self.e, self.depth.camera, self.asked
        stride = strides(camera.width, camera.height)[level]
        scaling = self._scaling(surface.median_depth, surface.bound, stride, self.depth)
        gate = max(GATE_SIGMAS * sigma, 10.0 * FLOOR_DEPTH)
        unit = units(asked.depth, surface.median_depth)
        constants = e.upload(np.concatenate([scaling.parameters(sigma, gate), [_SMOOTH * sigma, 0.0], unit]))
        kernel = self._kernel(depth_pair_kernel, self.depth, stride, asked)
        ref = surface.inverse_depth, surface.slope_x, surface.slope_y, surface.roughness
        tables = e.upload(to_base), e.upload(ref_from_base)
        rays, own = (optics.rays_x, optics.rays_y), (optics.depth_camera, optics.error)
        raw = kernel(DepthPairInput(z, *rays, tables[0], *ref, tables[1], constants, *own))
        current, reference, _, _ = block_counts(self.depth, self.depth)
        unit = unit * surface.bound
        return lambda: in_units(scaling.unpack(raw.numpy(), current, reference, len(unit)), unit)

    def by_color(
        self, images: tuple[Any, Any], surface: Surface, to_base: FloatArray, from_base: FloatArray,
        ref_from_base: FloatArray, optics: Optics, bound: float, brightness: FloatArray, sigma: float, level: int,
    ) -> Callable[[], BlockSums]:  # fmt: skip
        """A colour image against the reference's, both given as intensities of a level.

        bound: see `Scaling`, from the reference's gradients. brightness (2,): gain and offset; σ: of intensities.
        """
        e, camera, asked = self.e, self.depth.camera, self.asked
        stride = strides(camera.width, camera.height)[level]
        scaling = self._scaling(surface.median_depth, bound, stride, self.color)
        unit = units(asked.color, surface.median_depth)
        constants = e.upload(np.concatenate([scaling.parameters(sigma, GATE_INTENSITY), brightness, unit]))
        kernel = self._kernel(color_pair_kernel, self.color, self.depth, stride, level, asked)
        tables = e.upload(to_base), e.upload(from_base), e.upload(ref_from_base)
        points = surface.shown_z, optics.rays_x, optics.rays_y, tables[0], optics.error
        seen = images[0], tables[1], images[1], tables[2], optics.color_camera
        raw = kernel(ColorPairInput(*points, *seen, constants))
        current, reference, _, _ = block_counts(self.color, self.color)
        unit = np.concatenate([unit * bound, np.ones(2)])
        return lambda: in_units(scaling.unpack(raw.numpy(), current, reference, len(unit)), unit)

    def _scaling(self, median_depth: float, bound: float, stride: int, lens: Lens) -> Scaling:
        camera = self.depth.camera
        pixels = -(-camera.width // stride) * -(-camera.height // stride)
        blocks = block_counts(lens, lens)[0]
        return Scaling(median_depth, bound, min(pixels, -(-_CROWDED * pixels // blocks)))


def intensity_bound(image: Float32Image, fx: float, median_depth: float) -> float:
    """`Scaling.bound` of the colour term from intensities (h, w), NaN where unknown."""
    gy, gx = np.gradient(image[::2, ::2])
    slope = 0.5 * np.hypot(gx, gy)
    slope = slope[np.isfinite(slope)]
    steep = float(np.percentile(slope, 99.5)) if slope.size else 1.0
    return max(1e-2, 2.0 * fx * steep / median_depth)
