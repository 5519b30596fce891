"""Meshes of moving objects: each a Mitsuba scene of its own, in its own frame, without light."""

from __future__ import annotations

import hashlib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.config.motion import ObjectConfig, ShapeConfig
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.formats import scene_reader
from rsgen.scene.material import Material, bsdf
from rsgen.scene.meshes import grid_faces, joined_triangles, ply_bytes, repair_meshes, surface
from rsgen.scene.placement import SceneOptions

_SEGMENTS = 96  # squares around a ball or cylinder, at least
_MOST_CHECKS = 20_000


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
            scene = repair_meshes(mi, mi.load_dict(shapes, parallel=False, optimize=False), Path(thing.name))
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
            scene_reader(thing.mesh.suffix).hash_into(digest, thing.mesh, SceneOptions(thing.scale, thing.up, "none"))
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
        file = _mesh_file(thing)
        shapes: dict[str, Any] = scene_reader(file.suffix).scene_dict(
            mi, file, scratch, SceneOptions(thing.scale, thing.up, "none")
        )
        return shapes
    vertices, faces, odd = built_in(thing.shape)
    size, other = np.asarray(thing.shape.size_m), thing.shape.check_color
    smooth = thing.shape.kind == "sphere"
    normals = vertices / size**2 if smooth else None
    colors = None if other is None else np.where(odd[:, None], np.asarray(other), np.asarray(thing.shape.color))
    file = scratch / "shape.ply"
    file.write_bytes(ply_bytes(vertices, faces, normals, face_colors=colors))
    look = bsdf(mi, Material(color=np.asarray(thing.shape.color)), None if colors is None else "face_color")
    return {"type": "scene", "shape": {"type": "ply", "filename": str(file), "face_normals": not smooth, "bsdf": look}}


def built_in(shape: ShapeConfig) -> tuple[FloatArray, IntArray, BoolArray]:
    """Vertices (n, 3) and faces (m, 3) of a box, ball or cylinder about the origin, and which are odd checks (m,)."""
    size, edge = np.asarray(shape.size_m, float), shape.check_m if shape.check_color is not None else np.inf
    along = np.maximum(np.rint(size / edge), 1).astype(int)
    around = 2 * max(1, round(0.25 * np.pi * (size[0] + size[2]) / edge))
    cut = max(1, -(-_SEGMENTS // around))  # parts of a check, so that it bends
    if (along * np.roll(along, 1)).sum() + around * along[1] > _MOST_CHECKS:
        raise UserError(f"check_m {shape.check_m:g} is too fine for a thing of {size.max():g} m: raise it")
    sheets = []
    if shape.kind == "box":
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            for side in (-0.5, 0.5):
                a, b, faces, odd = _sheet(along[i], along[j], 1)
                place = np.full((len(a), 3), side)
                place[:, i], place[:, j] = a - 0.5, b - 0.5
                sheets.append((place, faces, odd))
    elif shape.kind == "sphere":
        a, b, faces, odd = _sheet(max(2, around // 2), around, cut)
        sheets.append((_around(0.5 * np.sin(np.pi * a), 0.5 * np.cos(np.pi * a), b), faces, odd))
    else:
        a, b, faces, odd = _sheet(along[1], around, cut)
        sheets.append((_around(0.5, a - 0.5, b), faces, odd))
        for side in (-0.5, 0.5):
            a, b, faces, odd = _sheet(max(1, along[0] // 2), around, cut)
            sheets.append((_around(0.5 * a, side, b), faces, odd))
    vertices, faces = joined_triangles([sheet[0] for sheet in sheets], [sheet[1] for sheet in sheets])
    return vertices * size, faces, np.concatenate([sheet[2] for sheet in sheets])


def _around(radius: FloatArray | float, y: FloatArray | float, turn: FloatArray) -> FloatArray:
    """Points (n, 3) about the y axis; turn (n,): of the whole circle."""
    return np.stack(np.broadcast_arrays(radius * np.sin(2 * np.pi * turn), y, radius * np.cos(2 * np.pi * turn)), -1)


def _sheet(rows: int, columns: int, cut: int) -> tuple[FloatArray, FloatArray, IntArray, BoolArray]:
    """A square of rows x columns checks of cut x cut parts: coordinates a, b (n,) in [0, 1] of its vertices, faces
    (m, 3), and which faces are of odd checks (m,).
    """
    m, n = int(rows) * cut, int(columns) * cut
    a, b = (grid.ravel() for grid in np.meshgrid(np.arange(m + 1) / m, np.arange(n + 1) / n, indexing="ij"))
    i, j, faces = grid_faces(m, n)
    return a, b, faces, np.tile((i // cut + j // cut) % 2 == 1, 2)
