"""A sparse symmetric system of 6×6 blocks: summed up, solved; where its numbers go is worked out once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse
from scipy.sparse.linalg import splu

from rsgen.array_types import FloatArray, IntArray

# Columns that SuperLU takes together, as they have the same rows.
_TOGETHER = 6
_SYMMETRIC: dict[str, Any] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
# Information that holds the first block, in m⁻² and rad⁻²: the gauge.
_HELD = 1e14


@dataclass(frozen=True)
class Layout:
    """Where blocks that are put at rows (m,) and columns (m,) go in a symmetric matrix of compressed columns.

    unknowns (n,): those of the matrix, by their number in the system, in an order by minimum degree, in which its
    factors have few numbers. order (m,), begins (u,): sorts the blocks, and where the same place begins anew. places
    (nnz,): of the matrix's values among the sums' (u, 6, 6) numbers; indices (nnz,), indptr: as SciPy has them;
    columns_of (nnz,).
    """

    rows: IntArray
    columns: IntArray
    unknowns: IntArray
    order: IntArray
    begins: IntArray
    is_diagonal: npt.NDArray[np.bool_]
    places: IntArray
    indices: npt.NDArray[np.int32]
    columns_of: IntArray
    indptr: npt.NDArray[np.int32]

    @classmethod
    def of(cls, rows: IntArray, columns: IntArray, count: int) -> Layout:
        """Of a matrix of so many blocks a side; blocks belong in its upper triangle."""
        order = np.lexsort((columns, rows))
        r, c = rows[order], columns[order]
        begins = np.flatnonzero(np.append(True, (np.diff(r) != 0) | (np.diff(c) != 0)))
        r, c = r[begins], c[begins]
        is_diagonal, inner = r == c, np.arange(6)
        place = _least_degree(r, c, count)
        r, c = place[r], place[c]
        number = np.arange(36 * len(r)).reshape(-1, 6, 6)
        i = np.broadcast_to(6 * r[:, None, None] + inner[:, None], number.shape)
        j = np.broadcast_to(6 * c[:, None, None] + inner, number.shape)
        above = np.flatnonzero(~is_diagonal)
        i, j = np.append(i, j[above]), np.append(j, i[above])
        # Compressed as a matrix of numbers of values, from one on: a zero would be none.
        values = np.append(number, number[above]) + 1
        matrix = scipy.sparse.coo_matrix((values, (i, j)), shape=(6 * count, 6 * count)).tocsc()
        matrix.sort_indices()
        indptr = np.asarray(matrix.indptr)
        return cls(
            rows, columns, (6 * np.argsort(place)[:, None] + inner).ravel(), order, begins, is_diagonal,
            np.asarray(matrix.data) - 1, np.asarray(matrix.indices), np.repeat(np.arange(6 * count), np.diff(indptr)),
            indptr,
        )  # fmt: skip

    def is_of(self, rows: IntArray, columns: IntArray) -> bool:
        """Whether it is of blocks at these places."""
        return np.array_equal(self.rows, rows) and np.array_equal(self.columns, columns)

    def values(self, blocks: FloatArray) -> FloatArray:
        """The matrix's values (nnz,) from the blocks (m, 6, 6)."""
        sums = np.add.reduceat(blocks[self.order], self.begins, axis=0)
        own = sums[self.is_diagonal]
        sums[self.is_diagonal] = 0.5 * (own + np.swapaxes(own, 1, 2))
        return np.asarray(sums.ravel()[self.places])


def _least_degree(rows: IntArray, columns: IntArray, count: int) -> IntArray:
    """Place (count,) of each block in an order by minimum degree of a matrix with blocks there and mirrored.

    SuperLU finds it, which factors a matrix of one number for each block: a 36th of the work.
    """
    some = scipy.sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    matrix = scipy.sparse.csc_matrix(some + some.T + 4.0 * len(rows) * scipy.sparse.eye(count))
    return np.asarray(splu(matrix, permc_spec="MMD_AT_PLUS_A", **_SYMMETRIC).perm_c, np.int64)


class BlockSystem:
    """H x = −g. Of H the blocks on the diagonal, whole, and those above it are put, any number at a place.

    g (count, 6). layouts: that of a system before, if there is one; this one's is left in its place.
    """

    def __init__(self, count: int, layouts: list[Layout]) -> None:
        self.g = np.zeros((count, 6))
        self._layouts = layouts
        self._rows: list[IntArray] = []
        self._columns: list[IntArray] = []
        self._blocks: list[FloatArray] = []

    def put(self, rows: IntArray, columns: IntArray, blocks: FloatArray) -> None:
        """Blocks (k, 6, 6) at rows (k,) and columns (k,)."""
        self._rows.append(np.asarray(rows))
        self._columns.append(np.asarray(columns))
        self._blocks.append(blocks)

    def solved(self) -> FloatArray:
        """Increments (n, 6) of all blocks. Raises numpy.linalg.LinAlgError."""
        inverted = self._inverted()
        x = -inverted(self.g.ravel())
        if not np.isfinite(x).all():
            raise np.linalg.LinAlgError("the graph's system has no finite solution")
        return np.asarray(x.reshape(-1, 6))

    def covariance(self) -> Callable[[IntArray], FloatArray]:
        """Of unknowns by their numbers (k,): (k, k). Raises numpy.linalg.LinAlgError."""
        inverted, size = self._inverted(), self.g.size
        return lambda numbers: np.stack([inverted(np.eye(1, size, int(k) % size)[0])[numbers] for k in numbers])

    def matrix(self) -> tuple[scipy.sparse.csc_matrix, FloatArray, IntArray]:
        """H scaled to a diagonal of ones from both sides, the scale (n,), and the unknowns (n,) that it is of."""
        self.put(np.zeros(1, int), np.zeros(1, int), _HELD * np.eye(6)[None])
        rows, columns = np.concatenate(self._rows), np.concatenate(self._columns)
        blocks = np.concatenate(self._blocks)
        if not (self._layouts and self._layouts[0].is_of(rows, columns)):
            self._layouts[:] = [Layout.of(rows, columns, len(self.g))]
        layout, size = self._layouts[0], self.g.size
        values = layout.values(blocks)
        diagonal = values[layout.indices == layout.columns_of]
        scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-300))
        values *= scale[layout.indices] * scale[layout.columns_of]
        matrix = scipy.sparse.csc_matrix((values, layout.indices, layout.indptr), shape=(size, size))
        return matrix, scale, layout.unknowns

    def _inverted(self) -> Callable[[FloatArray], FloatArray]:
        """Takes a vector to H⁻¹ times it."""
        scaled, scale, unknowns = self.matrix()
        try:
            factors = splu(scaled, permc_spec="NATURAL", relax=_TOGETHER, panel_size=_TOGETHER, **_SYMMETRIC)
        except RuntimeError as error:
            raise np.linalg.LinAlgError(f"the graph's system has no solution ({error})") from None

        def inverted(b: FloatArray) -> FloatArray:
            x = np.empty(len(b))
            x[unknowns] = scale * factors.solve(scale * b[unknowns])
            return x

        return inverted
