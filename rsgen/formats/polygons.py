"""Polygons as triangles: Mitsuba and trimesh take every one for convex, and a wall with a niche loses the niche."""

from __future__ import annotations

import mapbox_earcut
import numpy as np

from rsgen.array_types import BoolArray, FloatArray, IntArray

_STRAIGHT = 1e-9  # of a polygon's area: corners that turn less go straight on


def triangulate(points: FloatArray, vertex: IntArray, counts: IntArray, kept: BoolArray) -> tuple[IntArray, IntArray]:
    """Triangles of polygons, in the polygons' order.

    points (n, 3); vertex (k,): point of each corner, polygon after polygon; counts (m,): corners of each; kept (m,):
    which are wanted. Returns corners (t, 3), numbers into `vertex`, and the polygon (t,) of each triangle.
    """
    first = np.cumsum(counts) - counts
    out, of = [], []
    for count in np.unique(counts[kept & (counts >= 3)]):
        which = np.flatnonzero(kept & (counts == count))
        ring = first[which, None] + np.arange(count)
        step = np.arange(1, count - 1)
        fan = np.stack([np.broadcast_to(ring[:, :1], (len(ring), count - 2)), ring[:, step], ring[:, step + 1]], -1)
        if count > 3:
            p = points[vertex[fan]]
            normal = np.cross(p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :])
            bent = (np.einsum("mtk,mk->mt", normal, normal.sum(axis=1)) < 0).any(axis=1)
            for k in np.flatnonzero(bent):
                fan[k] = ring[k][triangulated(points[vertex[ring[k]]])]
        out.append(fan.reshape(-1, 3))
        of.append(np.repeat(which, count - 2))
    if not out:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    corners, polygon = np.concatenate(out), np.concatenate(of)
    order = np.argsort(polygon, kind="stable")
    return corners[order], polygon[order]


def triangulated(corners: FloatArray) -> IntArray:
    """Triangles (n - 2, 3), numbers of corners, of a planar polygon that does not cross itself, corners (n, 3).

    They turn as the polygon does. It may touch itself, as those do that have a hole, with a cut that leads to it. A
    convex one is a fan from its first corner, as Mitsuba has it; so is what cannot be cut into n - 2 triangles, as a
    polygon that crosses itself.
    """
    n = len(corners)
    if not is_convex(corners):
        xy, _ = _flattened(corners)
        cut = mapbox_earcut.triangulate_float64(np.ascontiguousarray(xy), np.array([n], np.uint32))
        if len(cut) == 3 * (n - 2):
            return cut.reshape(-1, 3).astype(np.int64)
    k = np.arange(1, n - 1)
    return np.stack([np.zeros_like(k), k, k + 1], axis=1)


def is_convex(corners: FloatArray) -> bool:
    """Whether the planar polygon with these corners (n, 3) is convex, so that a fan from any corner fills it."""
    xy, area = _flattened(corners)
    edge = np.roll(xy, -1, axis=0) - xy
    before = np.roll(edge, 1, axis=0)
    turn = before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0]  # twice the area of the triangle at each corner
    if (turn < -_STRAIGHT * area).any():
        return False
    angle = np.arctan2(turn, np.einsum("ij,ij->i", edge, before))
    return bool(area == 0 or angle.sum() < 3 * np.pi)  # once round, not twice


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
