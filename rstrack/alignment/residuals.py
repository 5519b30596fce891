"""The two dense error terms, linearised and summed over pixels on the device.

Geometric, equations (6)/(15): each current depth point, moved by its own line's pose, against the plane that the
reference's inverse depth has at the pixel where it falls. Inverse depth is affine in the pixel on a plane, so that
bilinear interpolation of it is exact there, and 1 − z ρ(x) is the point's distance to the plane over the plane's
distance to the camera.

Photometric, equations (8)/(14): each reference point, projected into the rolling-shutter colour image (equation (3)),
against the reference's intensity there.

Both depend on the poses only through a twist of the current line against the reference's (six numbers, expressed in
the base frame, which moves with neither), so both give one 6×6 system per block of lines. Against a reference that is
not rectified yet, its own line moves too, in the opposite sense: then there is one 6×6 system per *pair* of blocks.
Weights are Student t (equation (11)).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from rsgen.device.arrays import Engine, recorded_with
from rsgen.device.lens import Lens, per_focal
from rsgen.device.projection import TO_BASE, RollingProjection, Vector, gather, move, project_rolling
from rsgen.geometry.camera import Camera
from rstrack.alignment.block_sums import Blocks, Contribution, PixelGrid, Runs, block_slot, contribution, room, summed
from rstrack.alignment.brightness import MID_GREY
from rstrack.images.sampling import (
    BEHIND,
    EDGE,
    NEAREST,
    Blur,
    PyramidLevel,
    Raster,
    blur_length,
    blur_weight,
    grid,
    moved_to_base,
    nearest,
    row_of_pixel,
    surface,
    value_and_slope,
)

LEVEL = np.zeros(3)
"""A depth image that is not off as a whole: offset and two tilts of its inverse depth."""
# Length of a ray, z being 1, times its x or y: of pixels 60° off the axis.
_WIDEST = 4.0


@dataclass(frozen=True)
class GeometricInput:
    """Device arrays of the geometric kernel.

    depth (m), rays_* (normalised), to_base: of the current image's pixels and lines. inverse_depth, slope_* (smoothed,
    for normals), roughness (m), from_base: of the reference. constants: those of `Scaling`; the roughness beyond which
    a pixel of the reference is not smooth; 0 to leave such out, 1 to weigh them by its inverse fourth power; and the
    offset and tilts (1/m) that the image's inverse depth has now.
    """

    depth: Any
    rays_x: Any
    rays_y: Any
    to_base: Any
    inverse_depth: Any
    slope_x: Any
    slope_y: Any
    roughness: Any
    from_base: Any
    constants: Any


def geometric_kernel(
    e: Engine, lens: Lens, ref_lens: Lens, stride: int, shifts: bool = False
) -> Callable[[GeometricInput], Any]:
    """Kernel of the geometric term, equations (6) and (15): sums over blocks, as `Scaling.unpack` takes them.

    lens, ref_lens: the current depth camera's and the reference's, whose frame is the base if it is rectified. shifts:
    with the columns of `whole_image`.
    """
    count = len(LEVEL) if shifts else 0
    size, down = room(lens, ref_lens, count), lens.rolls and not lens.shutter.by_rows
    runs, own_blocks = Runs.over(e, lens.camera.width, lens.camera.height, stride, down), Blocks.of(lens, ref_lens)

    @recorded_with(e, GeometricInput, lens, ref_lens, runs, own_blocks)
    def kernel(given: GeometricInput, lens: Lens, ref_lens: Lens, runs: Runs, blocks: Blocks) -> Any:
        ref = ref_lens.camera
        parameters = [dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(7)]

        def at(pixels: PixelGrid) -> Contribution:
            z = dr.gather(e.Float, given.depth, pixels.index)
            active = pixels.meant & (z > 0.0)
            even = evened(z, parameters[2])
            xn, yn = (dr.gather(e.Float, ray, pixels.index) for ray in (given.rays_x, given.rays_y))
            if shifts:
                offset, by_x, by_y = (dr.gather(e.Float, given.constants, e.UInt(i)) for i in (9, 10, 11))
                z *= dr.rcp(dr.fma(z, dr.fma(by_x, xn, dr.fma(by_y, yn, offset)), 1.0))
            line = row_of_pixel(e, lens, pixels.x, pixels.y)
            to_base = gather(given.to_base, line, TO_BASE, stride=TO_BASE)
            p = move(to_base, (xn * z, yn * z, z))
            seen = project_rolling(ref_lens, given.from_base, p, e.UInt, e.Int)
            value, active = surface(e, ref, given.inverse_depth, seen.x, seen.y, active & seen.valid)
            r, g, is_smooth = plane_distance(e, given, ref, seen, value, active, even)
            # What lies behind the surface is hidden from the reference: nothing that it shows speaks for it or against.
            active &= r > -parameters[1]
            slot = block_slot(line, seen.row, blocks, pixels.y, columns=count)
            columns = whole_image(g, p, to_base, z, (xn, yn), parameters[2]) if shifts else ()
            return contribution(
                e, g, p, 1.0, r, active, parameters, slot, columns, judged=is_smooth, curved=count
            )  # fmt: skip

        return summed(e, runs, size, at, is_steady=not ref_lens.rolls)

    return kernel


def whole_image(g: Vector, p: Vector, to_base: list[Any], z: Any, ray: tuple[Any, Any], inv_median: Any) -> list[Any]:
    """Derivatives of r by an offset and two tilts of the image's inverse depth, in units of `whole_image_unit`.

    The tilts are along the ray's x and y. g: derivative by a shift of the point p = R q + t, which the pose to_base has
    of q; z (m), ray: of q. ∂q/∂ρ = −z q. inv_median: 1/m, of the reference.
    """
    along = [one - t for one, t in zip(p, to_base[9:], strict=True)]
    by_offset = dr.fma(g[0], along[0], dr.fma(g[1], along[1], g[2] * along[2])) * -z
    by_offset *= dr.square(inv_median) / _WIDEST
    # No pixel reaches 1 but one that is seen at a slant beyond 60°.
    return [dr.clip(column, -1.0, 1.0) for column in (by_offset, by_offset * ray[0], by_offset * ray[1])]


def whole_image_unit(median_depth: float) -> float:
    """What one of a column of `whole_image` stands for, in 1/m, so that none exceeds 1 in fixed point."""
    return 1.0 / (_WIDEST * median_depth**2)


def plane_distance(
    e: Engine, given: GeometricInput, ref: Camera, seen: RollingProjection, value: Any, active: Any, even: Any
) -> tuple[Any, Vector, Any]:
    """Equation (6): points' distances to the plane that inverse depth, `value` (1/m) where they are seen, has there.

    even: see `evened`. Returns them (m), their derivatives by a shift of the point in the base frame, and whether the
    reference is smooth there.
    """
    at = nearest(e, ref.width, seen.x, seen.y, active)
    mx, my = dr.gather(e.Float, given.slope_x, at, active), dr.gather(e.Float, given.slope_y, at, active)
    # Where interpolation errs, its bias counts, not its size: such pixels are not used to estimate σ. In coarse
    # images, of which they are half, they weigh less the more so they are: without them the flat ones would slide.
    limit, coarse = (dr.gather(e.Float, given.constants, e.UInt(i)) for i in (7, 8))
    rough = dr.gather(e.Float, given.roughness, at, active)
    share = dr.select(rough <= limit, 1.0, coarse * dr.square(limit * dr.rcp(dr.maximum(rough, 1e-9))))
    # The plane m·q = 1 through the pixel; |m| is one over its distance.
    mz = value - mx * seen.at.xn - my * seen.at.yn
    inv_m = share * even * dr.rsqrt(mx * mx + my * my + mz * mz)
    r = (1.0 - seen.z * value) * inv_m
    scale = -seen.z * inv_m
    return r, seen.chain(*per_focal(ref, scale * mx, scale * my), -value * inv_m), rough <= limit


def evened(z: Any, inv_median_depth: Any) -> Any:
    """By what errors of depth count more the nearer they are.

    They grow with its square, in triangulating cameras and by interpolation: one σ serves all depths then.
    """
    return dr.minimum(dr.square(dr.rcp(dr.maximum(z * inv_median_depth, 1e-3))), NEAREST)


@dataclass(frozen=True)
class PhotometricInput:
    """Device arrays of the photometric kernel.

    x, y, z (m; 0: none), intensity, visible (0 or 1): points of the reference's every stride-th pixel in its camera's
    frame; to_base: its lines' poses. image: intensities of the pyramid's level, NaN where clipped; from_base: its
    lines. constants: those of `Scaling`, and the image's gain and offset.
    """

    x: Any
    y: Any
    z: Any
    intensity: Any
    visible: Any
    to_base: Any
    image: Any
    from_base: Any
    constants: Any


def photometric_kernel(
    e: Engine, lens: Lens, ref_lens: Lens, stride: int, level: int, blur_sigma_px: float = 0.0
) -> Callable[[PhotometricInput], Any]:
    """Kernel of the photometric term, equations (8) and (14): sums over blocks, as `Scaling.unpack` takes them.

    lens: the colour camera. level: of the pyramid (halved that often). blur_sigma_px: σ of equation (13), by which
    blurred points count less; 0: all alike.
    """
    weighs_blur = blur_sigma_px > 0.0 and lens.rolls and lens.shutter.exposure_s > 0.0
    blur = Blur.of(lens, blur_sigma_px) if weighs_blur else Blur(0.0, 0.0)
    size, down = room(lens, ref_lens, 2), lens.rolls and not lens.shutter.by_rows
    runs = Runs.over(e, ref_lens.camera.width, ref_lens.camera.height, stride, down)
    of_lenses = lens, ref_lens, runs, Blocks.of(lens, ref_lens), PyramidLevel.of(lens.camera, level), blur

    @recorded_with(e, PhotometricInput, *of_lenses)
    def kernel(
        given: PhotometricInput, lens: Lens, ref_lens: Lens, runs: Runs, blocks: Blocks, image: PyramidLevel, blur: Blur
    ) -> Any:  # fmt: skip
        shrink = image.shrink
        parameters = [dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(7)]
        gain, offset = (dr.gather(e.Float, given.constants, e.UInt(i)) for i in (7, 8))

        def at(pixels: PixelGrid) -> Contribution:
            stored = given.x, given.y, given.z, given.intensity, given.visible
            x, y, z, intensity, visible = (dr.gather(e.Float, values, pixels.number) for values in stored)
            p: Vector = x, y, z
            active = pixels.meant & (z > 0.0) & (visible > 0.5)
            ref_line = row_of_pixel(e, ref_lens, pixels.x, pixels.y)
            p = moved_to_base(e, ref_lens, given.to_base, pixels.x, pixels.y, p)
            seen = project_rolling(lens, given.from_base, p, e.UInt, e.Int)
            u, v = seen.x * shrink, seen.y * shrink
            value, dx, dy, active = value_and_slope(
                e, given.image, image.width, image.height, u, v, active & seen.valid
            )
            dx, dy = dx * shrink, dy * shrink
            contrast = intensity - MID_GREY
            r = value - (intensity + dr.fma(gain, contrast, offset))  # (8), and brightness
            columns = -contrast, e.Float(-1.0)
            if weighs_blur:
                # Of the squared error, so that σ stays that of sharp points.
                share = dr.sqrt(blur_weight(blur_length(seen.pixel_speed, blur.lines), blur.inv_sigma2))  # (13)
                r, dx, dy = r * share, dx * share, dy * share
                columns = columns[0] * share, columns[1] * share
            g = seen.chain(dx, dy, 0.0)
            slot = block_slot(seen.row, ref_line, blocks, seen.y, columns=len(columns))
            # A twist of the camera moves the point the other way.
            return contribution(e, g, p, -1.0, r, active, parameters, slot, columns)

        return summed(e, runs, size, at, is_steady=False)

    return kernel


@dataclass(frozen=True)
class VisibilityInput:
    """Device arrays that the visibility kernel takes: points as in `PhotometricInput`, and the depth image (m) with the
    poses of its lines in from_base."""

    x: Any
    y: Any
    z: Any
    to_base: Any
    depth: Any
    from_base: Any


def visibility_kernel(e: Engine, lens: Lens, ref_lens: Lens, stride: int) -> Callable[[VisibilityInput], Any]:
    """Kernel that gives 1 for points that a depth image does not hide, else 0.

    The depth image need not be taken at the colour image's time: what hides a point hides it a few milliseconds later.
    Unknown counts as visible.
    """

    @recorded_with(e, VisibilityInput, lens, ref_lens, Raster.of(ref_lens.camera, stride))
    def kernel(given: VisibilityInput, lens: Lens, ref_lens: Lens, raster: Raster) -> Any:
        camera = lens.camera
        _, x, y = grid(e, raster)
        p = moved_to_base(e, ref_lens, given.to_base, x, y, (given.x, given.y, given.z))
        seen = project_rolling(lens, given.from_base, p, e.UInt, e.Int)
        inside = seen.valid & (given.z > 0.0)
        inside &= (seen.x >= 0.0) & (seen.y >= 0.0) & (seen.x < camera.width - 1.0) & (seen.y < camera.height - 1.0)
        index = nearest(e, camera.width, seen.x, seen.y, inside)
        z = dr.gather(e.Float, given.depth, index, inside)
        hidden = inside & (z > 0.0) & (seen.z > z * (1.0 + EDGE) + BEHIND)
        return dr.select(hidden, e.Float(0.0), e.Float(1.0))

    return kernel
