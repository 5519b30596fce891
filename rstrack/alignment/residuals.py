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

from rsgen.device.arrays import Engine
from rsgen.device.projection import TO_BASE, Lens, Vector, cross, gather, move, project_rolling
from rsgen.device.recording import recorded
from rsgen.geometry.so3 import FloatArray
from rstrack.alignment.student_t import NU
from rstrack.images.sampling import EDGE, NEAREST, bilinear, grid, level_size, nearest, surface

# Lines that share one linearisation by the control points (DESIGN section 5: eight lose nothing).
LINES_PER_BLOCK = 8
# Blocks of an unrectified reference are larger: it is bootstrapping only, and pairs of blocks are many.
LINES_PER_PAIR_BLOCK = 32
# Integers per block: 21 of H (upper triangle), 6 of g, sum of w s², cost, count, and padding to a power of two.
_SLOTS = 32
# Metres that a point has to lie behind what is seen there to count as hidden, beside EDGE of its depth.
_BEHIND = 0.02
# Share of a pixel's weight that its curvature keeps at least.
_CURVATURE = 0.5
_UPPER = np.triu_indices(6)


@dataclass(frozen=True)
class BlockSums:
    """Sums over pixels: for each block of current lines (and of reference lines, 1 if rectified).

    H (nc, nr, 6, 6) = Σ w j jᵀ, g (nc, nr, 6) = Σ w j s with s = r / σ and j the derivative of r by the twist
    [m; rad] in the base frame; `weighted` = Σ w s², `cost` = Σ (ν+1)/2 log(1 + s²/ν), `count` of pixels (all blocks).
    """

    H: FloatArray
    g: FloatArray
    weighted: float
    cost: float
    count: int


@dataclass(frozen=True)
class Scaling:
    """Fixed-point units: rotations are divided by `lever` (m), so that j's parts are alike; |j| is bounded by `bound`
    and a block holds at most `capacity` pixels."""

    lever: float
    bound: float
    capacity: int

    def parameters(self, sigma: float, gate: float) -> FloatArray:
        """What a kernel takes: 1/σ, gate (in units of r), 1/lever, bound, units of H, of g, of the cost sums."""
        room = 2.0**30 / self.capacity
        # The largest weight is 1.2, the largest w |s| 1.35. The cost passes 16 at |s| = 32 but twice that only at 460.
        units = room / (1.2 * self.bound**2), room / (1.4 * self.bound), room / 16.0
        return np.array([1 / sigma, gate, 1 / self.lever, self.bound, *units])

    def unpack(self, raw: FloatArray, current: int, reference: int) -> BlockSums:
        """Integers as summed on the device to `BlockSums`."""
        raw = raw.reshape(current, reference, _SLOTS)
        _, _, _, _, unit_H, unit_g, unit_cost = self.parameters(1.0, 0.0)
        scale = np.array([1.0, 1.0, 1.0, self.lever, self.lever, self.lever])
        H = np.empty((current, reference, 6, 6))
        a, b = _UPPER
        H[..., a, b] = H[..., b, a] = raw[..., :21] * (scale[a] * scale[b] / unit_H)
        g = raw[..., 21:27] * (scale / unit_g)
        total = raw[..., 27:30].astype(np.int64).sum(axis=(0, 1))
        return BlockSums(H, g, float(total[0] / unit_cost), float(total[1] / unit_cost), int(total[2]))


def _accumulate(
    e: Engine, g: Vector, p: Vector, sign: float, r: Any, active: Any, parameters: list[Any], slot: Any, size: int
) -> Any:
    """Σ w j jᵀ and so on into `size` integers; j = sign [g, p × g]."""
    inv_sigma, gate, inv_lever, bound, unit_H, unit_g, unit_cost = parameters
    active &= dr.abs(r) < gate
    j = [*g, *cross((p[0] * inv_lever, p[1] * inv_lever, p[2] * inv_lever), g)]
    norm2 = dr.maximum(j[0] * j[0] + j[1] * j[1] + j[2] * j[2], j[3] * j[3] + j[4] * j[4] + j[5] * j[5])
    active &= dr.isfinite(norm2) & dr.isfinite(r)
    s = dr.select(active, r * inv_sigma, 0.0)
    w = (NU + 1.0) / (NU + s * s)
    # The bound keeps the integers from overflowing; it is chosen so that only outliers reach it.
    w = dr.select(active, w * dr.minimum(1.0, bound * bound * dr.rcp(dr.maximum(norm2, 1e-12))), 0.0)
    j = [dr.select(active, c, 0.0) for c in j]
    wj = [w * c for c in j]
    # Newton's weight rather than that of reweighted least squares, which converges only linearly; kept positive.
    h = unit_H * dr.maximum((NU - s * s) / (NU + s * s), _CURVATURE)
    hj = [h * c for c in wj]
    values = [hj[a] * j[b] for a, b in zip(*_UPPER, strict=True)]
    values += [c * s * (sign * unit_g) for c in wj]
    values += [w * s * s * unit_cost, (0.5 * (NU + 1.0)) * dr.log(1.0 + s * s * (1.0 / NU)) * unit_cost]
    sums = dr.zeros(e.Int, size * _SLOTS)
    for k, value in enumerate(values):
        dr.scatter_reduce(dr.ReduceOp.Add, sums, e.Int(dr.round(value)), slot + k, active, mode=dr.ReduceMode.Expand)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, e.Int(1), slot + len(values), active, mode=dr.ReduceMode.Expand)
    return sums


def block_counts(lens: Lens, ref_lens: Lens) -> tuple[int, int, int, int]:
    """Blocks of current lines and of reference lines (1 if rectified), and lines per block of each."""
    if ref_lens.lines == 1:
        return -(-lens.lines // LINES_PER_BLOCK), 1, LINES_PER_BLOCK, 1
    per = LINES_PER_PAIR_BLOCK
    return -(-lens.lines // per), -(-ref_lens.lines // per), per, per


def _slot(line: Any, ref_line: Any, lens: Lens, ref_lens: Lens) -> tuple[Any, int]:
    """First integer of each pixel's block, or pair of blocks, and how many there are."""
    current, reference, per, ref_per = block_counts(lens, ref_lens)
    block = line // per if reference == 1 else line // per * reference + ref_line // ref_per
    return block * _SLOTS, current * reference


def _line_index(e: Engine, lens: Lens, x: Any, y: Any) -> Any:
    return e.UInt(0) if lens.lines == 1 else e.UInt(lens.line_of(e.Int(x), e.Int(y)))


def geometric_kernel(e: Engine, lens: Lens, ref_lens: Lens, stride: int) -> Callable[..., Any]:
    """Kernel (depth, rays_x, rays_y, to_base, inverse_depth, slope_x, slope_y, roughness, from_base, parameters) →
    integers.

    `parameters`: those of `Scaling`, and the roughness (m) from which on a pixel of the reference is left out.
    `lens`: current depth camera. `ref_lens`: the reference's camera; global shutter if it is rectified, and then
    `from_base` is not looked at (the base frame is the reference's). `slope_*`: gradient of the reference's inverse
    depth by normalised coordinates, smoothed: it gives normals, while the residual takes inverse depth as it is.
    """
    camera = lens.camera
    ref = ref_lens.camera

    @recorded
    def kernel(
        depth: Any, rays_x: Any, rays_y: Any, to_base: Any, rho: Any, slope_x: Any, slope_y: Any, roughness: Any,
        from_base: Any, constants: Any,
    ) -> Any:  # fmt: skip
        parameters = [dr.gather(e.Float, constants, e.UInt(i)) for i in range(7)]
        index, px, py = grid(e, camera.width, camera.height, stride)
        z = dr.gather(e.Float, depth, index)
        active = z > 0.0
        # Errors of depth grow with its square, in triangulating cameras and by interpolation: one σ serves all depths.
        even = dr.minimum(dr.square(dr.rcp(dr.maximum(z * parameters[2], 1e-3))), NEAREST)
        q = dr.gather(e.Float, rays_x, index) * z, dr.gather(e.Float, rays_y, index) * z, z
        line = _line_index(e, lens, px, py)
        p = move(gather(to_base, line, TO_BASE, stride=TO_BASE), q)
        seen = project_rolling(ref_lens, from_base, p, e.UInt, e.Int)
        value, active = surface(e, ref, rho, seen.x, seen.y, active & seen.valid)
        at = nearest(e, ref.width, seen.x, seen.y, active)
        mx, my = dr.gather(e.Float, slope_x, at, active), dr.gather(e.Float, slope_y, at, active)
        active &= dr.gather(e.Float, roughness, at, active) < dr.gather(e.Float, constants, e.UInt(7))
        # The plane m·q = 1 through the pixel; |m| is one over its distance.
        mz = value - mx * seen.at.xn - my * seen.at.yn
        inv_m = even * dr.rsqrt(mx * mx + my * my + mz * mz)
        r = (1.0 - seen.z * value) * inv_m
        scale = -seen.z * inv_m
        g = seen.chain(scale * mx / ref.fx, scale * my / ref.fy, -value * inv_m)
        slot, size = _slot(line, seen.row, lens, ref_lens)
        return _accumulate(e, g, p, 1.0, r, active, parameters, slot, size)

    return kernel


def blur_weight(lens: Lens, pixel_speed: tuple[Any, Any], sigma_px: float) -> Any:
    """Equation (13): exp(−‖x_t − x_{t−t_e}‖ / σ²) of points that move by pixel_speed (px) per line delay."""
    lines = lens.shutter.exposure_s / lens.shutter.line_delay(lens.camera)
    u, v = pixel_speed
    return dr.exp(-dr.sqrt(u * u + v * v) * (lines / sigma_px**2))


def photometric_kernel(
    e: Engine, lens: Lens, ref_lens: Lens, stride: int, level: int, blur_sigma_px: float = 0.0
) -> Callable[..., Any]:
    """Kernel (points_x, _y, _z, intensity, visible, to_base, image, from_base, parameters) → integers.

    Points are those of the reference's every stride-th pixel, in its camera's frame, z = 0 where there is none.
    `to_base` are the reference's lines (looked at only if it is not rectified), `from_base` the colour camera's.
    `image`: intensities of pyramid level `level` (halved that often); `visible` 0 for points that are hidden.
    `blur_sigma_px`: σ of equation (13), by which blurred points count less; 0: all alike.
    """
    weighs_blur = blur_sigma_px > 0.0 and lens.lines > 1 and lens.shutter.exposure_s > 0.0
    camera, ref = lens.camera, ref_lens.camera
    width, height = level_size(camera.width, level), level_size(camera.height, level)
    shrink = 0.5**level

    @recorded
    def kernel(
        points_x: Any, points_y: Any, points_z: Any, intensity: Any, visible: Any, to_base: Any, image: Any,
        from_base: Any, constants: Any,
    ) -> Any:  # fmt: skip
        parameters = [dr.gather(e.Float, constants, e.UInt(i)) for i in range(7)]
        p = points_x, points_y, points_z
        active = (points_z > 0.0) & (visible > 0.5)
        _, x, y = grid(e, ref.width, ref.height, stride)
        ref_line = _line_index(e, ref_lens, x, y)
        if ref_lens.lines > 1:
            p = move(gather(to_base, ref_line, TO_BASE, stride=TO_BASE), p)
        seen = project_rolling(lens, from_base, p, e.UInt, e.Int)
        u, v = seen.x * shrink, seen.y * shrink
        a, b, c, d, fx, fy, active = bilinear(e, image, width, height, u, v, active & seen.valid)
        top, bottom = dr.fma(b - a, fx, a), dr.fma(d - c, fx, c)
        r = dr.fma(bottom - top, fy, top) - intensity
        dx = dr.fma((d - c) - (b - a), fy, b - a) * shrink
        dy = (bottom - top) * shrink
        if weighs_blur:
            # Of the squared error, so that σ stays that of sharp points.
            share = dr.sqrt(blur_weight(lens, seen.pixel_speed, blur_sigma_px))
            r, dx, dy = r * share, dx * share, dy * share
        g = seen.chain(dx, dy, 0.0)
        slot, size = _slot(seen.row, ref_line, lens, ref_lens)
        # A twist of the camera moves the point the other way.
        return _accumulate(e, g, p, -1.0, r, active, parameters, slot, size)

    return kernel


def visibility_kernel(e: Engine, lens: Lens, ref_lens: Lens, stride: int) -> Callable[..., Any]:
    """Kernel (points_x, _y, _z, to_base, depth, from_base) → 1 for points that a depth image does not hide, else 0.

    Points as in `photometric_kernel`. The depth image, whose lines have their own poses in `from_base`, need not be
    taken at the colour image's time: what hides a point hides it a few milliseconds later. Unknown counts as visible.
    """
    camera, ref = lens.camera, ref_lens.camera

    @recorded
    def kernel(points_x: Any, points_y: Any, points_z: Any, to_base: Any, depth: Any, from_base: Any) -> Any:
        p = points_x, points_y, points_z
        if ref_lens.lines > 1:
            _, x, y = grid(e, ref.width, ref.height, stride)
            p = move(gather(to_base, _line_index(e, ref_lens, x, y), TO_BASE, stride=TO_BASE), p)
        seen = project_rolling(lens, from_base, p, e.UInt, e.Int)
        inside = seen.valid & (points_z > 0.0)
        inside &= (seen.x >= 0.0) & (seen.y >= 0.0) & (seen.x < camera.width - 1.0) & (seen.y < camera.height - 1.0)
        index = nearest(e, camera.width, seen.x, seen.y, inside)
        z = dr.gather(e.Float, depth, index, inside)
        hidden = inside & (z > 0.0) & (seen.z > z * (1.0 + EDGE) + _BEHIND)
        return dr.select(hidden, e.Float(0.0), e.Float(1.0))

    return kernel
