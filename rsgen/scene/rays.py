"""Single rays into a scene: how far the nearest surface is, and which way it faces; densities of sampled ones."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from rsgen.array_types import Float32Array, FloatArray
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


def radiance_along(
    scene: Any, integrator: Any, p_world: FloatArray, direction: FloatArray, spp: int, seed: int
) -> Float32Array:
    """Linear RGB (n, 3) from points (n, 3) along unit directions (n, 3), world frame: the mean of spp samples.

    integrator: a Mitsuba sampling integrator. seed: of all its random numbers.
    """
    index = dr.arange(mi.UInt32, len(p_world) * spp) // spp
    ray = rays_from(p_world, direction)
    ray = mi.RayDifferential3f(mi.Ray3f(dr.gather(mi.Point3f, ray.o, index), dr.gather(mi.Vector3f, ray.d, index)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(int(np.random.SeedSequence(seed).generate_state(1)[0]), dr.width(index))
    light, _, _ = integrator.sample(scene, sampler, ray, None, mi.Bool(True))
    light = mi.unpolarized_spectrum(light)
    sums = mi.Color3f(*(dr.block_sum(dr.select(dr.isfinite(channel), channel, 0), spp) for channel in light))
    return (rows_of(sums) / np.float32(spp)).astype(np.float32)


def rays_from(p_world: npt.ArrayLike, direction: npt.ArrayLike) -> Any:
    """Rays on the device from points (n, 3) along unit directions (n, 3)."""
    return mi.Ray3f(vectors(mi.Point3f, p_world), vectors(mi.Vector3f, direction))


def proper(density: Any) -> Any:
    """A density of sampled directions (Float), 0 where it is NaN: Mitsuba's is, of rough metal seen from behind."""
    return dr.select(dr.isfinite(density), density, 0)
