"""Pieces: things that could be carried away, each with a name, so that their arrangement can be checked."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from scenes.kit.shapes import Array, Parts, move_parts, rotation


@dataclass(frozen=True)
class Piece:
    """A thing at its place in the world: what it is called, and its shapes."""

    name: str
    parts: Parts

    @property
    def bounds(self) -> Array:
        """(2, 3) lowest and highest corner, metres."""
        v = np.concatenate([mesh.v for _, mesh in self.parts])
        return np.stack([v.min(0), v.max(0)])


def stand(name: str, parts: Parts, x: float, y: float, z: float, turn: float = 0.0) -> Piece:
    """A piece about its own origin, put at (x, y, z) and turned by degrees about the vertical."""
    return Piece(name, move_parts(parts, (x, y, z), rotation("y", turn)))


def surfaces(pieces: Iterable[Piece]) -> Parts:
    """The shapes of all pieces."""
    return [part for piece in pieces for part in piece.parts]
