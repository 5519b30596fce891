"""Pieces of a room, things that could be carried away, and what a seed draws: arrangements and colours of lamps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from scenes.kit.shapes import Array, Parts, move_parts, rotation

SHELL = "shell"  # the piece that is the room itself


@dataclass(frozen=True)
class Piece:
    """A thing at its place in the world: what it is called, its shapes, and what it stands or hangs on, if stated."""

    name: str
    parts: Parts
    on: str = ""

    @property
    def bounds(self) -> Array:
        """(2, 3) lowest and highest corner, metres."""
        v = np.concatenate([mesh.v for _, mesh in self.parts])
        return np.stack([v.min(0), v.max(0)])


def stand(name: str, parts: Parts, x: float, y: float, z: float, turn: float = 0.0) -> Piece:
    """A piece about its own origin, put at (x, y, z) and turned by degrees about the vertical."""
    return Piece(name, move_parts(parts, (x, y, z), rotation("y", turn)))


def instance_names(pieces: Sequence[Piece]) -> list[str]:
    """A name of its own for each piece: numbered where several have one; '' of the shell, which materials divide."""
    count = Counter(piece.name for piece in pieces)
    seen: Counter[str] = Counter()
    names = []
    for piece in pieces:
        seen[piece.name] += 1
        number = f" {seen[piece.name]}" if count[piece.name] > 1 else ""
        names.append("" if piece.name == SHELL else f"{piece.name}{number}")
    return names


def parts_rows(pieces: Sequence[Piece], materials: Iterable[str], prefix: str = "") -> list[str]:
    """Lines 'shape,first,name' of what each mesh of a material is put together from, in the pieces' order."""
    rows = []
    for material in materials:
        first = 0
        for name, piece in zip(instance_names(pieces), pieces, strict=True):
            for used, mesh in piece.parts:
                if used == material:
                    rows.append(f"{prefix}{material},{first},{name or material}")
                    first += len(mesh.f)
    return rows


_GREY = np.array([0.2126, 0.7152, 0.0722])


def draw(seed: int, what: str) -> np.random.Generator:
    """The random numbers of one aspect of a variant: other aspects draw from others, and may change by themselves."""
    return np.random.default_rng([seed, *what.encode()])


def kelvin(temperature: float) -> np.ndarray:
    """(3,) linear sRGB of a black body of 2000 to 12000 K, of luminance 1.

    Chromaticity by the cubic of Kim et al. (US patent 7024034, 2002) for the Planckian locus in CIE xy.
    """
    t = 1e3 / temperature
    if temperature < 4000:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
    if temperature < 2222:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif temperature < 4000:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    xyz = np.array([x / y, 1.0, (1 - x - y) / y])
    matrix = [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
    rgb = np.maximum(np.array(matrix) @ xyz, 0.02)
    return rgb / float(_GREY @ rgb)
