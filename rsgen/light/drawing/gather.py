"""Light off other surfaces: gathered by cosine-distributed rays that look up how what they meet is lit."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from rsgen.array_types import IntArray
from rsgen.light.drawing.rounds import Draw, drawn_at
from rsgen.light.drawing.specular import first_scatterer
from rsgen.light.places.sampling import chunks, r2, rotation
from rsgen.light.places.surface_points import SurfacePoints
from rsgen.render.irradiance import IrradianceField


def gathering(scene: Any, field: IrradianceField, points: SurfacePoints, which: IntArray, follow: bool) -> Draw:
    """Draws the irradiance that arrives from other surfaces, each lit as `field` says, but no emitter's own.

    follow: by way of panes and mirrors too.
    """

    def sample(at: Sequence[Any], _: IntArray, begin: int, count: int) -> Any:
        return _gather_at(scene, field, *at, begin, count, follow)

    return drawn_at(which, partial(chunks, points), sample)


@dr.syntax
def _gather_at(scene, field, p, n, number, begin, rays, follow):
    frame = mi.Frame3f(n)
    offset = mi.Point2f(rotation(number, 101), rotation(number, 102))
    lobe = rotation(number, 103)
    context = mi.BSDFContext()
    i = dr.opaque(mi.UInt32, begin)
    end = i + dr.opaque(mi.UInt32, rays)
    even, odd = mi.Color3f(0), mi.Color3f(0)
    while i < end:
        u = r2(i, offset)
        d = frame.to_world(mi.warp.square_to_cosine_hemisphere(u))
        pick = lobe + mi.Float(i) * 0.6180339887498949
        pick -= dr.floor(pick)
        pi, si, ray, through, _ = first_scatterer(scene, mi.Ray3f(p, d), pick, follow, mi.Bool(True))
        hit = si.is_valid()
        # The sampled weight's mean is the albedo ρ, exactly and without noise for Lambert's law.
        _, albedo = si.bsdf(ray).sample(context, si, pick, mi.Point2f(u.y, u.x), hit)
        # With pdf cosθ/π, ∫ L cosθ dω is the mean of ρE where Lambert's surface sends L = ρE/π.
        light = dr.select(hit, through * albedo * field.lookup(pi, si, -ray.d, hit), 0)
        first = (i & 1) == 0
        even += dr.select(first, light, 0)
        odd += dr.select(first, 0, light)
        i += 1
    return mi.Vector3f(even), mi.Vector3f(odd)
