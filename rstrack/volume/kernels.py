"""Device kernels of the signed distance volume: distances' scale, visible blocks, integration, ray casting.

Lattice point (i, j, k) lies at (i, j, k) times the voxel's size in the world. A block holds 8×8×8 lattice points; the
directory, a dense table over a box of blocks about the camera, holds where each block's values begin, -1 where there is
none. Stored are sums over frames: of weights, of weights times truncated distances (in units of the truncation), and of
weights times colours.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import drjit as dr

from rsgen.device.arrays import Engine, recorded
from rsgen.device.lens import Lens
from rsgen.device.projection import Vector, gather, move, project
from rstrack.images.sampling import EDGE, Raster, depth_of, grid, nearest, pinhole_ray, surface

BLOCK = 8
POINTS = BLOCK**3
# Where around the surface blocks are wanted, in truncations along the ray; the steps are shorter than half a block.
_BAND = (-0.6, -0.2, 0.2, 0.6)
# Every so-manyth pixel and row is asked which blocks it sees.
_STRIDE = 2
# Pixels to both sides between which the surface's slope is taken: noise counts a sixth of what it does in neighbours.
_REACH = 3
# Standard deviation of a structured-light camera's depth (Nguyen et al., 3DIMPVT 2012), m: a + b (z - c)².
_NOISE = (0.0012, 0.0019, 0.4)
# Weight of one measurement at most, in measurements at one metre.
_HEAVIEST = 2.5
# Voxels from the surface within which lattice points take its colour.
_COLORED = 2.0
_SECANT_STEPS = 5
# Voxels: how far from zero the distance may be where a ray hits.
_HIT = 0.1
_MOST_STEPS = 4096


def scale_kernel(e: Engine, lens: Lens) -> Callable[..., Any]:
    """Kernel (inverse_depth) → distance (m) from the camera's centre to the plane through each pixel's surface.

    A point q on the ray of a pixel with inverse depth ρ lies (1 − q_z ρ) times that in front of the plane. Where the
    slope cannot be had, at edges, the plane is taken as square to the ray.
    """
    camera = lens.camera
    w, h = camera.width, camera.height

    @recorded
    def kernel(rho: Any) -> Any:
        index, px, py = grid(e, Raster.of(camera))
        at = dr.gather(e.Float, rho, index)
        slopes, smooth = [], e.Bool(True)
        for coordinate, size, stride, focal in ((px, w, 1, camera.fx), (py, h, w, camera.fy)):
            # At the border the slope is that of the nearest pixel that has one.
            inner = dr.clip(e.Int(coordinate), _REACH, size - 1 - _REACH)
            middle = e.UInt(e.Int(index) + (inner - e.Int(coordinate)) * stride)
            here = dr.gather(e.Float, rho, middle)
            before = dr.gather(e.Float, rho, middle - _REACH * stride)
            after = dr.gather(e.Float, rho, middle + _REACH * stride)
            smooth &= (dr.minimum(before, after) > 0.0) & (dr.abs(before + after - 2.0 * here) < EDGE * here)
            smooth &= dr.abs(here - at) < EDGE * at
            slopes.append((after - before) * (focal / (2.0 * _REACH)))
        xn, yn = pinhole_ray(e, camera, px, py)
        nz = at - slopes[0] * xn - slopes[1] * yn
        plane = dr.rsqrt(slopes[0] * slopes[0] + slopes[1] * slopes[1] + nz * nz)
        along = dr.sqrt(xn * xn + yn * yn + 1.0) / at
        return dr.select(at > 0.0, dr.select(smooth, plane, along), 0.0)

    return kernel


def visible_blocks_kernel(e: Engine, lens: Lens, band_m: float, voxel_m: float) -> Callable[..., Any]:
    """Kernel (inverse_depth, T_world_cam (12), box (6)) → per part of the band: directory entries, and which count.

    box: the directory's first block (3) and its size in blocks (3), x y z.
    """
    camera = lens.camera

    @recorded
    def kernel(rho: Any, pose: Any, box: Any) -> Any:
        index, px, py = grid(e, Raster.of(camera, _STRIDE))
        at = dr.gather(e.Float, rho, index)
        z, active = depth_of(at)
        xn, yn = pinhole_ray(e, camera, px, py)
        length = dr.sqrt(xn * xn + yn * yn + 1.0)
        M, limits = gather(pose, e.UInt(0), 12), _integers(e, box, 6)
        out = []
        for part in _BAND:
            t = z + part * band_m / length
            p = move(M, (xn * t, yn * t, t))
            block = [_round(e, c * (1.0 / voxel_m)) >> 3 for c in p]
            entry, inside = _entry(e, block, limits)
            out.append((entry, active & inside))
        return out

    return kernel


def integrate(
    e: Engine, lens: Lens, voxel_m: float, truncation_m: float, rho: Any, scale: Any, image_weight: Any, image: Any,
    slots: Any, corners: list[Any], turn: list[Any], sums: list[Any],
) -> None:  # fmt: skip
    """Add one depth image to the sums of the blocks listed, in place.

    slots (n,): where their values begin; corners 3 × (n,): their first lattice points in the camera's frame (m); turn
    (9): R_cam_world, numbers on the device. image_weight: an image of weights or None; image: red, green, blue, weight,
    or none. sums: Σ w d, Σ w, and with colour Σ w red, Σ w green, Σ w blue, Σ w.

    Not `recorded`, which would copy the whole volume; and sums instead of means, because reading what is
    written to would copy it too. No two threads add to the same place, so the order does not matter.
    """
    camera = lens.camera
    i = dr.arange(e.UInt, POINTS * dr.width(slots))
    entry, local = i >> 9, i & (POINTS - 1)
    index = dr.gather(e.UInt, slots, entry) * POINTS + local
    inner = [e.Float(part) * voxel_m for part in (local & 7, (local >> 3) & 7, local >> 6)]
    q = []
    for row, corner in enumerate(corners):
        along = dr.fma(turn[3 * row + 1], inner[1], turn[3 * row + 2] * inner[2])
        q.append(dr.gather(e.Float, corner, entry) + dr.fma(turn[3 * row], inner[0], along))
    at = project(camera, (q[0], q[1], q[2]))
    value, active = surface(e, camera, rho, at.x, at.y, at.valid)
    pixel = nearest(e, camera.width, at.x, at.y, active)
    reach = dr.gather(e.Float, scale, pixel, active)
    distance = (1.0 - q[2] * value) * reach
    active &= (reach > 0.0) & (distance > -truncation_m)
    facing = dr.minimum(reach * value * dr.rsqrt(at.xn * at.xn + at.yn * at.yn + 1.0), 1.0)
    if image_weight is None:
        off = dr.rcp(dr.select(active, value, 1.0)) - _NOISE[2]
        ratio = (_NOISE[0] + _NOISE[1] * (1.0 - _NOISE[2]) ** 2) / (_NOISE[0] + _NOISE[1] * off * off)
        measured = dr.minimum(ratio * ratio, _HEAVIEST)
    else:
        measured = dr.gather(e.Float, image_weight, pixel, active)
    # What lies behind the surface is a guess, and where things are thin it belongs to the other side.
    guess = dr.clip((distance + truncation_m) / (truncation_m - voxel_m), 0.0, 1.0)
    weight = measured * facing * guess
    active &= weight > 0.0
    _add(sums[0], weight * dr.minimum(distance / truncation_m, 1.0), index, active)
    _add(sums[1], weight, index, active)
    if image:
        active &= dr.abs(distance) < _COLORED * voxel_m
        weight = weight * dr.gather(e.Float, image[3], pixel, active)
        for plane, total in zip(image[:3], sums[2:5], strict=True):
            _add(total, weight * dr.gather(e.Float, plane, pixel, active), index, active)
        _add(sums[5], weight, index, active)
    dr.eval(*sums)


def raycast_kernel(e: Engine, lens: Lens, voxel_m: float, truncation_m: float) -> Callable[..., Any]:
    """Kernel (T_world_cam (12), box (6), near (m), directory, sums) → inverse depth.

    Empty blocks are jumped over, seen ones stepped through by what the distance allows; where it changes from in
    front to behind, the zero of the trilinear interpolation is found by secants. 0 where there is none.
    """
    camera = lens.camera
    per_t = truncation_m / voxel_m

    @recorded
    def kernel(pose: Any, box: Any, near: Any, directory: Any, sums: Any) -> Any:
        _, px, py = grid(e, Raster.of(camera))
        xn, yn = pinhole_ray(e, camera, px, py)
        M, limits = gather(pose, e.UInt(0), 12), _integers(e, box, 6)
        length = dr.sqrt(xn * xn + yn * yn + 1.0) * (1.0 / voxel_m)
        origin = tuple(c * (1.0 / voxel_m) for c in M[9:12])
        way = [(M[3 * i] * xn + M[3 * i + 1] * yn + M[3 * i + 2]) * (1.0 / voxel_m) for i in range(3)]
        way = [dr.select(dr.abs(d) < 1e-6, 1e-6, d) for d in way]
        # Within the directory's box.
        first, last = dr.gather(e.Float, near, e.UInt(0)), e.Float(dr.inf)
        for i in range(3):
            low = (e.Float(limits[i] * BLOCK) - 0.5 - origin[i]) / way[i]
            high = (e.Float((limits[i] + limits[3 + i]) * BLOCK) - 0.5 - origin[i]) / way[i]
            first, last = dr.maximum(first, dr.minimum(low, high)), dr.minimum(last, dr.maximum(low, high))
        first = first + 0.01 / length

        def at(t: Any) -> Vector:
            return dr.fma(way[0], t, origin[0]), dr.fma(way[1], t, origin[1]), dr.fma(way[2], t, origin[2])

        def going(t: Any, hit: Any, front: Any, steps: Any) -> Any:
            return ~hit & (t < last) & (steps < _MOST_STEPS)

        def step(t: Any, hit: Any, front: Any, steps: Any) -> Any:
            cell = [_round(e, c) for c in at(t)]
            index, there = _find(e, directory, cell, limits)
            weight = dr.gather(e.Float, sums[1], index, there)
            seen = weight > 0.0
            value = dr.gather(e.Float, sums[0], index, seen) / dr.select(seen, weight, 1.0)
            hit = seen & (value <= 0.0) & front
            leave = e.Float(dr.inf)
            for i in range(3):
                corner = e.Float((cell[i] >> 3) << 3) - 0.5
                leave = dr.minimum(leave, (dr.select(way[i] > 0.0, corner + BLOCK, corner) - origin[i]) / way[i])
            jump = dr.maximum(leave - t, 0.0) + 0.02 / length
            walk = dr.maximum(dr.select(seen, value * per_t - 1.0, 0.5), 0.5) / length
            t = dr.select(hit, t, t + dr.select(there, walk, jump))
            return t, hit, seen & (value > 0.0), steps + 1

        state = (first, e.Bool(False), e.Bool(False), dr.zeros(e.UInt, dr.width(first)))
        start, hit, _, _ = dr.while_loop(state, going, step, labels=("t", "hit", "front", "steps"))

        def trilinear(t: Any, active: Any) -> tuple[Any, Any]:
            return _distance(e, directory, sums, limits, at(t), active)

        f0, known = trilinear(start, hit)
        t0, t1 = start, start + dr.select(known, dr.clip(f0 * per_t, -2.0, 2.0), 0.0) / length
        f1, good = trilinear(t1, known)
        known &= good
        for _ in range(_SECANT_STEPS):
            slope = f1 - f0
            move_by = dr.select(dr.abs(slope) > 1e-6, -f1 * (t1 - t0) / slope, 0.0)
            t0, f0 = t1, f1
            t1 = t1 + dr.clip(move_by, -2.0 / length, 2.0 / length)
            f1, good = trilinear(t1, known)
            known &= good
        known &= (dr.abs(f1) * per_t < _HIT) & (dr.abs(t1 - start) * length < 4.0) & (t1 > 0.0)
        return dr.select(known, dr.rcp(dr.select(known, t1, 1.0)), 0.0)

    return kernel


# ---------------------------------------------------------------------------------------------------------------------


def _add(total: Any, value: Any, index: Any, active: Any) -> None:
    dr.scatter_reduce(dr.ReduceOp.Add, total, value, index, active, mode=dr.ReduceMode.NoConflicts)


def _integers(e: Engine, table: Any, count: int) -> list[Any]:
    return [e.Int(dr.gather(e.Float, table, e.UInt(i))) for i in range(count)]


def _round(e: Engine, c: Any) -> Any:
    return e.Int(dr.floor(c + 0.5))


def _entry(e: Engine, block: list[Any], limits: list[Any]) -> tuple[Any, Any]:
    """The directory's entry of a block, and whether it has one."""
    bx, by, bz = (c - low for c, low in zip(block, limits[:3], strict=True))
    nx, ny, nz = limits[3:]
    inside = (bx >= 0) & (by >= 0) & (bz >= 0) & (bx < nx) & (by < ny) & (bz < nz)
    return e.UInt(dr.select(inside, (bz * ny + by) * nx + bx, 0)), inside


def _find(e: Engine, directory: Any, cell: list[Any], limits: list[Any]) -> tuple[Any, Any]:
    """Index of a lattice point's values, and whether its block is there."""
    entry, inside = _entry(e, [c >> 3 for c in cell], limits)
    slot = dr.gather(e.Int, directory, entry, inside)
    there = inside & (slot >= 0)
    local = ((cell[2] & 7) << 6) | ((cell[1] & 7) << 3) | (cell[0] & 7)
    return e.UInt(dr.select(there, slot * POINTS + local, 0)), there


def _distance(e: Engine, directory: Any, sums: Any, limits: list[Any], p: Vector, active: Any) -> tuple[Any, Any]:
    """Trilinear distance at lattice coordinates p, and where all eight lattice points around have been seen."""
    low = [dr.floor(c) for c in p]
    part = [c - f for c, f in zip(p, low, strict=True)]
    base, out = [e.Int(f) for f in low], e.Float(0.0)
    for high in product((0, 1), repeat=3):
        share = e.Float(1.0)
        for f, up in zip(part, high, strict=True):
            share = share * (f if up else 1.0 - f)
        index, there = _find(e, directory, [b + up for b, up in zip(base, high, strict=True)], limits)
        weight = dr.gather(e.Float, sums[1], index, there & active)
        active = active & there & (weight > 0.0)
        out += share * dr.gather(e.Float, sums[0], index, active) / dr.select(active, weight, 1.0)
    return out, active
