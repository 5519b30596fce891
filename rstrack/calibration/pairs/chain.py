"""From sums over pairs of blocks of lines to normal equations of control points and parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rstrack.alignment.block_sums import BlockSums, Scaling
from rstrack.calibration.pairs.images import LinePoses
from rstrack.calibration.parameters import COUNT
from rstrack.compiled import compiled

# σ of gain and offset of an image against another, and the least and the most that they become.
_BRIGHTNESS, _BRIGHTNESS_BOUNDS = np.array([0.3, 0.15]), (-0.7, 2.0)


@dataclass(frozen=True)
class PairSums:
    """Sums of p pairs of images, of those u pairs of their blocks that have pixels.

    blocks: see `BlockSums`, the pairs of blocks as current ones. begin (p + 1,): where a pair of images begins among
    these. current, reference (u,): numbers of the blocks among those of all images. coupling (u, 6, n), own_H (p, n, n)
    and own_g (p, n): further columns', see `ColumnSums`, the latter two of each pair, or (1, ...) of all together.
    """

    blocks: BlockSums
    begin: IntArray
    current: IntArray
    reference: IntArray
    coupling: FloatArray
    own_H: FloatArray
    own_g: FloatArray


def pair_sums(
    raw: IntArray, scaling: Scaling, pairs: IntArray, count: int, unit: FloatArray, apart: bool
) -> PairSums:  # fmt: skip
    """Integers (p, ...) as summed on the device, of pairs (p, 2) of images, current and reference, with `count` blocks.

    unit (n,): what 1 of the further columns stands for. apart: some of these belong to one pair alone.
    """
    p, n = len(pairs), len(unit)
    rows = raw.reshape(p * count**2, -1)
    used = np.flatnonzero(rows.any(axis=1))
    pair, of = used // count**2, used % count**2
    blocks = scaling.unpack(rows[used], len(used), 1, n)
    coupling = np.zeros((len(used), 6, 0)) if blocks.columns is None else blocks.columns.coupling[:, 0] * unit
    totals = rows.reshape(p if apart else 1, -1, rows.shape[1]).sum(axis=1)
    own = [each for total in totals if (each := scaling.unpack(total, 1, 1, n).columns) is not None]
    own_H = np.array([each.H for each in own]).reshape(len(totals), n, n) * np.outer(unit, unit)
    own_g = np.array([each.g for each in own]).reshape(len(totals), n) * unit
    begin = np.searchsorted(pair, np.arange(p + 1))
    current, reference = pairs[pair, 0] * count + of // count, pairs[pair, 1] * count + of % count
    return PairSums(blocks, begin, current, reference, coupling, own_H, own_g)


def add_system(
    H: FloatArray, g: FloatArray, sums: PairSums, lines: LinePoses, asked: Sequence[int], sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Add pairs to the normal equations H, g over [control points, parameters]; sigma: of r.

    lines: of the images. asked: places among the parameters of the first of the further columns. Of those that are left
    over, such as gain and offset: coupling (p, size, k), H (p, k, k) and g (p, k).
    """
    x, size, n = len(g) - COUNT, len(g), sums.coupling.shape[2]
    slopes = lines.slopes.reshape(-1, *lines.slopes.shape[2:])
    column = np.empty((len(slopes), slopes.shape[2]), np.int64)
    points = column.shape[1] - len(lines.moved)
    column[:, :points] = 6 * lines.first.reshape(-1, 1) + np.arange(points)
    column[:, points:] = x + np.array(lines.moved)
    blocks, of = sums.blocks, (sums.begin, sums.current, sums.reference)
    given = blocks.H[:, 0] / sigma**2, blocks.g[:, 0] / sigma, sums.coupling / sigma**2
    half, gradient, shared, apart = _chained(*given, *of, slopes, column, points, n - len(asked), size)
    own_H, own_g = sums.own_H / sigma**2, sums.own_g / sigma
    k = len(asked)
    at = x + np.array(asked, int)
    H += half + half.T
    H[:, at] += shared[:, :k]
    H[at] += shared[:, :k].T
    H[np.ix_(at, at)] += own_H[:, :k, :k].sum(axis=0)
    g += gradient
    g[at] += own_g[:, :k].sum(axis=0)
    apart[:, at] += own_H[:, :k, k:]
    return apart, own_H[:, k:, k:], own_g[:, k:]


def without_brightness(
    H: FloatArray, g: FloatArray, coupling: FloatArray, own: FloatArray, own_g: FloatArray, at: FloatArray
) -> FloatArray:
    """Take gains and offsets of p pairs, `at` (p, 2), out of H (m, m) and g (m,), and return their next values.

    coupling (p, m, 2), own (p, 2, 2), own_g (p, 2): see `normal_equations.eliminate`, which takes them out one by one.
    """
    system, right = own + np.diag(_BRIGHTNESS**-2.0), own_g + at * _BRIGHTNESS**-2.0
    solved = np.linalg.solve(system, np.concatenate([right[..., None], coupling.swapaxes(1, 2)], axis=2))
    flat = coupling.swapaxes(0, 1).reshape(len(g), -1)
    H -= flat @ solved[..., 1:].reshape(-1, len(g))
    g -= flat @ solved[..., 0].ravel()
    return np.clip(at - solved[..., 0], *_BRIGHTNESS_BOUNDS)


@compiled
def _chained(
    H: Any, g: Any, coupling: Any, begin: Any, current: Any, reference: Any, slopes: Any, column: Any, points: Any,
    apart: Any, size: Any,
) -> Any:  # fmt: skip
    """With J (r, 6, m) the slopes of r blocks by unknowns `column` (r, m), of which the first `points` stand side by
    side, and each pair of blocks moving by J of the current one less J of the reference: half (size, size) of the
    system, which is that and its transpose; the gradient (size,); the coupling (size, n) of all pairs, and that
    (p, size, apart) of each pair with the last of the columns."""
    pairs, (rows, _, m), n = len(begin) - 1, slopes.shape, coupling.shape[2]
    own_H, own_g, own_c = np.zeros((rows, 6, 6)), np.zeros((rows, 6)), np.zeros((rows, 6, n))
    half, gradient, shared = np.zeros((size, size)), np.zeros(size), np.zeros((size, n))
    each, moved = np.zeros((pairs, size, apart)), np.zeros((6, size))
    for q in range(pairs):
        u = begin[q]
        while u < begin[q + 1]:
            c, low, high = current[u], size, 0
            # All references' blocks that one current block is compared with, at once.
            while u < begin[q + 1] and current[u] == c:
                r = reference[u]
                own_H[c] += H[u]
                own_H[r] += H[u]
                own_g[c] += g[u]
                own_g[r] -= g[u]
                own_c[c] += coupling[u]
                own_c[r] -= coupling[u]
                low, high = min(low, column[r, 0]), max(high, column[r, 0] + points)
                for i in range(6):
                    for j in range(6):
                        h = H[u, i, j]
                        for a in range(m):
                            moved[i, column[r, a]] += h * slopes[r, j, a]
                    for k in range(apart):
                        h = coupling[u, i, n - apart + k]
                        for a in range(m):
                            each[q, column[c, a], k] += h * slopes[c, i, a]
                            each[q, column[r, a], k] -= h * slopes[r, i, a]
                u += 1
            for i in range(6):
                for a in range(m):
                    s, row = slopes[c, i, a], column[c, a]
                    for t in range(low, high):
                        half[row, t] -= s * moved[i, t]
                    for b in range(points, m):
                        half[row, column[c, b]] -= s * moved[i, column[c, b]]
            moved[:] = 0.0
    for r in range(rows):
        for i in range(6):
            for a in range(m):
                s, row = slopes[r, i, a], column[r, a]
                gradient[row] += s * own_g[r, i]
                for k in range(n):
                    shared[row, k] += s * own_c[r, i, k]
                for j in range(6):
                    h = 0.5 * s * own_H[r, i, j]
                    for b in range(m):
                        half[row, column[r, b]] += h * slopes[r, j, b]
    return half, gradient, shared, each
