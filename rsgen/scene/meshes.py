"""Triangle meshes: as arrays and PLY files, repaired as they are loaded, and terrain in parts.

A triangle without area or a vertex normal without direction would put NaN into the baked light, and from there into
images. A ground to the horizon must not take the samples that its house needs: meshes larger than a building are taken
for terrain, and what lies between the others for where one may be. Terrain's triangles are cut into parts, smaller the
nearer they are, and light on it is the coarser the farther it is.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.device.arrays import aligned
from rsgen.errors import UserError

log = logging.getLogger("rsgen")

_UP = (0.0, 0.0, 1.0)
_FLAT = 1e-7  # twice a triangle's area over its longest edge squared: below lies what float32 makes of a line
_BUILDING_M = 60.0
_NEAR_M = 2.0  # so far beside where one may be, light is as fine as there
_EDGE_M = 10.0  # longest edge of terrain there
_SPLIT = ("vertex_positions", "vertex_normals", "vertex_texcoords", "faces")


def ply_bytes(
    vertices: NDArray, faces: NDArray, normals: NDArray | None = None, uv: NDArray | None = None,
    vertex_colors: NDArray | None = None, face_colors: NDArray | None = None,
) -> bytes:  # fmt: skip
    """Binary PLY of triangles: vertices (n, 3), faces (m, 3), unit normals (n, 3) and texture coordinates (n, 2).

    Colours (n, 3), (m, 3) become Mitsuba's attributes `vertex_color` and `face_color`, as they are.
    """
    names = ["x", "y", "z"]
    parts = [vertices]
    if normals is not None:
        names += ["nx", "ny", "nz"]
        parts.append(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
    if uv is not None:
        names += ["u", "v"]
        parts.append(uv)
    if vertex_colors is not None:
        names += ["r", "g", "b"]
        parts.append(vertex_colors)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    columns: list[tuple[Any, ...]] = [("n", "u1"), ("v", "<i4", 3)]
    if face_colors is not None:
        header += [f"property float {name}" for name in "rgb"]
        columns.append(("c", "<f4", 3))
    header += ["end_header", ""]
    face_rows = np.empty(len(faces), dtype=columns)
    face_rows["n"], face_rows["v"] = 3, faces
    if face_colors is not None:
        face_rows["c"] = face_colors
    data = np.concatenate(parts, axis=1).astype("<f4")
    return "\n".join(header).encode() + data.tobytes() + face_rows.tobytes()


def joined_triangles(vertices: Sequence[NDArray], faces: Sequence[NDArray]) -> tuple[NDArray, NDArray]:
    """Vertices (n, 3) and faces (m, 3) of several meshes as those of one."""
    first = np.cumsum([0, *(len(v) for v in vertices)])
    moved = [f + f.dtype.type(k) for f, k in zip(faces, first[:-1], strict=True)]
    return np.concatenate(vertices), np.concatenate(moved)


def surface(scene: Any) -> tuple[Float32Array, NDArray[np.uint32]]:
    """All triangles of a scene: vertices (n, 3) in the world frame, metres, and faces (m, 3)."""
    vertices, faces = zip(*map(mesh_arrays, meshes_of(scene)), strict=True)
    return joined_triangles(vertices, faces)


def meshes_of(scene: Any) -> list[Any]:
    """The shapes of a scene that are meshes."""
    return [shape for shape in scene.shapes() if shape.is_mesh()]


def mesh_corners(shape: Any) -> FloatArray:
    """Corners (m, 3, 3) of one Mitsuba mesh's triangles in the world frame."""
    vertices, faces = mesh_arrays(shape)
    return vertices[faces].astype(np.float64)


def mesh_arrays(shape: Any) -> tuple[Float32Array, NDArray[np.uint32]]:
    """Vertices (n, 3) float32 in the world frame and faces (m, 3) uint32 of one Mitsuba mesh."""
    vertices, faces = shape.vertex_positions_buffer(), shape.faces_buffer()
    return np.asarray(vertices, np.float32).reshape(-1, 3), np.asarray(faces, np.uint32).reshape(-1, 3)


def repair_meshes(mi: Any, scene: Any, path: Path) -> Any:
    """The loaded scene without triangles that have no area, and with normals where a mesh's own are useless.

    Meshes are changed in place; one that has no area at all is left out of the scene that this returns. Raises
    UserError if a mesh names vertices that it has not, has vertices that are not finite, or if none has an area.
    """
    changed, flat = False, set()
    for number, shape in enumerate(scene.shapes()):
        if not shape.is_mesh():
            continue
        vertices, faces = mesh_arrays(shape)
        what = f"scene {path}: mesh '{shape.id() or number}'"
        if faces.size and faces.max() >= len(vertices):
            raise UserError(f"{what} names vertex {faces.max()} of {len(vertices)}: export it anew")
        if not np.isfinite(vertices).all():
            raise UserError(f"{what} has vertices that are not finite: export it anew")
        keep = has_area(vertices, faces)
        if keep.any():
            changed |= _repair(mi, shape, vertices, faces, keep)
        else:
            log.debug("mesh '%s': left out, it has no area", shape.id() or number)
            flat.add(number)
    if all(number in flat or not shape.is_mesh() for number, shape in enumerate(scene.shapes())):
        raise UserError(f"scene {path}: no triangle of it has an area: export its meshes anew")
    return rebuilt(mi, scene, flat) if changed or flat else scene


def grid_faces(rows: int, columns: int) -> tuple[IntArray, IntArray, IntArray]:
    """Row and column (n,) of each square of a grid whose (rows + 1) x (columns + 1) vertices are numbered row by row,
    and the squares' triangles (2 n, 3), of all of them the first halves first.
    """
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    p = i * (columns + 1) + j
    q = p + columns + 1
    return i, j, np.concatenate([np.stack([p, q, q + 1], -1), np.stack([p, q + 1, p + 1], -1)])


def rebuilt(mi: Any, scene: Any, left_out: Collection[int] = ()) -> Any:
    """A new scene of all shapes but those numbered in `left_out`, and of all lamps that are no shapes.

    Needed after a mesh's triangles have changed: `scene.parameters_changed` may leave the old ones in Embree's tree.
    """
    shapes = {f"shape_{k:06d}": shape for k, shape in enumerate(scene.shapes()) if k not in left_out}
    lamps = {f"lamp_{k:06d}": lamp for k, lamp in enumerate(scene.emitters()) if lamp.get_shape() is None}
    return mi.load_dict({"type": "scene", **shapes, **lamps}, optimize=False)


def has_area(vertices: Float32Array, faces: NDArray) -> NDArray[np.bool_]:
    """(m,) whether each of the faces (m, 3) over vertices (n, 3) has an area, to the precision of float32."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    edges = b - a, c - b, a - c
    longest = np.maximum.reduce([np.einsum("ij,ij->i", edge, edge) for edge in edges])
    normal = np.cross(edges[0], edges[2])
    return np.einsum("ij,ij->i", normal, normal) > (_FLAT * longest) ** 2


def _repair(mi: Any, shape: Any, vertices: Float32Array, faces: NDArray, keep: NDArray[np.bool_]) -> bool:
    """Whether anything was to be repaired."""
    normals = np.zeros((0, 3), np.float32)
    useless = np.zeros(len(vertices), bool)
    if shape.has_vertex_normals():
        normals = np.asarray(shape.vertex_normals_buffer(), np.float32).reshape(-1, 3)
        length = np.linalg.norm(normals, axis=-1)
        useless = ~((length > 1e-6) & (length < 1e6))  # NaN is neither
        if useless.any():  # of vertices that no triangle has, never mind
            useless[np.setdiff1d(np.flatnonzero(useless), faces[keep])] = False
    if keep.all() and not useless.any():
        return False
    parameters = mi.traverse(shape)
    if not keep.all():
        for name in [name for name in parameters.keys() if name.startswith("face_")]:  # noqa: SIM118
            rows = np.asarray(parameters[name]).reshape(len(faces), -1)
            parameters[name] = mi.Float(aligned(rows[keep]))
        parameters["faces"] = mi.UInt32(aligned(faces[keep], np.uint32))
        if shape.has_vertex_normals():
            parameters["vertex_normals"] = mi.Float(aligned(normals))  # else made anew, from the triangles
        log.debug("mesh '%s': %d triangles without area dropped", shape.id(), np.count_nonzero(~keep))
    if useless.any():
        repaired = np.where(useless[:, None], vertex_normals(vertices, faces[keep], _UP), normals)
        parameters["vertex_normals"] = mi.Float(aligned(repaired))
        log.debug("mesh '%s': %d vertex normals without direction replaced", shape.id(), np.count_nonzero(useless))
    parameters.update()
    return True


def vertex_normals(vertices: Float32Array, faces: NDArray, otherwise: tuple[float, float, float]) -> FloatArray:
    """Unit normals (n, 3), the mean of the faces' by area; `otherwise` where no face is, or where they cancel."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    total = np.stack([np.bincount(faces.ravel(), normal[:, k], len(vertices)) for k in range(3)], axis=-1)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1), otherwise)


def inhabited_box(shapes: Sequence[Any]) -> FloatArray:
    """Least and largest corner (2, 3), world, m, of all meshes that are no terrain; of all if there is nothing else."""
    every = [_vertices(shape) for shape in shapes]
    others = [v for v in every if _across(v) <= _BUILDING_M]
    boxes = np.array([[v.min(axis=0), v.max(axis=0)] for v in others or every])
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def coarser(corners: FloatArray, box: FloatArray) -> FloatArray:
    """How many times coarser than asked for light is on triangles (n, 3, 3) away from the `inhabited_box`."""
    return np.maximum(_distance(corners, box) / _NEAR_M, 1.0)


def split_terrain(mi: Any, scene: Any) -> Any:
    """The scene with the triangles of its terrain in parts, if it has any; meshes are changed in place."""
    shapes = meshes_of(scene)
    terrain = [_across(_vertices(shape)) > _BUILDING_M for shape in shapes]
    if all(terrain):
        return scene  # with nothing that it is around
    box, changed = inhabited_box(shapes), False
    for shape, is_terrain in zip(shapes, terrain, strict=True):
        if not is_terrain or shape.is_emitter():
            continue
        parameters = mi.traverse(shape)
        if any(key.startswith(("vertex_", "face_")) and key not in _SPLIT for key in parameters.keys()):  # noqa: SIM118
            continue  # colours of its own
        widths = {"vertex_positions": 3}
        if shape.has_vertex_normals():
            widths["vertex_normals"] = 3
        if shape.has_vertex_texcoords():
            widths["vertex_texcoords"] = 2
        columns = [np.asarray(parameters[name], np.float64).reshape(-1, width) for name, width in widths.items()]
        before = np.asarray(parameters["faces"]).reshape(-1, 3).astype(np.int64)
        faces, table = split_triangles(before, np.hstack(columns), box)
        if len(faces) == len(before):
            continue
        for name, values in zip(widths, np.split(table, np.cumsum([*widths.values()])[:-1], axis=1), strict=True):
            parameters[name] = mi.Float(aligned(values))
        parameters["faces"] = mi.UInt32(aligned(faces, np.uint32))
        parameters.update()
        log.debug("mesh '%s': %d triangles of terrain made %d", shape.id(), len(before), len(faces))
        changed = True
    return rebuilt(mi, scene) if changed else scene


def split_triangles(faces: IntArray, table: FloatArray, box: FloatArray) -> tuple[IntArray, FloatArray]:
    """Triangles (m, 3) over vertices (n, 3 + k), position first, halved until no edge is too long for where it is.

    box: where one may be. There that is 10 m, farther away as much as the distance.
    """
    while True:
        corners = table[:, :3][faces]
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)  # edge k: from corner k to the next
        long = edges.max(axis=1) > np.maximum(_EDGE_M, _distance(corners, box))
        if not long.any():
            return faces, table
        rows = np.flatnonzero(long)
        k = edges[rows].argmax(axis=1)
        a, b, c = (faces[rows, (k + turn) % 3] for turn in range(3))
        ends, which = np.unique(np.sort(np.stack([a, b], axis=1), axis=1), axis=0, return_inverse=True)
        middle = len(table) + which.ravel()
        table = np.concatenate([table, table[ends].mean(axis=1)])
        halves = np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)
        faces = np.concatenate([faces[~long], *halves])


def _distance(corners: FloatArray, box: FloatArray) -> FloatArray:
    """Of the boxes about triangles (n, 3, 3) from `box`, m (n,)."""
    away = np.maximum(np.maximum(box[0] - corners.max(axis=1), corners.min(axis=1) - box[1]), 0.0)
    return np.asarray(np.linalg.norm(away, axis=1))


def _across(vertices: FloatArray) -> float:
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def _vertices(shape: Any) -> FloatArray:
    return mesh_arrays(shape)[0].astype(np.float64)
