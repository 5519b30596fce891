"""Mesh files that Mitsuba misreads or refuses, as files that it takes.

Mitsuba and trimesh take every polygon for convex and make a fan of it: a wall with a niche loses the niche. OBJ files
with such polygons are rewritten with triangles. All else in them stays: texture coordinates, normals, the order.
What Mitsuba's loaders refuse is read by trimesh: polygons, texture coordinates of corners, odd layouts.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import first_few
from rsgen.formats.meshes.mesh_file import from_srgb, given_normals
from rsgen.formats.meshes.parts import is_convex, triangulated
from rsgen.scene.meshes import joined_triangles, ply_bytes
from rsgen.scene.placement import as_ply

_OBJ_METHOD = b"obj-polygons/2"
"""Raise when files come out differently: light baked on their surfaces is stored under it."""

_POLYGON = re.compile(rb"(?:^|(?<=\n))[ \t]*f((?:[ \t]+\S+){5,})[ \t]*\r?(?=\n|$)")
_VERTEX = re.compile(rb"(?:^|(?<=\n))[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)")
_MOST_CHARACTERS = 1000  # of a line; Mitsuba takes some more


def triangles_mark(data: bytes) -> bytes:
    """What goes into a scene's hash for an OBJ file: the method if `with_triangles` changes it, nothing else."""
    return b"" if with_triangles(data) is None else _OBJ_METHOD


def with_triangles(data: bytes) -> bytes | None:
    """The OBJ file with triangles for polygons where one of five corners or more is not convex, or its line too long.

    None if there is no such polygon, or if it names vertices that are not there or are no numbers.
    """
    polygons = list(_POLYGON.finditer(data))
    if not polygons:
        return None
    places, vertices = [], []
    for found in _VERTEX.finditer(data):
        places.append(found.start())
        vertices.append(found.groups())
    text, end, needed = [], 0, False
    try:
        positions = np.array(vertices).astype(float).reshape(-1, 3)
        for polygon in polygons:
            words = polygon[1].split()
            corners = positions[_indices(words, int(np.searchsorted(places, polygon.start())), len(positions))]
            needed |= len(polygon[0]) > _MOST_CHARACTERS or not is_convex(corners)
            faces = [b"f " + b" ".join(words[k] for k in triangle) for triangle in triangulated(corners)]
            text += [data[end : polygon.start()], b"\n".join(faces)]
            end = polygon.end()
    except (ValueError, IndexError):
        return None
    return b"".join([*text, data[end:]]) if needed else None


def _indices(words: list[bytes], before: int, count: int) -> list[int]:
    """Numbers of vertices, from 0, that a face's corners name, `before` of `count` above it. Raises IndexError."""
    numbers = [int(word.partition(b"/")[0]) for word in words]
    found = [number - 1 if number > 0 else before + number for number in numbers]
    if min(found) < 0 or max(found) >= count:
        raise IndexError
    return found


log = logging.getLogger("rsgen")

_READ = ("obj", "ply")
_Mesh = tuple[FloatArray, IntArray, FloatArray | None, FloatArray | None, FloatArray | None, FloatArray | None]
_UV = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))


def read_polygons(mi: Any, state: Any, scratch: Path) -> None:
    """Have shapes read copies in `scratch` of OBJ files that hold polygons which are not convex, in place."""
    made: dict[str, str | None] = {}
    for node in state.nodes:
        if node.type != mi.ObjectType.Shape or node.props.plugin_name() != "obj":
            continue
        name = str(node.props["filename"])
        if name not in made:
            text = with_triangles(Path(str(mi.file_resolver().resolve(name))).read_bytes())
            made[name] = None if text is None else _stored(text, scratch, f"triangles{len(made)}.obj")
        node.props["filename"] = made[name] or name


def read_refused(mi: Any, state: Any, path: Path, scratch: Path) -> bool:
    """Whether Mitsuba refuses meshes of a parsed scene that trimesh reads: these are PLY files in `scratch` now."""
    names: list[str] = []
    for number, node in enumerate(state.nodes):
        if node.type != mi.ObjectType.Shape or node.props.plugin_name() not in _READ:
            continue
        name = str(node.props["filename"])
        file = Path(str(mi.file_resolver().resolve(name)))
        plugin = node.props.plugin_name()
        mesh = None if _takes(mi, plugin, file) else _read(file, plugin)
        if mesh is not None:
            flipped = node.props.get("flip_tex_coords", True)
            node.props = as_ply(mi, node.props, Path(_stored(mesh, scratch, f"read{number}.ply")))
            if plugin == "obj":  # whose v runs the other way by default
                node.props["flip_tex_coords"] = flipped
            names.append(name)
    if names:
        log.info("scene %s: read by trimesh, Mitsuba does not: %s", path, first_few(names))
    return bool(names)


def _stored(data: bytes, folder: Path, name: str) -> str:
    (folder / name).write_bytes(data)
    return str(folder / name)


def _takes(mi: Any, plugin: str, file: Path) -> bool:
    try:
        mi.load_dict({"type": plugin, "filename": str(file)})
    except Exception:  # of whatever kind Mitsuba's loaders raise
        return False
    return True


def _read(file: Path, plugin: str) -> bytes | None:
    """A mesh file as a PLY file that Mitsuba takes; None if it is damaged, or holds no finite triangles."""
    try:
        meshes = list(trimesh.load_scene(file, file_type=plugin, process=False, skip_materials=True).geometry.values())
        vertices, faces, *more = _of_ply(meshes[0].metadata["_ply_raw"]) if plugin == "ply" else _of_obj(meshes)
        if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
            return None
        with np.errstate(invalid="ignore"):  # normals without direction are repaired later
            return ply_bytes(vertices, faces, *more)
    except Exception:  # of whatever kind trimesh's parsers raise
        return None


def _of_obj(meshes: Sequence[Any]) -> _Mesh:
    """Of the parts of an OBJ file, one for each of its materials."""
    vertices, faces = joined_triangles([m.vertices for m in meshes], [m.faces for m in meshes])
    uv = _of_all([getattr(m.visual, "uv", None) for m in meshes])
    colors = _of_all([from_srgb(m.visual.vertex_colors) if m.visual.kind == "vertex" else None for m in meshes])
    return vertices, faces, _of_all([given_normals(m) for m in meshes]), uv, colors, None


def _of_all(columns: Sequence[FloatArray | None]) -> FloatArray | None:
    given = [column for column in columns if column is not None]
    return np.concatenate(given) if len(given) == len(columns) else None


def _of_ply(elements: Any) -> _Mesh:
    """Of what trimesh has read from a PLY file. Its own mesh of that has fans for polygons, and no normals if it has
    texture coordinates of corners: corners of one vertex whose coordinates differ become vertices of their own.
    """
    vertex, face = elements["vertex"]["data"], elements["face"]["data"]
    vertices = _columns(vertex, "xyz")
    assert vertices is not None
    polygons = next(found for name in ("vertex_indices", "vertex_index") if (found := _lists(face, name)) is not None)
    corner = np.concatenate(polygons).astype(np.int64)
    triangles, polygon_of = _triangles(vertices, polygons)
    texcoord = _lists(face, "texcoord")
    uv = next((given for names in _UV if (given := _columns(vertex, names)) is not None), None)
    which, of_corner = np.arange(len(vertices)), corner
    if texcoord is not None:
        uv_of_corner = np.concatenate(texcoord).astype(float).reshape(len(corner), 2)
        rows, of_corner = np.unique(np.column_stack([corner, uv_of_corner]), axis=0, return_inverse=True)
        which, uv, of_corner = rows[:, 0].astype(np.int64), rows[:, 1:], of_corner.ravel()
    elif uv is not None:
        uv = uv[which]
    normals, colors, of_faces = _columns(vertex, ("nx", "ny", "nz")), _colors(vertex), _colors(face)
    return (
        vertices[which], of_corner[triangles], None if normals is None else normals[which], uv,
        None if colors is None else colors[which], None if of_faces is None else of_faces[polygon_of],
    )  # fmt: skip


def _triangles(vertices: FloatArray, polygons: Sequence[NDArray]) -> tuple[IntArray, IntArray]:
    """Triangles (t, 3) of polygons, by numbers in the row of all their corners, and whose each of them is (t,)."""
    size = np.array([len(polygon) for polygon in polygons])
    first = np.cumsum(size) - size
    plain = np.flatnonzero(size == 3)
    made, of = [first[plain, None] + np.arange(3)], [plain]
    for k in np.flatnonzero(size > 3):
        made.append(first[k] + triangulated(vertices[np.asarray(polygons[int(k)], np.int64)]))
        of.append(np.full(len(made[-1]), k))
    return np.concatenate(made), np.concatenate(of)


def _columns(data: Any, names: Sequence[str]) -> FloatArray | None:
    try:
        return np.stack([np.asarray(data[name], float).ravel() for name in names], axis=1)
    except (ValueError, KeyError):  # there is no such property
        return None


def _lists(data: Any, name: str) -> Sequence[NDArray] | None:
    """The lists of a property, one of each row: all as long as one another in a binary file."""
    try:
        column = data[name]
    except (ValueError, KeyError):
        return None
    return column if getattr(column, "dtype", None) is None or column.dtype.names is None else column["f1"]


def _colors(data: Any) -> FloatArray | None:
    found = _columns(data, ("red", "green", "blue"))
    return None if found is None else from_srgb(found)
