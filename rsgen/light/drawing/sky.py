"""Light from the sky, and lamps' light that comes off what mirrors or through thick glass, on points of surfaces.

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
from rsgen.light.drawing.specular import emitted_along, shines
from rsgen.light.places.bake_points import thin
from rsgen.light.places.sampling import chunks, r2, rotation
from rsgen.light.places.surface_points import SurfacePoints

_CELL_M = 0.5  # parts of the scene that have one histogram, of like normals on one piece of surface
_FIRST_LOOK_TEXELS, _FIRST_LOOK_SAMPLES = 3.0, 64
_ROUNDS = 6
# Directions drawn in all, of those of the first round: where light is hard to find the worst places get them.
_EFFORT = 4.0
# One sample of light off lacquer or brushed metal counts at most as so much of a place's other light, or as the fourth
# part of all such light seen nearby: the sun in a chair's leg is a spark, which would be a blotch on the floor.
_FAINT_MOST, _FAINT_SEEN = 16.0, 4.0
_OCTAVES = 64
_LESS = 4  # without a sky, what comes is lamps' light off what mirrors and through thick glass: mostly little


def has_sky_light(scene: Any) -> bool:
    """Whether a scene has any of this light."""
    return scene.environment() is not None or shines(scene)


def sky_light(
    scene: Any, points: SurfacePoints, which: IntArray, patch: IntArray, texel_m: float, samples: int,
    beside: FloatArray, scatter: float, report: Callable[[float], None],
) -> tuple[Float32Array, FloatArray]:  # fmt: skip
    """Irradiance from the sky and from lamps by ways with turns: off what mirrors and through thick glass.

    samples: directions at each point at first; more where the standard error exceeds `scatter`, as far as the effort
    allows; beside (n,): light that points have from elsewhere, in grey. Returns means (2, len(which), 3) of two halves
    of what was drawn, and the error (n,) left (see `rounds`).
    """
    cell, follow = thin(points, _CELL_M, which)[1], shines(scene)
    guide, most = _learned(scene, points, which, cell, beside, texel_m, follow)

    def sample(at: Sequence[Any], here: IntArray, begin: int, count: int) -> Any:
        cells = mi.UInt32(aligned(cell[here], np.uint32))
        limit = mi.Float(aligned(most[cell[here]], np.float32))
        return _sky_at(scene, guide, cells, limit, *at, begin, count, follow)

    draw = drawn_at(which, partial(chunks, points), sample)
    first = samples if scene.environment() is not None else max(4, samples // _LESS)
    return in_rounds(draw, patch, lambda own: own + beside, scatter, first, _ROUNDS, _EFFORT * samples, report)


def _learned(
    scene: Any, points: SurfacePoints, which: IntArray, cell: IntArray, beside: FloatArray, texel_m: float, follow: bool
) -> tuple[Guide, FloatArray]:  # fmt: skip
    """A guide, and the most (cells,) that a sample of faint light counts for in its cells, in grey."""
    coarse = thin(points, _FIRST_LOOK_TEXELS * texel_m, which)[0]
    seen = np.zeros((int(cell.max()) + 1, BINS), np.float32)
    light, count = np.zeros((2, len(seen)))
    octaves = np.zeros((len(seen), _OCTAVES))
    for first, part, p, n, number in chunks(points, which[coarse], lambda _: None, (1 << 22) // _FIRST_LOOK_SAMPLES):
        found = _first_look(scene, p, n, number, follow)
        dr.eval(found)
        chosen = coarse[first : first + len(part)]
        here = cell[chosen]
        sharp, faint = (np.array(v).reshape(-1, _FIRST_LOOK_SAMPLES) for v in found[1:])
        own = sharp.mean(axis=1) + beside[chosen]
        row, k = np.nonzero(faint)
        octave = np.clip(np.frexp(faint[row, k])[1] + _OCTAVES // 2, 0, _OCTAVES - 1)
        np.add.at(octaves, (here[row], octave), 1)
        brought = sharp + np.minimum(faint, _FAINT_MOST * own[:, None])
        np.add.at(seen, (np.repeat(here, _FIRST_LOOK_SAMPLES), np.array(found[0])), brought.ravel())
        light += np.bincount(here, own, len(light))
        count += np.bincount(here, minlength=len(light))
    return Guide.learned(seen), np.maximum(_FAINT_MOST * light / np.maximum(count, 1), _often(octaves))


def _often(octaves: FloatArray) -> FloatArray:
    """The largest value (cells,) that all samples together have `_FAINT_SEEN` times, if none counts for more than it.

    octaves (cells, k): how many samples there were of between 2^(k - 1) and 2^k, about 1.
    """
    size = 2.0 ** (np.arange(_OCTAVES) - _OCTAVES // 2)
    above = np.cumsum(octaves[:, ::-1], axis=1)[:, ::-1] - octaves
    below = np.cumsum(octaves * 0.75 * size, axis=1)
    enough = above * size + below >= _FAINT_SEEN * size
    return np.asarray(np.where(enough.any(axis=1), size[_OCTAVES - 1 - np.argmax(enough[:, ::-1], axis=1)], 0.0))


def _first_look(scene: Any, p: Any, n: Any, number: Any, follow: bool) -> tuple[Any, Any, Any]:
    """Bin, light and faint light of each of the first samples of all points, a point's side by side."""
    count = dr.width(number)
    index = dr.arange(mi.UInt32, count * _FIRST_LOOK_SAMPLES)
    point, i = index // _FIRST_LOOK_SAMPLES, index % _FIRST_LOOK_SAMPLES
    p, n = dr.gather(mi.Point3f, p, point), dr.gather(mi.Vector3f, n, point)
    number = dr.gather(mi.UInt32, number, point)
    u = r2(i >> 1, mi.Point2f(rotation(number, 201), rotation(number, 202)))
    d, density = _drawn(scene, p, n, u, (i & 1) == 1, None)
    lights = _arriving(scene, p, n, d, density, number, i, rotation(number, 203), follow)
    return bin_of(d), *map(mi.luminance, lights)


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


def _arriving(
    scene: Any, p: Any, n: Any, d: Any, density: Any, number: Any, i: Any, pick: Any, follow: bool
) -> tuple[Any, Any]:  # fmt: skip
    """Irradiance at p (normal n), by one sample d of this density, from the sky and off mirrors, and off lacquer."""
    cosine = dr.dot(n, d)
    there = (cosine > 0) & (density > 0)
    lights = emitted_along(scene, mi.Ray3f(p, d), number, i, pick - dr.floor(pick), follow, there)
    scale = dr.select(there, cosine / dr.maximum(density, 1e-20), 0)
    return lights[0] * scale, lights[1] * scale


@dr.syntax
def _sky_at(scene, guide, cell, limit, p, n, number, begin, samples, follow):
    """Sums over two halves of the samples `begin` to `begin + samples`, each one's faint light up to `limit`."""
    offset = mi.Point2f(rotation(number, 204), rotation(number, 205))
    lobe = rotation(number, 206)
    i = dr.opaque(mi.UInt32, begin)
    end = i + dr.opaque(mi.UInt32, samples)
    even, odd = mi.Color3f(0), mi.Color3f(0)
    while i < end:
        u = r2(i >> 1, offset)
        guided = (guide.sample(cell, u), lambda d: guide.density(cell, d))
        d, density = _drawn(scene, p, n, u, (i & 1) == 1, guided)
        pick = lobe + mi.Float(i) * 0.6180339887498949
        light, faint = _arriving(scene, p, n, d, density, number, i, pick, follow)
        light += faint * dr.minimum(1, limit / dr.maximum(mi.luminance(faint), 1e-20))
        first = ((i >> 1) & 1) == 0
        even += dr.select(first, light, 0)
        odd += dr.select(first, 0, light)
        i += 1
    return mi.Vector3f(even), mi.Vector3f(odd)
