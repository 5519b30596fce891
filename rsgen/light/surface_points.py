"""Where light is baked: the unique points of a scene's surfaces that its lattice samples, and barriers between them.

A floor under a wall, a board or a box is two pieces of surface, each with its own light. Light must not be mixed across
a barrier: outside a wall the sky shines on the floor, one texel away from the room. A ray runs just above the surface
between every two neighbours of a triangle's grid. Where something blocks it, each of the two counts only up to the
obstacle (for the lookup). Pieces of surface that are joined nowhere nearby are kept apart while light is smoothed and
interpolated (`SamplePoints.piece`). A point right below something, such as a desk under a sheet of paper, is not
visible and does not count for its neighbours.
"""

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
from rsgen.device.arrays import aligned, rows_of, vectors
from rsgen.render.irradiance import (
    FREE,
    REACH_LEVELS,
    Lattice,
    at_triangles,
    lattice_barycentric,
    packed_reach,
    registry_id,
)
from rsgen.scene.meshes import mesh_arrays, meshes_of
from rsgen.scene.rays import RAY_OFFSET_M, rays_from

_NORMAL_SCALE = 0.35  # normals this far apart count as much as one spacing
_APART = 1e4  # spacings between different pieces of surface
_INSET_M = 2e-3  # samples on a triangle's rim move this far inwards: a corner exactly on two surfaces sees neither
_COVERED_TEXELS, _COVERED_M = 0.3, 0.01  # what is nearer above a surface than either covers it
_CHUNK = 1 << 20  # points looked at in one launch


@dataclass(frozen=True)
class SamplePoints:
    """Unique sample points: position on the surface, shading normal, geometric normal, (n, 3) float32 each, and (n,)
    the number of the piece of surface that each lies on: one side of a connected part of a mesh that nothing stands on.
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
    how far these count on either side (see `_barriers`).
    """
    position, normal, geometric, key = _on_lattice(scene, lattice)
    # Points that are their triangles' only ones have none in common, so all of a piece of mesh count as one place.
    alone = np.repeat(lattice.cells[:, 0] == 0, lattice.counts)
    chosen, index, place = _unique(key, alone)
    first = np.concatenate(chosen)
    sign = np.repeat(np.array([1, -1], np.float32), [len(side) for side in chosen])[:, None]
    unique_geometric = sign * geometric[first]
    within = min(_COVERED_TEXELS * texel_m, _COVERED_M)
    covered = find_covered(scene, position[first], unique_geometric, within)[index]
    reach, piece = _barriers(scene, lattice, position, geometric, index, place, covered, texel_m)
    return SamplePoints(position[first], sign * normal[first], unique_geometric, piece), index, reach


def _on_lattice(scene: Any, lattice: Lattice) -> tuple[Float32Array, Float32Array, Float32Array, tuple[NDArray, ...]]:
    """At a lattice's points: where to look at light from, shading and geometric normal of the front, (points, 3) each.

    And what makes two of them alike: position and normal, rounded, and the connected piece of mesh.
    """
    face, uv = lattice_barycentric(lattice)
    count = len(face)
    position = np.empty((count, 3), np.float32)
    normal, geometric, middle = (np.empty_like(position) for _ in range(3))
    shapes = meshes_of(scene)
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
    return _connected((a, b), (b, c), size=int(same.max()) + 1)[a]


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


_HEIGHT_M = 1e-3  # of the rays above the surface
_SHORTEST_M = 2e-4  # neighbours nearer than this are taken for joined
_NEARBY = 8.0  # spacings: what is joined only farther away, through a door, is two pieces here
_OFF = np.array([0.37, 0.43, 0.41])  # of cells of that size: walls stand at round numbers
_HASHES = 1 << 26


def _barriers(
    scene: Any, lattice: Lattice, position: Float32Array, normal: Float32Array, index: IntArray, place: IntArray,
    covered: NDArray[np.bool_], spacing: float,
) -> tuple[tuple[NDArray[np.uint32], NDArray[np.uint32]], IntArray]:  # fmt: skip
    """Barriers of a scene between its lattice's points.

    Returns for the front and the back how far each lattice point counts, (points,), 0 where it reaches all its
    neighbours (see `packed_reach`), and the number (n,) of the piece of surface that each unique point lies on.

    position, normal: (points, 3), world, m: where light is looked at, and the geometric normal of the front. index:
    (2, points), the unique point of each one's front and back, the fronts' numbers before the backs'. place: (points,),
    alike where points are at one place of one surface. covered: (2, points), see `find_covered`. spacing: of
    the lattice, m.
    """
    here, there, along = _neighbours(lattice)
    reach, piece, pieces = [], np.empty(int(index.max()) + 1, np.int64), 0
    for side, sign in enumerate((1.0, -1.0)):
        hidden = covered[side]
        apart = hidden[here] != hidden[there]
        levels = np.full((lattice.points, 4), FREE, np.uint8)
        for begin in range(0, len(here), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            blocked, forth, back = _between(scene, position, sign * normal, here[part], there[part])
            at = begin + blocked
            apart[at] = True
            levels[here[at], along[at]] = forth
            levels[there[at], along[at] + 1] = back
        levels[hidden] = 0
        reach.append(packed_reach(levels))
        del levels
        # No point of the front is one of the back's, so each has its graph: half the memory at a time.
        first = int(index[side].min())
        nodes = (index[side] - first).astype(np.int32)
        count = int(nodes.max()) + 1
        places = (place + count).astype(np.int32)
        label = _pieces((nodes, places), (nodes[here], nodes[there]), apart, position / (_NEARBY * spacing))
        piece[first : first + count] = pieces + label[:count]
        pieces += int(label.max()) + 1
    return (reach[0], reach[1]), piece


def _pieces(
    same: tuple[NDArray[np.int32], NDArray[np.int32]], beside: tuple[NDArray[np.int32], NDArray[np.int32]],
    apart: NDArray[np.bool_], scaled: NDArray,
) -> IntArray:  # fmt: skip
    """(n,) label of the piece that each node belongs to; of what is joined only beyond the cell that it is in, several.

    same: (points,) the nodes of lattice points and of where these are; beside: those of neighbours, and apart: whether
    anything stands between; scaled (points, 3): positions in units of a cell.
    """
    joined = beside[0][~apart], beside[1][~apart]
    whole = _connected(same, joined).astype(np.int64)
    cell = np.zeros((len(whole), 3), np.int32)
    cell[same[0]] = cell[same[1]] = np.floor(scaled + _OFF)
    mixed = (cell * np.array([73856093, 19349663, 83492791])).sum(axis=1) % _HASHES  # Teschner et al. 2003
    # What is several parts in a cell where nothing stands, as the sides of a board are, is no matter of walls.
    crossed = np.zeros(_HASHES, bool)
    for ends in beside:
        crossed[mixed[ends[apart]]] = True
    near = np.flatnonzero(crossed[mixed])
    if not len(near):
        return whole
    number = np.full(len(whole), -1, np.int32)
    number[near] = np.arange(len(near))
    inside = [(number[a] >= 0) & (mixed[a] == mixed[b]) for a, b in (same, joined)]
    edges = [(number[a[i]], number[b[i]]) for (a, b), i in zip((same, joined), inside, strict=True)]
    part = _connected(*edges, size=len(near))
    # Each part is of one piece in one cell. A piece is split only where it is in several there.
    of_part = np.zeros(int(part.max()) + 1, np.int64)
    of_part[part] = whole[near] * _HASHES + mixed[near]
    _, group, parts = np.unique(of_part, return_inverse=True, return_counts=True)
    several = (parts[group] > 1)[part]
    split = near[several]
    first = int(whole.max()) + 1
    whole[split] = first + part[several]
    return whole


def _connected(*edges: tuple[NDArray[np.int32], NDArray[np.int32]], size: int = 0) -> NDArray[np.int32]:
    """(n,) label of the connected part that each of `size` nodes, or all there are, belongs to, given edges' ends."""
    a, b = (np.concatenate(ends) for ends in zip(*edges, strict=True))
    size = size or int(max(a.max(), b.max())) + 1
    return connected_components(coo_array((np.ones(len(a), bool), (a, b)), shape=(size, size)), directed=False)[1]


def find_covered(scene: Any, position: Float32Array, normal: Float32Array, within_m: float) -> NDArray[np.bool_]:
    """Which points (n, 3) have something less than `within_m` in front of them, along the normal."""
    out = np.zeros(len(position), bool)
    for begin in range(0, len(position), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        rays = rays_from(position[part] + RAY_OFFSET_M * normal[part], normal[part])
        rays.maxt = dr.opaque(mi.Float, within_m)
        out[part] = np.array(scene.ray_test(rays)).astype(bool)
    return out


def _neighbours(lattice: Lattice) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int8]]:
    """Pairs of neighbours in the grids of all triangles, and the way from the first to the second: 0 is u, 2 is v."""
    face, row, column = lattice.places()
    point = np.arange(lattice.points)
    nu, nv = lattice.cells[face].T
    down, right = point[row < nu], point[(column < nv) & (row > 0)]  # a triangle's apex is all of its first row
    here = np.concatenate([down, right]).astype(np.int32)
    there = np.concatenate([down + nv[down] + 1, right + 1]).astype(np.int32)
    return here, there, np.repeat(np.array([0, 2], np.int8), [len(down), len(right)])


def _between(
    scene: Any, position: Float32Array, normal: NDArray, here: NDArray[np.int32], there: NDArray[np.int32]
) -> tuple[IntArray, NDArray, NDArray]:
    """Which pairs something stands between, and how far it is from the first and from the second, in levels."""
    p = position[here] + np.float32(_HEIGHT_M) * normal[here]
    way = (position[there] - position[here]).astype(np.float32)
    length = np.linalg.norm(way, axis=1)
    long = np.flatnonzero(length > _SHORTEST_M)
    rays = rays_from(p[long], way[long] / length[long, None])
    rays.maxt = mi.Float(aligned(length[long]))
    blocked = long[np.array(scene.ray_test(rays)).astype(bool)]
    if not len(blocked):
        return blocked, np.zeros(0, np.uint8), np.zeros(0, np.uint8)
    away = []
    for start, sign in ((p, 1.0), (p + way, -1.0)):
        d = sign * way[blocked] / length[blocked, None]
        rays = rays_from(start[blocked], d)
        rays.maxt = mi.Float(aligned(length[blocked]))
        pi = scene.ray_intersect_preliminary(rays, coherent=False)
        # What a ray meets one way and misses the other, at the very end of it, is far.
        t = np.array(dr.select(pi.is_valid(), pi.t, rays.maxt))
        away.append(np.clip(np.rint(t / length[blocked] * (REACH_LEVELS - 1)), 0, REACH_LEVELS - 1).astype(np.uint8))
    return blocked, away[0], away[1]
