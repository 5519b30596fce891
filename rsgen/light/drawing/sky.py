"""Light from the sky, and lamps' light that comes off mirrors or through thick glass, on points of surfaces.

In a room a sky is seen through a window only: most directions that are drawn from the whole of it end at a wall. So a
first look tells where light comes from in each part of the scene, and half of the directions are drawn from that. How
much is drawn depends on how much it still scatters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.device.arrays import aligned
from rsgen.light.drawing.guide import BINS, Guide, bin_of
from rsgen.light.drawing.rounds import drawn_at, in_rounds
from rsgen.light.drawing.specular import first_scatterer, passes_light_on
from rsgen.light.places.bake_points import thin
from rsgen.light.places.sampling import chunks, in_channels, r2, rotation
from rsgen.light.places.surface_points import SurfacePoints

_CELL_M = 0.5  # parts of the scene that have one histogram, of like normals on one piece of surface
_FIRST_LOOK_TEXELS, _FIRST_LOOK_SAMPLES = 3.0, 64
LESS = 4  # part of the samples that is drawn at first: most places see no sky, nor lamps by ways with turns
_ROUNDS, _ROUNDS_OF_LAMPS = 8, 6
# Directions drawn at most in all, of the samples asked for: where light is hard to find the worst places get them.
_EFFORT = 4.0


def has_sky_light(scene: Any) -> bool:
    """Whether a scene has any of this light."""
    return scene.environment() is not None or passes_light_on(scene)


def sky_light(
    scene: Any, points: SurfacePoints, which: IntArray, patch: IntArray, texel_m: float, samples: int,
    beside: FloatArray, scatter: float, report: Callable[[float], None],
) -> tuple[Float32Array, FloatArray]:  # fmt: skip
    """Irradiance from the sky and from lamps by ways with turns: off mirrors and through thick glass.

    samples: directions at each point, one in `LESS` at first; more where the standard error exceeds `scatter`, as far
    as the effort allows; beside (n,): light that points have from elsewhere, in grey. Returns means (2, len(which), 4)
    of two halves of what was drawn, and the error (n,) left (see `rounds`).
    """
    cell, follow = thin(points, _CELL_M, which)[1], passes_light_on(scene)
    guide = _learned(scene, points, which, cell, texel_m, follow)

    def sample(at: Sequence[Any], here: IntArray, begin: int, count: int) -> Any:
        return _sky_at(scene, guide, mi.UInt32(aligned(cell[here], np.uint32)), *at, begin, count, follow)

    draw = drawn_at(which, partial(chunks, points), sample)
    first, rounds = max(4, samples // LESS), _ROUNDS_OF_LAMPS if scene.environment() is None else _ROUNDS
    return in_rounds(draw, patch, lambda own: own + beside, scatter, first, rounds, _EFFORT * samples, report)


def _learned(
    scene: Any, points: SurfacePoints, which: IntArray, cell: IntArray, texel_m: float, follow: bool
) -> Guide:  # fmt: skip
    coarse = thin(points, _FIRST_LOOK_TEXELS * texel_m, which)[0]
    seen = np.zeros((int(cell.max()) + 1, BINS), np.float32)
    for first, part, p, n, number in chunks(points, which[coarse], lambda _: None, (1 << 22) // _FIRST_LOOK_SAMPLES):
        found = _first_look(scene, p, n, number, follow)
        dr.eval(found)
        here = cell[coarse[first : first + len(part)]]
        bins = np.repeat(here * BINS, _FIRST_LOOK_SAMPLES) + np.array(found[0])
        np.add.at(seen.reshape(-1), bins, np.array(found[1]))  # much faster by one index than by two
    return Guide.learned(seen)


def _first_look(scene: Any, p: Any, n: Any, number: Any, follow: bool) -> tuple[Any, Any]:
    """Bin and light of each of the first samples of all points, a point's side by side."""
    count = dr.width(number)
    index = dr.arange(mi.UInt32, count * _FIRST_LOOK_SAMPLES)
    point, i = index // _FIRST_LOOK_SAMPLES, index % _FIRST_LOOK_SAMPLES
    p, n = dr.gather(mi.Point3f, p, point), dr.gather(mi.Vector3f, n, point)
    number = dr.gather(mi.UInt32, number, point)
    u = r2(i >> 1, mi.Point2f(rotation(number, 201), rotation(number, 202)))
    d, density = _drawn(scene, p, n, u, (i & 1) == 1, None)
    _, light = _arriving(scene, p, n, d, rotation(number, 203), follow)
    return bin_of(d), dr.select(density > 0, mi.luminance(light) / dr.maximum(density, 1e-20), 0.0)


def _drawn(scene: Any, p: Any, n: Any, u: Any, other: Any, guided: Any) -> tuple[Any, Any]:
    """A direction of the sky's own or, where `other`, another one; and the density of both together.

    guided: (direction, density of any direction) of a guide. In the place of a guide or a sky that is not there: about
    the normal, cosine-distributed.
    """
    about = mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(u))
    own, sky = about, scene.environment()
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p, it.t, it.n = p, mi.Float(1), mi.Normal3f(n)
    if sky is not None:
        own = sky.sample_direction(it, u)[0].d
    d = dr.select(other, about if guided is None else guided[0], own)
    cosine = dr.maximum(dr.dot(n, d), 0) * dr.inv_pi
    density = cosine if guided is None else guided[1](d)
    towards = dr.zeros(mi.DirectionSample3f, dr.width(p))
    towards.d = d
    density += cosine if sky is None else sky.pdf_direction(it, towards)
    return d, 0.5 * density


def _arriving(scene: Any, p: Any, n: Any, d: Any, pick: Any, follow: bool) -> tuple[Any, Any]:
    """Whether anything arrives at p (normal n) from direction d, and radiance times cosine."""
    cosine = dr.dot(n, d)
    _, si, _, through, turned = first_scatterer(scene, mi.Ray3f(p, d), pick - dr.floor(pick), follow, cosine > 0)
    emitter = si.emitter(scene)
    found = (cosine > 0) & (emitter != dr.zeros(mi.EmitterPtr)) & (~si.is_valid() | turned)
    return found, dr.select(found, through * emitter.eval(si, found) * cosine, 0)


@dr.syntax
def _sky_at(scene, guide, cell, p, n, number, begin, samples, follow):
    """Sums over two halves of the samples `begin` to `begin + samples`."""
    offset = mi.Point2f(rotation(number, 204), rotation(number, 205))
    lobe = rotation(number, 206)
    i = dr.opaque(mi.UInt32, begin)
    end = i + dr.opaque(mi.UInt32, samples)
    even, odd = mi.Vector4f(0), mi.Vector4f(0)
    while i < end:
        u = r2(i >> 1, offset)
        guided = (guide.sample(cell, u), lambda d: guide.density(cell, d))
        d, density = _drawn(scene, p, n, u, (i & 1) == 1, guided)
        found, light = _arriving(scene, p, n, d, lobe + mi.Float(i) * 0.6180339887498949, follow)
        light = dr.select(found & (density > 0), light / dr.maximum(density, 1e-20), 0)
        light = in_channels(light, dr.dot(n, d))
        first = ((i >> 1) & 1) == 0
        even += dr.select(first, light, 0)
        odd += dr.select(first, 0, light)
        i += 1
    return even, odd
