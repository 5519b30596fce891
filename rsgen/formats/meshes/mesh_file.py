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

from rsgen.array_types import FloatArray
from rsgen.config.sections import SceneLight
from rsgen.errors import UserError
from rsgen.formats.meshes import gltf
from rsgen.formats.meshes.cutout import Mask, cut_away
from rsgen.formats.meshes.default_light import SKY, Probe
from rsgen.formats.meshes.mesh_visual import Looks, Part, joined
from rsgen.inputs import check_input
from rsgen.limits import MOST_M
from rsgen.render.file_names import located
from rsgen.render.material import bsdf, emitter
from rsgen.render.meshes import joined_triangles, ply_bytes
from rsgen.render.placement import SceneOptions, world_from_file

log = logging.getLogger("rsgen")

# Raise when files are read in another way, so that light baked for the older one is not taken for the new one's.
_READING = 1
_USUAL_M = (0.02, 300.0)  # sizes outside are rather wrong units


def read_parts(path: Path, options: SceneOptions) -> list[Part]:
    """All parts of a mesh file. Raises UserError if it holds nothing that can be rendered, or a file of it is missing.

    What trimesh's parsers raise on damaged files comes through.
    """
    data, header = path.read_bytes(), None
    files = {name: file.read_bytes() for name, file in referenced_files(path).items()}
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
    looks = Looks(path, header)
    parts = []
    for node in loaded.graph.nodes_geometry:  # in the file's order; never sort by name, some are random
        T_file_part, name = loaded.graph[node]
        mesh = loaded.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            parts.append(placed(path, name, looks.part(mesh, name), T_world_file @ T_file_part))
    return finished(path, parts)


def placed(path: Path, name: str, part: Part, T_world_part: FloatArray) -> Part:
    """A part of `path`, called `name` there, moved into the world by any affine map. Raises UserError."""
    if not (np.isfinite(part.vertices).all() and np.isfinite(T_world_part).all()):
        raise UserError(f"scene {path}: '{name}' has vertices that are not finite: mend it and export it again")
    return _moved(part, T_world_part)


def finished(path: Path, parts: Sequence[Part]) -> list[Part]:
    """Parts in the world, those alike as one, without triangles of no area and what masks hide. Raises UserError."""
    left, dropped = [], 0
    for part in parts:
        part, without_area = _solid(part)
        dropped += without_area
        if len(part.faces):
            left.append(_cut(part))
    if dropped:
        log.info("scene %s: %d triangles without area left out", path, dropped)
    left = _merged([part for part in left if len(part.faces)])
    if not left:
        raise UserError(f"scene {path}: holds no triangles that could be seen: export a mesh, with faces of some area")
    _check_size(path, left)
    return left


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


def light_shapes(mi: Any, path: Path, parts: Sequence[Part], light: SceneLight, folder: Path) -> dict[str, Any]:
    """Entries of a scene dictionary for the light that parts get, whose lamps' meshes go into `folder`.

    Raises UserError if lamps are asked for where there is no ceiling.
    """
    if light == "none":
        return {}
    probe = Probe(mi, *joined_triangles([part.vertices for part in parts], [part.faces for part in parts]))
    is_room = light == "ceiling" or (light == "auto" and probe.encloses())
    lamps = probe.lamps() if is_room else None
    if lamps is None and light == "ceiling":
        raise UserError(f"scene {path}: has no ceiling over its middle to put lamps under: set scene.light to sky")
    if lamps is None:
        return {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}}}
    shapes: dict[str, Any] = {}
    for number, corners in enumerate(lamps.corners):
        file = folder / f"lamp{number}.ply"
        file.write_bytes(ply_bytes(corners, np.array([[0, 1, 2], [0, 2, 3]])))
        radiance = {"type": "rgb", "value": lamps.radiance}
        shapes[f"lamp{number:05}"] = {
            "type": "ply", "filename": str(file), "face_normals": True, "bsdf": {"type": "diffuse"},
            "emitter": {"type": "area", "radiance": radiance},
        }  # fmt: skip
    return shapes


def referenced_files(path: Path) -> dict[str, Path]:
    """Files that a mesh file names (buffers, materials, textures), by the name used there.

    Raises UserError if one is missing.
    """
    suffix = path.suffix.lower()
    if suffix in gltf.SUFFIXES:
        names = gltf.external_files(gltf.read_header(path)[0])
        return {name: _beside(path, name) for name in names}
    if suffix == ".obj":
        libraries = {name: _beside(path, name) for name in _named(path.read_bytes(), rb"mtllib")}
        textures = {name for file in libraries.values() for name in _named(file.read_bytes(), rb"map_Kd")}
        return libraries | {name: _beside(path, name) for name in sorted(textures)}
    if suffix == ".ply":
        with path.open("rb") as file:
            head = file.read(1 << 16).partition(b"end_header")[0]
        return {name: _beside(path, name) for name in _named(head, rb"comment\s+TextureFile")}
    return {}


def hash_into(digest: Any, path: Path, options: SceneOptions) -> None:
    """Add to a hash of the file itself all else that decides its scene. Raises UserError if a file is missing."""
    digest.update(f"\0{_READING} {options.scale!r} {options.up} {options.light}".encode())
    for name, file in sorted(referenced_files(path).items()):
        digest.update(name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())


def _named(text: bytes, keyword: bytes) -> list[str]:
    """What follows a keyword at the beginning of lines, each once."""
    found = re.findall(rb"^[ \t]*" + keyword + rb"[ \t]+(.+?)\s*$", text, re.MULTILINE | re.IGNORECASE)
    return list(dict.fromkeys(name.decode(errors="replace") for name in found))


def _beside(path: Path, name: str) -> Path:
    file = located(path.parent, name)
    if file is None or not file.is_file():
        raise UserError(f"scene {path}: file '{name}' that it names is missing: put it there, or take its name out")
    check_input(file)
    return file


def _refuse_unreadable_texture(path: Path, name: str, data: bytes) -> None:
    """trimesh would leave it out without a word."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            image.load()
    except Exception:  # Pillow raises whatever its decoders do
        raise UserError(f"scene {path}: texture '{name}' cannot be read: make it a PNG or a JPEG") from None


def _moved(part: Part, T: FloatArray) -> Part:
    A = T[:3, :3]
    normals, faces = part.normals, part.faces
    if normals is not None:
        # The cofactors: what the inverse's transpose is but for its length, and defined where there is no inverse.
        cofactors = np.stack([np.cross(A[1], A[2]), np.cross(A[2], A[0]), np.cross(A[0], A[1])])
        normals = normals @ cofactors.T * np.sign(np.linalg.det(A))
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / length if np.isfinite(length).all() and length.all() else None
    if np.linalg.det(A) < 0:
        faces = faces[:, ::-1]
    return replace(part, vertices=part.vertices @ A.T + T[:3, 3], normals=normals, faces=faces)


def _solid(part: Part) -> tuple[Part, int]:
    """The part without triangles of no area, as float32 has them, and how many those were."""
    a, b, c = (part.vertices[part.faces[:, k]].astype(np.float32).astype(float) for k in range(3))
    edges = np.stack([b - a, c - b, a - c])
    longest = (edges**2).sum(axis=2).max(axis=0)
    keep = np.linalg.norm(np.cross(edges[0], edges[1]), axis=1) > 1e-7 * longest
    colors = None if part.face_colors is None else part.face_colors[keep]
    return replace(part, faces=part.faces[keep], face_colors=colors), int((~keep).sum())


def _cut(part: Part) -> Part:
    """What a mask leaves of a part."""
    material = part.material
    if material.cutoff is None:
        return part
    texture = material.color_texture
    if texture is None or part.uv is None:
        return part if material.opacity >= material.cutoff else replace(part, faces=part.faces[:0])
    alpha = texture.pixels[..., 3] / 255 * material.opacity
    if texture.wrap == "mirror":
        alpha = np.block([[alpha, alpha[:, ::-1]], [alpha[::-1], alpha[::-1, ::-1]]])
    uv = part.uv @ texture.transform[:, :2].T + texture.transform[:, 2]
    xy = uv * texture.pixels.shape[1::-1] - 0.5
    carried = [part.vertices, part.uv] + [v for v in (part.normals, part.vertex_colors) if v is not None]
    mask = Mask(alpha, material.cutoff, texture.wrap != "clamp")
    rows, faces, source = cut_away(np.concatenate(carried, axis=1), part.faces, xy, mask)
    columns = np.split(rows, np.cumsum([v.shape[1] for v in carried])[:-1], axis=1)
    normals = None if part.normals is None else columns[2]
    colors = None if part.vertex_colors is None else columns[-1]
    of_faces = None if part.face_colors is None else part.face_colors[source]
    return _solid(Part(columns[0], faces, material, normals, columns[1], colors, of_faces))[0]


def _merged(parts: list[Part]) -> list[Part]:
    """Parts of the same material as one: light is baked, and kernels are compiled, shape by shape."""
    alike: dict[tuple[Any, ...], list[Part]] = {}
    for part in parts:
        carries = (part.normals, part.uv, part.vertex_colors, part.face_colors)
        alike.setdefault((id(part.material), *(v is not None for v in carries)), []).append(part)
    return [joined(same) for same in alike.values()]


def _check_size(path: Path, parts: list[Part]) -> None:
    corners = np.concatenate(
        [[p.vertices[p.faces].min(axis=(0, 1)), p.vertices[p.faces].max(axis=(0, 1))] for p in parts]
    )
    size = float(np.ptp(corners, axis=0).max())
    if not np.abs(corners).max() <= MOST_M:
        raise UserError(f"scene {path}: reaches beyond {MOST_M:g} m: set scene.scale to metres per unit of the file")
    if not _USUAL_M[0] <= size <= _USUAL_M[1]:
        log.warning("scene %s: is %.3g m across: is scene.scale right, metres per unit of the file?", path, size)
