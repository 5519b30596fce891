"""Sums of the Hessians of control points, of any number of frames, in the band that these fill."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rstrack.alignment.normal_equations import Quadratic


@dataclass
class Band:
    """H over control points first, first + 1, ...: its upper blocks (n, w, 6, 6).

    blocks[i, d]: of control points first + i and first + i + d. Grows with what is added.
    """

    first: int = 0
    blocks: npt.NDArray[Any] = field(default_factory=lambda: np.zeros((0, 1, 6, 6)))

    def __len__(self) -> int:
        return len(self.blocks)

    @property
    def last(self) -> int:
        """One past the last control point."""
        return self.first + len(self)

    def add(self, model: Quadratic, factor: float = 1.0) -> None:
        """The Hessian of one more model, times a factor."""
        size = model.last - model.first
        self._cover(model.first, model.last, size)
        at = model.first - self.first
        H = factor * model.H.reshape(size, 6, size, 6)
        for d in range(size):
            rows = np.arange(size - d)
            self.blocks[at : at + size - d, d] += H[rows, :, rows + d]

    def cut(self, end: int) -> None:
        """Forget what depends on control points from number `end` on: those before are as if these could not move."""
        kept = max(0, min(len(self), end - self.first))
        self.blocks = self.blocks[:kept].copy()
        for d in range(1, self.blocks.shape[1]):
            self.blocks[max(0, kept - d) :, d] = 0.0

    def packed(self) -> Band:
        """The same with room for no more, in half the bytes: to be kept."""
        used = np.flatnonzero(np.abs(self.blocks).sum(axis=(1, 2, 3)))
        begin, end = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, 0)
        end = min(len(self), end + self.blocks.shape[1] - 1)
        return Band(self.first + begin, self.blocks[begin:end].astype(np.float32))

    def _cover(self, first: int, last: int, width: int) -> None:
        if not len(self):
            self.first = first
        before, after = max(0, self.first - first), max(0, last - self.last)
        wider = max(0, width - self.blocks.shape[1])
        if before or after or wider:
            # Room for more frames to come, so that adding them does not copy all of it each time.
            after = max(after, len(self)) if after else 0
            self.blocks = np.pad(self.blocks, ((before, after), (0, wider), (0, 0), (0, 0)))
            self.first -= before
