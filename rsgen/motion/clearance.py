"""How close a camera's path comes to a scene's surfaces, and tours that keep away from them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from rsgen.array_types import FloatArray
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
