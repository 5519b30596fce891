"""Two frames against each other, both with their own rolling shutters: depth by depth, colour by colour.

Depth: the geometric term of `alignment.residuals` against a reference that keeps its rows' times. Colour: points of the
reference's depth looked up in both colour images, each by its own lines. How the point itself was placed hardly matters
then, since both images see it move alike, and the derivative is taken half from each image (as in efficient
second-order minimisation, Benhimane and Malis, IROS 2004): the noise of one image's gradient alone would pass for
information about the extrinsics.
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
from rsgen.device.projection import TO_BASE, gather, move, project_rolling
from rsgen.device.recording import recorded_from
from rstrack.alignment.block_sums import BlockSums, Scaling, accumulate, block_counts, block_slot
from rstrack.alignment.brightness import MID_GREY
from rstrack.alignment.residuals import GeometricInput, geometric_kernel
from rstrack.images.sampling import EDGE, grid, level_size, value_and_slope
from rstrack.keyframes.keyframe import depth_scaling, strides, surface_bends, surface_slopes

# Part of the width over which inverse depth is averaged, to either side.
_WINDOW = 1.0 / 160.0
# Gates: residuals beyond are outliers for certain, in σ (depth) and intensity; and smallest credible σ (m, intensity).
_GATE_SIGMAS, _GATE_INTENSITY = 5.0, 0.3
FLOOR_DEPTH, FLOOR_INTENSITY = 2e-4, 1.0 / 255.0
# Part of σ by which the averaging may have bent a pixel's surface.
_SMOOTH = 0.25
# Inverse depth larger by this part may hide a point from the colour camera.
_HIDES = 0.2

Float32Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Surface:
    """A depth image that others are compared with, on the device: inverse depth (1/m, 0 missing) averaged over a
    window, its slopes by normalised coordinates, how far averaging may have moved it (m), and its points (m, z = 0:
    none) of each of the pyramid's levels. median_depth, bound: see `Scaling`.
    """

    inverse_depth: Any
    slope_x: Any
    slope_y: Any
    roughness: Any
    points: tuple[tuple[Any, Any, Any], ...]
    median_depth: float
    bound: float


def surface_of(
    e: Engine, rho: Float32Image, rays: FloatArray, fx: float, fy: float, baseline_m: float = 0.0
) -> Surface:
    """Of `averaged` inverse depth (h, w), and the camera's normalised coordinates (h, w, 2).

    baseline_m: at most so far is the colour camera away, from where nearer things hide some of what is seen.
    """
    height, width = rho.shape
    slope_x, slope_y = surface_slopes(rho, fx, fy)
    z = np.divide(np.float32(1.0), rho, out=np.zeros_like(rho), where=rho > 0)
    bend_x, bend_y = surface_bends(slope_x, slope_y, fx, fy)
    # A parabola's mean over the window is off by that.
    roughness = (_window(width) ** 2 - 1) / 24.0 * z * z * (bend_x + bend_y)
    reach = max(1, math.ceil(baseline_m * fx * float(np.percentile(rho[rho > 0], 90.0)))) if (rho > 0).any() else 1
    nearest = np.asarray(cv2.dilate(rho, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)))
    z = np.where((z > 0) & (nearest < np.float32(1.0 + _HIDES) * rho), z, np.float32(0.0))
    points = []
    for stride in strides(width, height)[:3]:
        pick = (slice(None, None, stride), slice(None, None, stride))
        x, y = rays[..., 0][pick] * z[pick], rays[..., 1][pick] * z[pick]
        points.append((e.upload(x), e.upload(y), e.upload(z[pick])))
    surface = e.upload(rho), e.upload(slope_x), e.upload(slope_y), e.upload(roughness)
    return Surface(*surface, tuple(points), *depth_scaling(rho))


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
class ColorPairInput:
    """Device arrays of the colour kernel.

    x, y, z: the reference's points in its depth camera (m, z = 0: none); to_base: poses of its depth lines. image,
    from_base: current intensities, NaN where they tell nothing, and the colour camera's lines; ref_*: the reference's.
    constants: those of `Scaling`, and gain and offset of the current image against the reference's.
    """

    x: Any
    y: Any
    z: Any
    to_base: Any
    image: Any
    from_base: Any
    ref_image: Any
    ref_from_base: Any
    constants: Any


def color_pair_kernel(e: Engine, color: Lens, depth: Lens, stride: int, level: int) -> Callable[[ColorPairInput], Any]:
    """Kernel of the colour term: sums over pairs of blocks (current, reference) of *colour* lines."""
    width, height = level_size(color.camera.width, level), level_size(color.camera.height, level)
    shrink = 0.5**level

    def looked_up(image: Any, seen: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        x, y = seen.x * shrink, seen.y * shrink
        value, dx, dy, active = value_and_slope(e, image, width, height, x, y, active & seen.valid)
        return value, dx * shrink, dy * shrink, active

    @recorded_from(ColorPairInput)
    def kernel(given: ColorPairInput) -> Any:
        parameters = [dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(7)]
        _, x, y = grid(e, depth.camera.width, depth.camera.height, stride)
        line = e.UInt(depth.line_of(e.Int(x), e.Int(y)))
        p = move(gather(given.to_base, line, TO_BASE, stride=TO_BASE), (given.x, given.y, given.z))
        here = project_rolling(color, given.from_base, p, e.UInt, e.Int)
        there = project_rolling(color, given.ref_from_base, p, e.UInt, e.Int)
        value, dx, dy, active = looked_up(given.image, here, given.z > 0.0)
        ref, ref_dx, ref_dy, active = looked_up(given.ref_image, there, active)
        gain, offset = (dr.gather(e.Float, given.constants, e.UInt(i)) for i in (7, 8))
        contrast = ref - MID_GREY
        r = value - (ref + dr.fma(gain, contrast, offset))
        own, other = here.chain(dx, dy, 0.0), there.chain(ref_dx, ref_dy, 0.0)
        g = tuple(0.5 * dr.fma(1.0 + gain, b, a) for a, b in zip(own, other, strict=True))
        slot, size = block_slot(here.row, there.row, color, color, here.y, with_brightness=True)
        # A twist of the camera moves the point the other way.
        return accumulate(e, g, p, -1.0, r, active, parameters, slot, size, (-contrast, e.Float(-1.0)))

    return kernel


@dataclass
class PairTerms:
    """The kernels of one rig. depth, color: lenses of `pair_lens`; rays: the depth camera's, on the device."""

    e: Engine
    depth: Lens
    color: Lens
    rays: tuple[Any, Any]
    _kernel: Kernels = field(init=False)

    def __post_init__(self) -> None:
        self._kernel = Kernels(self.e)

    def by_depth(
        self, z: Any, surface: Surface, to_base: FloatArray, ref_from_base: FloatArray, sigma: float, level: int
    ) -> Callable[[], BlockSums]:
        """A depth image's z against a surface; σ in m. The device works until what this returns is called."""
        e, camera = self.e, self.depth.camera
        stride = strides(camera.width, camera.height)[level]
        scaling = self._scaling(surface.median_depth, surface.bound, stride)
        gate = max(_GATE_SIGMAS * sigma, 10.0 * FLOOR_DEPTH)
        constants = e.upload(np.append(scaling.parameters(sigma, gate), [_SMOOTH * sigma, 0.0]))
        kernel = self._kernel(geometric_kernel, self.depth, self.depth, stride)
        ref = surface.inverse_depth, surface.slope_x, surface.slope_y, surface.roughness
        tables = e.upload(to_base), e.upload(ref_from_base)
        raw = kernel(GeometricInput(z, *self.rays, tables[0], *ref, tables[1], constants))
        current, reference, _, _ = block_counts(self.depth, self.depth)
        return lambda: scaling.unpack(raw.numpy(), current, reference)

    def by_color(
        self, images: tuple[Any, Any], surface: Surface, to_base: FloatArray, from_base: FloatArray,
        ref_from_base: FloatArray, bound: float, brightness: FloatArray, sigma: float, level: int,
    ) -> Callable[[], BlockSums]:  # fmt: skip
        """A colour image against the reference's, both given as intensities of a level.

        bound: see `Scaling`, from the reference's gradients. brightness (2,): gain and offset; σ: of intensities.
        """
        e, camera = self.e, self.depth.camera
        stride = strides(camera.width, camera.height)[level]
        scaling = self._scaling(surface.median_depth, bound, stride)
        constants = e.upload(np.append(scaling.parameters(sigma, _GATE_INTENSITY), brightness))
        kernel = self._kernel(color_pair_kernel, self.color, self.depth, stride, level)
        tables = e.upload(to_base), e.upload(from_base), e.upload(ref_from_base)
        raw = kernel(
            ColorPairInput(*surface.points[level], tables[0], images[0], tables[1], images[1], tables[2], constants)
        )
        current, reference, _, _ = block_counts(self.color, self.color)
        return lambda: scaling.unpack(raw.numpy(), current, reference)

    def _scaling(self, median_depth: float, bound: float, stride: int) -> Scaling:
        camera = self.depth.camera
        pixels = -(-camera.width // stride) * -(-camera.height // stride)
        return Scaling(median_depth, bound, pixels)


def intensity_bound(image: Float32Image, fx: float, median_depth: float) -> float:
    """`Scaling.bound` of the colour term from intensities (h, w), NaN where unknown."""
    gy, gx = np.gradient(image[::2, ::2])
    slope = 0.5 * np.hypot(gx, gy)
    slope = slope[np.isfinite(slope)]
    steep = float(np.percentile(slope, 99.5)) if slope.size else 1.0
    return max(1e-2, 2.0 * fx * steep / median_depth)
