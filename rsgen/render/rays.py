"""Single rays into a scene: how far the nearest surface is, and which way it faces; densities of sampled ones."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import rows_of, vectors

RAY_OFFSET_M = 2e-4  # of rays that start on a surface: so far above it


def cast_rays(scene: Any, p_world: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance (n,) in metres from points (n, 3) along unit directions (n, 3), world frame, and normals (n, 3) there.

    Normals are the triangles' own, whichever side is hit. Where there is nothing, the distance is infinite and the
    normal zero.
    """
    ray = rays_from(p_world, direction)
    hit = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False)
    valid = hit.is_valid()
    distance, normal = dr.select(valid, hit.t, dr.inf), dr.select(valid, hit.n, 0)
    dr.eval(distance, normal)
    return np.asarray(distance, float).reshape(-1), rows_of(normal).astype(float)


def rays_from(p_world: npt.ArrayLike, direction: npt.ArrayLike) -> Any:
    """Rays on the device from points (n, 3) along unit directions (n, 3)."""
    return mi.Ray3f(vectors(mi.Point3f, p_world), vectors(mi.Vector3f, direction))


def proper(density: Any) -> Any:
    """A density of sampled directions (Float), 0 where it is NaN: Mitsuba's is, of rough metal seen from behind."""
    return dr.select(dr.isfinite(density), density, 0)
