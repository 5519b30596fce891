"""Light off other surfaces: gathered by cosine-distributed rays that look up how what they meet is lit."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import mitsuba as mi

from rsgen.array_types import IntArray
from rsgen.light.drawing.rounds import Draw, drawn_at
from rsgen.light.drawing.specular import shines, thrown_along
from rsgen.light.places.sampling import about_normal, chunks
from rsgen.light.places.surface_points import SurfacePoints
from rsgen.render.irradiance import IrradianceField


def gathering(scene: Any, field: IrradianceField, points: SurfacePoints, which: IntArray) -> Draw:
    """Draws the irradiance that arrives from other surfaces, each lit as `field` says, but no emitter's own:
    by way of panes and whatever mirrors too.
    """
    follow = shines(scene)

    def sample(at: Sequence[Any], _: IntArray, begin: int, count: int) -> Any:
        p, n, number = at

        def light_along(ray: Any, i: Any, pick: Any) -> Any:
            return thrown_along(scene, field, ray, number, i, pick, follow, mi.Bool(True))

        return about_normal(p, n, number, begin, count, 101, light_along)

    return drawn_at(which, partial(chunks, points), sample)
