"""Light probes: the light that arrives at places in the air, as irradiance by direction, which lights moving objects.

Lamps and the sky are sampled, with the shadows of what is static. Baked light off surfaces, and what comes through
panes and off mirrors, is found by rays spread evenly over all directions. All places use the same directions, so that
the scatter that is left does not flicker along a path.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import aligned
from rsgen.light.sampling import golden, r2
from rsgen.light.specular import first_scatterer, passes_light_on, transmitted
from rsgen.render.irradiance import IrradianceField
from rsgen.scene.moving_objects import HARMONICS, harmonics, irradiance_coefficients

_RAYS = 4096
_LAMP_SAMPLES = 4096  # over all lamps together
_PLACES = 256  # at once


def gathered_light(scene: Any, field: IrradianceField, p_world: FloatArray) -> FloatArray:
    """Coefficients (n, 9, 3) of irradiance by the direction faced (see `moving_objects`) at places (n, 3), world, m."""
    follow = passes_light_on(scene)
    parts = [_gathered(scene, field, p_world[k : k + _PLACES], follow) for k in range(0, len(p_world), _PLACES)]
    return irradiance_coefficients(np.concatenate(parts))


def _gathered(scene: Any, field: IrradianceField, p_world: FloatArray, follow: bool) -> FloatArray:
    """Coefficients (n, 9, 3) of the radiance that arrives."""
    total = _from_surfaces(scene, field, p_world, follow)
    if len(scene.emitters()):
        total = total + _from_lamps(scene, p_world, follow)
    return total


def _from_surfaces(scene: Any, field: IrradianceField, p_world: FloatArray, follow: bool) -> FloatArray:
    index = dr.arange(mi.UInt32, len(p_world) * _RAYS)
    i = index % _RAYS
    d = mi.warp.square_to_uniform_sphere(r2(i, mi.Point2f(0.5)))
    ray = mi.Ray3f(_places(p_world, index // _RAYS), d)
    pi, si, ray, through, turned = first_scatterer(scene, ray, golden(i, 0), follow, mi.Bool(True))
    hit = si.is_valid()
    emitter = si.emitter(scene)
    lamp = (emitter != dr.zeros(mi.EmitterPtr)) & turned  # the others are sampled
    radiance = dr.select(lamp, through * emitter.eval(si, lamp), 0)
    # What a blend with metal mirrors straight back is in it, too.
    albedo = dr.minimum(si.bsdf(ray).eval_diffuse_reflectance(si, hit), 1)
    radiance += dr.select(hit, through * albedo * field.lookup(pi, si, -ray.d, hit) * dr.inv_pi, 0)
    return _projected(radiance, d, _RAYS) * (4 * np.pi)


def _from_lamps(scene: Any, p_world: FloatArray, follow: bool) -> FloatArray:
    index = dr.arange(mi.UInt32, len(p_world) * _LAMP_SAMPLES)
    it = dr.zeros(mi.Interaction3f, dr.width(index))
    it.p = _places(p_world, index // _LAMP_SAMPLES)
    it.t = mi.Float(1)
    ds, value = scene.sample_emitter_direction(it, r2(index % _LAMP_SAMPLES, mi.Point2f(0.5)), False)
    lit = (ds.pdf > 0) & (dr.max(value) > 0)
    arrives = transmitted(scene, it.p, ds.d, ds.dist, lit, follow)
    return _projected(dr.select(lit, value * arrives, 0), dr.select(lit, ds.d, 0), _LAMP_SAMPLES)


def _places(p_world: FloatArray, which: Any) -> Any:
    rows = mi.Float(aligned(p_world))
    return mi.Point3f(*(dr.gather(mi.Float, rows, 3 * which + k) for k in range(3)))


def _projected(value: Any, d: Any, count: int) -> FloatArray:
    """Mean (n, 9, 3) over each place's `count` samples of value times harmonics."""
    parts = [[y * channel for channel in value] for y in harmonics(d)]
    dr.eval(parts)  # at once: each sum alone would cast all rays again
    flat = np.array([[np.asarray(dr.block_sum(part, count)) for part in row] for row in parts], float)  # (9, 3, n)
    assert flat.shape[0] == HARMONICS
    return np.moveaxis(flat, 2, 0) / count
