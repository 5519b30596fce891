"""Polygons as triangles: Mitsuba and trimesh take every one for convex, and a wall with a niche loses the niche."""

from __future__ import annotations

import numpy as np

from rsgen.array_types import BoolArray, FloatArray, IntArray

_STRAIGHT = 1e-9  # of a polygon's area: corners that turn less go straight on


def is_convex(corners: FloatArray) -> bool:
    """Whether the planar polygon with these corners (n, 3) is convex, so that a fan from any corner fills it."""
    xy, area = _flattened(corners)
    turn = _turn(xy)
    if (turn < -_STRAIGHT * area).any():
        return False
    edge = np.roll(xy, -1, axis=0) - xy
    angle = np.arctan2(turn, np.einsum("ij,ij->i", edge, np.roll(edge, 1, axis=0)))
    return bool(area == 0 or angle.sum() < 3 * np.pi)  # once round, not twice


def triangulated(corners: FloatArray) -> IntArray:
    """Triangles (n - 2, 3), numbers of corners, of a planar polygon that does not cross itself, corners (n, 3).

    They turn as the polygon does. It may touch itself, as those do that have a hole, with a cut that leads to it. A
    convex one is a fan from its first corner, as Mitsuba has it; else ears are clipped (Meisters 1975). Of a polygon
    that crosses itself they are some triangles.
    """
    n = len(corners)
    if is_convex(corners):
        k = np.arange(1, n - 1)
        return np.stack([np.zeros_like(k), k, k + 1], axis=1)
    xy, area = _flattened(corners)
    left, triangles = np.arange(n), []
    while len(left) > 3:
        ear = _ear(xy[left], area)
        triangles.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        left = np.delete(left, ear)
    return np.array([*triangles, left], np.int64)


def _ear(xy: FloatArray, area: float) -> int:
    """Number of a corner of the polygon (n, 2), counter-clockwise, that can be cut off: the sharpest if none can."""
    turn = _turn(xy)
    blunt = xy[turn <= _STRAIGHT * area]  # only these can lie in an ear
    before, after = np.roll(xy, 1, axis=0), np.roll(xy, -1, axis=0)
    for k in np.flatnonzero(turn > _STRAIGHT * area):
        corner = np.stack([before[k], xy[k], after[k]])
        other = blunt[~(blunt[:, None] == corner).all(axis=-1).any(axis=1)]
        if not _inside(other, corner).any():
            return int(k)
    return int(np.argmin(np.abs(turn))) if (np.abs(turn) <= _STRAIGHT * area).any() else int(np.argmax(turn))


def _inside(p: FloatArray, corner: FloatArray) -> BoolArray:
    """Whether points (n, 2) are in a counter-clockwise triangle (3, 2) or on its edges."""
    edge = np.roll(corner, -1, axis=0) - corner
    to = p[:, None] - corner
    return np.all(edge[:, 0] * to[..., 1] - edge[:, 1] * to[..., 0] >= 0, axis=1)


def _flattened(corners: FloatArray) -> tuple[FloatArray, float]:
    """The polygon (n, 2) in its own plane, counter-clockwise, and its area (Newell's normal)."""
    p = corners - corners.mean(axis=0)
    normal = 0.5 * np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0)
    area = float(np.linalg.norm(normal))
    if not area > 0:
        return p[:, :2], 0.0
    side = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(side, normal / area)
    x /= np.linalg.norm(x)
    return p @ np.stack([x, np.cross(normal / area, x)], axis=1), area


def _turn(xy: FloatArray) -> FloatArray:
    """Twice the signed area (n,) of the triangle at each corner of a polygon (n, 2)."""
    a, b = xy - np.roll(xy, 1, axis=0), np.roll(xy, -1, axis=0) - xy
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
