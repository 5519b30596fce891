"""Cut the transparent parts of a texture out of the triangles that wear it.

Depth, truth and baked light know triangles only, so what an alpha mask hides must not be there for any of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import BoolArray, FloatArray, IntArray

_FINE_TEXELS = 2.0  # triangles this small are cut along a straight line
_MOST = 400_000  # triangles of one part; beyond, the outline gets coarser


@dataclass(frozen=True)
class Mask:
    """Where a surface is: alpha (h, w) in [0, 1], there at `cutoff` and above, repeated or else held at its rim."""

    alpha: FloatArray
    cutoff: float
    repeat: bool

    def at(self, xy: FloatArray) -> FloatArray:
        """Bilinear alpha (...,) less the cutoff at texel positions (..., 2), texel centres integer, row 0 on top."""
        h, w = self.alpha.shape
        low = np.floor(xy).astype(np.int64)
        fx, fy = (xy[..., k] - low[..., k] for k in (0, 1))
        columns, rows = ([self._inside(low[..., k] + step, size) for step in (0, 1)] for k, size in ((0, w), (1, h)))
        top = self.alpha[rows[0], columns[0]] * (1 - fx) + self.alpha[rows[0], columns[1]] * fx
        bottom = self.alpha[rows[1], columns[0]] * (1 - fx) + self.alpha[rows[1], columns[1]] * fx
        return top * (1 - fy) + bottom * fy - self.cutoff

    def _inside(self, index: IntArray, size: int) -> IntArray:
        return index % size if self.repeat else np.clip(index, 0, size - 1)


def cut_away(rows: FloatArray, faces: IntArray, xy: FloatArray, mask: Mask) -> tuple[FloatArray, IntArray, IntArray]:
    """What is left of triangles where `mask` is there.

    rows: (n, k), whatever vertices carry, interpolated linearly; faces (m, 3); xy (n, 2): texel position of each
    vertex. Returns new rows, faces and, per new face, the number of the old one.
    """
    solid = mask.alpha >= mask.cutoff
    if solid.all():
        return rows, faces, np.arange(len(faces))
    table = _counts(solid)
    corners = np.concatenate([rows, xy], axis=1)[faces]
    source = np.arange(len(faces))
    kept, kept_source = [], []
    while len(corners):
        there, nowhere = _uniform(corners[..., -2:], table, mask)
        kept.append(corners[there])
        kept_source.append(source[there])
        mixed = ~there & ~nowhere
        corners, source = corners[mixed], source[mixed]
        edge = np.linalg.norm(corners[..., -2:] - np.roll(corners[..., -2:], 1, axis=1), axis=-1).max(axis=1)
        fine = edge <= _FINE_TEXELS
        if sum(map(len, kept)) + 4 * len(corners) > _MOST:
            fine[:] = True
        clipped, of = _clip(corners[fine], mask.at(corners[fine][..., -2:]))
        kept.append(clipped)
        kept_source.append(source[fine][of])
        corners, source = _quartered(corners[~fine]), np.repeat(source[~fine], 4)
    left = np.concatenate(kept)
    return (
        left[..., :-2].reshape(-1, rows.shape[1]),
        np.arange(3 * len(left)).reshape(-1, 3),
        np.concatenate(kept_source),
    )


def _counts(solid: BoolArray) -> NDArray[np.int64]:
    """Summed-area table (2h + 1, 2w + 1) of two by two copies, so that no box of at most a copy's size wraps around."""
    table = np.zeros((2 * solid.shape[0] + 1, 2 * solid.shape[1] + 1), np.int64)
    table[1:, 1:] = np.tile(solid, (2, 2)).cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
    return table


def _uniform(xy: FloatArray, table: NDArray[np.int64], mask: Mask) -> tuple[BoolArray, BoolArray]:
    """Whether the mask is there, and whether it is nowhere, in all texels around triangles (m, 3, 2)."""
    size = np.array(mask.alpha.shape[::-1])
    low, high = np.floor(xy.min(axis=1)).astype(np.int64), np.ceil(xy.max(axis=1)).astype(np.int64)
    if mask.repeat:
        span = np.minimum(high - low + 1, size)
        low = low % size
    else:
        low = np.clip(low, 0, size - 1)
        span = np.clip(high, 0, size - 1) - low + 1
    (x0, y0), (x1, y1) = low.T, (low + span).T
    count = table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0]
    return count == span.prod(axis=1), count == 0


def _quartered(corners: FloatArray) -> FloatArray:
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.stack([np.stack(part, axis=1) for part in parts], axis=1).reshape(-1, 3, corners.shape[-1])


def _clip(corners: FloatArray, level: FloatArray) -> tuple[FloatArray, IntArray]:
    """The parts of triangles (m, 3, k) where a value, given at their corners (m, 3), is not negative; and of which."""
    inside = level >= 0
    count = inside.sum(axis=1)
    out, of = [corners[count == 3]], [np.flatnonzero(count == 3)]
    for ends in (1, 2):  # the odd corner first: the one inside, or the one outside
        which = np.flatnonzero(count == ends)
        odd = np.argmax(inside[which] == (ends == 1), axis=1)
        order = (odd[:, None] + np.arange(3)) % 3
        p = np.take_along_axis(corners[which], order[..., None], axis=1)
        s = np.take_along_axis(level[which], order, axis=1)
        q, r = (p[:, 0] + (s[:, 0] / (s[:, 0] - s[:, k]))[:, None] * (p[:, k] - p[:, 0]) for k in (1, 2))
        pieces = [(p[:, 0], q, r)] if ends == 1 else [(q, p[:, 1], p[:, 2]), (q, p[:, 2], r)]
        out += [np.stack(piece, axis=1) for piece in pieces]
        of += [which] * len(pieces)
    return np.concatenate(out), np.concatenate(of)
