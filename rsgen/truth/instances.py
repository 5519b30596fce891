"""Instances: which thing each triangle of a scene belongs to, and which one rays meet.

Of a Mitsuba scene a thing is a shape, by its id, unless PARTS lies beside the scene and divides shapes further; of a
mesh file it is a node. Importing this module needs an active Mitsuba variant (`rsgen.device.backend.mitsuba()`).
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from rsgen.array_types import FloatArray, IntArray
from rsgen.device.arrays import aligned
from rsgen.errors import UserError
from rsgen.files import read_text
from rsgen.formats import scene_reader
from rsgen.render.irradiance import registry_id
from rsgen.scene.meshes import mesh_arrays, mesh_corners, meshes_of
from rsgen.scene.placement import SceneOptions

PARTS = "parts*.csv"
"""Beside a scene: lines 'shape,first,name': from its triangle `first` on, a shape is of the thing `name`."""
_SAME_M = 1e-3  # a node's triangle and the same one in the scene, in float32, are nearer


@dataclass(frozen=True, eq=False)
class Instances:
    """Things of a scene: names (n,), numbered from 1; of_triangle (m,): number of each triangle, as `surface` has them.

    first: of each shape's triangles, by the number that Dr.Jit has for the shape.
    """

    names: tuple[str, ...]
    of_triangle: IntArray
    first: IntArray

    def seen_by(self, hit: Any) -> Any:
        """Number (UInt32) of the thing at preliminary intersections; 0 where there is none."""
        first, of = mi.UInt32(aligned(self.first.astype(np.uint32))), mi.UInt32(self.of_triangle.astype(np.uint32))
        shape = dr.select(hit.is_valid(), dr.reinterpret_array(mi.UInt32, hit.shape), 0)
        triangle = dr.gather(mi.UInt32, first, shape, hit.is_valid()) + hit.prim_index
        return dr.gather(mi.UInt32, of, triangle, hit.is_valid())


def find_instances(scene: Any, path: Path, options: SceneOptions) -> Instances:
    """The things of a scene that was loaded from `path` with these options. Raises UserError: PARTS is damaged."""
    shapes = meshes_of(scene)
    counts = np.array([len(mesh_arrays(shape)[1]) for shape in shapes])
    begin = np.cumsum([0, *counts])
    numbers = np.array([registry_id(shape) for shape in shapes])
    first = np.zeros(int(numbers.max()) + 1, np.int64)
    first[numbers] = begin[:-1]
    named: Any = np.repeat(np.array([_plain(shape.id()) for shape in shapes], object), counts)
    if path.suffix.lower() != ".xml":
        _name_nodes(named, np.concatenate([mesh_corners(shape).mean(axis=1) for shape in shapes]), path, options)
    else:
        parts = {shape: rows for file in sorted(path.parent.glob(PARTS)) for shape, rows in _read_parts(file).items()}
        for shape, at, count in zip(shapes, begin[:-1], counts, strict=True):
            for start, name in parts.get(_plain(shape.id()), ()):
                named[at + min(start, count) : at + count] = name
    names, inverse = np.unique(named.astype(str), return_inverse=True)
    return Instances(tuple(names.tolist()), inverse.astype(np.int64) + 1, first)


def _plain(shape: str) -> str:
    return shape.removeprefix("mesh_")


def _name_nodes(named: Any, middles: FloatArray, path: Path, options: SceneOptions) -> None:
    """Give triangles the names of the file's nodes that have a triangle in the same place."""
    names, places, owner = scene_reader(path.suffix).named_triangles(path, options)
    distance, nearest = cKDTree(places).query(middles)
    found = distance < _SAME_M
    named[found] = np.array(names, object)[owner[np.asarray(nearest)[found]]]


def _read_parts(path: Path) -> dict[str, list[tuple[int, str]]]:
    parts: dict[str, list[tuple[int, str]]] = {}
    try:
        for row in csv.DictReader(io.StringIO(read_text(path))):
            parts.setdefault(row["shape"], []).append((int(row["first"]), row["name"]))
    except (KeyError, TypeError, ValueError):
        raise UserError(f"{path}: expected lines 'shape,first,name': build the scene again, or delete it") from None
    return {shape: sorted(rows) for shape, rows in parts.items()}
