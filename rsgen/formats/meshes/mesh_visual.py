"""What trimesh, and glTF's own JSON, say of how a mesh looks: its material, its colours, its normals."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from rsgen import srgb
from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.formats.meshes import gltf
from rsgen.render.material import Material, Texture

log = logging.getLogger("rsgen")

_GREY = Material()
_WHITE = Material(color=np.ones(3))
_BLENDED = 0.5  # cover from which a blended surface counts as there
_RENDERED = {"KHR_materials_unlit", "KHR_materials_emissive_strength", "KHR_materials_pbrSpecularGlossiness"}


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material in the world frame, m: vertices (n, 3), faces (m, 3).

    normals (n, 3) unit, None: flat; uv (n, 2), v down; colors: linear, (n, 3) of vertices or (m, 3) of faces.
    """

    vertices: FloatArray
    faces: IntArray
    material: Material
    normals: FloatArray | None = None
    uv: FloatArray | None = None
    vertex_colors: FloatArray | None = None
    face_colors: FloatArray | None = None


def joined(parts: Sequence[Part]) -> Part:
    """One part of several that have one material and carry the same."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + k for part, k in zip(parts, first[:-1], strict=True)])
    columns = [
        None if getattr(parts[0], name) is None else np.concatenate([getattr(part, name) for part in parts])
        for name in ("normals", "uv", "vertex_colors", "face_colors")
    ]
    return Part(np.concatenate([part.vertices for part in parts]), faces, parts[0].material, *columns)


class Looks:
    """Parts of one file as trimesh's meshes say they look; each material is made once."""

    def __init__(self, path: Path, header: dict[str, Any] | None) -> None:
        """header: glTF's JSON, as `gltf.for_trimesh` left it; None for other files."""
        self._path, self._header = path, header
        # By identity, and with what they were made of, so that no number is used again.
        self._made: dict[tuple[int, bool], tuple[Any, Material]] = {}
        self._pixels: dict[int, tuple[Any, Any]] = {}
        if header is not None:
            self._warn_of_extensions(header)

    def part(self, mesh: Any, name: str) -> Part:
        """The mesh, called `name`, in its own frame. Raises UserError."""
        vertices, faces = np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise UserError(f"scene {self._path}: '{name}' has faces without vertices: export it again")
        part, visual = Part(vertices, faces, _GREY, given_normals(mesh)), mesh.visual
        if not isinstance(visual, trimesh.visual.TextureVisuals):
            if visual.kind == "vertex":
                return replace(part, material=_WHITE, vertex_colors=from_srgb(visual.vertex_colors))
            if visual.kind == "face":
                return replace(part, material=_WHITE, face_colors=from_srgb(visual.face_colors))
            return part
        if visual.uv is not None and len(visual.uv) == len(vertices):
            # trimesh's v runs up. Mitsuba's runs down, as glTF's does.
            uv = np.nan_to_num(np.array(visual.uv, float)[:, :2] * [1, -1] + [0, 1])
            part = replace(part, uv=np.clip(uv, -1e5, 1e5))
        part = replace(part, material=self._material(visual.material, part.uv is not None))
        return self._with_factors(part, visual.vertex_attributes.get("color"), name)

    def _with_factors(self, part: Part, factors: Any, name: str) -> Part:
        """A part with glTF's vertex colours, which are linear, and factors on the material's."""
        if factors is None or len(factors) != len(part.vertices):
            return part
        values = np.array(factors, float)[:, :3] / (np.iinfo(factors.dtype).max if factors.dtype.kind == "u" else 1.0)
        if not np.isfinite(values).all():
            raise UserError(f"scene {self._path}: '{name}' has colours that are not finite: export it again")
        # A primitive without a material is grey only where it has no colours either.
        material = _WHITE if part.material is _GREY else part.material
        if material.color_texture is not None:
            if np.ptp(values, axis=0).any():
                log.warning("scene %s: vertex colours of '%s' left out: it has a texture", self._path, name)
                return part
            factor = material.color * values[0]
            return part if (values[0] == 1).all() else replace(part, material=replace(material, color=factor))
        return replace(part, material=material, vertex_colors=np.clip(values * material.color, 0, 1))

    def _material(self, material: Any, with_uv: bool) -> Material:
        key = id(material), with_uv
        if key not in self._made:
            simple = isinstance(material, trimesh.visual.material.SimpleMaterial)
            made = self._simple(material) if simple else self._pbr(material)
            if not with_uv and made is not _GREY:
                none: dict[str, Any] = dict.fromkeys(
                    f"{name}_texture" for name in ("color", "metal", "normal", "emission")
                )
                made = replace(made, **none)
            self._made[key] = material, made
        return self._made[key][1]

    def _simple(self, material: Any) -> Material:
        """Of an OBJ or a PLY. A texture takes the place of the colour, as most programs that write both mean it."""
        own = material.kwargs
        glow = own.get("ke", ())
        emission = np.array([float(x) for x in glow[:3]]) if len(glow) >= 3 else np.zeros(3)
        # An image without a format is no file's, but trimesh's own dark grey for coordinates without a texture.
        if material.image is not None and material.image.format is not None:
            return Material(np.ones(3), self._texture(material.image, {}), emission=emission)
        if np.size(own.get("kd")) == 3:
            return Material(np.array(own["kd"], float), emission=emission)
        return Material(emission=emission) if emission.any() else _GREY

    def _pbr(self, material: Any) -> Material:
        json = {} if self._header is None else gltf.material_of(self._header, material.name)
        if json is None:
            return _GREY
        extensions = json.get("extensions", {})
        factors = {} if "KHR_materials_pbrSpecularGlossiness" in extensions else json.get("pbrMetallicRoughness", {})
        if "baseColorFactor" in factors:
            color = np.array(factors["baseColorFactor"], float)
        elif material.baseColorFactor is not None:
            color = np.array(material.baseColorFactor, float) / 255
        else:
            color = np.ones(4)
        unlit = "KHR_materials_unlit" in extensions
        metallic, roughness = (
            1.0 if f is None else float(f) for f in (material.metallicFactor, material.roughnessFactor)
        )
        glow = np.zeros(3) if material.emissiveFactor is None else np.array(material.emissiveFactor, float)
        strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        cutoff = {"MASK": 0.5 if material.alphaCutoff is None else float(material.alphaCutoff), "BLEND": _BLENDED}
        normal = json.get("normalTexture", {})
        return Material(
            color=color[:3],
            color_texture=self._texture(material.baseColorTexture, factors.get("baseColorTexture", {})),
            opacity=float(color[3]),
            cutoff=cutoff.get(str(material.alphaMode)),
            metallic=0.0 if unlit else metallic,
            roughness=1.0 if unlit else roughness,
            metal_texture=None if unlit else self._texture(
                material.metallicRoughnessTexture, factors.get("metallicRoughnessTexture", {})
            ),
            normal_texture=self._texture(material.normalTexture, normal),
            normal_scale=float(normal.get("scale", 1.0)),
            emission=glow * float(strength),
            emission_texture=self._texture(material.emissiveTexture, json.get("emissiveTexture", {})),
        )  # fmt: skip

    def _texture(self, image: Any, info: dict[str, Any]) -> Texture | None:
        """A texture of trimesh's image, as glTF's textureInfo says that it is looked up."""
        if image is None:
            if info:
                raise UserError(f"scene {self._path}: a texture of it cannot be read: make it a PNG or a JPEG")
            return None
        if id(image) not in self._pixels:
            try:
                self._pixels[id(image)] = image, np.asarray(image.convert("RGBA"))
            except (OSError, ValueError, SyntaxError):  # what Pillow raises on damaged images
                raise UserError(f"scene {self._path}: a texture of it is damaged: export it again") from None
        pixels = self._pixels[id(image)][1]
        return Texture(pixels) if self._header is None else Texture(pixels, *gltf.sampling(self._header, info))

    def _warn_of_extensions(self, header: dict[str, Any]) -> None:
        used = {name for material in header.get("materials", []) for name in material.get("extensions", {})}
        if left := sorted(used - _RENDERED):
            log.warning("scene %s: rendered without %s", self._path, ", ".join(left))


def given_normals(mesh: Any) -> FloatArray | None:
    """The file's own vertex normals; trimesh would make some up, smooth over every edge."""
    if "vertex_normals" not in mesh._cache.cache:
        return None
    normals = np.array(mesh.vertex_normals, float)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    usable = normals.shape == mesh.vertices.shape and np.isfinite(length).all() and length.all()
    return normals / length if usable else None


def from_srgb(colors: Any) -> FloatArray:
    """Linear colours (n, 3) of trimesh's, bytes in sRGB as PLY and OBJ have them by custom."""
    return srgb.decode(np.array(colors, float)[:, :3] / 255)
