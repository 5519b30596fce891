"""Triangles of a USD mesh, or of one of USD's solids: corners, normals, coordinates and colours, part by part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.formats.meshes.parts import WHITE, Part, triangulate, v_down, without_textures
from rsgen.formats.scenes.import_scene import Notes
from rsgen.formats.scenes.usd_material import BoundMaterial

SOLIDS = ("Cube", "Sphere", "Cylinder", "Cone", "Capsule", "Plane")

Primvar = Callable[[str], tuple[FloatArray, str] | None]
"""Values (k, ...) of a primvar by its name, with the kind of its interpolation; None if there is none."""

_CREASE = np.cos(np.radians(50))  # an edge whose corner leans less from its vertex is a smooth one
_SECTIONS = 48
# Rotations that take z to the axis; a plane's width and length have axes of their own.
_AXES = {"X": [[0, 0, 1], [1, 0, 0], [0, 1, 0]], "Y": [[0, 1, 0], [0, 0, 1], [1, 0, 0]], "Z": np.eye(3).tolist()}
_PLANE_AXES = _AXES | {"X": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], "Y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}


@dataclass(frozen=True, eq=False)
class PrimTriangles:
    """Triangles in a prim's own frame: points (n, 3); corners (m, 3) into face-vertices, whose point and face follow.

    vertex (k,): point of each face-vertex; face (m,): polygon of each triangle.
    """

    points: FloatArray
    vertex: IntArray
    corners: IntArray
    face: IntArray
    faces: int

    @property
    def triangles(self) -> IntArray:
        """Points of each triangle (m, 3)."""
        return self.vertex[self.corners]

    def at_corners(self, values: FloatArray, interpolation: str) -> FloatArray | None:
        """Values (m, 3, ...) at the corners; None if their number does not fit."""
        sizes = {"constant": 1, "uniform": self.faces, "faceVarying": len(self.vertex)}
        if len(values) != sizes.get(interpolation, len(self.points)):
            return None
        if interpolation == "constant":
            return np.broadcast_to(values[0], (*self.corners.shape, *values.shape[1:]))
        if interpolation == "uniform":
            return np.repeat(values[self.face][:, None], 3, axis=1)
        return values[self.corners if interpolation == "faceVarying" else self.triangles]


def mesh_triangles(mesh: Any, time: Any, notes: Notes, name: str) -> PrimTriangles | None:
    """Triangles of a UsdGeom.Mesh; None if it has none, or names points that it has not."""
    points = _array(mesh.GetPointsAttr().Get(time), (0, 3))
    counts = _array(mesh.GetFaceVertexCountsAttr().Get(time), (0,)).astype(np.int64)
    vertex = _array(mesh.GetFaceVertexIndicesAttr().Get(time), (0,)).astype(np.int64)
    if not len(counts) or not len(points):
        return None
    if counts.min() < 0 or counts.sum() != len(vertex) or vertex.min(initial=0) < 0 or vertex.max() >= len(points):
        notes.add("left out, its faces name vertices that are not there", name)
        return None
    if not np.isfinite(points[vertex]).all():
        notes.add("left out, it has vertices that are not finite", name)
        return None
    filled = np.ones(len(counts), bool)
    holes = _array(mesh.GetHoleIndicesAttr().Get(time), (0,)).astype(np.int64)
    filled[holes[(holes >= 0) & (holes < len(counts))]] = False
    corners, face = triangulate(points, vertex, counts, filled)
    if mesh.GetOrientationAttr().Get(time) == "leftHanded":
        corners = corners[:, ::-1]
    return PrimTriangles(points, vertex, corners, face, len(counts)) if len(corners) else None


def solid(prim: Any, geom: Any, time: Any) -> tuple[PrimTriangles, FloatArray]:
    """Triangles of a UsdGeom solid, and normals (m, 3, 3) at their corners."""
    kind = prim.GetTypeName()
    own = getattr(geom, kind)(prim)

    def number(name: str) -> float:
        return float(getattr(own, f"Get{name}Attr")().Get(time))

    turn = np.eye(3)
    if kind == "Cube":
        mesh = trimesh.creation.box([number("Size")] * 3)
    elif kind == "Sphere":
        mesh = trimesh.creation.uv_sphere(number("Radius"), count=(_SECTIONS // 2, _SECTIONS))
    else:
        axes = _PLANE_AXES if kind == "Plane" else _AXES
        turn = np.array(axes[str(own.GetAxisAttr().Get(time))], float)
        if kind == "Plane":
            w, h = number("Width") / 2, number("Length") / 2
            mesh = trimesh.Trimesh([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]], [[0, 1, 2], [0, 2, 3]])
        elif kind == "Cylinder":
            mesh = trimesh.creation.cylinder(number("Radius"), number("Height"), _SECTIONS)
        elif kind == "Cone":
            mesh = trimesh.creation.cone(number("Radius"), number("Height"), _SECTIONS)
            mesh.apply_translation([0, 0, -number("Height") / 2])
        else:
            mesh = trimesh.creation.capsule(number("Height"), number("Radius"), (_SECTIONS // 2, _SECTIONS))
            mesh.apply_translation([0, 0, -mesh.bounds.mean(axis=0)[2]])
    points, faces = np.array(mesh.vertices) @ turn.T, np.array(mesh.faces, np.int64)
    surface = PrimTriangles(
        points, faces.ravel(), np.arange(faces.size).reshape(-1, 3), np.arange(len(faces)), len(faces)
    )
    return surface, smooth_normals(surface)


def smooth_normals(surface: PrimTriangles) -> FloatArray:
    """Unit normals (m, 3, 3) at the corners: smooth over a vertex unless the corner's triangle leans far from it."""
    a, b, c = (surface.points[surface.triangles[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    summed = np.zeros_like(surface.points)
    np.add.at(summed, surface.triangles.ravel(), np.repeat(flat, 3, axis=0))
    smooth = _unit(summed)[surface.triangles]
    flat = np.repeat(_unit(flat)[:, None], 3, axis=1)
    return np.where(((smooth * flat).sum(axis=-1) > _CREASE)[..., None], smooth, flat)


def parts(
    surface: PrimTriangles, chosen: BoolArray, bound: BoundMaterial, normals: FloatArray | None, primvar: Primvar,
    notes: Notes, name: str,
) -> Part | None:  # fmt: skip
    """The part of the chosen triangles (m,) of a surface.

    normals (m, 3, 3) at corners, None: flat. None if nothing is chosen.
    """
    if not chosen.any():
        return None
    columns: dict[str, FloatArray] = {}
    if normals is not None:
        columns["normals"] = normals[chosen]
    uv = _corners(surface, primvar, bound.coordinates, 2, notes, name) if bound.coordinates else None
    if uv is not None:
        columns["uv"] = v_down(uv[chosen])
    colors = _corners(surface, primvar, bound.colors, 3, notes, name) if bound.colors else None
    if colors is not None:
        columns["vertex_colors"] = np.clip(np.nan_to_num(colors[chosen]), 0, 1)
    material = bound.material
    if colors is not None and not bound.bound:
        material = WHITE
    if uv is None and (plain := without_textures(material)) is not material:
        notes.add(f"rendered without its textures, it has no coordinates '{bound.coordinates}'", name)
        material = plain
    corners = surface.corners[chosen]
    rows = np.concatenate(
        [surface.points[surface.vertex[corners]], *columns.values()], axis=-1
    ).reshape(-1, 3 + sum(v.shape[-1] for v in columns.values()))  # fmt: skip
    # Corners of one face-vertex carry the same; those of one vertex do, where nothing differs from face to face.
    key = corners.ravel() if columns else surface.vertex[corners].ravel()
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)
    split = np.split(rows[first], np.cumsum([3, *(v.shape[-1] for v in columns.values())])[:-1], axis=1)
    carried = dict(zip(columns, split[1:], strict=True))
    return Part(split[0], faces.reshape(-1, 3).astype(np.int64), material, **carried)


def _corners(
    surface: PrimTriangles, primvar: Primvar, name: str, width: int, notes: Notes, of: str
) -> FloatArray | None:
    found = primvar(name)
    if found is None:
        return None
    values, interpolation = found
    at_corners = surface.at_corners(values, interpolation) if values.ndim == 2 and values.shape[1] >= width else None
    if at_corners is None:
        notes.add(f"primvar '{name}' left out, its size does not fit", of)
        return None
    return np.asarray(at_corners[..., :width], float)


def _array(values: Any, empty: tuple[int, ...]) -> FloatArray:
    return np.zeros(empty) if values is None else np.array(values, float)


def _unit(v: FloatArray) -> FloatArray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-30)
