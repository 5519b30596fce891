"""The error of baked light where cameras look, against light computed for the very places that they see.

Places lie anywhere between the samples, so that what the texel blurs counts as well as what scatters. What light a
bounce finds on other surfaces is taken as baked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen import srgb
from rsgen.array_types import BoolArray, FloatArray
from rsgen.device.arrays import rows_of
from rsgen.light.indirect import gathering
from rsgen.light.lamps import lamp_light
from rsgen.light.sampling import typical
from rsgen.light.sky import LESS, has_sky_light, sky_light
from rsgen.light.specular import first_scatterer, gathered_caustics, passes_light_on, shines
from rsgen.light.surface_points import SamplePoints
from rsgen.render.irradiance import IrradianceField
from rsgen.scene.rays import rays_from

_GREY = 0.18  # reflectance of the surface that is looked at, where light is typical
# Samples of each lamp, the sky and surfaces: their scatter must not hide the errors that are looked for.
_LAMP_SAMPLES, _SKY_SAMPLES, _RAYS = 16 * 512, 4096, 512


@dataclass(frozen=True)
class Quality:
    """PSNR in dB, in sRGB, of mid-grey surfaces, by estimate, and what it is at least (two standard errors)."""

    psnr_db: float
    at_least_db: float

    def __str__(self) -> str:
        return f"about {self.psnr_db:.0f} dB where cameras look, at least {self.at_least_db:.0f}"


def estimated_quality(
    scene: Any, field: IrradianceField, texel_m: float, eye: FloatArray, direction: FloatArray
) -> Quality:
    """Quality of the light on the surfaces that are seen, lamps left out, as if these were mid-grey.

    eye (n, 3), world, m, and unit direction (n, 3): the rays that they are seen along. Exposed so that `typical` light
    makes mid-grey. Infinite where nothing lit is seen.
    """
    points, baked, lacquered = _seen(scene, field, eye, direction)
    if not len(baked):
        return Quality(math.inf, math.inf)
    halves = _computed(scene, field, points, texel_m)
    # What is baked there is beneath lacquer, by how much of the light gets in.
    share = halves[..., 3].mean(axis=0) / np.maximum(halves[..., :3].mean(axis=(0, 2)), 1e-30)
    halves = halves[..., :3] * np.where(lacquered, share, 1)[:, None]
    exposed = typical(halves.mean(axis=(0, 2)))
    if exposed <= 0:
        return Quality(math.inf, math.inf)
    one, other, ours = (srgb.encode(np.clip(_GREY / exposed * e, 0, 1)) for e in (*halves, baked))
    return Quality(*srgb.psnr_without_noise((ours, ours), (one, other)))  # what is computed may scatter


def _seen(
    scene: Any, field: IrradianceField, eye: FloatArray, direction: FloatArray
) -> tuple[SamplePoints, FloatArray, BoolArray]:
    """Places seen, through panes and in mirrors too, as they face the eye, the irradiance (n, 3) baked there, and
    whether it is beneath lacquer (n,).
    """
    follow = passes_light_on(scene)
    pick = mi.Float(0.5)
    pi, si, ray, _, _ = first_scatterer(scene, rays_from(eye, direction), pick, follow, mi.Bool(True))
    lamp = si.emitter(scene) != dr.zeros(mi.EmitterPtr)
    shown = si.is_valid() & ~lamp
    light = field.lookup(pi, si, -ray.d, shown)
    towards = dr.select(dr.dot(si.n, ray.d) > 0, -1.0, 1.0)
    normal = si.sh_frame.n * dr.select(dr.dot(si.sh_frame.n, si.n) * towards > 0, 1.0, -1.0)
    lacquered = field.beneath_lacquer(si.shape, shown)
    dr.eval(shown, light, si.p, normal, towards, lacquered)
    there: BoolArray = np.broadcast_to(np.array(shown).astype(bool), (len(eye),))
    p, n, g, e = (rows_of(v)[there] for v in (si.p, normal, si.n * towards, light))
    coat: BoolArray = np.broadcast_to(np.array(lacquered).astype(bool), (len(eye),))
    return SamplePoints(p, n, g, np.zeros(len(p), np.int64)), e.astype(np.float64), coat[there]


def _computed(scene: Any, field: IrradianceField, points: SamplePoints, texel_m: float) -> NDArray[np.float64]:
    """Irradiance (2, n, 4), see `in_channels`, at each of the points for itself, by two halves of many samples."""
    everywhere = np.arange(len(points.position))
    dark = np.zeros(len(everywhere))
    follow = passes_light_on(scene)

    def silent(_: float) -> None:
        pass

    halves = lamp_light(scene, points, everywhere, everywhere, _LAMP_SAMPLES, follow, dark, 1.0, silent)[0]
    if shines(scene):
        halves += gathered_caustics(scene, points, everywhere, _SKY_SAMPLES)
    if has_sky_light(scene):
        asked = LESS * _SKY_SAMPLES  # of which this draws the first round
        halves += sky_light(scene, points, everywhere, everywhere, texel_m, asked, dark, math.inf, silent)[0]
    draw = gathering(scene, field, points, everywhere)
    return (halves + draw(everywhere, 0, _RAYS, silent) / (_RAYS / 2)).astype(np.float64)
