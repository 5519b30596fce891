"""Sums over the pixels of blocks of lines: what a dense residual comes to, in integers, the same on every run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.device.lens import Lens
from rsgen.device.projection import Vector, cross
from rstrack.alignment.student_t import cost, curvature, weight

# Lines that share one linearisation by the control points (DESIGN section 5: eight lose nothing).
LINES_PER_BLOCK = 8
# Blocks of an unrectified reference are larger: it is bootstrapping only, and pairs of blocks are many.
LINES_PER_PAIR_BLOCK = 32
# Integers per block: 21 of H (upper triangle), 6 of g, sum of w s², cost, count, and padding to a power of two.
_SLOTS = 32
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
    """Fixed-point units: rotations are divided by `median_depth` (m), so that j's parts are alike.

    |j| is bounded by `bound` and a block holds at most `capacity` pixels.
    """

    median_depth: float
    bound: float
    capacity: int

    def parameters(self, sigma: float, gate: float) -> FloatArray:
        """What a kernel takes: 1/σ, gate (in units of r), 1/median_depth, bound, units of H, of g, of the cost sums."""
        room = 2.0**30 / self.capacity
        # The largest weight is 1.2, the largest w |s| 1.35. The cost passes 16 at |s| = 32 but twice that only at 460.
        units = room / (1.2 * self.bound**2), room / (1.4 * self.bound), room / 16.0
        return np.array([1 / sigma, gate, 1 / self.median_depth, self.bound, *units])

    def unpack(self, raw: FloatArray, current: int, reference: int) -> BlockSums:
        """Integers as summed on the device to `BlockSums`."""
        raw = raw.reshape(current, reference, _SLOTS)
        _, _, _, _, unit_H, unit_g, unit_cost = self.parameters(1.0, 0.0)
        scale = np.array([1.0, 1.0, 1.0, self.median_depth, self.median_depth, self.median_depth])
        H = np.empty((current, reference, 6, 6))
        a, b = _UPPER
        H[..., a, b] = H[..., b, a] = raw[..., :21] * (scale[a] * scale[b] / unit_H)
        g = raw[..., 21:27] * (scale / unit_g)
        total = raw[..., 27:30].astype(np.int64).sum(axis=(0, 1))
        return BlockSums(H, g, float(total[0] / unit_cost), float(total[1] / unit_cost), int(total[2]))


def block_counts(lens: Lens, ref_lens: Lens) -> tuple[int, int, int, int]:
    """Blocks of current lines and of reference lines (1 if rectified), and lines per block of each."""
    if ref_lens.lines == 1:
        return -(-lens.lines // LINES_PER_BLOCK), 1, LINES_PER_BLOCK, 1
    per = LINES_PER_PAIR_BLOCK
    return -(-lens.lines // per), -(-ref_lens.lines // per), per, per


def block_slot(line: Any, ref_line: Any, lens: Lens, ref_lens: Lens) -> tuple[Any, int]:
    """First integer of each pixel's block, or pair of blocks, and how many there are."""
    current, reference, per, ref_per = block_counts(lens, ref_lens)
    block = line // per if reference == 1 else line // per * reference + ref_line // ref_per
    return block * _SLOTS, current * reference


def accumulate(
    e: Engine, g: Vector, p: Vector, sign: float, r: Any, active: Any, parameters: list[Any], slot: Any, size: int
) -> Any:
    """Σ w j jᵀ and so on into `size` integers; j = sign [g, p × g]."""
    inv_sigma, gate, inv_lever, bound, unit_H, unit_g, unit_cost = parameters
    active &= dr.abs(r) < gate
    j = [*g, *cross((p[0] * inv_lever, p[1] * inv_lever, p[2] * inv_lever), g)]
    norm2 = dr.maximum(j[0] * j[0] + j[1] * j[1] + j[2] * j[2], j[3] * j[3] + j[4] * j[4] + j[5] * j[5])
    active &= dr.isfinite(norm2) & dr.isfinite(r)
    s = dr.select(active, r * inv_sigma, 0.0)
    w = weight(s)
    # The bound keeps the integers from overflowing; it is chosen so that only outliers reach it.
    w = dr.select(active, w * dr.minimum(1.0, bound * bound * dr.rcp(dr.maximum(norm2, 1e-12))), 0.0)
    j = [dr.select(active, c, 0.0) for c in j]
    wj = [w * c for c in j]
    h = unit_H * curvature(s)
    hj = [h * c for c in wj]
    values = [hj[a] * j[b] for a, b in zip(*_UPPER, strict=True)]
    values += [c * s * (sign * unit_g) for c in wj]
    values += [w * s * s * unit_cost, cost(s) * unit_cost]
    sums = dr.zeros(e.Int, size * _SLOTS)
    for k, value in enumerate(values):
        dr.scatter_reduce(dr.ReduceOp.Add, sums, e.Int(dr.round(value)), slot + k, active, mode=dr.ReduceMode.Expand)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, e.Int(1), slot + len(values), active, mode=dr.ReduceMode.Expand)
    return sums
