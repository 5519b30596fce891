"""Room for a camera in a scene: how near its path comes to surfaces, tours that keep away, floors, free places."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree

from rsgen.array_types import BoolArray, FloatArray
from rsgen.config.motion import Waypoint
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rsgen.motion.make import TourCurve

_STEP_S = 0.02
_STEP_M = 0.02
_MARGIN = 1.2  # a pushed waypoint goes this much farther than it needs, as the curve between waypoints cuts corners
_ROUNDS = 30
_SMALLEST_M = 1e-3
_SHELLS, _NEARBY_M = 20, 1.0  # where a free place is looked for: spheres about the place that is not
_SIGHT_M = 0.02
_TRIED = 200
_CHUNK = 500  # points at once: bounds memory


def nearest_surface(points: FloatArray, triangles: FloatArray, reach_m: float) -> tuple[FloatArray, FloatArray]:
    """Exact distance (n,) of points (n, 3) to triangles (m, 3, 3), and the surface's nearest point (n, 3).

    Where there is nothing within reach_m the distance is infinite and the point NaN.
    """
    centre = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - centre[:, None], axis=-1).max(axis=1)
    # Walls and leaves differ a thousandfold in size: sorted by size, each sort has a tight bound on where to look.
    sizes = np.floor(np.log2(np.maximum(radius, _SMALLEST_M))).astype(np.int64)
    sorts = [(np.flatnonzero(sizes == size), 2.0 ** (size + 1.0)) for size in np.unique(sizes)]
    trees = [cKDTree(centre[members]) for members, _ in sorts]
    to_centre = np.stack([np.asarray(tree.query(points)[0]) for tree in trees]).min(axis=0)
    bound = np.minimum(to_centre, reach_m) * (1.0 + 1e-9)
    distance, nearest = np.full(len(points), np.inf), np.full((len(points), 3), np.nan)
    for (members, largest), tree in zip(sorts, trees, strict=True):
        for chunk in np.array_split(np.arange(len(points)), max(1, len(points) // _CHUNK)):
            hits = tree.query_ball_point(points[chunk], bound[chunk] + largest)
            i = np.repeat(chunk, [len(h) for h in hits])
            if not len(i):
                continue
            j = members[np.concatenate([np.asarray(h, dtype=np.int64) for h in hits])]
            found = trimesh.triangles.closest_point(triangles[j], points[i])
            d = np.linalg.norm(found - points[i], axis=1)
            order = np.lexsort((d, i))
            best = order[np.unique(i[order], return_index=True)[1]]
            best = best[(d[best] <= reach_m) & (d[best] < distance[i[best]])]
            distance[i[best]], nearest[i[best]] = d[best], found[best]
    return distance, nearest


def clearance(motion: Spline, triangles: FloatArray, reach_m: float = 0.5) -> float:
    """Least distance in metres of the camera's path to the triangles (m, 3, 3), world frame; inf beyond reach_m.

    The spline is sampled every 20 ms. (trimesh: mesh.triangles; arrays: vertices[faces].)
    """
    return float(nearest_surface(_samples(motion)[1], triangles, reach_m)[0].min())


def check_clearance(motion: Spline, triangles: FloatArray, clearance_m: float) -> None:
    """Raises UserError, naming time and place, if the camera comes closer than clearance_m to triangles (m, 3, 3)."""
    times, points = _samples(motion)
    distance, _ = nearest_surface(points, triangles, clearance_m)
    k = int(np.argmin(distance))
    if distance[k] < clearance_m:
        away = f"away{_free_nearby(points, distance, k, triangles, clearance_m)}"
        raise UserError(
            f"motion: comes within {distance[k]:.3f} m of a surface at {times[k]:.2f} s, at {_listed(points[k])}; "
            f"clearance_m is {clearance_m:g}: move the path {away} or reduce clearance_m"
        )


def _listed(point: FloatArray) -> str:
    return "[" + ", ".join(f"{x:.2f}" for x in point) + "]"


def _free_nearby(points: FloatArray, distance: FloatArray, k: int, triangles: FloatArray, clearance_m: float) -> str:
    """' (free within 0.4 m: [x, y, z])' of the place with clearance_m that is nearest to points[k], or '' without one.

    points (n, 3) of a path and their distances (n,), inf beyond clearance_m. A wall must not part the place from the
    path: from the last point with clearance before k, or else the first after it, one can see it.
    """
    steps = np.arange(1, _SHELLS + 1) / _SHELLS * max(_NEARBY_M, 2.0 * clearance_m)
    around = trimesh.creation.icosphere(subdivisions=2).vertices
    places = np.round(points[k] + (steps[:, None, None] * around).reshape(-1, 3), 2)
    places = places[nearest_surface(places, triangles, clearance_m)[0] >= clearance_m]
    free = np.flatnonzero(distance >= clearance_m)
    if not len(places) or not len(free):
        return ""
    before = free[free < k]
    seen_from = points[before[-1] if len(before) else free[0]]
    far = np.linalg.norm(places - points[k], axis=1)
    for nearest in np.argsort(far, kind="stable")[:_TRIED]:
        count = max(2, math.ceil(float(np.linalg.norm(places[nearest] - seen_from)) / _SIGHT_M))
        sight = seen_from + np.linspace(0.0, 1.0, count)[:, None] * (places[nearest] - seen_from)
        if np.isinf(nearest_surface(sight, triangles, 0.6 * _SIGHT_M)[0]).all():
            return f" (free within {math.ceil(10.0 * far[nearest]) / 10.0:.1f} m: {_listed(places[nearest])})"
    return ""


def plan_tour(
    triangles: FloatArray, waypoints: Sequence[Waypoint], clearance_m: float = 0.15, closed: bool = True
) -> tuple[Waypoint, ...]:
    """Waypoints of a tour that keeps clearance_m from triangles (m, 3, 3): those given, moved and added to as needed.

    Where the curve comes too close, it is pushed straight away from the nearest surface: by moving a waypoint that is
    near, else by a new one, whose target is the curve's. What passes *through* a surface cannot be pushed off it.
    Raises UserError naming the waypoint after which it stays too close.
    """
    tour = list(waypoints)
    for _ in range(_ROUNDS):
        curve = TourCurve.through(tour, closed)
        s = np.linspace(0.0, curve.length, max(2, round(curve.length / _STEP_M)) + 1)
        points, targets = curve.at(s)
        distance, nearest = nearest_surface(points, triangles, clearance_m)
        close = distance < clearance_m
        if not close.any():
            return tuple(tour)
        passes = curve.waypoint_distances()
        worst = int(np.argmin(distance))
        after = max(int(np.searchsorted(passes, s[worst] + 1e-6)) - 1, 0)
        if distance[worst] < 1e-6:
            break
        # One push for each part of the curve that is too close, from the last to the first so that indices stay valid.
        starts = np.flatnonzero(close & ~np.r_[False, close[:-1]])
        for begin in starts[::-1]:
            end = begin + int(np.argmin(np.r_[close[begin:], False]))
            k = begin + int(np.argmin(distance[begin:end]))
            away = (points[k] - nearest[k]) * (_MARGIN * clearance_m / max(distance[k], 1e-6) - 1.0)
            _push(tour, passes, float(s[k]), points[k], targets[k], away)
    raise UserError(
        f"motion: the tour after waypoint {after} stays within {distance[worst]:.3f} m of a surface, less than "
        f"clearance_m = {clearance_m:g}: move that waypoint or the next away, or reduce clearance_m"
    )


def _push(
    tour: list[Waypoint], passes: FloatArray, s: float, point: FloatArray, target: FloatArray, away: FloatArray
) -> None:
    """Move the waypoint at `s` metres along the tour by `away`, or insert one at `point` + `away`."""
    gaps = np.abs(passes - s)
    nearest = int(np.argmin(gaps))
    if gaps[nearest] < 5.0 * _STEP_M:
        old = tour[nearest]
        tour[nearest] = Waypoint(position=_vector(np.asarray(old.position) + away), target=old.target)
    else:
        where = int(np.searchsorted(passes, s))
        tour.insert(where, Waypoint(position=_vector(point + away), target=_vector(target)))


def _vector(v: FloatArray) -> tuple[float, float, float]:
    x, y, z = np.round(v, 4).tolist()
    return x, y, z


def _samples(motion: Spline) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and positions (n, 3)."""
    times = np.linspace(motion.t_begin, motion.t_end, max(2, round((motion.t_end - motion.t_begin) / _STEP_S)))
    return times, motion.pose(times)[:, :3, 3]


Cast = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From points (n, 3) along unit directions (n, 3): distances (n,), m, inf for none, and triangles' normals (n, 3)."""

HEADROOM_M = 1.6
"""Over a floor there is at least so much air."""

BOB_M = 0.08
"""So much does the camera rise above its mean height, and sink below it."""

HIGHEST_M = 60.0
"""What has walls and is higher is a room in another unit than metres."""

_EYE_M = 1.45  # a camera held before the chest of somebody who stands
_SLACK_M = 0.06
_COLUMNS = 48
_MOST_STOREYS = 24  # surfaces above each other that are looked through for floors
_LEVEL_M = 0.1  # floors are told apart so finely
_CELLS = 1_500_000
_CELL_M = 0.03
_PROBE_M = 0.2
_PROBES = 20_000
_AZIMUTHS = 24
_WALLED = 0.7  # of the horizontal rays, those that hit a wall where the camera is indoors
_FAR_M = 30.0  # a wall that is farther off is none
_LOW_M = 0.55  # one can hold a camera over a sofa or a low table, not over a cupboard
_SUNK_M = 0.2


@dataclass(frozen=True)
class Floor:
    """A height on which one can stand.

    y: world, m. area_m2: as far as columns of rays tell. gap_m: median height of the air above it, inf under the sky.
    """

    y: float
    area_m2: float
    gap_m: float


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Square cells over x and z at one height of the camera.

    corner: (2,) world x, z of the centre of cell [0, 0]. eye_y: the camera's mean height, world, m. room_m: (nx, nz)
    distance in the plane to the nearest surface at about that height, m. inside: (nx, nz) walls around, floor below.
    solid: whether these walls show their backs: what they enclose is a body rather than a room.
    """

    corner: FloatArray
    cell_m: float
    eye_y: float
    floor: Floor
    room_m: FloatArray
    inside: BoolArray
    solid: bool

    def largest(self, room_m: float) -> BoolArray:
        """Cells (nx, nz) of the largest connected region inside whose cells have room_m about them."""
        labels, count = ndimage.label((self.room_m >= room_m) & self.inside)
        if not count:
            return np.zeros(self.inside.shape, bool)
        return np.asarray(labels == 1 + np.argmax(np.bincount(labels.ravel())[1:]))

    def area_m2(self, cells: BoolArray) -> float:
        """Area of a region of cells, m²."""
        return float(cells.sum()) * self.cell_m**2


def find_floors(cast: Cast, low: FloatArray, high: FloatArray) -> list[Floor]:
    """Floors of a scene within the box of corners low and high (3,), world, m, the largest first.

    Columns of rays go down through everything; what has HEADROOM_M of air above it may be a floor.
    """
    size = high - low
    p = _columns(low, high, high[1] + 1.0)
    skin, above = 1e-4 * max(1.0, float(size.max())), np.full(len(p), np.inf)
    heights, gaps = [], []
    for _ in range(_MOST_STOREYS):
        distance, _ = cast(p, np.tile([0.0, -1.0, 0.0], (len(p), 1)))
        met = np.isfinite(distance)
        p, above = p[met] - distance[met, None] * [0.0, 1.0, 0.0], above[met]
        if not len(p):
            break
        heights.append(p[:, 1])
        gaps.append(above - p[:, 1])
        above, p = p[:, 1], p - skin * np.array([0.0, 1.0, 0.0])
    y, gap = np.concatenate([*heights, np.zeros(0)]), np.concatenate([*gaps, np.zeros(0)])
    y, gap = y[gap >= HEADROOM_M], gap[gap >= HEADROOM_M]
    floors = []
    column_m2 = float(size[0] * size[2]) / _COLUMNS**2
    while len(y):
        level = np.maximum((y - low[1]) / _LEVEL_M, 0.0).astype(np.int64)
        most = low[1] + (np.bincount(level).argmax() + 0.5) * _LEVEL_M
        here = np.abs(y - most) <= 1.5 * _LEVEL_M
        floors.append(Floor(float(np.median(y[here])), float(here.sum()) * column_m2, float(np.median(gap[here]))))
        y, gap = y[~here], gap[~here]
    return sorted(floors, key=lambda floor: -floor.area_m2)


def floor_plan(triangles: FloatArray, cast: Cast, floor: Floor, clearance_m: float) -> FloorPlan:
    """The plan over a floor of a scene of triangles (m, 3, 3), world, m, at the height at which a camera is held."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    far = _FAR_M if high[1] - low[1] <= HIGHEST_M else math.inf
    eye_y = floor.y + min(_EYE_M, floor.gap_m - clearance_m - BOB_M - _SLACK_M)
    cell = max(_CELL_M, math.sqrt(float((high[0] - low[0]) * (high[2] - low[2])) / _CELLS))
    shape = tuple(math.ceil((high[k] - low[k]) / cell) + 5 for k in (0, 2))
    corner = np.array([low[0], low[2]]) - 2.0 * cell
    reach = clearance_m + BOB_M
    taken = _occupied(triangles, (eye_y - reach, eye_y + reach), corner, cell, shape)
    # A cell is taken where a surface passes its centre within half a diagonal.
    room_m = np.maximum(ndimage.distance_transform_edt(~taken) - 0.75, 0.0) * cell
    stride = max(1, round(_PROBE_M / cell), math.ceil(math.sqrt(room_m.size / _PROBES)))
    cells = np.stack(np.meshgrid(*(np.arange(0, n, stride) for n in shape), indexing="ij"), axis=-1)
    probes = np.insert(corner + cells.reshape(-1, 2) * cell, 1, eye_y, axis=1)
    walled, backs, ground = _around(probes, cast, far)
    inside = walled & (ground >= floor.y - _SUNK_M) & (ground <= floor.y + _LOW_M)
    solid = bool(inside.any() and np.median(backs[inside]) > 0.5)
    grid = inside.reshape(cells.shape[:2])
    i, j = (np.minimum((np.arange(shape[k]) + stride // 2) // stride, grid.shape[k] - 1) for k in (0, 1))
    return FloorPlan(corner, cell, eye_y, floor, room_m, grid[np.ix_(i, j)], solid)


def share_without_floor(cast: Cast, low: FloatArray, high: FloatArray) -> float:
    """Share in [0, 1] of the places halfway up the box of corners low and high (3,), m, with walls but no floor."""
    walled, _, ground = _around(_columns(low, high, 0.5 * (low[1] + high[1])), cast, math.inf)
    return float((walled & np.isneginf(ground)).mean())


def _columns(low: FloatArray, high: FloatArray, y: float) -> FloatArray:
    """Points (_COLUMNS², 3) at the height y, evenly over x and z of the box of corners low and high (3,)."""
    x, z = (low[k] + (np.arange(_COLUMNS) + 0.5) / _COLUMNS * (high[k] - low[k]) for k in (0, 2))
    return np.insert(np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2), 1, y, axis=1)


def _around(p_world: FloatArray, cast: Cast, far: float) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Of places (n, 3): whether most horizontal rays hit a wall within far, the share of backs, the height below."""
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * (math.tau / _AZIMUTHS)
    around = np.tile(np.stack([np.cos(azimuth), np.zeros(_AZIMUTHS), np.sin(azimuth)], axis=1), (len(p_world), 1))
    distance, normal = cast(np.repeat(p_world, _AZIMUTHS, axis=0), around)
    walled = (distance.reshape(-1, _AZIMUTHS) < far).mean(axis=1) >= _WALLED
    backs = (np.einsum("ij,ij->i", normal, around) > 0).reshape(-1, _AZIMUTHS).mean(axis=1)
    below, _ = cast(p_world, np.tile([0.0, -1.0, 0.0], (len(p_world), 1)))
    return walled, backs, p_world[:, 1] - below


def _occupied(
    triangles: FloatArray, slab: tuple[float, float], corner: FloatArray, cell: float, shape: tuple[int, ...]
) -> BoolArray:
    """Cells that hold a part of a triangle between the two heights of the slab."""
    near = (triangles[..., 1].max(axis=1) >= slab[0]) & (triangles[..., 1].min(axis=1) <= slab[1])
    taken = np.zeros(shape, np.uint8)
    if not near.any():
        return taken.astype(bool)
    v, f = triangles[near].reshape(-1, 3), np.arange(3 * near.sum()).reshape(-1, 3)
    for height, normal in zip(slab, ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0)), strict=True):
        v, f, _ = trimesh.intersections.slice_faces_plane(v, f, normal, (0.0, height, 0.0))
    corners = np.round((v[f][..., [0, 2]] - corner) / cell).astype(np.int32)
    small = (np.ptp(corners, axis=1) <= 1).all(axis=1)
    taken[tuple(corners[small].reshape(-1, 2).T)] = 1
    for polygon in corners[~small][..., ::-1]:  # OpenCV counts columns first
        cv2.fillConvexPoly(taken, polygon, 1)
    return taken.astype(bool)
