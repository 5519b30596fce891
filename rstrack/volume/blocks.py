"""The blocks of a volume: which there are, a dense table of those about the camera for kernels, and their values.

Values lie in slots on the device, or in a temporary file while their blocks are far from the camera.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import IO, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from rsgen.array_types import BoolArray, Float32Array, IntArray
from rsgen.device.arrays import Engine
from rsgen.files import write_error
from rstrack.volume.kernels import POINTS

# Entries of the table: 64 MB.
MOST_ENTRIES = 2**24
# Blocks around what is looked at that the table covers when it moves.
_MARGIN = 8
_FIRST_BLOCKS = 4096

Integers = npt.NDArray[np.int32]


class BlockDirectory:
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


class BlockValues:
    """Sums of blocks: `count` numbers for each of a block's 512 lattice points.

    sums: (slots 512,) each, on the device. Slots that are free hold zeros. Blocks are named by the numbers of the
    volume's directory where they go to the file and come back.
    """

    def __init__(self, e: Engine, count: int, most_bytes: float) -> None:
        self._e, self._most_bytes = e, most_bytes
        self.sums = [self._zeros(_FIRST_BLOCKS) for _ in range(count)]
        # The slots that have ever been used come first.
        self._used, self._free = 0, np.zeros(0, np.int32)
        self._far = FarBlocks(count * POINTS)

    @property
    def bytes(self) -> int:
        """Memory on the device."""
        return 4 * sum(dr.width(array) for array in self.sums)

    def would_exceed(self, more: int) -> bool:
        """Whether so many blocks more on the device would be too many."""
        return 4 * POINTS * len(self.sums) * (self._used - len(self._free) + more) > self._most_bytes

    def has_room(self, count: int) -> bool:
        """Whether so many slots have become free."""
        return count <= len(self._free)

    def take(self, count: int) -> Integers:
        """Slots for so many blocks; makes room."""
        lacking = count - len(self._free)
        if lacking > 0:
            self._reserve(self._used + lacking)
            fresh = np.arange(self._used, self._used + lacking, dtype=np.int32)
            self._used, self._free = self._used + lacking, np.concatenate([self._free, fresh])
        taken, self._free = self._free[:count], self._free[count:]
        return taken

    def put_away(self, blocks: IntArray, slots: Integers) -> None:
        """Blocks (n,) into the file; their slots (n,) are free. Raises UserError: no room on disk."""
        self._far.put(blocks, self.at(slots).reshape(len(blocks), -1))
        self._write(slots, np.zeros((len(blocks), len(self.sums), POINTS), np.float32))
        self._free = np.concatenate([self._free, slots])

    def brought_back(self, blocks: IntArray) -> Integers:
        """Slots (n,) of blocks (n,) that were away."""
        slots = self.take(len(blocks))
        self._write(slots, self.away(blocks))
        return slots

    def at(self, slots: Integers) -> Float32Array:
        """Values (n, sums, 512) in slots (n,)."""
        index = self._points(slots)
        planes = [dr.gather(self._e.Float, array, index).numpy().reshape(-1, POINTS) for array in self.sums]
        return np.stack(planes, axis=1)

    def away(self, blocks: IntArray) -> Float32Array:
        """Values (n, sums, 512) of blocks (n,) in the file."""
        return self._far.get(blocks).reshape(len(blocks), len(self.sums), POINTS)

    def _write(self, slots: Integers, values: Float32Array) -> None:
        index = self._points(slots)
        for i, array in enumerate(self.sums):
            dr.scatter(array, self._e.upload(values[:, i]), index)
        dr.eval(*self.sums)

    def _points(self, slots: Integers) -> Any:
        return unsigned(self._e, slots[:, None].astype(np.int64) * POINTS + np.arange(POINTS))

    def _reserve(self, blocks: int) -> None:
        """Double the room until it holds so many blocks."""
        have = dr.width(self.sums[0]) // POINTS
        if blocks <= have:
            return
        room = have * 2 ** int(np.ceil(np.log2(blocks / have)))
        filled = dr.arange(self._e.UInt, have * POINTS)
        for i, old in enumerate(self.sums):
            grown = self._zeros(room)
            dr.scatter(grown, old, filled)
            dr.eval(grown)
            self.sums[i] = grown

    def _zeros(self, blocks: int) -> Any:
        # Copied: zeros that were made together would share memory, and the first sum added to would copy it.
        zeros = dr.copy(dr.zeros(self._e.Float, blocks * POINTS))
        dr.eval(zeros)
        return zeros


class FarBlocks:
    """Values of blocks far from the camera, `floats` for each, by the blocks' numbers, in a file.

    The file is in TMPDIR, and gone when this is.
    """

    def __init__(self, floats: int) -> None:
        self._floats = floats
        self._file: IO[bytes] | None = None
        self._places: dict[int, int] = {}

    def __getstate__(self) -> dict[str, Any]:
        """For a checkpoint, which must not change when a block is put again: with the values."""
        blocks = np.array(list(self._places), np.int64)
        return {"floats": self._floats, "blocks": blocks, "values": self.get(blocks)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["floats"])  # type: ignore[misc]
        self.put(state["blocks"], state["values"])

    def put(self, blocks: IntArray, values: Float32Array) -> None:
        """Write values (n, floats) of blocks (n,). Raises UserError: no room on disk."""
        try:
            if self._file is None:
                self._file = TemporaryFile()  # noqa: SIM115  it lives as long as the volume
            for block, row in zip(blocks.tolist(), np.ascontiguousarray(values, np.float32), strict=True):
                place = self._places.setdefault(block, len(self._places))
                if os.pwrite(self._file.fileno(), row.data, place * row.nbytes) != row.nbytes:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise write_error(Path(gettempdir()), error) from None

    def get(self, blocks: IntArray) -> Float32Array:
        """Values (n, floats) of blocks (n,) as they were put last."""
        out = np.empty((len(blocks), self._floats), np.float32)
        for row, block in zip(out, blocks.tolist(), strict=True):
            assert self._file is not None
            data = os.pread(self._file.fileno(), row.nbytes, self._places[block] * row.nbytes)
            row[:] = np.frombuffer(data, np.float32)
        return out


def _entries(low: IntArray, high: IntArray) -> float:
    return float(np.prod((high - low).astype(float)))


def unsigned(e: Engine, values: npt.ArrayLike) -> Any:
    """Integers on the device, in memory of their own: `Engine.upload` says why."""
    return e.UInt(dr.copy(e.UInt(np.array(values, np.uint32).ravel())))
