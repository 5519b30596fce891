"""Sums over an image's pixels on the device: each lane goes along a run of them and adds up in registers.

A kernel that adds every pixel's integers to memory spends more than half of its time on that. Neighbours mostly fall
into the same block of lines, so a lane writes only where its run leaves a block, and at its end. Integers add up to the
same in any order: the bits do not depend on how runs are laid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from rsgen.device.arrays import Engine
from rstrack.alignment.block_sums import Contribution, Layout

# Lanes that keep all cores of a CPU busy, and longest run: a longer one gains nothing.
_LANES, _LONGEST = 1024, 40
# No block: nothing has been added yet.
_NONE = 0xFFFFFFFF


@dataclass(frozen=True)
class Pixels:
    """Every stride-th pixel of every stride-th row of an image, or some of them: their number among those, their index
    in the whole image, x and y, and which are meant (the others lie beyond the end of a run)."""

    number: Any
    index: Any
    x: Any
    y: Any
    meant: Any


def every(e: Engine, width: int, height: int, stride: int) -> Pixels:
    """All of them at once."""
    columns, rows = -(-width // stride), -(-height // stride)
    number = dr.arange(e.UInt, columns * rows)
    return _pixels(width, columns, stride, number - number // columns * columns, number // columns, e.Bool(True))


def summed(
    e: Engine,
    shape: tuple[int, int, int],
    of: Layout,
    at: Callable[[Pixels], Contribution],
    down: bool,
    is_steady: bool,
) -> Any:
    """Sums (of.size,) over every stride-th pixel of an image, shape = width, height, stride, of what `at` gives.

    down: runs go down columns, not along rows. is_steady: no run leaves the block that it begins in.
    """
    width, height, stride = shape
    columns, rows = -(-width // stride), -(-height // stride)
    along, across = (rows, columns) if down else (columns, rows)
    lanes = -(-along // _run(e, along, across))
    lane = dr.arange(e.UInt, across * lanes)
    line = lane // lanes
    first = lane - line * lanes
    sums = dr.zeros(e.Int, of.size)

    def add(slot: Any, values: tuple[Any, ...], active: Any) -> None:
        for k, value in enumerate(values):
            dr.scatter_reduce(dr.ReduceOp.Add, sums, value, slot + k, active, mode=dr.ReduceMode.Expand)

    def here(i: Any) -> Contribution:
        # Lanes beside each other read pixels beside each other.
        k = first + i * lanes
        meant, k = k < along, dr.minimum(k, along - 1)
        column, row = (line, k) if down else (k, line)
        return at(_pixels(width, columns, stride, column, row, meant))

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

    if lanes == along:
        found = here(e.UInt(0))
        add(found.slot, found.values, found.compared)
        return sums
    nothing = tuple(dr.zeros(e.Int, across * lanes) for _ in range(of.values))
    start = e.UInt(0), dr.full(e.UInt, _NONE, across * lanes), nothing
    _, slot, total = dr.while_loop(start, lambda i, *_: i * lanes < along, step)
    add(slot, total, slot != _NONE)
    return sums


def _run(e: Engine, along: int, across: int) -> int:
    """Pixels that one lane goes through: a GPU needs far more lanes than it has images' rows."""
    return 1 if e.backend == "cuda" else max(1, min(_LONGEST, along * across // _LANES))


def _plus(total: tuple[Any, ...], more: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(a + b for a, b in zip(total, more, strict=True))


def _pixels(width: int, columns: int, stride: int, column: Any, row: Any, meant: Any) -> Pixels:
    x, y = column * stride, row * stride
    return Pixels(row * columns + column, y * width + x, x, y, meant)
