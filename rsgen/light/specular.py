"""Light through panes and off mirrors: rays followed to the first surface that scatters."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

# Panes and mirrors that a ray is followed through: a double-glazed window seen in a mirror has nine.
_MOST = 10
_STRAIGHT = int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.Null)
_NULL = int(mi.BSDFFlags.Null)
_DIFFUSE = int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.DiffuseTransmission)


def passes_light_on(scene: Any) -> bool:
    """Whether a scene has panes, mirrors or cut-out surfaces."""
    flags = [int(shape.bsdf().flags()) for shape in scene.shapes() if shape.bsdf() is not None]
    return any(f & _NULL or (f & _STRAIGHT and not f & _DIFFUSE) for f in flags)


@dr.syntax
def first_scatterer(scene, ray, pick, follow, active):
    """What a ray meets behind panes and mirrors; without `follow` what it meets.

    pick: uniform in [0, 1), which lobe of glass and of cut-outs is taken. Returns its hit, the surface there, the ray
    that met it, what gets through (Color3f) and how often it was passed on (UInt32).
    """
    context = mi.BSDFContext()
    through = mi.Color3f(1)
    passed = mi.UInt32(0)
    going = mi.Bool(active)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
    if dr.hint(follow, mode="scalar"):
        while going:
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, going)
            bsdf = si.bsdf(ray)
            going &= si.is_valid() & (passed < _MOST)
            u = pick + mi.Float(passed) * 0.6180339887498949
            u -= dr.floor(u)
            bs, weight = bsdf.sample(context, si, u, mi.Point2f(u, 0.5), going)
            matte = (bsdf.flags() & _DIFFUSE) != 0
            going &= ((bs.sampled_type & _NULL) != 0) | (((bs.sampled_type & _STRAIGHT) != 0) & ~matte)
            through = dr.select(going, through * weight, through)
            onward = si.spawn_ray(si.to_world(bs.wo))
            ray.o = dr.select(going, onward.o, ray.o)
            ray.d = dr.select(going, onward.d, ray.d)
            again = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
            pi = dr.select(going, again, pi)
            passed = dr.select(going, passed + 1, passed)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    return pi, si, ray, through, passed
