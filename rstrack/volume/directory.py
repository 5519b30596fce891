"""Which blocks a volume has, wherever they are, and a dense table of those about the camera, for kernels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsgen.array_types import BoolArray, IntArray

# Entries of the table: 64 MB.
MOST_ENTRIES = 2**24
# Blocks around what is looked at that the table covers when it moves.
_MARGIN = 8

Integers = npt.NDArray[np.int32]


class Directory:
    """Blocks by the order in which they were made, and the window: a box of block coordinates (x y z).

    at: (n, 3) block coordinates. slots: (n,) where each block's values are on the device, -1 for those put away.
    first: (3,) block coordinates of table[0, 0, 0]; table: (nz, ny, nx) slots of the blocks in the window, -1 for none.
    """

    def __init__(self) -> None:
        self._at, self._slots, self._count = np.zeros((64, 3), np.int64), np.full(64, -1, np.int32), 0
        self.first, self.table = np.zeros(3, np.int64), np.zeros((0, 0, 0), np.int32)

    def __len__(self) -> int:
        return self._count

    @property
    def at(self) -> IntArray:
        """See the class."""
        return self._at[: self._count]

    @property
    def slots(self) -> Integers:
        """See the class."""
        return self._slots[: self._count]

    @property
    def size(self) -> IntArray:
        """Blocks (3,) x y z of the window."""
        return np.array(self.table.shape[::-1], np.int64)

    def covers(self, low: IntArray, high: IntArray) -> bool:
        """Whether the window holds the box from low to high (3,), the latter excluded."""
        return bool(self.table.size and (low >= self.first).all() and (high <= self.first + self.size).all())

    def move(self, low: IntArray, high: IntArray, alone: bool = False) -> bool:
        """Let the window hold a box: grown to that, or, where that would be too much or `alone`, the box alone.

        The table is empty then, see `fill`. False, and nothing done, if the box is too large.
        """
        low, high = low - _MARGIN, high + _MARGIN
        if self.table.size and not alone:
            grown = np.minimum(low, self.first), np.maximum(high, self.first + self.size)
            if _entries(*grown) <= MOST_ENTRIES:
                low, high = grown
        if _entries(low, high) > MOST_ENTRIES:
            return False
        self.first, self.table = low, np.full((high - low)[::-1], -1, np.int32)
        return True

    def inside(self) -> BoolArray:
        """Which blocks (n,) lie in the window."""
        from_first = self.at - self.first
        return np.asarray(((from_first >= 0) & (from_first < self.size)).all(axis=1))

    def fill(self) -> None:
        """Enter the blocks of the window into its table. All of them must have slots."""
        blocks = np.flatnonzero(self.inside())
        x, y, z = (self.at[blocks] - self.first).T
        self.table[z, y, x] = self.slots[blocks]

    def blocks_at(self, entries: IntArray) -> IntArray:
        """Block coordinates (n, 3) of places in the flat table."""
        nx, ny, _ = self.size
        return np.stack([entries % nx, entries // nx % ny, entries // (nx * ny)], axis=-1) + self.first

    def add(self, entries: IntArray, slots: Integers) -> None:
        """New blocks at places of the flat table, with their values in these slots."""
        count = self._count + len(entries)
        while count > len(self._at):
            self._at = np.concatenate([self._at, np.zeros_like(self._at)])
            self._slots = np.concatenate([self._slots, np.full_like(self._slots, -1)])
        self._at[self._count : count], self._slots[self._count : count] = self.blocks_at(entries), slots
        self._count = count
        self.table.reshape(-1)[entries] = slots


def _entries(low: IntArray, high: IntArray) -> float:
    return float(np.prod((high - low).astype(float)))
