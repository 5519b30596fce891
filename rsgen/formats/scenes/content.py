"""What an importer finds in a scene of another program, and its lamps as entries of a Mitsuba scene dictionary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, first_few, how_to_install
from rsgen.formats.meshes.parts import Part

MOST_TRIANGLES = 30_000_000

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
    """All of a scene that can be rendered; `notes` list in one line each what cannot, or is changed."""

    parts: Sequence[Part]
    lamps: Sequence[Lamp]
    notes: Sequence[str]


def check_installed(module: str, need: str, extra: str, note: str = "") -> None:
    """Raises UserError, beginning with the need, if there is no such module: the extra's packages, and a note."""
    if find_spec(module) is None:
        raise UserError(f"{need}, which is not installed: install it with: {how_to_install(extra)}{note}")


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
        return [f"{remark}: {first_few(names)}" for remark, names in self._names.items()]


_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # Mitsuba's lights shine along z, USD's and Blender's along -z
_SURFACES = ("rectangle", "disk", "sphere")


def lamp_shapes(lamps: Sequence[Lamp], folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Entries of a scene dictionary, and remarks; pictures of skies go into `folder`. Of several skies one counts."""
    skies = [lamp for lamp in lamps if lamp.kind == "sky"]
    # Mitsuba takes one; uniform ones add up where there is no picture.
    pictured = [lamp for lamp in skies if lamp.picture is not None]
    taken = "one with a picture" if pictured else "the sum"
    remarks = [f"of {len(skies)} skies {taken} is taken"] if len(skies) > 1 else []
    others = [lamp for lamp in lamps if lamp.kind != "sky"]
    shapes = {f"light{number:05}": _entry(lamp) for number, lamp in enumerate(others)}
    if pictured:
        sky, file = pictured[0], folder / f"sky{pictured[0].suffix}"
        file.write_bytes(sky.picture or b"")
        # Its one factor is the value's mean, so that the colour of a sky with a picture is lost.
        factor = float(sky.value.mean())
        shapes["sky"] = {"type": "envmap", "filename": str(file), "scale": factor, "to_world": sky.T_world_lamp}
    elif skies:
        total = np.sum([lamp.value for lamp in skies], axis=0)
        shapes["sky"] = {"type": "constant", "radiance": _rgb(total)}
    return shapes, remarks


def _entry(lamp: Lamp) -> dict[str, Any]:
    T = lamp.T_world_lamp
    if lamp.kind in _SURFACES:
        return {
            "type": lamp.kind, "to_world": T if lamp.kind == "sphere" else T @ _TURN,
            "bsdf": {"type": "diffuse", "reflectance": _rgb(np.full(3, 0.5))},
            "emitter": {"type": "area", "radiance": _rgb(lamp.value)},
        }  # fmt: skip
    if lamp.kind == "directional":
        return {"type": "directional", "to_world": T @ _TURN, "irradiance": _rgb(lamp.value)}
    if lamp.kind == "point":
        place = np.eye(4)
        place[:3, 3] = T[:3, 3]
        return {"type": "point", "to_world": place, "intensity": _rgb(lamp.value)}
    cutoff, beam = lamp.cone_deg
    cone = {"cutoff_angle": cutoff, "beam_width": min(beam, 0.999 * cutoff)}
    return {"type": "spot", "to_world": T @ _TURN, "intensity": _rgb(lamp.value), **cone}


def _rgb(value: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(v) for v in value]}
