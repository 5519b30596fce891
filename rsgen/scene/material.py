"""Materials of mesh files, and Mitsuba BSDFs for them that path tracing and baked light agree on.

Of Mitsuba's BSDFs `principled` is nearest to glTF's, but it does not tell its diffuse lobe from the others, and baked
light needs that. So: `diffuse` for what is matte, `roughplastic` where a highlight would show, `roughconductor` for
metal, `blendbsdf` between them, all seen from both sides.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rsgen import srgb
from rsgen.array_types import ByteArray, Float32Array, FloatArray

GREY = 0.6  # reflectance of surfaces without any colour of their own
_MATTE = 0.7  # a dielectric this rough or rougher has no highlight to speak of
_SMOOTHEST = 0.03  # roughness: below, lamps in a highlight become sparkles
_METAL = 0.02  # a share of metal this near to 0 or 1 counts as that
_NO_TRANSFORM = np.eye(2, 3)


@dataclass(frozen=True, eq=False)
class Texture:
    """An image (h, w, 4) of bytes, row 0 at v = 0, and how it is looked up.

    wrap: repeat, clamp or mirror; transform (2, 3): from texture coordinates (v down) to the image's.
    """

    pixels: ByteArray
    wrap: str = "repeat"
    nearest: bool = False
    transform: FloatArray = field(default_factory=lambda: _NO_TRANSFORM)


@dataclass(frozen=True, eq=False)
class Material:
    """What a surface looks like: glTF's metallic-roughness model. Factors are linear, (3,) for colours."""

    color: FloatArray = field(default_factory=lambda: np.full(3, GREY))
    color_texture: Texture | None = None
    opacity: float = 1.0
    cutoff: float | None = None  # opacity from which the surface is there; None: everywhere
    metallic: float = 0.0
    roughness: float = 1.0
    metal_texture: Texture | None = None  # roughness in green, metal in blue
    normal_texture: Texture | None = None
    normal_scale: float = 1.0
    emission: FloatArray = field(default_factory=lambda: np.zeros(3))  # radiance
    emission_texture: Texture | None = None


def bsdf(mi: Any, material: Material, attribute: str | None) -> dict[str, Any]:
    """Mitsuba dictionary of a material's BSDF; attribute: of the mesh, to be its colour in the place of its own."""
    metal, roughness = _metal_and_roughness(mi, material)
    paint = {"type": "mesh_attribute", "name": attribute} if attribute else _color(mi, material)
    matte: dict[str, Any] = {"type": "diffuse", "reflectance": paint}
    mean = float(np.mean(_channel(material, 1))) * material.roughness
    if mean < _MATTE:
        # Its roughness takes no texture.
        gloss = max(mean, _SMOOTHEST) ** 2
        matte = {"type": "roughplastic", "distribution": "ggx", "alpha": gloss, "diffuse_reflectance": paint}
    conductor = {"type": "roughconductor", "distribution": "ggx", "alpha": roughness, "specular_reflectance": paint}
    inner: dict[str, Any]
    if isinstance(metal, dict):
        inner = {"type": "blendbsdf", "weight": metal, "first": matte, "second": conductor}
    else:
        inner = conductor if metal == 1 else matte
    # A tilted diffuse lobe beside a highlight makes sparkles in baked light, which has one irradiance per point.
    if material.normal_texture is not None and inner["type"] in ("diffuse", "roughconductor"):
        inner = {"type": "normalmap", "normalmap": _normals(mi, material), "inner": inner}
    return {"type": "twosided", "inner": inner}


def emitter(mi: Any, material: Material) -> dict[str, Any] | None:
    """Mitsuba dictionary of the light that a material sends out, on its front; None for none."""
    if not material.emission.any():
        return None
    radiance: dict[str, Any] = _rgb(material.emission)
    if material.emission_texture is not None:
        values = _linear(material.emission_texture) * material.emission
        if not values.any():
            return None
        radiance = _bitmap(mi, material.emission_texture, values)
    return {"type": "area", "radiance": radiance}


def _metal_and_roughness(mi: Any, material: Material) -> tuple[Any, Any]:
    """Share of metal (a number, or a texture where it changes), and Mitsuba's alpha = roughness² likewise."""
    metal = _channel(material, 2) * material.metallic
    alpha = np.clip(_channel(material, 1) * material.roughness, _SMOOTHEST, 1) ** 2
    if material.metal_texture is None or np.ptp(alpha) < 1e-6:
        rough: Any = float(alpha.flat[0])
    else:
        rough = _bitmap(mi, material.metal_texture, alpha[..., None])
    if metal.max() < _METAL:
        return 0.0, rough
    if metal.min() > 1 - _METAL:
        return 1.0, rough
    if material.metal_texture is None or np.ptp(metal) < 1e-6:
        return {"type": "uniform", "value": float(metal.flat[0])}, rough
    return _bitmap(mi, material.metal_texture, metal[..., None]), rough


def _channel(material: Material, channel: int) -> Float32Array:
    """Channel (h, w) of the metallic-roughness texture, 0 to 1; 1 where there is none."""
    if material.metal_texture is None:
        return np.ones((1, 1), np.float32)
    return material.metal_texture.pixels[..., channel].astype(np.float32) / np.float32(255)


def _color(mi: Any, material: Material) -> dict[str, Any]:
    if material.color_texture is None:
        return _rgb(np.clip(material.color, 0, 1))
    values = np.clip(_linear(material.color_texture) * material.color, 0, 1)
    return _bitmap(mi, material.color_texture, values)


def _normals(mi: Any, material: Material) -> dict[str, Any]:
    assert material.normal_texture is not None
    n = material.normal_texture.pixels[..., :3].astype(np.float32) / 127.5 - 1
    n[..., :2] *= material.normal_scale
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-6)
    return _bitmap(mi, material.normal_texture, (n + 1) / 2)


def _linear(texture: Texture) -> Float32Array:
    return srgb.decode(np.arange(256) / 255).astype(np.float32)[texture.pixels[..., :3]]


def _rgb(values: FloatArray) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(v) for v in values]}


def _bitmap(mi: Any, texture: Texture, values: FloatArray | Float32Array) -> dict[str, Any]:
    """A `bitmap` of linear values (h, w, 1 or 3), looked up as `texture` is."""
    to_uv = np.vstack([texture.transform, [0, 0, 1]])
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(values, np.float32)),
        "format": "fp16",
        "raw": True,
        "wrap_mode": texture.wrap,
        "filter_type": "nearest" if texture.nearest else "bilinear",
        "to_uv": mi.ScalarTransform3f(to_uv),
    }
