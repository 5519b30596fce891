"""What a track's frames said of its control points, kept small for when the whole spline is adjusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from rstrack.adjustment.band import Band
from rstrack.adjustment.graph import Seen
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.keyframes.keyframe import Reference


@dataclass
class Chain:
    """Frames' normal equations, summed over those aligned to one keyframe: 1.5 kB a frame.

    Only the Hessians: where the frames were found, gradients are zero. Frames against references that are rolling still
    are put together under None.
    """

    _done: list[Seen] = field(default_factory=list)
    _keyframe: int | None = None
    _band: Band = field(default_factory=Band)

    @property
    def seen(self) -> list[Seen]:
        """All of it."""
        return [*self._done, Seen(self._keyframe, self._band.packed())] if len(self._band) else list(self._done)

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
            self._done.append(Seen(self._keyframe, self._band.packed()))
            self._band = Band()
