"""Device kernels that make and improve a keyframe: rectify depth, look up colour, fuse depth.

Rectification goes backwards: for each pixel of the global-shutter keyframe the pixel of the source image that shows
the same point is found by fixed-point iteration; inverse depth is interpolated there, never across an edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from rsgen.device.arrays import Engine, recorded, recorded_from
from rsgen.device.lens import Lens
from rsgen.device.projection import TO_BASE, gather, move, project, project_rolling
from rsgen.geometry.camera import Camera
from rstrack.images.sampling import (
    EDGE,
    bilinear,
    bilinear_value,
    depth_of,
    grid,
    level_size,
    moved_to_base,
    nearest,
    pinhole_ray,
    surface,
)

# Each step shrinks the error by the picture's stretching, a few per cent. Rounds at most, and steps of each: for these
# the pose and the ray found at its beginning are followed along a straight line.
_ROUNDS, _STEPS = 3, 2
# Pixels: a fixed point that has not settled lies at an occlusion; another round changes depth that is so near by less
# than a hundredth of a millimetre.
_SETTLED, _EXACT = 0.02, 1e-3
# Pixels that a step goes at most.
_STRIDE = 40.0


@dataclass(frozen=True)
class _Line:
    """Poses T_base_cam at an image's lines: at line `low` and, line by line, from there on."""

    M: list[Any]
    change: list[Any]
    low: Any

    @classmethod
    def at(cls, e: Engine, lens: Lens, to_base: Any, x: Any, y: Any) -> _Line:
        """Those about a pixel."""
        if lens.lines == 1:
            return cls(gather(to_base, e.UInt(0), TO_BASE, stride=TO_BASE), [], e.Float(0.0))
        line = dr.clip(lens.line_of(x, y), 0.0, lens.lines - 1.0)
        low = e.UInt(e.Int(dr.minimum(dr.floor(line), lens.lines - 2.0)))
        before, after = (gather(to_base, at, TO_BASE, stride=TO_BASE) for at in (low, low + 1))
        return cls(before, [b - a for a, b in zip(before, after, strict=True)], e.Float(low))

    def pose(self, lens: Lens, x: Any, y: Any) -> list[Any]:
        """T_base_cam at a pixel's own time, between the lines' poses."""
        part = lens.line_of(x, y) - self.low
        return [dr.fma(part, d, m) for m, d in zip(self.M, self.change, strict=True)] if self.change else self.M


@dataclass(frozen=True)
class _Rays:
    """Normalised coordinates about a pixel, bilinear: in the cell of pixels that it lies in, and from there on."""

    lens: Lens
    cells: list[Any]
    corner: tuple[Any, Any]

    @classmethod
    def at(cls, e: Engine, lens: Lens, rays: tuple[Any, ...], x: Any, y: Any) -> _Rays:
        camera = lens.camera
        if camera.model == "pinhole":
            return cls(lens, [], (0.0, 0.0))
        cells = [bilinear(e, table, camera.width, camera.height, x, y, e.Bool(True))[:4] for table in rays]
        return cls(lens, cells, (dr.floor(x), dr.floor(y)))

    def of(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Those of a pixel."""
        if not self.cells:
            camera = self.lens.camera
            return (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
        u, v = x - self.corner[0], y - self.corner[1]
        xn, yn = (dr.lerp(dr.lerp(a, b, u), dr.lerp(c, d, u), v) for a, b, c, d in self.cells)
        return xn, yn


def _found(
    e: Engine, lens: Lens, base: Lens, rho: Any, rays: tuple[Any, ...], to_base: Any, wanted: Any
) -> tuple[Any, Any, Any]:  # fmt: skip
    """Inverse depth of the base image's wanted pixels, 0 where the source shows nothing, and the source's pixels."""
    camera, source = base.camera, lens.camera
    _, px, py = grid(e, camera.width, camera.height, 1)
    goal = e.Float(px), e.Float(py)
    still = _Line.at(e, lens, to_base, *goal) if lens.lines == 1 else None

    def round_(count: Any, x: Any, y: Any, value: Any, miss: Any) -> tuple[Any, ...]:
        x, y = _inside(source, x, y)
        line = still or _Line.at(e, lens, to_base, x, y)
        ray = _Rays.at(e, lens, rays, x, y)
        for _ in range(_STEPS):
            x, y = _inside(source, x, y)
            value, active = surface(e, source, rho, x, y, e.Bool(True))
            # Where there is no depth the last guess is as good as any; it may move back onto the surface.
            z = dr.rcp(dr.select(active, value, 1.0))
            rx, ry = ray.of(x, y)
            at = project(camera, move(line.pose(lens, x, y), (rx * z, ry * z, z)))
            dx, dy = goal[0] - at.x, goal[1] - at.y
            miss = dr.maximum(dr.abs(dx), dr.abs(dy))
            active &= at.valid & (miss < _SETTLED)
            value = dr.select(active, dr.rcp(at.q[2]), 0.0)
            ok = at.valid & dr.isfinite(dx + dy)
            if source.model != "pinhole":
                # A fisheye's pixels are up to twice as wide as the keyframe's: the step would overshoot and swing.
                dx, dy = project(source, (rx, ry, e.Float(1.0))).jvp((dx / camera.fx, dy / camera.fy, 0.0))
            x = dr.select(ok, x + dr.clip(dx, -_STRIDE, _STRIDE), x)
            y = dr.select(ok, y + dr.clip(dy, -_STRIDE, _STRIDE), y)
        return count + 1, x, y, value, miss

    _, x, y, value, _ = dr.while_loop(
        (e.UInt(0), *_first_guess(lens, base, *goal), e.Float(0.0), e.Float(dr.inf)),
        lambda count, x, y, value, miss: wanted & (count < _ROUNDS) & (miss > _EXACT),
        round_,
    )
    return value, x, y


def _inside(camera: Camera, x: Any, y: Any) -> tuple[Any, Any]:
    return dr.clip(x, 0.0, camera.width - 1.001), dr.clip(y, 0.0, camera.height - 1.001)


def _first_guess(lens: Lens, base: Lens, x: Any, y: Any) -> tuple[Any, Any]:
    """Where a source that stood still would show the keyframe's pixel (x, y).

    An older keyframe is not turned to where it looks first: filled with all that it shows then, and not with what lies
    within some steps' reach, keyframes of a drone's flight gave errors an eighth larger.
    """
    if lens.camera.model == "pinhole":
        return x, y
    ray = (x - base.camera.cx) / base.camera.fx, (y - base.camera.cy) / base.camera.fy, type(x)(1.0)
    at = project(lens.camera, ray)
    return dr.select(at.valid, at.x, x), dr.select(at.valid, at.y, y)


def rectify_kernel(e: Engine, lens: Lens, base: Lens) -> Callable[..., Any]:
    """Kernel (inverse_depth, rays_x, rays_y, to_base) → (inverse depth in the base image, source x, source y).

    0 where the source shows nothing. `base` is a global-shutter pinhole.
    """
    return recorded(lambda rho, x, y, to_base: _found(e, lens, base, rho, (x, y), to_base, e.Bool(True)))


def resting_kernel(e: Engine, lens: Lens) -> Callable[..., Any]:
    """Kernel (inverse depth in a base image, source x, y, the source's inverse depth without what moves) → the first,
    0 where what moves was taken from the source."""

    @recorded
    def kernel(rho: Any, x: Any, y: Any, resting: Any) -> Any:
        _, rests = surface(e, lens.camera, resting, x, y, rho > 0.0)
        return dr.select(rests, rho, 0.0)

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
    """Kernel → intensity at the pixels of the reference `base`, NaN where unknown, looked up by equation (3) in the
    image's pyramid at `level`."""
    width, height = level_size(lens.camera.width, level), level_size(lens.camera.height, level)
    shrink = 0.5**level

    @recorded_from(ColorInput)
    def kernel(given: ColorInput) -> Any:
        z, active = depth_of(given.inverse_depth)
        _, x, y = grid(e, base.camera.width, base.camera.height, 1)
        p = moved_to_base(e, base, given.to_base, x, y, (given.rays_x * z, given.rays_y * z, z))
        seen = project_rolling(lens, given.from_base, p, e.UInt, e.Int)
        u, v = seen.x * shrink, seen.y * shrink
        value, active = bilinear_value(e, given.image, width, height, u, v, active & seen.valid)
        return dr.select(active, value, dr.nan)  # NaN also where clipped

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

    @recorded_from(FusionInput)
    def kernel(given: FusionInput) -> Any:
        rho, weight = given.inverse_depth, given.weight
        gate, limit = dr.gather(e.Float, given.constants, e.UInt(0)), dr.gather(e.Float, given.constants, e.UInt(1))
        _, px, py = grid(e, base.camera.width, base.camera.height, 1)
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


@dataclass(frozen=True)
class InheritedInput:
    """Device arrays: the keyframe's inverse depth and weight; the older one's inverse depth; T_new_older as `TO_BASE`
    floats."""

    inverse_depth: Any
    weight: Any
    older: Any
    to_base: Any


@dataclass(frozen=True)
class HiddenInput(InheritedInput):
    """The same, and where something moves before the keyframe (above 0), the older one's intensities, and the factor
    and offset that make them the newer one's."""

    hidden: Any
    intensity: Any
    as_now: Any


def inherit_kernel(e: Engine, older: Lens, base: Lens, moves: bool) -> Callable[[Any], Any]:
    """Kernel → (inverse depth, weight, intensity): holes filled with what an older keyframe shows there, with weight 1.

    moves: takes a `HiddenInput`; intensities are those where something moves, NaN elsewhere and where they are not
    known. Without it there are none.
    """
    width, height = older.camera.width, older.camera.height

    @recorded_from(HiddenInput if moves else InheritedInput)
    def kernel(given: Any) -> Any:
        hole = given.inverse_depth <= 0.0
        wanted = hole | (given.hidden > 0.0) if moves else hole
        old, x, y = _found(e, older, base, given.older, (), given.to_base, wanted)
        filled = hole & (old > 0.0)
        rho, weight = dr.select(filled, old, given.inverse_depth), dr.select(filled, 1.0, given.weight)
        if not moves:
            return rho, weight
        same = wanted & (old > 0.0) & (dr.abs(old - rho) < EDGE * rho)
        value, same = bilinear_value(e, given.intensity, width, height, x, y, same)
        factor, offset = (dr.gather(e.Float, given.as_now, e.UInt(i)) for i in (0, 1))
        return rho, weight, dr.select(same, dr.fma(factor, value, offset), dr.nan)

    return kernel
