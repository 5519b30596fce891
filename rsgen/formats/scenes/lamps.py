"""Lamps as entries of a Mitsuba scene dictionary: flat ones and balls become part of the scene's surface."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.formats.scenes.content import Lamp

_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # Mitsuba's lights shine along z, USD's and Blender's along -z
_SURFACES = ("rectangle", "disk", "sphere")


def lamp_shapes(lamps: Sequence[Lamp], folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Entries of a scene dictionary, and remarks; pictures of skies go into `folder`. Of several skies one counts."""
    skies = [lamp for lamp in lamps if lamp.kind == "sky"]
    # Mitsuba takes one; uniform ones add up where there is no picture.
    pictured = [lamp for lamp in skies if lamp.picture is not None]
    remarks = [] if len(skies) == max(len(pictured[:1]), 1 if skies and not pictured else 0) else [
        f"of {len(skies)} skies {'one with a picture' if pictured else 'the sum'} is taken"
    ]  # fmt: skip
    shapes: dict[str, Any] = {}
    others = [lamp for lamp in lamps if lamp.kind != "sky"]
    for number, lamp in enumerate(others):
        shapes[f"light{number:05}"] = _entry(lamp)
    if pictured:
        shapes["sky"] = _environment(pictured[0], folder)
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
    return {
        "type": "spot", "to_world": T @ _TURN, "intensity": _rgb(lamp.value),
        "cutoff_angle": cutoff, "beam_width": min(beam, 0.999 * cutoff),
    }  # fmt: skip


def _environment(lamp: Lamp, folder: Path) -> dict[str, Any]:
    """An envmap; its one factor is the value's mean, so that the colour of a sky with a picture is lost."""
    assert lamp.picture is not None
    file = folder / f"sky{lamp.suffix}"
    file.write_bytes(lamp.picture)
    return {"type": "envmap", "filename": str(file), "scale": float(lamp.value.mean()), "to_world": lamp.T_world_lamp}


def _rgb(value: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(v) for v in value]}
