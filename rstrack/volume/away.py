"""Values of blocks that are far from the camera, in a temporary file."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import IO, Any

import numpy as np

from rsgen.array_types import Float32Array, IntArray
from rsgen.files import write_error


class Away:
    """Blocks' values by the blocks' numbers, `floats` for each. The file is in TMPDIR, and gone when this is."""

    def __init__(self, floats: int) -> None:
        self._floats = floats
        self._file: IO[bytes] | None = None
        self._places: dict[int, int] = {}

    def __len__(self) -> int:
        """Blocks that have been here at some time: their places are kept."""
        return len(self._places)

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
