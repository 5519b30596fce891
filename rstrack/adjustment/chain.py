"""Normal equations of a track's frames, summed by keyframes and stored small until the whole spline is adjusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.keyframes.keyframe import Reference


@dataclass
class BandedHessian:
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

    def packed(self) -> BandedHessian:
        """The same with room for no more, in half the bytes: to be stored."""
        used = np.flatnonzero(np.abs(self.blocks).sum(axis=(1, 2, 3)))
        begin, end = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, 0)
        end = min(len(self), end + self.blocks.shape[1] - 1)
        return BandedHessian(self.first + begin, self.blocks[begin:end].astype(np.float32))

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


@dataclass(frozen=True)
class KeyframeModel:
    """Frames' quadratic model of control points against a keyframe; None: against each other.

    gradient (n, 6): of the band's control points, where the models were made; None: zero, as
    after the tracker's own steps.
    """

    keyframe: int | None
    band: BandedHessian
    gradient: FloatArray | None = None

    def weakened(self, spread: float) -> KeyframeModel:
        """Taken as so many times as uncertain (σ)."""
        gradient = None if self.gradient is None else self.gradient / spread**2
        return KeyframeModel(self.keyframe, BandedHessian(self.band.first, self.band.blocks / spread**2), gradient)


@dataclass
class Chain:
    """Frames' normal equations, summed over those aligned to one keyframe: 1.5 kB a frame.

    Only the Hessians: where the frames were found, gradients are zero. Frames against references that are rolling still
    are put together under None.
    """

    _done: list[KeyframeModel] = field(default_factory=list)
    _keyframe: int | None = None
    _band: BandedHessian = field(default_factory=BandedHessian)

    @property
    def seen(self) -> list[KeyframeModel]:
        """All of it."""
        return (
            [*self._done, KeyframeModel(self._keyframe, self._band.packed())] if len(self._band) else list(self._done)
        )

    def add(self, ref: Reference, fresh: Sequence[Observation], state: SplineState, excess: float) -> None:
        """A frame that has been found. excess: by how much σ of its images are too small, see `Scores.excess`."""
        keyframe = ref.index if ref.rolling is None else None
        if keyframe != self._keyframe:
            self._put_away()
            self._keyframe = keyframe
        for o in fresh:
            if o.is_linearised:
                self._band.add(o.model(state), 1.0 / excess**2)

    def cut(self, end: int) -> None:
        """Control points from number `end` on are others from now on."""
        self._put_away()
        for seen in self._done:
            if seen.band.last > end:
                seen.band.cut(end)
        self._done = [seen for seen in self._done if len(seen.band)]

    def _put_away(self) -> None:
        if len(self._band):
            self._done.append(KeyframeModel(self._keyframe, self._band.packed()))
            self._band = BandedHessian()
