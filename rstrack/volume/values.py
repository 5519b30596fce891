"""What a volume holds of its blocks: in slots on the device, or in a file while they are far from the camera."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from rsgen.array_types import Float32Array, IntArray
from rsgen.device.arrays import Engine
from rstrack.volume.away import Away
from rstrack.volume.kernels import POINTS

_FIRST_BLOCKS = 4096

Integers = npt.NDArray[np.int32]


class Values:
    """Sums of blocks: `count` numbers for each of a block's 512 lattice points.

    sums: (slots 512,) each, on the device. Slots that are free hold zeros. Blocks are named by the numbers of the
    volume's directory where they go to the file and come back.
    """

    def __init__(self, e: Engine, count: int, most_bytes: float) -> None:
        self._e, self._most_bytes = e, most_bytes
        self.sums = [self._zeros(_FIRST_BLOCKS) for _ in range(count)]
        # The slots that have ever been used come first.
        self._used, self._free = 0, np.zeros(0, np.int32)
        self._away = Away(count * POINTS)

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
        self._away.put(blocks, self.at(slots).reshape(len(blocks), -1))
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
        return self._away.get(blocks).reshape(len(blocks), len(self.sums), POINTS)

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
        kept = dr.arange(self._e.UInt, have * POINTS)
        for i, old in enumerate(self.sums):
            grown = self._zeros(room)
            dr.scatter(grown, old, kept)
            dr.eval(grown)
            self.sums[i] = grown

    def _zeros(self, blocks: int) -> Any:
        # Copied: zeros that were made together would share memory, and the first sum added to would copy it.
        zeros = dr.copy(dr.zeros(self._e.Float, blocks * POINTS))
        dr.eval(zeros)
        return zeros


def unsigned(e: Engine, values: npt.ArrayLike) -> Any:
    """Integers on the device, in memory of their own: `Engine.upload` says why."""
    return e.UInt(dr.copy(e.UInt(np.array(values, np.uint32).ravel())))
