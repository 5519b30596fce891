"""Meshes of the things that move by themselves: each a Mitsuba scene of its own, in its own frame, without light."""

from __future__ import annotations

import hashlib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from rsgen.array_types import FloatArray, IntArray
from rsgen.config.objects import ObjectConfig, ShapeConfig
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.render.mended import mend_meshes
from rsgen.render.mesh_files.material import Material, bsdf
from rsgen.render.mesh_files.mesh_file import MeshOptions, hash_into, mesh_scene
from rsgen.render.ply import ply_bytes
from rsgen.render.scene import surface

_SEGMENTS = 64
_MOST_FACES = 200_000  # of a built-in shape's checks


@dataclass(frozen=True, eq=False)
class ObjectMesh:
    """An object's look and size. scene: Mitsuba's; vertices (n, 3), faces (m, 3): its triangles, own frame, m.

    middle (3,) and radius: a ball that holds it; axes (3,): half-axes of an ellipsoid about the middle that stands for
    it where it takes light away, of its bounding box's proportions and its convex hull's volume.
    """

    scene: Any
    vertices: FloatArray
    faces: IntArray
    middle: FloatArray
    radius: float
    axes: FloatArray


def load_object(thing: ObjectConfig) -> ObjectMesh:
    """The mesh of a config's object. Raises UserError, naming the object."""
    mi = mitsuba()
    with tempfile.TemporaryDirectory(prefix="rsgen-object-") as scratch:
        try:
            shapes = _shapes(mi, thing, Path(scratch))
            scene = mend_meshes(mi, mi.load_dict(shapes, parallel=False, optimize=False), Path(thing.name))
        except UserError as error:
            raise UserError(f"objects.{thing.name}: {str(error).removeprefix('scene ')}") from None
        except Exception as error:  # Mitsuba and trimesh raise whatever their parsers do
            text = " ".join(str(error).split())[:300]
            raise UserError(f"objects.{thing.name}: {text}") from None
    single, faces = surface(scene)
    vertices = single.astype(float)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = 0.5 * (low + high)
    radius = float(np.linalg.norm(vertices - middle, axis=1).max())
    half = np.maximum(0.5 * (high - low), 0.01 * radius)  # what is flat has some thickness
    return ObjectMesh(
        scene, vertices, faces.astype(np.int64), middle, radius, half * _fullness(vertices, half) ** (1 / 3)
    )


def _fullness(vertices: FloatArray, half: FloatArray) -> float:
    """Volume of the convex hull over that of the ellipsoid with these half-axes."""
    try:
        volume = float(trimesh.convex.convex_hull(np.asarray(vertices, float)).volume)
    except Exception:  # of points in one plane, Qhull's own
        volume = 0.0
    return max(volume / float(4 / 3 * np.pi * half.prod()), 0.05)


def object_hash(thing: ObjectConfig) -> str:
    """SHA-256 of an object's mesh file and of all that decides its shapes. Raises UserError."""
    digest = hashlib.sha256(thing.model_dump_json(include={"scale", "up", "shape"}).encode())
    if thing.mesh is not None:
        try:
            digest.update(_mesh_file(thing).read_bytes())
            hash_into(digest, thing.mesh, MeshOptions(thing.scale, thing.up, "none"))
        except (AttributeError, KeyError, TypeError, UserError) as error:
            raise UserError(f"objects.{thing.name}: {str(error).removeprefix('scene ')}") from None
    return digest.hexdigest()


def _mesh_file(thing: ObjectConfig) -> Path:
    assert thing.mesh is not None
    if not thing.mesh.is_file():
        raise UserError(f"mesh {thing.mesh}: no such file: name a mesh file, or give a shape")
    return thing.mesh


def _shapes(mi: Any, thing: ObjectConfig, scratch: Path) -> dict[str, Any]:
    if thing.shape is None:
        return mesh_scene(mi, _mesh_file(thing), scratch, MeshOptions(thing.scale, thing.up, "none"))
    mesh, smooth = built_in(thing.shape), thing.shape.kind == "sphere"
    normals = np.asarray(mesh.vertex_normals, float) if smooth else None
    file = scratch / "shape.ply"
    colors = _checks(thing.shape, mesh)
    file.write_bytes(ply_bytes(mesh.vertices, mesh.faces, normals, face_colors=colors))
    look = bsdf(mi, Material(color=np.asarray(thing.shape.color)), None if colors is None else "face_color")
    return {"type": "scene", "shape": {"type": "ply", "filename": str(file), "face_normals": not smooth, "bsdf": look}}


def built_in(shape: ShapeConfig) -> trimesh.Trimesh:
    """Triangles of a box, sphere or cylinder about the origin, fine enough for its checks."""
    size = np.asarray(shape.size_m, float)
    if shape.kind == "box":
        mesh = trimesh.creation.box(extents=size)
    elif shape.kind == "sphere":
        mesh = trimesh.creation.icosphere(4, 1.0)
        mesh.apply_scale(0.5 * size)
    else:
        mesh = trimesh.creation.cylinder(radius=0.5, height=1.0, sections=_SEGMENTS)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
        mesh.apply_scale(size)
    if shape.check_color is None:
        return mesh
    if mesh.area / (0.5 * shape.check_m) ** 2 > _MOST_FACES:
        raise UserError(f"check_m {shape.check_m:g} is too fine for a thing of {size.max():g} m: raise it")
    return mesh.subdivide_to_size(0.5 * shape.check_m, max_iter=20)


def _checks(shape: ShapeConfig, mesh: trimesh.Trimesh) -> FloatArray | None:
    """Reflectance (m, 3) of each triangle; None where all have one."""
    if shape.check_color is None:
        return None
    cell = np.floor(np.asarray(mesh.triangles_center) / shape.check_m).astype(int)
    odd = cell.sum(axis=1) % 2 == 1
    return np.where(odd[:, None], np.asarray(shape.check_color), np.asarray(shape.color))
