"""Where light is baked: the unique points of a scene's surfaces that its lattice samples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rsgen.array_types import Float32Array, IntArray
from rsgen.device.arrays import rows_of, vectors
from rsgen.light.barriers import find_barriers, find_covered
from rsgen.render.irradiance import Lattice, at_triangles, lattice_barycentric, registry_id
from rsgen.scene.meshes import mesh_arrays
from rsgen.scene.rays import RAY_OFFSET_M

_NORMAL_SCALE = 0.35  # normals this far apart count as much as one spacing
_APART = 1e4  # spacings between different pieces of surface
_INSET_M = 2e-3  # samples on a triangle's rim move this far inwards: a corner exactly on two surfaces sees neither
_COVERED_TEXELS, _COVERED_M = 0.3, 0.01  # what is nearer above a surface than either covers it
_CHUNK = 1 << 20  # points looked at in one launch


@dataclass(frozen=True)
class SamplePoints:
    """Unique sample points: position on the surface, shading normal, geometric normal, (n, 3) float32 each, and (n,)
    the number of the piece of surface that each lies on: one side of a connected part of a mesh that
    nothing stands on (see `barriers`).
    """

    position: Float32Array
    normal: Float32Array
    geometric: Float32Array
    piece: IntArray

    def coordinates(self, spacing: float, which: IntArray) -> NDArray:
        """(len(which), 7): two points are near where positions, in units of `spacing` metres, and normals are, on one
        piece.
        """
        position, normal, piece = self.position[which], self.normal[which], self.piece[which]
        return np.concatenate([position / spacing, normal / _NORMAL_SCALE, _APART * piece[:, None]], axis=1)

    @cached_property
    def on_device(self) -> tuple[Any, Any]:
        """Ray origins (Point3f) and normals (Vector3f) of all points."""
        origin = self.position + np.float32(RAY_OFFSET_M) * self.geometric
        return vectors(mi.Point3f, origin), vectors(mi.Vector3f, self.normal)


def sample_points(
    scene: Any, lattice: Lattice, texel_m: float
) -> tuple[SamplePoints, IntArray, tuple[NDArray, NDArray]]:  # fmt: skip
    """Unique points of both sides of the lattice, the (2, points) index of each lattice point's front and back one, and
    how far these count on either side (see `barriers.Barriers`).
    """
    position, normal, geometric, key = _on_lattice(scene, lattice)
    # Points that are their triangles' only ones have none in common, so all of a piece of mesh count as one place.
    alone = np.repeat(lattice.cells[:, 0] == 0, (lattice.cells + 1).prod(axis=1))
    chosen, index, place = _unique(key, alone)
    first = np.concatenate(chosen)
    sign = np.repeat(np.array([1, -1], np.float32), [len(side) for side in chosen])[:, None]
    unique_geometric = sign * geometric[first]
    within = min(_COVERED_TEXELS * texel_m, _COVERED_M)
    covered = find_covered(scene, position[first], unique_geometric, within)[index]
    barriers = find_barriers(scene, lattice, position, geometric, index, place, (covered[0], covered[1]), texel_m)
    points = SamplePoints(position[first], sign * normal[first], unique_geometric, barriers.piece)
    return points, index, barriers.reach


def _on_lattice(scene: Any, lattice: Lattice) -> tuple[Float32Array, Float32Array, Float32Array, tuple[NDArray, ...]]:
    """At a lattice's points: where to look at light from, shading and geometric normal of the front, (points, 3) each.

    And what makes two of them alike: position and normal, rounded, and the connected piece of mesh.
    """
    face, uv = lattice_barycentric(lattice)
    count = len(face)
    position = np.empty((count, 3), np.float32)
    normal, geometric, middle = (np.empty_like(position) for _ in range(3))
    shapes = [s for s in scene.shapes() if s.is_mesh()]
    firsts = np.sort(lattice.shape_first[lattice.shape_first >= 0])
    owner = np.searchsorted(firsts, face, side="right") - 1
    label, islands = [], 0
    for shape in shapes:
        label.append(islands + _islands(*mesh_arrays(shape)).astype(np.int64))
        islands = int(label[-1].max()) + 1
    numbers = np.array([registry_id(shape) for shape in shapes], np.uint32)
    # All shapes at once: a launch for each would be compiled for each.
    for begin in range(0, count, _CHUNK):
        part = slice(begin, begin + _CHUNK)
        of, local = numbers[owner[part]], (face[part] - firsts[owner[part]]).astype(np.uint32)
        position[part], normal[part], geometric[part] = surface_at(of, local, uv[part])
        middle[part] = surface_at(of, local, np.full_like(uv[part], 1 / 3))[0]
    # The side that shading lights, where winding and vertex normals disagree.
    geometric *= np.where(np.einsum("ij,ij->i", geometric, normal) < 0, -1, 1)[:, None].astype(np.float32)
    key = np.round(position * 1e4).astype(np.int32), np.round(normal * 32).astype(np.int32), np.concatenate(label)[face]
    inward = middle - position
    distance = np.linalg.norm(inward, axis=1, keepdims=True)
    position += inward * np.minimum(_INSET_M / np.maximum(distance, 1e-9), 0.1)
    return position, normal, geometric, key


def _unique(key: tuple[NDArray, ...], alone: NDArray[np.bool_]) -> tuple[list[IntArray], NDArray, NDArray]:
    """Which lattice points stand for all of the front and of the back; (2, points) which of these, fronts before backs,
    each is; and (points,) a number of the place on its piece of mesh.

    Points that triangles share are computed once, so that edges cannot show.
    """
    position, normal, island = key
    chosen: list[IntArray] = []
    index = np.empty((2, len(island)), np.int32)
    for side, sign in enumerate((1, -1)):
        _, first, inverse = np.unique(row_hash(*position.T, *(sign * normal).T), return_index=True, return_inverse=True)
        first, rank = in_order(first)
        index[side] = rank[inverse] + sum(map(len, chosen))
        chosen.append(first)
    place = np.where(alone[:, None], 0, position)
    return chosen, index, np.unique(row_hash(*place.T, island), return_inverse=True)[1]


def in_order(chosen: IntArray) -> tuple[IntArray, IntArray]:
    """Numbers of points (n,) rising, and the place of each of `chosen` among them.

    Points run along triangles then: neighbours are beside each other in memory, and rays from them go like ways. In the
    order of hashes, which is none, searches take four times as long.
    """
    order = np.argsort(chosen)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return chosen[order], rank


def _islands(vertices: NDArray, faces: NDArray) -> IntArray:
    """(f,) label of the connected piece that each triangle of a mesh belongs to; vertices at one place are one."""
    _, same = np.unique(np.round(vertices * 1e5).astype(np.int64), axis=0, return_inverse=True)
    a, b, c = same.ravel()[faces.astype(np.int64)].T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    size = int(same.max()) + 1
    edges = coo_array((np.ones(2 * len(a), bool), ends), shape=(size, size))
    return connected_components(edges, directed=False)[1][a]


def row_hash(*columns: IntArray) -> NDArray[np.uint64]:
    """One well-mixed 64-bit hash of each row of integers (splitmix64's finaliser, chained over columns)."""
    h = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        h ^= column.astype(np.int64).view(np.uint64)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            h ^= h >> np.uint64(shift)
            h *= np.uint64(factor)
        h ^= h >> np.uint64(31)
    return h


def surface_at(
    shape: NDArray[np.uint32], face: NDArray[np.uint32], uv: Float32Array
) -> tuple[NDArray, NDArray, NDArray]:
    """Position, shading normal and geometric normal, as the renderer sees them, at barycentric `uv` of triangles.

    shape: the registry's number of the mesh that each triangle is one of.
    """
    si = at_triangles(shape, face, uv)[1]
    dr.eval(si.p, si.sh_frame.n, si.n)
    normal, geometric = rows_of(si.sh_frame.n), rows_of(si.n)
    # Corners' normals that are each other's opposites have none in the middle between them.
    return rows_of(si.p), np.where(np.isfinite(normal).all(axis=1, keepdims=True), normal, geometric), geometric
