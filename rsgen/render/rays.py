"""Single rays into a scene: how far the nearest surface is, and which way it faces."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import FloatArray


def cast_rays(scene: Any, p_world: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance (n,) in metres from points (n, 3) along unit directions (n, 3), world frame, and normals (n, 3) there.

    Normals are the triangles' own, whichever side is hit. Where there is nothing, the distance is infinite and the
    normal zero.
    """
    ray = mi.Ray3f(_points(p_world), mi.Vector3f(_points(direction)))
    hit = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False)
    valid = hit.is_valid()
    distance = np.asarray(dr.select(valid, hit.t, dr.inf), float)
    normal = np.asarray(dr.select(valid, hit.n, 0), float)
    return distance.reshape(-1), normal.T.reshape(-1, 3)


def _points(rows: FloatArray) -> Any:
    return mi.Point3f(np.ascontiguousarray(rows.T, np.float32))
