"""Light off other surfaces: gathered by cosine-distributed rays that look up how what they meet is lit."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from rsgen.array_types import IntArray
from rsgen.light.drawing.rounds import Draw, drawn_at
from rsgen.light.drawing.specular import shines, thrown_along
from rsgen.light.places.sampling import chunks, r2, rotation
from rsgen.light.places.surface_points import SurfacePoints
from rsgen.render.irradiance import IrradianceField


def gathering(scene: Any, field: IrradianceField, points: SurfacePoints, which: IntArray) -> Draw:
    """Draws the irradiance that arrives from other surfaces, each lit as `field` says, but no emitter's own:
    by way of panes and whatever mirrors too.
    """
    follow = shines(scene)

    def sample(at: Sequence[Any], _: IntArray, begin: int, count: int) -> Any:
        return _gather_at(scene, field, *at, begin, count, follow)

    return drawn_at(which, partial(chunks, points), sample)


@dr.syntax
def _gather_at(scene, field, p, n, number, begin, rays, follow):
    frame = mi.Frame3f(n)
    offset = mi.Point2f(rotation(number, 101), rotation(number, 102))
    lobe = rotation(number, 103)
    i = dr.opaque(mi.UInt32, begin)
    end = i + dr.opaque(mi.UInt32, rays)
    even, odd = mi.Color3f(0), mi.Color3f(0)
    while i < end:
        u = r2(i, offset)
        d = frame.to_world(mi.warp.square_to_cosine_hemisphere(u))
        pick = lobe + mi.Float(i) * 0.6180339887498949
        pick -= dr.floor(pick)
        # With pdf cosθ/π, ∫ L cosθ dω is the mean of πL.
        light = thrown_along(scene, field, mi.Ray3f(p, d), number, i, pick, follow, mi.Bool(True))
        first = (i & 1) == 0
        even += dr.select(first, light, 0)
        odd += dr.select(first, 0, light)
        i += 1
    return mi.Vector3f(even), mi.Vector3f(odd)
