"""`BakedIntegrator`: primary rays that find their light on the surfaces, in the place of path tracing."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from rsgen.irradiance import IrradianceField

_DIFFUSE = int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.DiffuseTransmission)
_SPECULAR = int(mi.BSDFFlags.Glossy) | int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.Null)


class BakedIntegrator(mi.SamplingIntegrator):
    """Radiance from baked irradiance: emission + diffuse lobe x E, and traced bounces for all other lobes.

    The diffuse lobe is weighted with one cosine-distributed direction, which is exact (no noise) for Lambert's law and
    nearly so for the diffuse base of plastics. Glossy and specular lobes are sampled and traced onto the baked
    surfaces, up to `bounces` times in a row.
    """

    def __init__(self, field: IrradianceField, bounces: int = 4) -> None:
        super().__init__(mi.Properties())
        self._field = field
        self._bounces = bounces

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True):
        radiance, valid = trace_baked(scene, self._field, sampler, mi.Ray3f(ray), self._bounces, mi.Bool(active))
        return radiance, valid, []


@dr.syntax
def trace_baked(scene, field, sampler, ray, bounces, active):
    """Radiance (Color3f) along `ray` and whether it hit a surface; see `BakedIntegrator`."""
    diffuse = mi.BSDFContext()
    diffuse.type_mask = _DIFFUSE
    specular = mi.BSDFContext()
    specular.type_mask = _SPECULAR

    radiance = mi.Color3f(0)
    throughput = mi.Color3f(1)
    depth = mi.UInt32(0)
    valid = mi.Bool(False)
    while active:
        pi = scene.ray_intersect_preliminary(ray, coherent=depth == 0, active=active)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        radiance[active] += throughput * si.emitter(scene, active).eval(si, active)
        active &= si.is_valid()
        valid |= active

        bsdf = si.bsdf(ray)
        wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(active))
        wo.z *= dr.sign(si.wi.z)
        lobe = bsdf.eval(diffuse, si, wo, active) / dr.maximum(dr.abs(wo.z), 1e-6)
        radiance[active] += throughput * lobe * field.lookup(pi, si, -ray.d, active)

        glossy = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
        delta = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta) | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        active &= (glossy | delta) & (depth < bounces)
        bs, weight = bsdf.sample(specular, si, sampler.next_1d(active), sampler.next_2d(active), active)
        throughput *= weight
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= dr.max(throughput) > 0
        depth += 1
    return radiance, valid
