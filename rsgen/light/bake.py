"""Bake a scene's diffuse irradiance: direct light by emitter sampling, indirect by gathering over bounces.

1. Every lattice point of `irradiance.Lattice` (both sides of each triangle; points that coincide are one) gets direct
   light from each lamp with a stratified set of samples, and from the sky and through panes as `sky` has it.
   Where a mesh is finer than the texel, a thinned set of points is computed and the others are interpolated.
2. Indirect light varies slowly, so it is gathered at a still thinner set, a few texels apart, by cosine-distributed
   rays that look the previous bounce up where they hit, and interpolated in position and normal.
3. Points that never get any light (buried in another object) are marked as not alive.

All randomness is a fixed low-discrepancy sequence rotated by a hash of the point's number: a scene bakes to the same
bytes each time on one backend.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array
from rsgen.config.config import LightConfig
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.light.bake_points import Interpolation, SurfacePoints, sample_points, thin
from rsgen.light.sampling import chunks, r2, rotation
from rsgen.light.sky import sky_light
from rsgen.light.specular import first_scatterer, passes_light_on
from rsgen.render.irradiance import IrradianceField, Lattice, make_field

log = logging.getLogger("rsgen")


# Raise when the method changes, so that older caches are not taken for new ones.
METHOD = 2
_FINE_TEXELS = 0.9  # direct light is computed at points at least about this far apart
_COARSE_TEXELS = 3.0  # and indirect light at these
_FIRST_LOOK_RAYS = 12
_FIRST_LOOK_BOUNCES = 2
_BOUNCE_RAYS = 32
_MANY_EMITTERS = 24
_SMALL_EMITTER_M = 0.3
# Light sampling is trusted this much more than hemisphere rays; only where an emitter all but touches a surface, and
# its samples' 1/d² explodes, do the rays take over.
_LIGHT_TRUST = 64.0
_GREY_SLOPE = 0.21  # of sRGB at its middle, by the logarithm of light


def bake(scene: Any, lattice: Lattice, light: LightConfig, progress: Progress) -> tuple[NDArray, NDArray]:
    """Irradiance (points, 4) float32 of the front and back sides: E_r, E_g, E_b (scene units), alive (0 or 1)."""
    progress("light", 0.0, "where light is looked at")
    points, index = sample_points(scene, lattice)
    fine, fine_of_point = thin(points, light.texel_m * _FINE_TEXELS)
    log.info("baking light: %d triangles, %d samples of %d stored", len(lattice.first), len(fine), len(fine_of_point))
    total = np.zeros((len(fine), 3), np.float32)

    lamps, follow = [e for e in scene.emitters() if not e.is_environment()], passes_light_on(scene)
    by_sky = follow or len(lamps) < len(scene.emitters())
    sky = np.zeros((len(fine), 3), np.float32)
    if by_sky:
        scatter = 10 ** (-light.target_db / 20) / _GREY_SLOPE
        report = _reporter(progress, 0.0, 0.2, "light of the sky and through panes")
        sky, reached = sky_light(scene, points, fine, light.texel_m, light.direct_samples, follow, scatter, report)
        log.info("light of the sky: %.0f dB before smoothing", -20 * math.log10(max(reached * _GREY_SLOPE, 1e-5)))

    # A first look with few samples finds what any light reaches; only that gets the full effort.
    begin = 0.2 if by_sky else 0.0
    report = _reporter(progress, begin, 0.05, "finding lit surfaces")
    first_look = sky + _direct(scene, lamps, points, fine, 2, report)
    for bounce in range(_FIRST_LOOK_BOUNCES):
        field = _field(
            lattice, index, total[fine_of_point] + first_look[fine_of_point], np.ones(len(fine_of_point), bool)
        )
        report = _reporter(progress, begin + 0.05 + 0.03 * bounce, 0.03, "finding lit surfaces")
        total = _gather(scene, field, points, fine, _FIRST_LOOK_RAYS, follow, by_sky, report)
    alive = (first_look + total).max(axis=1) > 0
    alive_point = alive[fine_of_point]
    fine = fine[alive]
    if not len(fine):
        raise UserError("the scene is dark: no light reaches any surface; add an emitter or move it into the open")

    report = _reporter(progress, begin + 0.11, 0.39 - begin, "direct light")
    direct = sky[alive] + _direct(scene, lamps, points, fine, light.direct_samples, report)
    lit_points = np.flatnonzero(alive_point)
    to_point = Interpolation.between(points, fine, lit_points, light.texel_m)
    coarse = fine[thin(points, light.texel_m * _COARSE_TEXELS, fine)[0]]
    coarse_to_fine = Interpolation.between(points, coarse, fine, light.texel_m * _COARSE_TEXELS)
    indirect = np.zeros_like(direct)
    values = np.zeros((len(points.position), 3), np.float32)
    for bounce in range(light.bounces):
        last = bounce == light.bounces - 1
        values[lit_points] = to_point(direct + indirect)
        field = _field(lattice, index, values, alive_point)
        begin = 0.5 + 0.3 * bounce / light.bounces
        report = _reporter(progress, begin, 1 - begin if last else 0.3 / light.bounces, f"bounce {bounce + 1}")
        rays = light.gather_rays if last else min(_BOUNCE_RAYS, light.gather_rays)
        indirect = coarse_to_fine(_gather(scene, field, points, coarse, rays, follow, by_sky, report))
    values[lit_points] = to_point(direct + indirect)
    table = _table(values, alive_point)
    progress("light", 1.0, "light baked")
    return table[index[0]], table[index[1]]


def _reporter(progress: Progress, begin: float, span: float, what: str) -> Callable[[float], None]:
    return lambda fraction: progress("light", begin + span * fraction, what)


def _table(values: NDArray, alive: NDArray) -> Float32Array:
    return np.where(alive[:, None], np.concatenate([values, alive[:, None]], axis=1), 0).astype(np.float32)


def _field(lattice: Lattice, index: NDArray, values: NDArray, alive: NDArray) -> IrradianceField:
    table = _table(values, alive)
    return make_field(lattice, table[index[0]], table[index[1]])


def _direct(
    scene: Any,
    lamps: Sequence[Any],
    points: SurfacePoints,
    which: NDArray,
    samples: int,
    report: Callable[[float], None],
) -> NDArray:
    """Direct irradiance (len(which), 3) from all lamps, `samples` for each."""
    out = np.zeros((len(which), 3), np.float32)
    for begin, part, p, n, number in chunks(points, which, report):
        total = mi.Color3f(0)
        if len(lamps) > _MANY_EMITTERS:
            total = _from_emitter(scene, None, p, n, number, samples * _MANY_EMITTERS, 0)
        else:
            for k, emitter in enumerate(lamps):
                total += _from_emitter(scene, emitter, p, n, number, _samples_for(emitter, samples), k)
                dr.eval(total)
        out[begin : begin + len(part)] = np.array(total).reshape(3, -1).T
    return out


def _samples_for(emitter: Any, samples: int) -> int:
    """A small emitter's penumbra is narrow: a quarter of the samples serves as well."""
    shape = emitter.get_shape()
    small = shape is not None and dr.norm(shape.bbox().extents()) < _SMALL_EMITTER_M
    return max(1, samples // 4) if small else samples


@dr.syntax
def _from_emitter(scene, emitter, p, n, number, samples, dimension):
    """Mean irradiance at p (normal n) from one emitter, or if that is None from a random one but the sky."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    it.t = mi.Float(1)
    it.n = mi.Normal3f(n)
    offset = mi.Point2f(rotation(number, 2 * dimension), rotation(number, 2 * dimension + 1))
    count = dr.opaque(mi.UInt32, samples)
    total = mi.Color3f(0)
    i = mi.UInt32(0)
    while i < count:
        u = r2(i, offset)
        if dr.hint(emitter is None, mode="scalar"):
            ds, value = scene.sample_emitter_direction(it, u, False)
            if dr.hint(scene.environment() is not None, mode="scalar"):
                value = dr.select(ds.emitter == mi.EmitterPtr(scene.environment()), 0, value)
        else:
            ds, value = emitter.sample_direction(it, u)
        cosine = dr.dot(n, ds.d)
        lit = (cosine > 0) & (ds.pdf > 0) & (dr.max(value) > 0)
        # Short of the emitter itself, whose surface would shadow its own sample.
        shadow = mi.Ray3f(p, ds.d, ds.dist * (1 - 1e-4) - 1e-5, 0.0, mi.Color0f())
        lit &= ~scene.ray_test(shadow, active=lit)
        total += dr.select(lit, value * cosine * dr.select(ds.delta, 1, _light_share(ds.pdf, cosine)), 0)
        i += 1
    return total / mi.Float(count)


def _light_share(light_pdf: Any, cosine: Any) -> Any:
    """The light samples' part in the balance heuristic (Veach and Guibas 1995) with cosine-distributed rays."""
    # Written so that a grazing emitter's infinite density gives 1, and 0 / 0 does not occur.
    trusted = dr.maximum(_LIGHT_TRUST * light_pdf, 1e-20)
    return dr.rcp(1 + dr.maximum(cosine, 0) * dr.inv_pi / trusted)


def _gather(
    scene: Any,
    field: IrradianceField,
    points: SurfacePoints,
    which: NDArray,
    rays: int,
    follow: bool,
    by_sky: bool,
    report: Callable[[float], None],
) -> NDArray:
    """Irradiance (len(which), 3) that arrives from other surfaces, each lit as `field` says; follow: through panes too.

    Holds also the small part of emitters' own light that `_direct` leaves out (see `_light_share`); by_sky: without
    what `sky_light` holds.
    """
    out = np.zeros((len(which), 3), np.float32)
    for begin, part, p, n, number in chunks(points, which, report):
        out[begin : begin + len(part)] = (
            np.array(_gather_at(scene, field, p, n, number, rays, follow, by_sky)).reshape(3, -1).T
        )
    return out


@dr.syntax
def _gather_at(scene, field, p, n, number, rays, follow, by_sky):
    frame = mi.Frame3f(n)
    offset = mi.Point2f(rotation(number, 101), rotation(number, 102))
    lobe = rotation(number, 103)
    count = dr.opaque(mi.UInt32, rays)
    context = mi.BSDFContext()
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    it.n = mi.Normal3f(n)
    many = len(scene.emitters()) > _MANY_EMITTERS
    total = mi.Color3f(0)
    i = mi.UInt32(0)
    while i < count:
        u = r2(i, offset)
        d = frame.to_world(mi.warp.square_to_cosine_hemisphere(u))
        pick = lobe + mi.Float(i) * 0.6180339887498949
        pick -= dr.floor(pick)
        pi, si, ray, through, passed = first_scatterer(scene, mi.Ray3f(p, d), pick, follow, mi.Bool(True))
        hit = si.is_valid()
        emitter = si.emitter(scene)
        lamp = emitter != dr.zeros(mi.EmitterPtr)
        if dr.hint(by_sky, mode="scalar"):
            lamp &= hit & (passed == 0)
        towards = mi.DirectionSample3f(scene, si, it)
        straight = lamp & (passed == 0)
        if dr.hint(many, mode="scalar"):
            light_pdf = scene.pdf_emitter_direction(it, towards, straight)
        else:
            light_pdf = emitter.pdf_direction(it, towards, straight)
        # With pdf cosθ/π, ∫ L cosθ dω is the mean of πL, and of ρE where Lambert's surface sends L = ρE/π.
        left_out = dr.select(passed == 0, 1 - _light_share(light_pdf, dr.dot(n, d)), 1)
        total += dr.select(lamp, dr.pi * through * emitter.eval(si, lamp) * left_out, 0)
        # The sampled weight's mean is the albedo ρ, exactly and without noise for Lambert's law.
        _, albedo = si.bsdf(ray).sample(context, si, pick, mi.Point2f(u.y, u.x), hit)
        total += dr.select(hit, through * albedo * field.lookup(pi, si, -ray.d, hit), 0)
        i += 1
    return total / mi.Float(count)
