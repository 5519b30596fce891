"""Polygons as triangles: fans where they are convex, ears where they are not."""

from __future__ import annotations

import numpy as np

from rsgen.array_types import BoolArray, FloatArray, IntArray


def triangulate(points: FloatArray, vertex: IntArray, counts: IntArray, kept: BoolArray) -> tuple[IntArray, IntArray]:
    """Triangles of polygons, in the polygons' order.

    points (n, 3); vertex (k,): point of each corner, polygon after polygon; counts (m,): corners of each; kept (m,).
    Returns corners (t, 3), numbers into `vertex`, and the polygon (t,) of each triangle.
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
                fan[k] = ring[k][_ears(points[vertex[ring[k]]], normal[k].sum(axis=0))]
        out.append(fan.reshape(-1, 3))
        of.append(np.repeat(which, count - 2))
    if not out:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    corners, polygon = np.concatenate(out), np.concatenate(of)
    order = np.argsort(polygon, kind="stable")
    return corners[order], polygon[order]


def _ears(p: FloatArray, normal: FloatArray) -> IntArray:
    """Triangles (n - 2, 3) of one simple polygon (n, 3), seen along its normal, of twice its area."""
    drop = int(np.abs(normal).argmax())
    flat = np.delete(p, drop, axis=1) * ([1, 1] if (normal[drop] > 0) != (drop == 1) else [1, -1])
    left, out = list(range(len(p))), []
    while len(left) > 3:
        for k in range(len(left)):
            a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
            others = flat[[i for i in left if i not in (a, b, c)]]
            if _cross(flat[a], flat[b], flat[c]) > 0 and not _inside(others, flat[a], flat[b], flat[c]).any():
                break
        else:  # it meets itself: any triangles will do
            a, b, c, k = left[-1], left[0], left[1], 0
        out.append([a, b, c])
        del left[k]
    return np.array([*out, left], np.int64)


def _cross(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    u, v = b - a, c - a
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


def _inside(p: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray) -> BoolArray:
    return np.asarray((_cross(a, b, p) >= 0) & (_cross(b, c, p) >= 0) & (_cross(c, a, p) >= 0))
