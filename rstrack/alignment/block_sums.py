"""Sums over the pixels of blocks of lines: the parts of equation (12)'s normal equations that come from the device.

They are integers (`Scaling`), which add up to the same in any order, so that every run gives the same bits. A kernel
that adds every pixel's integers to memory spends more than half of its time on that. Neighbours mostly fall into the
same block of lines, so each lane goes along a run of pixels, adds up in registers, and writes only where its run leaves
a block, and at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.device.arrays import Engine, Numbers, quotient
from rsgen.device.lens import Lens
from rsgen.device.projection import Vector, cross
from rstrack.alignment.weights import cost, curvature, weight
from rstrack.compiled import compiled

# Blocks of lines that share one linearisation by the control points: half of a millisecond (eight of 480 lines lose
# nothing).
BLOCKS = 60
# Those of an unrectified reference are larger: it is bootstrapping only, and pairs of blocks are many.
PAIR_BLOCKS = 15
# Integers per block: 21 of H (upper triangle), 6 of g, sum of w s², cost, count, compared; with n further columns 6 n
# of the coupling, n (n + 1) / 2 of their own H and n of their g more; and padding.
_SLOTS, _PAD = 31, 16
_UPPER = np.triu_indices(6)
# What the number of blocks is rounded up to a multiple of, see `room`.
_SPARE_BLOCKS = 64
# Lanes that keep all cores of a CPU busy, and longest run: a longer one gains nothing.
_LANES, _LONGEST = 1024, 40
# No block: nothing has been added yet.
_NONE = 0xFFFFFFFF


@dataclass(frozen=True)
class ColumnSums:
    """Sums with c, the derivatives of r by n further unknowns, such as a colour image's gain and offset.

    coupling (nc, nr, 6, n) = Σ w j cᵀ, H (n, n) = Σ w c cᵀ and g (n,) = Σ w c s over all blocks.
    """

    coupling: FloatArray
    H: FloatArray
    g: FloatArray


@dataclass(frozen=True)
class BlockSums:
    """Sums over pixels: for each block of current lines (and of reference lines, 1 if rectified).

    H (nc, nr, 6, 6) = Σ w j jᵀ, g (nc, nr, 6) = Σ w j s with s = r / σ and j the derivative of r by the twist
    [m; rad] in the base frame; `weighted` = Σ w s², `cost` = Σ (ν+1)/2 log(1 + s²/ν), `count` of pixels, of
    the `compared` ones that have a counterpart, be it beyond the gate.
    """

    H: FloatArray
    g: FloatArray
    weighted: float
    cost: float
    count: int
    compared: int = 0
    columns: ColumnSums | None = None

    def summed(self) -> BlockSums:
        """The same of all current lines at once."""
        own = self.columns
        if own is not None:
            own = replace(own, coupling=own.coupling.sum(axis=0, keepdims=True))
        H, g = self.H.sum(axis=0, keepdims=True), self.g.sum(axis=0, keepdims=True)
        return replace(self, H=H, g=g, columns=own)


@dataclass(frozen=True)
class Scaling:
    """Fixed-point units: rotations are divided by `median_depth` (m), so that j's parts are alike.

    |j| is bounded by `bound` and a block holds at most `capacity` pixels.
    """

    median_depth: float
    bound: float
    capacity: int

    @property
    def units(self) -> tuple[float, float, float]:
        """Of H, of g and of the cost sums."""
        room = 2.0**30 / self.capacity
        # The largest weight is 1.2, the largest w |s| 1.35. The cost passes 16 at |s| = 32 but twice that only at 460.
        return room / (1.2 * self.bound**2), room / (1.4 * self.bound), room / 16.0

    def parameters(self, sigma: float, gate: float, *more: float) -> FloatArray:
        """What a kernel takes: 1/σ, gate (in units of r), 1/median_depth, bound, the units, and more of its own."""
        return np.array([1 / sigma, gate, 1 / self.median_depth, self.bound, *self.units, *more])

    def unpack(self, raw: IntArray, current: int, reference: int, columns: int = 0) -> BlockSums:
        """Integers as summed on the device, with so many further columns, to `BlockSums`; what follows is spare."""
        used = raw.ravel()[: current * reference * _slots(columns)].reshape(current, reference, -1)
        H, g, totals, own, coupling = _unpacked(used, self.median_depth, self.bound, self.units, columns)
        weighted, cost, count, compared = totals.tolist()
        unit_H, unit_g, unit_cost = self.units
        more = None
        if columns:
            # c is summed in units of `bound`, so that the same units serve.
            own_H, own_g = own[:-columns], own[-columns:]
            full = np.empty((columns, columns))
            a, b = np.triu_indices(columns)
            full[a, b] = full[b, a] = own_H / (unit_H * self.bound**2)
            more = ColumnSums(coupling, full, own_g / (unit_g * self.bound))
        return BlockSums(H, g, weighted / unit_cost, cost / unit_cost, count, compared, more)


@compiled
def _unpacked(raw: Any, median_depth: Any, bound: Any, units: Any, n: Any) -> Any:
    """H, g and coupling of each block, and the sums over blocks of what follows g and of what follows the coupling."""
    blocks, others, _ = raw.shape
    unit_H, unit_g, _ = units
    H, g = np.empty((blocks, others, 6, 6)), np.empty((blocks, others, 6))
    coupling = np.empty((blocks, others, 6, n))
    totals, own = np.zeros(4, np.int64), np.zeros(n * (n + 1) // 2 + n, np.int64)
    scale = np.ones(6)
    scale[3:] = median_depth
    for b in range(blocks):
        for r in range(others):
            one = raw[b, r]
            k = 0
            for i in range(6):
                for j in range(i, 6):
                    H[b, r, i, j] = H[b, r, j, i] = one[k] * (scale[i] * scale[j] / unit_H)
                    k += 1
            for i in range(6):
                g[b, r, i] = one[k + i] * (scale[i] / unit_g)
            for i in range(4):
                totals[i] += one[k + 6 + i]
            k += 10
            for c in range(n):
                for i in range(6):
                    coupling[b, r, i, c] = one[k + 6 * c + i] * (scale[i] / (unit_H * bound))
            k += 6 * n
            for i in range(len(own)):
                own[i] += one[k + i]
    return H, g, totals, own, coupling


def block_counts(lens: Lens, ref_lens: Lens) -> tuple[int, int, int, int]:
    """Blocks of current lines and of reference lines (1 if rectified), and lines per block of each.

    Sums of an image whose lines are exposed at once are separate too: their scatter shows how far its pixels are
    independent (`BlockSums.summed` is what they come to).
    """
    blocks = PAIR_BLOCKS if ref_lens.rolls else BLOCKS
    lines = lens.camera.height if _is_global(lens, ref_lens) else lens.lines
    per, ref_per = max(1, lines // blocks), max(1, ref_lens.lines // blocks)
    return -(-lines // per), -(-ref_lens.lines // ref_per), per, ref_per


def _is_global(lens: Lens, ref_lens: Lens) -> bool:
    return not lens.rolls and not ref_lens.rolls


@dataclass(frozen=True)
class Blocks(Numbers):
    """Blocks of an image's lines and of a reference's.

    reference: how many the latter has. per, ref_per: lines of a block. last_row: of the image.
    rows: whether a pixel's own row counts, since all lines are exposed at once; pairs: whether the reference has more
    than one block.
    """

    COMPILED: ClassVar[tuple[str, ...]] = ("rows", "pairs")

    reference: int
    per: int
    ref_per: int
    last_row: int
    rows: bool
    pairs: bool

    @classmethod
    def of(cls, lens: Lens, ref_lens: Lens) -> Blocks:
        """Of images of these lenses."""
        _, reference, per, ref_per = block_counts(lens, ref_lens)
        rows, last_row = _is_global(lens, ref_lens), lens.camera.height - 1
        return cls(reference, per, ref_per, last_row, rows, reference > 1)


def block_slot(line: Any, ref_line: Any, blocks: Blocks, y: Any, columns: int = 0) -> Any:
    """First integer of each pixel's block, or pair of blocks.

    columns: further ones, see `ColumnSums`. y: the pixel's own, which is its line where all are exposed at once.
    """
    if blocks.rows:
        line = type(line)(dr.clip(y, 0, blocks.last_row))
    block = quotient(line, blocks.per)
    if blocks.pairs:
        block = block * blocks.reference + quotient(ref_line, blocks.ref_per)
    return block * _slots(columns)


def sizes(lens: Lens, ref_lens: Lens, columns: int = 0) -> tuple[int, int]:
    """How many integers the sums of an image against a reference have in all, and how many each pixel adds to."""
    current, reference, _, _ = block_counts(lens, ref_lens)
    return current * reference * _slots(columns), _values(columns)


def room(lens: Lens, ref_lens: Lens, columns: int = 0) -> tuple[int, int]:
    """`sizes` rounded up to a multiple of 64 blocks: the number is compiled in, and most images have 60 to 64."""
    size, values = sizes(lens, ref_lens, columns)
    spare = _SPARE_BLOCKS * _slots(columns)
    return -(-size // spare) * spare, values


def _values(columns: int) -> int:
    return _SLOTS + 7 * columns + columns * (columns + 1) // 2


def _slots(columns: int) -> int:
    return -(-_values(columns) // _PAD) * _PAD


@dataclass(frozen=True)
class Contribution:
    """What each pixel adds to its block: integers (0 where it adds nothing) from number `slot` on, of those that are
    `compared`."""

    slot: Any
    values: tuple[Any, ...]
    compared: Any


def contribution(
    e: Engine, g: Vector, p: Vector, sign: float, r: Any, active: Any, parameters: list[Any], slot: Any,
    c: Sequence[Any] = (), judged: Any = True, curved: int = 0,
) -> Contribution:  # fmt: skip
    """w j jᵀ and so on of pixels, from `slot` on (`block_slot`); j = sign [g, p × g].

    c: see `ColumnSums`, each at most 1. judged: pixels that σ is estimated from and that are counted; others only add
    to the system and the cost. curved: so many columns, the first, have Newton's curvature as j has: what they share
    with a motion would pass for information if the two had different ones.
    """
    inv_sigma, gate, inv_lever, bound, unit_H, unit_g, unit_cost = parameters
    compared = active & dr.isfinite(r)
    active = compared & (dr.abs(r) < gate)
    j = [*g, *cross((p[0] * inv_lever, p[1] * inv_lever, p[2] * inv_lever), g)]
    norm2 = dr.maximum(j[0] * j[0] + j[1] * j[1] + j[2] * j[2], j[3] * j[3] + j[4] * j[4] + j[5] * j[5])
    active &= dr.isfinite(norm2)
    s = dr.select(active, r * inv_sigma, 0.0)
    w = weight(s)
    # The bound keeps the integers from overflowing; it is chosen so that only outliers reach it.
    w = dr.select(active, w * dr.minimum(1.0, bound * bound * dr.rcp(dr.maximum(norm2, 1e-12))), 0.0)
    j = [dr.select(active, c, 0.0) for c in j]
    wj = [w * c for c in j]
    h = unit_H * curvature(s)
    hj = [h * c for c in wj]
    sums = [hj[a] * j[b] for a, b in zip(*_UPPER, strict=True)]
    sums += [c * s * (sign * unit_g) for c in wj]
    statistics = dr.select(active & judged, w * s * s * unit_cost, 0.0), cost(s) * unit_cost
    counted = [dr.select(which & judged, e.Int(1), e.Int(0)) for which in (active, compared)]
    c = [dr.select(active, bound * column, 0.0) for column in c]
    more = [sign * one * column for column in c for one in hj]
    # The others' own is that of reweighted least squares: Newton's would overshoot a large step of brightness.
    bends = [h * w if k < curved else unit_H * w for k in range(len(c))]
    more += [bends[a] * c[a] * c[b] for a, b in zip(*np.triu_indices(len(c)), strict=True)]
    more += [w * s * unit_g * column for column in c]
    whole = [[e.Int(dr.round(value)) for value in part] for part in ((*sums, *statistics), more)]
    return Contribution(slot, (*whole[0], *counted, *whole[1]), compared)


@dataclass(frozen=True)
class PixelGrid:
    """Some of every stride-th pixel and row of an image: number among these, index in the image, x and y; which are
    meant (others lie beyond the end of a run)."""

    number: Any
    index: Any
    x: Any
    y: Any
    meant: Any


def every(e: Engine, width: int, height: int, stride: int) -> PixelGrid:
    """All of them at once."""
    columns, rows = -(-width // stride), -(-height // stride)
    number = dr.arange(e.UInt, columns * rows)
    return _pixels(width, columns, stride, number - number // columns * columns, number // columns, e.Bool(True))


@dataclass(frozen=True)
class Runs(Numbers):
    """Every stride-th pixel of an image in runs, each of one lane: along its rows, or down its columns.

    width: of the image; columns: of these pixels. along: pixels of a row, or of a column; lanes: that share it. total:
    number of all lanes; alone: whether each has one pixel.
    """

    COMPILED: ClassVar[tuple[str, ...]] = ("total", "down", "alone")

    width: int
    stride: int
    columns: int
    along: int
    lanes: int
    total: int
    down: bool
    alone: bool

    @classmethod
    def over(cls, e: Engine, width: int, height: int, stride: int, down: bool) -> Runs:
        """Of an image of that size."""
        columns, rows = -(-width // stride), -(-height // stride)
        along, across = (rows, columns) if down else (columns, rows)
        lanes = -(-along // _run(e, along, across))
        return cls(width, stride, columns, along, lanes, across * lanes, down, lanes == along)


def summed(e: Engine, runs: Runs, of: tuple[int, int], at: Callable[[PixelGrid], Contribution], is_steady: bool) -> Any:
    """Sums over the pixels of what `at` gives.

    of: see `sizes`. is_steady: no run leaves the block that it begins in.
    """
    size, values_each = of
    lane = dr.arange(e.UInt, runs.total)
    line = quotient(lane, runs.lanes)
    first = lane - line * runs.lanes
    sums = dr.zeros(e.Int, size)

    def add(slot: Any, values: tuple[Any, ...], active: Any) -> None:
        for k, value in enumerate(values):
            dr.scatter_reduce(dr.ReduceOp.Add, sums, value, slot + k, active, mode=dr.ReduceMode.Expand)

    def here(i: Any) -> Contribution:
        # Lanes beside each other read pixels beside each other.
        k = first + i * runs.lanes
        meant, k = k < runs.along, dr.minimum(k, runs.along - 1)
        column, row = (line, k) if runs.down else (k, line)
        return at(_pixels(runs.width, runs.columns, runs.stride, column, row, meant))

    def step(i: Any, slot: Any, total: tuple[Any, ...]) -> tuple[Any, Any, tuple[Any, ...]]:
        found = here(i)
        if is_steady:
            return i + 1, found.slot, _plus(total, found.values)
        now = dr.select(found.compared, found.slot, slot)

        def written(slot: Any, total: tuple[Any, ...]) -> tuple[Any, ...]:
            add(slot, total, True)
            return tuple(e.Int(0) for _ in total)

        left = (now != slot) & (slot != _NONE)
        total = dr.if_stmt((slot, total), left, written, lambda _, total: total)
        return i + 1, now, _plus(total, found.values)

    if runs.alone:
        found = here(e.UInt(0))
        add(found.slot, found.values, found.compared)
        return sums
    nothing = tuple(dr.zeros(e.Int, runs.total) for _ in range(values_each))
    start = e.UInt(0), dr.full(e.UInt, _NONE, runs.total), nothing
    _, slot, total = dr.while_loop(start, lambda i, *_: i * runs.lanes < runs.along, step)
    add(slot, total, slot != _NONE)
    return sums


def _run(e: Engine, along: int, across: int) -> int:
    """Pixels that one lane goes through: a GPU needs far more lanes than it has images' rows."""
    return 1 if e.backend == "cuda" else max(1, min(_LONGEST, along * across // _LANES))


def _plus(total: tuple[Any, ...], more: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(a + b for a, b in zip(total, more, strict=True))


def _pixels(width: int, columns: int, stride: int, column: Any, row: Any, meant: Any) -> PixelGrid:
    x, y = column * stride, row * stride
    return PixelGrid(row * columns + column, y * width + x, x, y, meant)
