"""Small USD stages as text, and what an imported scene holds when it is loaded: triangles, brightness, albedo."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendering import mi

from rsgen.formats.scenes.import_scene import import_scene
from rsgen.scene.loading import load_scene
from rsgen.scene.meshes import surface

needs_usd = pytest.mark.skipif(find_spec("pxr") is None, reason="needs USD: pip install usd-core")
SQUARE = """
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1)]
    uniform token subdivisionScheme = "none"
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "faceVarying")
"""
MATTE = "float inputs:roughness = 1"

# USD wants a line an attribute.
_TYPES = "(?:double|float|color3f|point3f|int|int64|quath|bool|asset|string|token|rel)"
_ATTRIBUTE = re.compile(rf"(?<!uniform) +(?=(?:uniform )?(?:{_TYPES}\d?(?:\[\])? [\w:.]+(?: =| *[}}\n]))|\}}|def )")


def usda(path: Path, content: str, unit: float = 1.0, up: str = "Y") -> Path:
    """A stage of this content, in which spaces will do between attributes."""
    content = _ATTRIBUTE.sub("\n", content)
    path.write_text(f'#usda 1.0\n(\n    metersPerUnit = {unit}\n    upAxis = "{up}"\n)\n{content}')
    return path


def material(inputs: str, more: str = "") -> str:
    return f"""
def Material "Paint" {{
    token outputs:surface.connect = </Paint/Surface.outputs:surface>
    def Shader "Surface" {{
        uniform token info:id = "UsdPreviewSurface"
        {inputs}
        token outputs:surface
    }}
    {more}
}}
"""


def square(extra: str = "", bound: bool = True) -> str:
    binding = "rel material:binding = </Paint>" if bound else ""
    api = '(prepend apiSchemas = ["MaterialBindingAPI"])' if bound else ""
    return f'def Mesh "Square" {api} {{{SQUARE}{binding}\n{extra}\n}}\n'


def imported(file: Path, out: Path | None = None, **options: Any) -> tuple[Any, tuple[str, ...]]:
    """The scene as it is loaded again, and the notes."""
    made = import_scene(file, out or file.with_suffix(""), force=True, **options)
    return load_scene(made.scene), made.notes


def triangles(scene: Any) -> np.ndarray:
    """(m, 3, 3) in an order of their own, each beginning with its least corner."""
    vertices, faces = surface(scene)
    return canonical(vertices[faces])


def canonical(t: np.ndarray) -> np.ndarray:
    t = np.round(np.asarray(t, float), 4) + 0.0
    first = [min(range(3), key=lambda k: tuple(x[k])) for x in t]
    turned = np.array([np.roll(x, -k, axis=0) for x, k in zip(t, first, strict=True)])
    return turned[np.lexsort(turned.reshape(len(t), 9).T[::-1])]


def brightness(scene: Any, spp: int = 1, **how: int) -> np.ndarray:
    """Radiance (3,) that leaves the scene's middle, seen askew from above, by direct light."""
    sensor = {
        "type": "radiancemeter", "origin": [0.3, 0.4, 0.2], "direction": [-0.3, -0.4, -0.2],
        "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
    }  # fmt: skip
    image = mi.render(scene, sensor=mi.load_dict(sensor), integrator=mi.load_dict({"type": "direct"} | how), spp=spp)
    return np.array(image).ravel()[:3]


def albedo(scene: Any, xz: np.ndarray) -> np.ndarray:
    """Linear diffuse reflectance (n, 3) of what lies below points (n, 2)."""
    o = np.column_stack([xz[:, 0], np.full(len(xz), 5.0), xz[:, 1]]).astype(np.float32).T
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(0, -1, 0)))
    return np.array(si.bsdf().eval_diffuse_reflectance(si)).reshape(3, -1).T
