"""Land about a scene: a ground to the horizon must not take the samples that its house needs.

Meshes larger than a building are taken for land, and what lies between the others for where one may be. Land's
triangles are cut into pieces, smaller the nearer they are, and light on it is the coarser the farther it is.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import FloatArray, IntArray
from rsgen.device.arrays import aligned
from rsgen.render.meshes import rebuilt

log = logging.getLogger("rsgen")

_BUILDING_M = 60.0
_NEAR_M = 2.0  # so far beside where one may be, light is as fine as there
_PIECE_M = 10.0  # longest edge of land there
_SPLIT = ("vertex_positions", "vertex_normals", "vertex_texcoords", "faces")


def inhabited(shapes: Sequence[Any]) -> FloatArray:
    """Least and largest corner (2, 3), world, m, of all meshes that are no land; of all if there is nothing else."""
    all_of_it = [_vertices(shape) for shape in shapes]
    things = [v for v in all_of_it if _across(v) <= _BUILDING_M]
    boxes = np.array([[v.min(axis=0), v.max(axis=0)] for v in things or all_of_it])
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def coarser(corners: FloatArray, box: FloatArray) -> FloatArray:
    """How many times coarser than asked for light is on triangles (n, 3, 3) that are away from the `inhabited` box."""
    return np.maximum(_distance(corners, box) / _NEAR_M, 1.0)


def split_terrain(mi: Any, scene: Any) -> Any:
    """The scene with the triangles of its land in pieces, if it has any; meshes are changed in place."""
    shapes = [shape for shape in scene.shapes() if shape.is_mesh()]
    land = [_across(_vertices(shape)) > _BUILDING_M for shape in shapes]
    if all(land):
        return scene  # and nothing that it is about
    box, changed = inhabited(shapes), False
    for shape, is_land in zip(shapes, land, strict=True):
        if not is_land or shape.is_emitter():
            continue
        vertices = _vertices(shape)
        parameters = mi.traverse(shape)
        if any(key.startswith(("vertex_", "face_")) and key not in _SPLIT for key in parameters.keys()):  # noqa: SIM118
            continue  # colours of its own
        columns = [vertices]
        if shape.has_vertex_normals():
            columns.append(_rows(parameters["vertex_normals"], 3))
        if shape.has_vertex_texcoords():
            columns.append(_rows(parameters["vertex_texcoords"], 2))
        before = np.asarray(parameters["faces"]).reshape(-1, 3).astype(np.int64)
        faces, table = pieces(before, np.hstack(columns), box)
        if len(faces) == len(before):
            continue
        parameters["vertex_positions"] = mi.Float(aligned(table[:, :3]))
        if shape.has_vertex_normals():
            parameters["vertex_normals"] = mi.Float(aligned(table[:, 3:6]))
        if shape.has_vertex_texcoords():
            parameters["vertex_texcoords"] = mi.Float(aligned(table[:, -2:]))
        parameters["faces"] = mi.UInt32(aligned(faces, np.uint32))
        parameters.update()
        log.debug("mesh '%s': %d triangles of land made %d", shape.id(), len(before), len(faces))
        changed = True
    return rebuilt(mi, scene) if changed else scene


def pieces(faces: IntArray, table: FloatArray, box: FloatArray) -> tuple[IntArray, FloatArray]:
    """Triangles (m, 3) over vertices (n, 3 + k), position first, halved until no edge is too long for where it is.

    box: where one may be. There that is 10 m, farther away as much as the distance.
    """
    while True:
        corners = table[:, :3][faces]
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)  # edge k: from corner k to the next
        long = edges.max(axis=1) > np.maximum(_PIECE_M, _distance(corners, box))
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
    return _rows(shape.vertex_positions_buffer(), 3)


def _rows(buffer: Any, width: int) -> NDArray[np.float64]:
    return np.asarray(buffer, np.float64).reshape(-1, width)
