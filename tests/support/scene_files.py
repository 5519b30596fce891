"""Small Mitsuba scenes as files, rays into them, and the one line with which a bad one is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendering import mi

from rsgen.errors import UserError
from rsgen.scene.loading import load_scene

_RIGID = '<rotate x="0.36" y="0.48" z="-0.8" angle="50"/><translate x="0.3" y="-0.2" z="0.4"/>'
ANY_POSE = '<scale x="0.8" y="1.3" z="0.6"/>' + _RIGID
EVEN_POSE = '<scale value="0.9"/>' + _RIGID
MIRRORED = '<scale x="-1"/>'
# A plugin's own parameters, whether Mitsuba takes an uneven scale of it, and its size across for the tolerance.
SHAPES = {
    "rectangle": ("", True),
    "disk": ("", True),
    "sphere": ('<float name="radius" value="0.7"/><point name="center" x="0.2" y="0.1" z="-0.3"/>', False),
    "cylinder": (
        '<float name="radius" value="0.4"/><point name="p0" x="0.1" y="-0.5" z="0.2"/>'
        '<point name="p1" x="-0.3" y="0.6" z="0.4"/>',
        False,
    ),
}


def write_scene(folder: Path, *elements: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "scene.xml"
    path.write_text('<scene version="3.0.0">' + "\n".join(elements) + "</scene>")
    return path


def shape_xml(plugin: str, to_world: str, inside: str = "", flip: bool = False) -> str:
    flipped = '<boolean name="flip_normals" value="true"/>' if flip else ""
    pose = f'<transform name="to_world">{to_world}</transform>'
    return f'<shape type="{plugin}" id="it">{SHAPES[plugin][0]}{flipped}{pose}{inside}</shape>'


def rays_at(center: np.ndarray, spread: float, count: int = 4000) -> Any:
    """Rays from all around towards a region."""
    rng = np.random.default_rng(5)
    from_direction = rng.normal(size=(count, 3))
    origin = center + 5 * from_direction / np.linalg.norm(from_direction, axis=-1, keepdims=True)
    d = center + spread * rng.uniform(-1, 1, (count, 3)) - origin
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return mi.Ray3f(mi.Point3f(origin.astype(np.float32).T), mi.Vector3f(d.astype(np.float32).T))


def hits(scene: Any, ray: Any) -> dict[str, np.ndarray]:
    si = scene.ray_intersect(ray)
    vectors = {"p": si.p, "n": si.n, "sh_n": si.sh_frame.n, "uv": si.uv, "emitted": si.emitter(scene).eval(si)}
    found = {name: np.array(v).reshape(len(v), -1).T for name, v in vectors.items()}
    return {**found, "t": np.array(si.t), "valid": np.array(si.is_valid())}


def fails(path: Path, *words: str) -> None:
    with pytest.raises(UserError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600
    for word in (path.name, *words):
        assert re.search(word, message), f"{word!r} is not in: {message}"
