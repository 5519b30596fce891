"""Light from the sky, and lamps' light that comes off mirrors or through thick glass, on points of surfaces.

A room sees the sky through windows only: most directions sampled from the whole sky end at a wall. So a first pass
learns where light comes from in each part of the scene, as a histogram over directions, and half of the directions are
sampled from that: path guiding (Müller, Gross, Novák, CGF 2017), with cells and bins of one size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.device.arrays import aligned
from rsgen.light.sampling import (
    chunks,
    golden,
    in_channels,
    in_halves,
    interaction,
    r2,
    rotation,
    sampled_adaptively,
    sampler_at,
    thin,
)
from rsgen.light.specular import first_scatterer, passes_light_on
from rsgen.light.surface_points import SamplePoints

_CELL_M = 0.5  # parts of the scene that have one histogram, of like normals on one piece of surface
_FIRST_LOOK_TEXELS, _FIRST_LOOK_SAMPLES = 3.0, 64
LESS = 4  # part of the samples that is drawn at first: most places see no sky, nor lamps by ways with turns
_ROUNDS, _ROUNDS_OF_LAMPS = 8, 6
# Directions drawn at most in all, of the samples asked for: where light is hard to find the worst places get them.
_EFFORT = 4.0
# Bins around the vertical and along it: of equal solid angle.
_AROUND, _ALONG = 32, 16
BINS = _AROUND * _ALONG
# Part of the directions that is drawn evenly, and part of a bin's light that its neighbours get: what the first look
# missed must not be missed for ever.
_EVENLY, _SPILL = 0.1, 0.15
_GUIDE_CHUNK = 8192  # cells at a time


def has_sky_light(scene: Any) -> bool:
    """Whether a scene has any of this light."""
    return scene.environment() is not None or passes_light_on(scene)


def sky_light(
    scene: Any, points: SamplePoints, which: IntArray, patch: IntArray, texel_m: float, samples: int,
    beside: FloatArray, scatter: float, report: Callable[[float], None],
) -> tuple[Float32Array, FloatArray]:  # fmt: skip
    """Irradiance from the sky and from lamps by ways with turns: off mirrors and through thick glass.

    samples: directions at each point, one in `LESS` at first; more where the standard error exceeds `scatter`, as far
    as the effort allows; beside (n,): light that points have from elsewhere, in grey. Returns means (2, len(which), 4)
    of two halves of what was drawn, and the error (n,) left (see `sampled_adaptively`).
    """
    cell, follow = thin(points, _CELL_M, which)[1], passes_light_on(scene)
    guide = _learned(scene, points, which, cell, texel_m, follow)

    def sample(at: Sequence[Any], here: IntArray, begin: int, count: int) -> Any:
        p, n, number = at
        return _sky_at(scene, guide, mi.UInt32(aligned(cell[here], np.uint32)), p, n, number, begin, count, follow)

    draw = sampler_at(points, which, sample)
    first, rounds = max(4, samples // LESS), _ROUNDS_OF_LAMPS if scene.environment() is None else _ROUNDS
    return sampled_adaptively(draw, patch, lambda own: own + beside, scatter, first, rounds, _EFFORT * samples, report)


def _learned(
    scene: Any, points: SamplePoints, which: IntArray, cell: IntArray, texel_m: float, follow: bool
) -> Guide:  # fmt: skip
    coarse = thin(points, _FIRST_LOOK_TEXELS * texel_m, which)[0]
    seen = np.zeros((int(cell.max()) + 1, BINS), np.float32)
    for first, part, p, n, number in chunks(points, which[coarse], lambda _: None, (1 << 22) // _FIRST_LOOK_SAMPLES):
        found = _first_look(scene, p, n, number, follow)
        dr.eval(found)
        here = cell[coarse[first : first + len(part)]]
        bins = np.repeat(here * BINS, _FIRST_LOOK_SAMPLES) + np.array(found[0])
        np.add.at(seen.reshape(-1), bins, np.array(found[1]))  # much faster by one index than by two
    return Guide(seen)


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
    it = interaction(p, n)
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
    _, si, _, through, turned = first_scatterer(scene, mi.Ray3f(p, d), pick, follow, cosine > 0)
    emitter = si.emitter(scene)
    found = (cosine > 0) & (emitter != dr.zeros(mi.EmitterPtr)) & (~si.is_valid() | turned)
    return found, dr.select(found, through * emitter.eval(si, found) * cosine, 0)


def _sky_at(
    scene: Any, guide: Guide, cell: Any, p: Any, n: Any, number: Any, begin: int, samples: int, follow: bool
) -> tuple[Any, Any]:
    """Sums over two halves of the samples `begin` to `begin + samples`."""
    offset = mi.Point2f(rotation(number, 204), rotation(number, 205))
    lobe = rotation(number, 206)

    def light(i: Any) -> Any:
        u = r2(i >> 1, offset)
        guided = (guide.sample(cell, u), lambda d: guide.density(cell, d))
        d, density = _drawn(scene, p, n, u, (i & 1) == 1, guided)
        found, brought = _arriving(scene, p, n, d, golden(i, lobe), follow)
        return in_channels(dr.select(found & (density > 0), brought / dr.maximum(density, 1e-20), 0), dr.dot(n, d))

    return in_halves(begin, samples, light, bit=2)  # of each two one is the sky's own and one guided


class Guide:
    """Densities of directions for each cell; no dataclass, which Dr.Jit's loops would take apart as their state."""

    def __init__(self, seen: Float32Array) -> None:
        """Learned from the light (cells, BINS) that samples, drawn evenly, have brought from each bin."""
        cumulative = np.empty_like(seen)
        for begin in range(0, len(seen), _GUIDE_CHUNK):
            part = slice(begin, begin + _GUIDE_CHUNK)
            cumulative[part] = _distribution(seen[part].reshape(-1, _ALONG, _AROUND).astype(np.float64))
        # Of each cell its bins' distribution function, the last being 1.
        self.cumulative = mi.Float(aligned(cumulative))

    def sample(self, cell: Any, u: Any) -> Any:
        """A direction (Vector3f, world frame) in each cell, by two uniform numbers."""
        first = cell * BINS
        bin_ = dr.binary_search(0, BINS - 1, lambda k: dr.gather(mi.Float, self.cumulative, first + k) <= u.x)
        begin = dr.select(bin_ > 0, dr.gather(mi.Float, self.cumulative, first + bin_ - 1, bin_ > 0), 0.0)
        end = dr.gather(mi.Float, self.cumulative, first + bin_)
        within = dr.clip((u.x - begin) / dr.maximum(end - begin, 1e-20), 0.0, 1.0)
        around = (mi.Float(bin_ % _AROUND) + within) * (2.0 * dr.pi / _AROUND)
        z = (mi.Float(bin_ // _AROUND) + u.y) * (2.0 / _ALONG) - 1.0
        r = dr.safe_sqrt(1.0 - z * z)
        sine, cosine = dr.sincos(around)
        return mi.Vector3f(r * cosine, r * sine, z)

    def density(self, cell: Any, d: Any) -> Any:
        """Of `sample`, per steradian."""
        bin_ = bin_of(d)
        first = cell * BINS
        begin = dr.select(bin_ > 0, dr.gather(mi.Float, self.cumulative, first + bin_ - 1, bin_ > 0), 0.0)
        return (dr.gather(mi.Float, self.cumulative, first + bin_) - begin) * (BINS / (4.0 * dr.pi))


def _distribution(grid: FloatArray) -> FloatArray:
    """Distribution function (cells, bins) of what has been seen (cells, along, around)."""
    up, down = np.zeros_like(grid), np.zeros_like(grid)
    up[:, 1:], down[:, :-1] = grid[:, :-1], grid[:, 1:]
    spilt = np.roll(grid, 1, axis=2) + np.roll(grid, -1, axis=2) + up + down
    flat = (grid + _SPILL * spilt).reshape(len(grid), BINS)
    total = flat.sum(axis=1, keepdims=True)
    share = np.where(total > 0, flat / np.where(total > 0, total, 1.0), 1.0 / BINS)
    cumulative: FloatArray = np.cumsum((1.0 - _EVENLY) * share + _EVENLY / BINS, axis=1)
    cumulative[:, -1] = 1.0
    return cumulative


def bin_of(d: Any) -> Any:
    """The bin (UInt32) that a direction lies in."""
    around = dr.atan2(d.y, d.x) * (0.5 * dr.inv_pi)
    around -= dr.floor(around)
    k = dr.minimum(mi.UInt32(around * _AROUND), _AROUND - 1)
    j = dr.minimum(mi.UInt32(dr.clip(0.5 * (d.z + 1.0), 0.0, 1.0) * _ALONG), _ALONG - 1)
    return j * _AROUND + k
