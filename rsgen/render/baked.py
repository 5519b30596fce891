"""`BakedIntegrator`: primary rays that find their light on the surfaces, in the place of path tracing."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from rsgen.render.irradiance import IrradianceField
from rsgen.scene.moving_objects import MovingObjects, ShadedField
from rsgen.scene.rays import proper

_DIFFUSE = int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.DiffuseTransmission)
_SPECULAR = int(mi.BSDFFlags.Glossy) | int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.Null)
_GLOSSY = int(mi.BSDFFlags.Glossy)
_FROSTED = int(mi.BSDFFlags.GlossyTransmission)
_MOST_MIRRORS = 16  # before a glossy hit: a glass of wine has twelve
_MOST_LIGHTS = 16  # light samples at a glossy hit
_PANE = int(mi.BSDFFlags.DeltaReflection), int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.Null)
_CERTAINLY = 1 - 2**-20  # a random number that no pane reflects at, but where it reflects all
_SHEETS = 8  # of paper in a lamp's light: what lacquer seen in lacquer shows of it at most
_FAINT = 0.05  # of the matte light at a hit: reflections below are cast by lot, which saves most shadow rays


class BakedIntegrator(mi.SamplingIntegrator):
    """Radiance from baked irradiance: emission + diffuse lobe x E, and traced bounces for all other lobes.

    The diffuse lobe of a plastic is weighted with one cosine-distributed direction, which is nearly free of noise.
    Glossy lobes are sampled and traced onto the baked surfaces, behind mirrors too. They cost ten times as much: of a
    pixel's samples only `glossy_spp` are traced there, of the others what is matte is shown.
    """

    def __init__(self, field: IrradianceField, glossy_spp: int = 16, objects: MovingObjects | None = None) -> None:
        """objects: that stand before the scene in `matte`, and take light from it; `sample` shows the scene alone."""
        super().__init__(mi.Properties())
        self._field = field if objects is None else ShadedField(field, objects)
        self.objects = objects
        self.glossy_spp = glossy_spp

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True):
        """Mitsuba's interface: radiance along rays, whether they hit, no AOVs."""
        u = sampler.next_2d(), sampler.next_2d()
        radiance, valid = trace_baked(scene, self._field, sampler, mi.Ray3f(ray), mi.Bool(active), *u)
        return radiance, valid, []

    @property
    def state(self) -> list[Any]:
        """All on the device that radiance depends on beside the scene."""
        return list(vars(self._field).values())

    def mirrored(self, scene: Any, sampler: Any, ray: Any, lobe: Any, lamps: Any) -> Any:
        """Radiance (Color3f) along the rays of pixels, but for what `matte` has. lobe, lamps: uniform (Point2f), where
        the first surface's lobe is looked along and where on lamps.
        """
        ray, active = mi.Ray3f(ray), mi.Bool(True)
        return trace_baked(scene, self._field, sampler, ray, active, lobe, lamps, matte_too=False)[0]

    def matte(self, scene: Any, ray: Any, u: Any) -> tuple[Any, Any]:
        """Radiance where the first hit is purely diffuse (or none), exact for Lambert's law, and a mask of the rest:
        of these what their matte lobe shows, for which u (Point2f) is uniform.

        Most of a scene is matte: rendering that without a loop, and of the rest only some samples with `mirrored`,
        takes less than half the time of `sample` for all.
        """
        matte_lobe = mi.BSDFContext()
        matte_lobe.type_mask = _DIFFUSE
        pi = scene.ray_intersect_preliminary(ray, coherent=True)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        hit = si.is_valid()
        bsdf = si.bsdf(ray)
        rest = hit & ((bsdf.flags() & _SPECULAR) != 0)
        radiance = si.emitter(scene).eval(si)
        albedo = bsdf.eval_diffuse_reflectance(si, hit & ~rest)
        beneath = rest & ((bsdf.flags() & _DIFFUSE) != 0)
        wo = mi.warp.square_to_cosine_hemisphere(u)
        wo.z *= dr.sign(si.wi.z)
        lobe = bsdf.eval(matte_lobe, si, wo, beneath) / dr.maximum(dr.abs(wo.z), 1e-6)
        irradiance = self._field.lookup(pi, si, -ray.d, hit & (~rest | beneath))
        radiance = dr.select(rest, 0, radiance + dr.select(hit, albedo * irradiance * dr.inv_pi, 0))
        radiance += dr.select(beneath, lobe * irradiance, 0)
        if self.objects is None or self.objects.now is None:
            return radiance, rest
        meeting = self.objects.now.meet(ray, dr.select(hit, pi.t, dr.inf))
        met = meeting.number > 0
        return dr.select(met, self.objects.now.shaded(ray, meeting), radiance), rest & ~met


@dr.syntax
def trace_baked(scene, field, sampler, ray, active, first_lobe, first_lamp, matte_too=True):
    """Radiance (Color3f) along `ray` and whether it hit a surface; see `BakedIntegrator`.

    first_lobe, first_lamp: uniform (Point2f), for the first surface's lobe and for each of the lamps that it mirrors.
    matte_too: whether the first surface's matte lobe counts.

    A path follows mirrors and glass, frosted too, then a glossy bounce. Of the next surface it sees the matte lobe or,
    by lot, what the others show of one more, all of which counts as diffuse, and of a lamp there no more than `_SHEETS`
    of paper in its light would show: lamps in lacquer in lacquer would be speckle. At a pane it goes on both ways, one
    after the other: by lot, a bright window that shines in one would be speckle. Emitters seen in a glossy lobe are
    found by sampling each of them and the lobe, with the balance heuristic (Veach and Guibas 1995): small bright lamps
    would otherwise leave sparkles.
    """
    everything = mi.BSDFContext()
    diffuse = mi.BSDFContext()
    diffuse.type_mask = _DIFFUSE
    specular = mi.BSDFContext()
    specular.type_mask = _SPECULAR
    lights = min(len(scene.emitters()), _MOST_LIGHTS)

    radiance = mi.Color3f(0)
    throughput = mi.Color3f(1)
    depth = mi.UInt32(0)
    valid = mi.Bool(False)
    last = mi.Bool(False)  # the path has had its glossy bounce
    beyond = mi.Bool(False)  # and one more
    paper = mi.Color3f(0)  # what so many sheets of matte white would send from there
    glossy_hit = dr.zeros(mi.Interaction3f, dr.width(ray.o))
    lobe_pdf = mi.Float(1)  # of the direction sampled there
    waiting = mi.Bool(False)  # what a pane reflects, until the way through it has ended
    reflected = mi.Ray3f(ray)
    reflected_throughput = mi.Color3f(0)
    reflected_depth = mi.UInt32(0)
    while active:
        pi = scene.ray_intersect_preliminary(ray, coherent=depth == 0, active=active)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        emitter = si.emitter(scene, active)
        found = active & (emitter != dr.zeros(mi.EmitterPtr))
        towards = mi.DirectionSample3f(scene, si, glossy_hit)
        light_pdf = scene.pdf_emitter_direction(glossy_hit, towards, found & last)
        share = dr.select(last & ~beyond, lobe_pdf / (lobe_pdf + lights * light_pdf), 1)
        shown = emitter.eval(si, found)
        shown = dr.select(beyond, dr.minimum(shown, paper), shown)
        radiance[found] += throughput * share * shown
        active &= si.is_valid()
        valid |= active

        bsdf = si.bsdf(ray)
        wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(active))
        wo.z *= dr.sign(si.wi.z)
        lobe = bsdf.eval(diffuse, si, wo, active & ~last) / dr.maximum(dr.abs(wo.z), 1e-6)
        once, albedo = bsdf.sample(everything, si, sampler.next_1d(active), sampler.next_2d(active), active & last)
        # Of rough metal seen from behind Mitsuba samples no direction, with weight 0.
        further = active & last & ~beyond & ((once.sampled_type & _SPECULAR) != 0) & (dr.max(albedo) > 0)
        irradiance = field.lookup(pi, si, -ray.d, active)
        counts = active & ~further & ((depth > 0) | matte_too)
        radiance[counts] += throughput * irradiance * dr.select(last, albedo * dr.inv_pi, lobe)

        active &= ((bsdf.flags() & _SPECULAR) != 0) & ~last & (depth < _MOST_MIRRORS)
        flags = bsdf.flags()
        frosted = (flags & _FROSTED) != 0
        smooth = active & ((flags & _GLOSSY) != 0) & ~frosted
        faint = _FAINT * dr.max(irradiance * lobe)
        light = mi.UInt32(0)
        while smooth & (light < lights):
            u = dr.select(depth == 0, first_lamp, sampler.next_2d(smooth))
            u.x = (mi.Float(light) + u.x) / lights
            ds, value = scene.sample_emitter_direction(si, u, False, smooth)
            to_light = si.to_local(ds.d)
            cast, pdf = bsdf.eval_pdf(specular, si, to_light, smooth)
            share = dr.select(ds.delta, 1 / lights, dr.rcp(lights + proper(pdf) / dr.maximum(ds.pdf, 1e-20)))
            gain = cast * value * share
            chance = dr.minimum(dr.max(gain) / dr.maximum(faint, 1e-20), 1)
            cast_shadow = smooth & (ds.pdf > 0) & (sampler.next_1d(smooth) < chance)
            seen = cast_shadow & ~scene.ray_test(si.spawn_ray_to(ds.p), cast_shadow)
            radiance[seen] += throughput * gain / chance
            light += 1

        pane = active & ~waiting & ((flags & _PANE[0]) != 0) & ((flags & _PANE[1]) != 0) & ((flags & _GLOSSY) == 0)
        toward = dr.select(depth == 0, first_lobe, sampler.next_2d(active))
        bs, weight = bsdf.sample(specular, si, sampler.next_1d(active), toward, active)
        onward, kept = bsdf.sample(specular, si, _CERTAINLY, mi.Point2f(0.5), pane)
        other, share = bsdf.sample(specular, si, 0, mi.Point2f(0.5), pane)
        # All there is, or it is left to the lot: total reflection has one way, a blend may have three.
        pane &= (other.sampled_type != onward.sampled_type) & (dr.abs(other.pdf + onward.pdf - 1) < 1e-3)
        reflected = dr.select(pane, si.spawn_ray(si.to_world(other.wo)), reflected)
        reflected_throughput = dr.select(pane, throughput * share * other.pdf, reflected_throughput)
        reflected_depth = dr.select(pane, depth + 1, reflected_depth)
        waiting |= pane
        bs = dr.select(pane, onward, bs)
        before = mi.Color3f(throughput)  # else it would change with it
        throughput *= dr.select(pane, kept * onward.pdf, weight)
        last = ((bs.sampled_type & _GLOSSY) != 0) & ~frosted
        lobe_pdf = proper(bs.pdf)
        glossy_hit = mi.Interaction3f(si)
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= dr.max(throughput) > 0
        depth += 1

        matte = (flags & _DIFFUSE) != 0
        paper = dr.select(further, dr.select(matte, _SHEETS * irradiance * dr.inv_pi, dr.inf), paper)
        throughput = dr.select(further, before * albedo, throughput)
        ray = dr.select(further, si.spawn_ray(si.to_world(once.wo)), ray)
        active |= further
        last |= further
        beyond |= further

        back = waiting & ~active
        ray = dr.select(back, reflected, ray)
        throughput = dr.select(back, reflected_throughput, throughput)
        depth = dr.select(back, reflected_depth, depth)
        last &= ~back
        beyond &= ~back
        active |= back
        waiting &= ~back
    return radiance, valid
