"""Light through panes and off what mirrors: rays followed to surfaces that scatter and to lamps; shadows of panes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from rsgen.light.sampling import golden
from rsgen.scene.rays import proper

# Panes and mirrors that a ray is followed through: a double-glazed window seen in a mirror has nine.
_MOST = 10
_STRAIGHT = int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.Null)
_NULL = int(mi.BSDFFlags.Null)
GLOSSY = int(mi.BSDFFlags.Glossy)
SPECULAR = GLOSSY | _STRAIGHT
_DIFFUSE = int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.DiffuseTransmission)


def passes_light_on(scene: Any) -> bool:
    """Whether a scene has panes, mirrors or cut-out surfaces."""
    return any(f & _NULL or (f & _STRAIGHT and not f & _DIFFUSE) for f in _kinds(scene))


def shines(scene: Any) -> bool:
    """Whether anything in a scene mirrors or lets through, be it faintly like lacquer or blurred like brushed metal."""
    return any(f & SPECULAR for f in _kinds(scene))


def casts_caustics(shape: Any) -> bool:
    """Whether a surface is matte beneath what mirrors, or mirrors blurred: lacquer, satin, brushed metal."""
    kind = _kind(shape)
    return bool(kind & GLOSSY or (kind & _STRAIGHT and kind & _DIFFUSE and not kind & _NULL))


def _kinds(scene: Any) -> list[int]:
    return [_kind(shape) for shape in scene.shapes()]


def _kind(shape: Any) -> int:
    return int(shape.bsdf().flags()) if shape.bsdf() is not None else 0


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
            # Most of what is met is matte: flags show that without the costly description of the place.
            kind = pi.shape.bsdf().flags()
            going &= pi.is_valid() & (passed < _MOST) & ((kind & _STRAIGHT) != 0)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, going)
            bsdf = si.bsdf(ray)
            u = golden(passed, pick)
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
def surface_radiance(scene, field, ray, number, i, pick, follow):
    """Radiance times π (Color3f) that matte surfaces send along a ray, lit as `field` states.

    With `follow` by way of whatever mirrors or lets through, which of a surface's lobes by lot; without, the first
    surface counts as matte altogether, as the last one does after many. number, i: of the place and of its ray, for
    random numbers; pick: uniform in [0, 1), the first lot.
    """
    context = mi.BSDFContext()
    light = mi.Color3f(0)
    through = mi.Color3f(1)
    passed = mi.UInt32(0)
    going = mi.Bool(True)
    while going:
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, going)
        going &= si.is_valid()
        # The sampled weight's mean is the albedo ρ, exactly and without noise for Lambert's law.
        bs, weight = si.bsdf(ray).sample(context, si, pick, _drawn(number, i, passed), going)
        onward = going & ((bs.sampled_type & SPECULAR) != 0) & (passed < _MOST) & (dr.max(weight) > 0)
        if dr.hint(not follow, mode="scalar"):
            onward = mi.Bool(False)
        ends = going & ~onward
        # Lambert's surface sends L = ρE/π.
        light += dr.select(ends, through * weight * field.lookup(pi, si, -ray.d, ends), 0)
        through = dr.select(onward, through * weight, through)
        ray = si.spawn_ray(si.to_world(bs.wo))
        going = onward
        passed += 1
        pick = golden(1, pick)
    return light


@dr.syntax
def caustic_radiance(scene, ray, number, i, pick):
    """Radiance (Color3f) of lamps and sky that comes along a ray by way of lacquer or brushed metal.

    Arguments as of `surface_radiance`. What brushed metal blurs is found by sampling lamps and lobe, with the balance
    heuristic (Veach and Guibas 1995).
    """
    specular = mi.BSDFContext()
    specular.type_mask = SPECULAR
    light = mi.Color3f(0)
    through = mi.Color3f(1)
    passed = mi.UInt32(0)
    thrown = mi.Bool(False)  # by lacquer or brushed metal
    blurred = mi.Bool(False)  # at the last turn, by a lobe of this density, there
    density = mi.Float(1)
    there = dr.zeros(mi.Interaction3f, dr.width(ray.o))
    going = mi.Bool(True)
    while going:
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, going)
        emitter = si.emitter(scene, going)
        found = going & (emitter != dr.zeros(mi.EmitterPtr)) & thrown
        towards = mi.DirectionSample3f(scene, si, there)
        drawn = scene.pdf_emitter_direction(there, towards, found & blurred)
        share = dr.select(blurred, density / dr.maximum(density + drawn, 1e-20), 1)
        light += dr.select(found, through * share * emitter.eval(si, found), 0)
        bsdf = si.bsdf(ray)
        kind = bsdf.flags()
        going &= si.is_valid() & ((kind & SPECULAR) != 0) & (passed < _MOST)
        brushed = going & ((kind & GLOSSY) != 0)
        ds, value = scene.sample_emitter_direction(si, _drawn(number, i, 2 * _MOST + passed), False, brushed)
        cast, lobe = bsdf.eval_pdf(specular, si, si.to_local(ds.d), brushed)
        gain = value * cast * dr.select(ds.delta, 1, ds.pdf / dr.maximum(ds.pdf + proper(lobe), 1e-20))
        lit = brushed & (ds.pdf > 0) & (dr.max(through * gain) > 0)
        lit &= ~scene.ray_test(si.spawn_ray_to(ds.p), lit)
        light += dr.select(lit, through * gain, 0)
        bs, weight = bsdf.sample(specular, si, pick, _drawn(number, i, passed), going)
        through = dr.select(going, through * weight, through)
        going &= dr.max(through) > 0
        thrown |= going & ((bs.sampled_type & _NULL) == 0) & ((kind & (GLOSSY | _DIFFUSE)) != 0)
        blurred = (bs.sampled_type & GLOSSY) != 0
        density = proper(bs.pdf)
        there = mi.Interaction3f(si)
        ray = si.spawn_ray(si.to_world(bs.wo))
        passed += 1
        pick = golden(1, pick)
    return light


def _drawn(number: Any, i: Any, passed: Any) -> Any:
    """Two uniform numbers for a ray's turn."""
    seed = i * (4 * _MOST) + passed
    return mi.Point2f(mi.sample_tea_float32(number, 2 * seed, 4), mi.sample_tea_float32(number, 2 * seed + 1, 4))


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
