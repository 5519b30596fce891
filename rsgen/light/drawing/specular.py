"""Light through panes and off mirrors: rays followed to the first surface that scatters, and shadows of panes."""

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
    that met it, what gets through (Color3f), and whether the ray was turned on its way: through thin panes and
    cut-outs it goes straight on (`transmitted`).
    """
    context = mi.BSDFContext()
    through = mi.Color3f(1)
    passed = mi.UInt32(0)
    turned = mi.Bool(False)
    going = mi.Bool(active)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
    if dr.hint(follow, mode="scalar"):
        while going:
            # Most of what is met is matte: told by its flags, before the costly description of the place.
            kind = pi.shape.bsdf().flags()
            going &= pi.is_valid() & (passed < _MOST) & ((kind & _STRAIGHT) != 0)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, going)
            bsdf = si.bsdf(ray)
            u = pick + mi.Float(passed) * 0.6180339887498949
            u -= dr.floor(u)
            bs, weight = bsdf.sample(context, si, u, mi.Point2f(u, 0.5), going)
            straight_on = (bs.sampled_type & _NULL) != 0
            going &= straight_on | (((bs.sampled_type & _STRAIGHT) != 0) & ((kind & _DIFFUSE) == 0))
            turned |= going & ~straight_on
            through = dr.select(going, through * weight, through)
            onward = si.spawn_ray(si.to_world(bs.wo))
            ray.o = dr.select(going, onward.o, ray.o)
            ray.d = dr.select(going, onward.d, ray.d)
            again = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
            pi = dr.select(going, again, pi)
            passed = dr.select(going, passed + 1, passed)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    return pi, si, ray, through, turned


@dr.syntax
def transmitted(scene, p, d, distance, active, follow):
    """Part (Color3f) of the light that gets straight from `distance` along d (unit) to p; with `follow` through panes.

    Panes that bend light, of a thickness, throw a shadow; what they let through is found by `first_scatterer`.
    """
    # Short of the emitter itself, whose surface would shadow its own sample.
    length = distance * (1 - 1e-4) - 1e-5
    end = p + d * length
    ray = mi.Ray3f(p, d, length, 0.0, mi.Color0f())
    if dr.hint(not follow, mode="scalar"):
        return mi.Color3f(dr.select(active & ~scene.ray_test(ray, active=active), 1, 0))
    through = mi.Color3f(dr.select(active, 1, 0))
    passed = mi.UInt32(0)
    going = mi.Bool(active)
    while going:
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
        going &= pi.is_valid()
        clear = going & ((pi.shape.bsdf().flags() & _NULL) != 0) & (passed < _MOST)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, clear)
        share = si.bsdf(ray).eval_null_transmission(si, clear)
        through = dr.select(clear, through * share, dr.select(going, 0, through))
        onward = si.spawn_ray(ray.d)
        # It goes on a little beside its line, and is aimed anew: else it would reach into the emitter.
        rest = end - onward.o
        length = dr.norm(rest)
        ray.o = dr.select(clear, onward.o, ray.o)
        ray.d = dr.select(clear, rest / length, ray.d)
        ray.maxt = dr.select(clear, length, ray.maxt)
        going = clear & (dr.max(through) > 0)
        passed += 1
    return through
