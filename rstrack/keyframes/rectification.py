"""Device kernels that make and improve a keyframe: rectify depth, look up colour, fuse depth.

Rectification goes backwards: for each pixel of the global-shutter keyframe the pixel of the source image that shows
the same point is found by fixed-point iteration; inverse depth is interpolated there, never across an edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from rsgen.device.arrays import Engine, recorded_with
from rsgen.device.lens import Lens, per_focal
from rsgen.device.projection import TO_BASE, gather, move, project, project_rolling
from rstrack.images.sampling import (
    PyramidLevel,
    Raster,
    bilinear_value,
    depth_of,
    grid,
    moved_to_base,
    nearest,
    pinhole_ray,
    surface,
)

# Each iteration shrinks the error by the picture's stretching, a few per cent.
ITERATIONS = 6
# Pixels: a fixed point that has not settled lies at an occlusion.
_SETTLED = 0.02


def _ray(e: Engine, lens: Lens, rays: tuple[Any, Any], x: Any, y: Any, active: Any) -> tuple[Any, Any]:
    camera = lens.camera
    if camera.model == "pinhole":
        return per_focal(camera, x - camera.cx, y - camera.cy)
    xn, yn = (bilinear_value(e, table, camera.width, camera.height, x, y, active)[0] for table in rays)
    return xn, yn


def _pose(e: Engine, lens: Lens, to_base: Any, x: Any, y: Any) -> list[Any]:
    """T_base_cam at a pixel's own time, between the lines' poses."""
    if not lens.rolls:
        return gather(to_base, e.UInt(0), TO_BASE, stride=TO_BASE)
    line = dr.clip(lens.line_of(x, y), 0.0, lens.lines - 1.0)
    low = e.UInt(e.Int(dr.minimum(dr.floor(line), lens.lines - 2.0)))
    part = line - e.Float(low)
    before, after = gather(to_base, low, TO_BASE, stride=TO_BASE), gather(to_base, low + 1, TO_BASE, stride=TO_BASE)
    return [dr.lerp(one, other, part) for one, other in zip(before, after, strict=True)]


def _first_guess(e: Engine, lens: Lens, base: Lens, x: Any, y: Any) -> tuple[Any, Any]:
    """Where a source that stood still would show the keyframe's pixel (x, y)."""
    if lens.camera.model == "pinhole":
        return e.Float(x), e.Float(y)
    ray = *per_focal(base.camera, x - base.camera.cx, y - base.camera.cy), e.Float(1.0)
    at = project(lens.camera, ray)
    return dr.select(at.valid, at.x, x), dr.select(at.valid, at.y, y)


@dataclass(frozen=True)
class RectifyInput:
    """Device arrays: the source's inverse depth and rays, and the poses of its lines."""

    inverse_depth: Any
    rays_x: Any
    rays_y: Any
    to_base: Any


def rectify_kernel(e: Engine, lens: Lens, base: Lens) -> Callable[[RectifyInput], Any]:
    """Kernel → (inverse depth in the base image, source x, source y).

    0 where the source shows nothing. `base` is a global-shutter pinhole.
    """

    @recorded_with(e, RectifyInput, lens, base, Raster.of(base.camera))
    def kernel(given: RectifyInput, lens: Lens, base: Lens, raster: Raster) -> Any:
        camera = base.camera
        _, px, py = grid(e, raster)
        goal_x, goal_y = e.Float(px), e.Float(py)
        x, y = _first_guess(e, lens, base, goal_x, goal_y)
        width, height = lens.camera.width, lens.camera.height
        value, active, miss = e.Float(0.0), e.Bool(True), e.Float(0.0)
        for _ in range(ITERATIONS):
            x, y = dr.clip(x, 0.0, width - 1.001), dr.clip(y, 0.0, height - 1.001)
            value, active = surface(e, lens.camera, given.inverse_depth, x, y, e.Bool(True))
            # Where there is no depth the last guess is as good as any; it may move back onto the surface.
            z = dr.rcp(dr.select(active, value, 1.0))
            rx, ry = _ray(e, lens, (given.rays_x, given.rays_y), x, y, e.Bool(True))
            at = project(camera, move(_pose(e, lens, given.to_base, x, y), (rx * z, ry * z, z)))
            dx, dy = goal_x - at.x, goal_y - at.y
            miss = dr.maximum(dr.abs(dx), dr.abs(dy))
            value = dr.rcp(at.q[2])
            active &= at.valid & (miss < _SETTLED)
            ok = at.valid & dr.isfinite(dx + dy)
            if lens.camera.model != "pinhole":
                # A fisheye's pixels are up to twice as wide as the keyframe's: the step would overshoot and swing.
                dx, dy = project(lens.camera, (rx, ry, e.Float(1.0))).jvp((*per_focal(camera, dx, dy), 0.0))
            x, y = dr.select(ok, x + dr.clip(dx, -40.0, 40.0), x), dr.select(ok, y + dr.clip(dy, -40.0, 40.0), y)
        return dr.select(active, value, 0.0), x, y

    return kernel


@dataclass(frozen=True)
class ColorInput:
    """Device arrays: the reference's inverse depth and rays, poses of its lines (if it is not rectified), the colour
    image's intensities and the poses of its lines."""

    inverse_depth: Any
    rays_x: Any
    rays_y: Any
    to_base: Any
    image: Any
    from_base: Any


def color_kernel(e: Engine, lens: Lens, base: Lens, level: int = 0) -> Callable[[ColorInput], Any]:
    """Kernel → (intensity, valid 0/1) at the pixels of the reference `base`, looked up by equation (3) in the image's
    pyramid at `level`."""

    @recorded_with(e, ColorInput, lens, base, Raster.of(base.camera), PyramidLevel.of(lens.camera, level))
    def kernel(given: ColorInput, lens: Lens, base: Lens, raster: Raster, image: PyramidLevel) -> Any:
        z, active = depth_of(given.inverse_depth)
        _, x, y = grid(e, raster)
        p = moved_to_base(e, base, given.to_base, x, y, (given.rays_x * z, given.rays_y * z, z))
        seen = project_rolling(lens, given.from_base, p, e.UInt, e.Int)
        u, v = seen.x * image.shrink, seen.y * image.shrink
        value, active = bilinear_value(e, given.image, image.width, image.height, u, v, active & seen.valid)
        active &= dr.isfinite(value)  # not clipped
        return dr.select(active, value, 0.0), dr.select(active, e.Float(1.0), 0.0)

    return kernel


@dataclass(frozen=True)
class FusionInput:
    """Device arrays: the keyframe's inverse depth, weight and slopes; the source's inverse depth and weight, and the
    poses of its lines; constants: gate (m), largest weight."""

    inverse_depth: Any
    weight: Any
    slope_x: Any
    slope_y: Any
    source: Any
    source_weight: Any
    from_base: Any
    constants: Any


def fuse_kernel(e: Engine, lens: Lens, base: Lens) -> Callable[[FusionInput], Any]:
    """Kernel → (inverse depth, weight): weighted mean of the keyframe's depth and the source's, where they agree.

    A depth difference at the source's pixel shifts the keyframe's local plane along its normal. Weights count
    measurements of unit quality, 1/σ_z² over that of a pixel at one metre.
    """

    @recorded_with(e, FusionInput, lens, base, Raster.of(base.camera))
    def kernel(given: FusionInput, lens: Lens, base: Lens, raster: Raster) -> Any:
        rho, weight = given.inverse_depth, given.weight
        gate, limit = dr.gather(e.Float, given.constants, e.UInt(0)), dr.gather(e.Float, given.constants, e.UInt(1))
        _, px, py = grid(e, raster)
        xn, yn = pinhole_ray(e, base.camera, px, py)
        z, active = depth_of(rho)
        seen = project_rolling(lens, given.from_base, (xn * z, yn * z, z), e.UInt, e.Int)
        value, active = surface(e, lens.camera, given.source, seen.x, seen.y, active & seen.valid)
        z_there = dr.rcp(dr.select(active, value, 1.0))
        active &= dr.abs(z_there - seen.z) < gate * dr.maximum(1.0, z)
        # Relative change of depth: the plane m·p = 1 moves by the same distance for both cameras.
        n = given.slope_x, given.slope_y, rho - given.slope_x * xn - given.slope_y * yn
        ray = seen.at.q[0] / seen.at.q[2], seen.at.q[1] / seen.at.q[2], e.Float(1.0)
        M = seen.M
        along = (
            n[0] * (M[0] * ray[0] + M[3] * ray[1] + M[6]) + n[1] * (M[1] * ray[0] + M[4] * ray[1] + M[7])
            + n[2] * (M[2] * ray[0] + M[5] * ray[1] + M[8])
        )  # fmt: skip
        ratio = dr.clip(along * z, 0.5, 2.0)
        fused_z = z + (z_there - seen.z) * ratio
        w = dr.gather(e.Float, given.source_weight, nearest(e, lens.camera.width, seen.x, seen.y, active), active)
        active &= w > 0.0
        share = dr.select(active, w / (weight + w), 0.0)
        return dr.fma(share, dr.rcp(fused_z) - rho, rho), dr.minimum(weight + dr.select(active, w, 0.0), limit)

    return kernel
