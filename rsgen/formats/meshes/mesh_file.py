"""Read a mesh file through trimesh: parts in the world frame, each with one material, in an order that never changes.

Instances are parts of their own. What a mask hides is cut out of the triangles; triangles without area are left out.
"""

from __future__ import annotations

import hashlib
import io
import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from rsgen import srgb
from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.formats.meshes import gltf
from rsgen.formats.meshes.default_light import light_shapes
from rsgen.formats.meshes.parts import WHITE, Part, finished, placed, v_down, without_textures
from rsgen.image_codecs import encode_png
from rsgen.inputs import check_input
from rsgen.scene.material import Material, Texture, bsdf, emitter
from rsgen.scene.meshes import ply_bytes
from rsgen.scene.placement import SceneOptions, world_from_file
from rsgen.scene.xml_scene import located, missing_file

log = logging.getLogger("rsgen")

# Raise when files are read in another way, so that light baked for the older one is not taken for the new one's.
_READING = 1
_GREY = Material()
_GREY_PICTURE = encode_png(np.full((1, 1, 3), 188, np.uint8))  # half of the light, in place of one that is missing
_BLENDED = 0.5  # cover from which a blended surface counts as there
_RENDERED = {"KHR_materials_unlit", "KHR_materials_emissive_strength", "KHR_materials_pbrSpecularGlossiness"}


def read_parts(path: Path, options: SceneOptions) -> list[Part]:
    """All parts of a mesh file. Raises UserError if it holds nothing that can be rendered, or a file of it is missing.

    What trimesh's parsers raise on damaged files comes through.
    """
    return finished(path, [part for _, part in _nodes(path, options)])


def _nodes(path: Path, options: SceneOptions) -> list[tuple[str, Part]]:
    """Nodes that have triangles, by name, in the world."""
    data, header = path.read_bytes(), None
    files = _contents(path, options.skip_missing)
    if path.suffix.lower() in gltf.SUFFIXES:
        header, chunks = gltf.read_header(path)
        data = gltf.for_trimesh(path, header, chunks)
    else:
        libraries = _named(data, b"mtllib") if path.suffix.lower() == ".obj" else []
        for name in files.keys() - set(libraries):
            _refuse_unreadable_texture(path, name, files[name])
        if libraries:
            files[libraries[0]] = b"\n".join(files[name] for name in libraries)  # trimesh reads the first only
    loaded = trimesh.load_scene(io.BytesIO(data), file_type=path.suffix[1:].lower(), resolver=files, process=False)
    T_world_file = world_from_file(options)
    reader = PartReader(path, header)
    parts = []
    for node in loaded.graph.nodes_geometry:  # in the file's order; never sort by name, some are random
        T_file_part, name = loaded.graph[node]
        mesh = loaded.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            parts.append((str(node), placed(path, name, reader.part(mesh, name), T_world_file @ T_file_part)))
    return parts


def named_triangles(path: Path, options: SceneOptions) -> tuple[list[str], FloatArray, IntArray]:
    """Names of a mesh file's nodes, middles (n, 3) of all their triangles in the world, m, and each one's node (n,).

    Raises UserError as `read_parts`.
    """
    names: list[str] = []
    middles, owner = [], []
    for name, part in _nodes(path, options):
        names.append(name)
        middles.append(part.vertices[part.faces].mean(axis=1))
        owner.append(np.full(len(part.faces), len(names) - 1))
    return names, np.concatenate(middles), np.concatenate(owner)


def scene_dict(mi: Any, path: Path, scratch: Path, options: SceneOptions) -> dict[str, Any]:
    """Scene dictionary of a mesh file and of the light that it gets; files go into `scratch`."""
    parts = read_parts(path, options)
    return {"type": "scene", **part_shapes(mi, parts, scratch), **light_shapes(mi, path, parts, options.light, scratch)}


def part_shapes(mi: Any, parts: Sequence[Part], folder: Path) -> dict[str, Any]:
    """Entries of a scene dictionary for parts, whose meshes go into `folder`."""
    shapes: dict[str, Any] = {}
    for number, part in enumerate(parts):
        attribute = "vertex_color" if part.vertex_colors is not None else "face_color"
        colored = part.vertex_colors is not None or part.face_colors is not None
        file = folder / f"{number}.ply"
        colors = part.vertex_colors, part.face_colors
        file.write_bytes(ply_bytes(part.vertices, part.faces, part.normals, part.uv, *colors))
        shape = {"type": "ply", "filename": str(file), "face_normals": part.normals is None}
        shape["bsdf"] = bsdf(mi, part.material, attribute if colored else None)
        if (light := emitter(mi, part.material)) is not None:
            shape["emitter"] = light
        shapes[f"part{number:05}"] = shape
    return shapes


def _contents(path: Path, skip_missing: bool) -> dict[str, bytes]:
    """What is in the files that a mesh file names (buffers, materials, textures), by the name used there.

    Raises UserError if one is missing. skip_missing: a picture that is is an even grey, materials are none.
    """
    suffix = path.suffix.lower()
    libraries: list[str] = []
    if suffix in gltf.SUFFIXES:
        header = gltf.read_header(path)[0]
        names, buffers = gltf.external_files(header), gltf.external_files(header, ("buffers",))
    elif suffix == ".obj":
        names = libraries = _named(path.read_bytes(), rb"mtllib")
        buffers = []
    elif suffix == ".ply":
        with path.open("rb") as file:
            head = file.read(1 << 16).partition(b"end_header")[0]
        names, buffers = _named(head, rb"comment\s+TextureFile"), []
    else:
        return {}

    def read(name: str) -> bytes:
        file = located(path.parent, name)
        if file is not None and file.is_file():
            check_input(file)
            return file.read_bytes()
        if not skip_missing or name in buffers:
            raise UserError(missing_file(path, name))
        log.warning("scene %s: file '%s' is missing: rendered without it", path, name)
        return b"" if name in libraries else _GREY_PICTURE

    contents = {name: read(name) for name in names}
    textures = {name for library in libraries for name in _named(contents[library], rb"map_Kd")}
    return contents | {name: read(name) for name in sorted(textures)}


def hash_into(digest: Any, path: Path, options: SceneOptions) -> None:
    """Add to a hash of the file itself all else that decides its scene. Raises UserError if a file is missing."""
    digest.update(f"\0{_READING} {options.scale!r} {options.up} {options.light}".encode())
    for name, data in sorted(_contents(path, options.skip_missing).items()):
        digest.update(name.encode() + b"\0" + hashlib.sha256(data).digest())


def _named(text: bytes, keyword: bytes) -> list[str]:
    """What follows a keyword at the beginning of lines, each once."""
    found = re.findall(rb"^[ \t]*" + keyword + rb"[ \t]+(.+?)\s*$", text, re.MULTILINE | re.IGNORECASE)
    return list(dict.fromkeys(name.decode(errors="replace") for name in found))


def _refuse_unreadable_texture(path: Path, name: str, data: bytes) -> None:
    """trimesh would leave it out without a word."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            image.load()
    except Exception:  # Pillow raises whatever its decoders do
        raise UserError(f"scene {path}: texture '{name}' cannot be read: make it a PNG or a JPEG") from None


class PartReader:
    """Parts of one file from trimesh's meshes; each material is made once."""

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
                return replace(part, material=WHITE, vertex_colors=from_srgb(visual.vertex_colors))
            if visual.kind == "face":
                return replace(part, material=WHITE, face_colors=from_srgb(visual.face_colors))
            return part
        if visual.uv is not None and len(visual.uv) == len(vertices):
            # trimesh's v runs up, also of glTF, whose own runs down.
            part = replace(part, uv=v_down(np.array(visual.uv, float)[:, :2]))
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
        material = WHITE if part.material is _GREY else part.material
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
            self._made[key] = material, made if with_uv else without_textures(made)
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
        """A texture of trimesh's image, looked up as glTF's textureInfo states."""
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
