"""What is found in a scene of another program: parts, lamps, and what has no place here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.formats.meshes.mesh_visual import Part

MOST_TRIANGLES = 30_000_000
_NAMED = 3

Kind = Literal["rectangle", "disk", "sphere", "point", "spot", "directional", "sky"]


@dataclass(frozen=True, eq=False)
class Lamp:
    """A light in the world frame, m, shining along the -z axis of its own frame where it has a direction.

    value (3,), linear: radiance of a surface or the sky, intensity (per sr) of a point or spot, irradiance across the
    direction of a directional one. T_world_lamp (4, 4): of the unit shape (square and disk of half-width 1, ball of
    radius 1), rigid for the others. cone_deg: half the angle of a spot, and where its light begins to fall off.
    picture: bytes of a latitude-longitude image, which the sky's value is a factor of; suffix: of its file's name.
    """

    kind: Kind
    value: FloatArray
    T_world_lamp: FloatArray = field(default_factory=lambda: np.eye(4))
    cone_deg: tuple[float, float] = (45.0, 45.0)
    picture: bytes | None = None
    suffix: str = ""


@dataclass(frozen=True, eq=False)
class Content:
    """All of a scene that can be rendered; `notes` say in one line each what cannot, or is another way."""

    parts: Sequence[Part]
    lamps: Sequence[Lamp]
    notes: Sequence[str]


class Notes:
    """Collects remarks, each with the names of what it is about."""

    def __init__(self) -> None:
        self._names: dict[str, list[str]] = {}

    def add(self, remark: str, name: str) -> None:
        """Remark on the thing called `name`; of many, the first few are named."""
        names = self._names.setdefault(remark, [])
        if name not in names:
            names.append(name)

    def lines(self) -> list[str]:
        """A line a remark."""
        return [f"{remark}: {_listed(names)}" for remark, names in self._names.items()]


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
