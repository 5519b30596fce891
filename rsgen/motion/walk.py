"""A closed walk through the free places of a floor plan, or round a thing: where the camera goes, not yet its gaze."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage
from skimage.graph import MCP_Geometric
from skimage.measure import find_contours

from rsgen.array_types import BoolArray, FloatArray
from rsgen.motion.floor_plan import BOB_M, FloorPlan

_SLACK_M = 0.04  # hand-shake, and the curve between waypoints, need so much more than the clearance
_DISTANCES_M = (1.2, 1.0, 0.8, 0.65, 0.5)
_CORNER_M = 0.08  # smoothing may cut so far into corners where the walk keeps the least distance
_ROUND = 0.04  # area over length squared: a square has 0.0625, a path to and fro nothing
_ENOUGH = 0.8  # of the length asked for, or of the longest walk there is
_SMOOTH_M = (0.3, 0.2, 0.12, 0.06)
_SHRINKING = 1.15  # by so much smoothing shortens an outline, about
_STEP_M = 0.05
_WAYPOINT_M = 0.6
_LEAST_M2 = 0.25  # a camera cannot be carried about in less
_LEAST_LOOP_M = 1.0
_SHORTEST_M = 3.0  # to walk round: a shorter outline has too few cells to be smoothed
_BISECTIONS = 12

_FILLING = 1.9  # radii of a thing's sphere from its middle: it takes 60 degrees, and what matters of it less
_NEAREST_M = 0.6
_HIGHEST_M = 1.8
_ABOVE = math.radians(28.0)
_UNEVEN = 0.1
_FEWEST = 8


def free_region(plan: FloorPlan, clearance_m: float) -> BoolArray | None:
    """Cells (nx, nz) of the largest region for walks that keep clearance_m; None where there is no room for any."""
    cells = plan.largest(clearance_m + _SLACK_M + _CORNER_M)
    return cells if plan.area_m2(cells) >= _LEAST_M2 else None


def walk_inside(plan: FloorPlan, length_m: float, clearance_m: float, rng: np.random.Generator) -> FloatArray | None:
    """Camera centres (n, 3), world, m, of a closed walk of length_m, or 3 m, at most; None if there is no room.

    A motion that is shorter than its waypoints takes a likeness of them.

    The walk is the outline of the free region within reach of a place that rng draws. It stays as far from the walls,
    up to 1.2 m, as leaves it long enough: surfaces are then at the distances that depth cameras like.
    """
    widest = free_region(plan, clearance_m)
    if widest is None:
        return None
    need = clearance_m + _SLACK_M
    enough = _ENOUGH * min(length_m, _length(_outline(widest, plan)))
    fitting = []
    for room in (room for room in _DISTANCES_M if room > need + _CORNER_M):
        cells = plan.largest(room)
        length = _length(_outline(cells, plan))
        if length >= enough and plan.area_m2(cells) >= _ROUND * length**2:
            fitting.append(cells)
    # The two that keep the farthest from the walls; by chance one of them, so that seeds differ.
    cells = [*fitting, widest, widest][int(rng.integers(2))]
    within = _within(cells, plan, _SHRINKING * max(length_m, _SHORTEST_M), rng)
    loop = _smooth(_outline(within, plan), plan, need)
    if loop is None:
        return None
    loop = np.roll(loop, int(rng.integers(len(loop))), axis=0)[:: 1 if rng.random() < 0.5 else -1]
    around = np.arange(len(loop)) * (math.tau / len(loop))
    waves = max(1, round(_length(loop) / 4.0))
    y = plan.eye_y + BOB_M * np.sin(waves * around + rng.uniform(0.0, math.tau))
    return _waypoints(np.insert(loop, 1, y, axis=1))


def _outline(cells: BoolArray, plan: FloorPlan) -> FloatArray:
    """World x, z (n, 2) of the longest outline of a region of cells, closed, its last point not the first."""
    if not cells.any():
        return np.zeros((0, 2))
    box = ndimage.find_objects(cells.astype(np.uint8))[0]
    outlines = find_contours(np.pad(cells[box].astype(float), 1), 0.5)
    longest = max(outlines, key=_length)[:-1]
    return plan.corner + (longest - 1 + [box[0].start, box[1].start]) * plan.cell_m


def _length(loop: FloatArray) -> float:
    """Length of a closed polygon (n, d)."""
    return float(np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum())


def _within(cells: BoolArray, plan: FloorPlan, length_m: float, rng: np.random.Generator) -> BoolArray:
    """The part of a region that is within reach of one of its cells, as far as its outline is no longer than length_m.

    The whole region where that has so short an outline.
    """
    if _length(_outline(cells, plan)) <= length_m:
        return cells
    places = np.argwhere(cells)
    start = places[int(rng.integers(len(places)))]
    reach, _ = MCP_Geometric(np.where(cells, 1.0, np.inf)).find_costs([start])
    short, long = 0.0, length_m / plan.cell_m
    for _ in range(_BISECTIONS):
        middle = 0.5 * (short + long)
        fits = _length(_outline(reach <= middle, plan)) <= length_m
        short, long = (middle, long) if fits else (short, middle)
    return np.asarray(reach <= short)


def _smooth(loop: FloatArray, plan: FloorPlan, need_m: float) -> FloatArray | None:
    """The loop (n, 2) as smooth as keeps need_m from what stands there, every 5 cm; None where even itself does not."""
    length = _length(loop)
    if length < _LEAST_LOOP_M:
        return None
    closed = np.concatenate([loop, loop[:1]])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.arange(round(length / _STEP_M)) * (length / round(length / _STEP_M))
    even = np.stack([np.interp(at, s, closed[:, k]) for k in range(2)], axis=1)
    for sigma in _SMOOTH_M:
        smooth = ndimage.gaussian_filter1d(even, sigma / _STEP_M, axis=0, mode="wrap")
        room = ndimage.map_coordinates(plan.room_m, ((smooth - plan.corner) / plan.cell_m).T, order=1)
        if room.min() >= need_m and _length(smooth) >= _LEAST_LOOP_M:
            return np.asarray(smooth)
    return None


def _waypoints(p_world: FloatArray) -> FloatArray:
    """Of the points (n, 3) of a loop those that stand for it, about every 60 cm, six at least."""
    count = max(6, round(_length(p_world) / _WAYPOINT_M))
    return p_world[np.round(np.arange(count) * (len(p_world) / count)).astype(np.int64)]


def ring(low: FloatArray, high: FloatArray, ground_y: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Camera centres and the points they look at, (n, 3), world, m, round a thing in the box of corners low, high (3,).

    So far off that it fills the picture, from a little above, but no higher than somebody on the ground holds a camera,
    and no nearer than a depth camera sees. rng draws the start, the direction and how uneven the ring is.
    """
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    radius = max(_FILLING * float(np.linalg.norm(half)), float(np.hypot(half[0], half[2])) + _NEAREST_M)
    count = max(_FEWEST, round(math.tau * radius / _WAYPOINT_M))
    around = (np.arange(count) / count + rng.random()) * (math.tau if rng.random() < 0.5 else -math.tau)
    uneven = 1.0 + _UNEVEN * np.sin(2.0 * around + rng.uniform(0.0, math.tau))
    rise = radius * math.tan(_ABOVE) * (1.0 + 2.0 * _UNEVEN * np.sin(3.0 * around + rng.uniform(0.0, math.tau)))
    y = np.minimum(centre[1] + rise, max(ground_y + _HIGHEST_M, centre[1]))
    x, z = (centre[k] + radius * uneven * wave for k, wave in ((0, np.cos(around)), (2, np.sin(around))))
    return np.stack([x, y, z], axis=1), centre + _UNEVEN * half * rng.uniform(-1.0, 1.0, (count, 3))
