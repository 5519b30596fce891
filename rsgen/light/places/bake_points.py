"""Where light is baked: the unique sample points of a lattice, thinned sets of them, and interpolation between sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.device.arrays import rows_of
from rsgen.light.places.surface_points import SurfacePoints
from rsgen.light.places.walls import find_barriers, find_covered
from rsgen.render.irradiance import Lattice, at_triangles, lattice_barycentric, registry_id
from rsgen.render.scene import mesh_arrays

_INSET_M = 2e-3  # samples on a triangle's rim move this far inwards: a corner exactly on two surfaces sees neither
_COVERED_TEXELS, _COVERED_M = 0.3, 0.01  # what is nearer above a surface than either covers it
_NEIGHBOURS = 8
_SMOOTHING = 0.3  # spacings: closer sources than this count alike
_STEP, _BEYOND = 0.15, 1e-3  # spacings: of a step in a surface; what is beyond one counts for so little
_CHUNK = 1 << 20  # points looked at in one launch


def sample_points(
    scene: Any, lattice: Lattice, texel_m: float
) -> tuple[SurfacePoints, IntArray, tuple[NDArray, NDArray]]:  # fmt: skip
    """Unique points of both sides of the lattice, the (2, points) index of each lattice point's front and back one, and
    how far these count on either side (see `walls.Barriers`).
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
    points = SurfacePoints(position[first], sign * normal[first], unique_geometric, barriers.piece)
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
        _, first, inverse = np.unique(_mix(*position.T, *(sign * normal).T), return_index=True, return_inverse=True)
        first, rank = _in_order(first)
        index[side] = rank[inverse] + sum(map(len, chosen))
        chosen.append(first)
    place = np.where(alone[:, None], 0, position)
    return chosen, index, np.unique(_mix(*place.T, island), return_inverse=True)[1]


def _in_order(chosen: IntArray) -> tuple[IntArray, IntArray]:
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


def _mix(*columns: IntArray) -> NDArray[np.uint64]:
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


def thin(
    points: SurfacePoints, spacing: float, among: IntArray | None = None, steps: bool = False
) -> tuple[IntArray, IntArray]:
    """Of `among` (default: all), one in each cell of `spacing` metres, of like normals on one piece of surface.

    steps: none stands for what is a step above or below it, as the bottom of a groove is. Returns the chosen ones as
    indices into `among`, and for each of `among` which of the chosen stands for it.
    """
    position, normal, piece = points.position, points.normal, points.piece
    if among is not None:
        position, normal, piece = position[among], normal[among], piece[among]
    cell = np.floor(position / spacing)
    off_centre = ((position / spacing - cell - 0.5) ** 2).sum(axis=1)
    # A buried face must not stand for a lit one just in front of it, so pieces of surface are kept apart.
    facing = np.round(normal)
    key = _mix(*cell.T, *facing.T, piece)
    if steps:
        above = np.einsum("ij,ij->i", position / spacing - cell, facing / np.linalg.norm(facing, axis=1, keepdims=True))
        key = _mix(key.view(np.int64), np.floor(above / _STEP).astype(np.int64))
    del cell
    order = np.lexsort((off_centre, key))
    sorted_key = key[order]
    starts = np.concatenate([[True], sorted_key[1:] != sorted_key[:-1]])
    chosen, rank = _in_order(order[starts])
    stands_for = np.empty(len(order), np.int64)
    stands_for[order] = rank[np.cumsum(starts) - 1]
    return chosen, stands_for


@dataclass(frozen=True)
class Interpolation:
    """Values at some points from those at `sources`: neighbours (n, k) among the sources and weights (n, k)."""

    neighbours: NDArray[np.int32]
    weights: Float32Array

    @classmethod
    def between(cls, points: SurfacePoints, sources: NDArray, targets: NDArray, spacing: float) -> Interpolation:
        """By distance in position (in units of `spacing` metres) and normal together, within one piece of surface.

        The dark inside of a thin sheet is a millimetre from its lit outside and has the normal of the other outside.
        """
        k = min(_NEIGHBOURS, len(sources))
        tree = cKDTree(points.coordinates(spacing, sources))
        near, weights = np.empty((len(targets), k), np.int32), np.empty((len(targets), k), np.float32)
        for begin in range(0, len(targets), _CHUNK >> 2):
            part = slice(begin, begin + (_CHUNK >> 2))
            found = tree.query(points.coordinates(spacing, targets[part]), k=k, workers=-1, eps=0.2)
            distance, near[part] = (np.reshape(v, (-1, k)) for v in found)
            # Falls to zero at the furthest neighbour, so that the interpolant is continuous as neighbours change, and
            # grows without bound towards a source, so that it passes through the sources.
            falling = np.clip(1 - (distance / (distance[:, -1:] * 1.0001 + 1e-9)) ** 2, 0, 1) ** 2
            weight = (falling + 1e-6) / (distance**2 + _SMOOTHING**2)
            apart = points.position[sources[near[part]]] - points.position[targets[part], None]
            step = np.einsum("nki,ni->nk", apart, points.normal[targets[part]]) / (_STEP * spacing)
            weight *= np.exp(-(step**2)) + _BEYOND
            weights[part] = weight / weight.sum(axis=1, keepdims=True)
        return cls(near, weights)

    def __call__(self, at_sources: Float32Array) -> Float32Array:
        n, k = self.neighbours.shape
        rows = np.arange(0, n * k + 1, k)
        flat = self.weights.ravel(), self.neighbours.ravel(), rows
        return np.asarray(csr_array(flat, shape=(n, len(at_sources))) @ at_sources.astype(np.float32, copy=False))

    def spread(self, at_sources: FloatArray) -> FloatArray:
        """Standard deviation (n,), by their weights, of the values (m,) that each one is interpolated from."""
        mean, square = np.zeros((2, len(self.neighbours)))
        for weight, near in zip(self.weights.T, self.neighbours.T, strict=True):
            mean += weight * at_sources[near]
            square += weight * at_sources[near] ** 2
        return np.sqrt(np.maximum(square - mean**2, 0.0))
