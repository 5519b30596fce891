"""Barriers on a surface: a floor under a wall, a board or a box is two pieces of surface, each with its own light.

Light must not be mixed across a barrier: outside a wall the sky shines on the floor, one texel away from the room. A
ray runs just above the surface between every two neighbours of a triangle's grid. Where something blocks it, each of
the two counts only up to the obstacle (`Barriers.reach`, for the lookup). Pieces of surface that are joined nowhere
nearby are kept apart while light is smoothed and interpolated (`Barriers.piece`). A point right below something, such
as a desk under a sheet of paper, is not visible and does not count for its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rsgen.array_types import Float32Array, IntArray
from rsgen.device.arrays import aligned
from rsgen.render.irradiance import FREE, REACH_LEVELS, Lattice, packed_reach
from rsgen.scene.rays import RAY_OFFSET_M, rays_from

_HEIGHT_M = 1e-3  # of the rays above the surface
_SHORTEST_M = 2e-4  # neighbours nearer than this are taken for joined
_NEARBY = 8.0  # spacings: what is joined only farther away, through a door, is two pieces here
_OFF = np.array([0.37, 0.43, 0.41])  # of cells of that size: walls stand at round numbers
_HASHES = 1 << 26
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Barriers:
    """reach: for the front and the back, (points,) uint32 of each lattice point, 0 where it reaches all its neighbours
    (see `packed_reach`); piece (n,): number of the piece of surface that each unique point lies on.
    """

    reach: tuple[NDArray[np.uint32], NDArray[np.uint32]]
    piece: IntArray


def find_barriers(
    scene: Any, lattice: Lattice, position: Float32Array, normal: Float32Array, index: IntArray, place: IntArray,
    covered: tuple[NDArray[np.bool_], NDArray[np.bool_]], spacing: float,
) -> Barriers:  # fmt: skip
    """Barriers of a scene between its lattice's points.

    position, normal: (points, 3), world, m: where light is looked at, and the geometric normal of the front. index:
    (2, points), the unique point of each one's front and back, the fronts' numbers before the backs'. place: (points,),
    alike where points are at one place of one surface. covered: (points,) of front and back, see `find_covered`.
    spacing: of the lattice, m.
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
    return Barriers((reach[0], reach[1]), piece)


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
    counts = (lattice.cells + 1).prod(axis=1)
    face = np.repeat(np.arange(len(counts)), counts)
    point = np.arange(lattice.points)
    nu, nv = lattice.cells[face].T
    row, column = np.divmod(point - lattice.first[face], nv + 1)
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
