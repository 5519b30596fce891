"""Direct light of lamps on points of surfaces, drawn from each lamp in rounds.

Where a lamp all but touches a surface, samples on it scatter without bound (1 / d²): there rays about the normal take
over, by the balance heuristic (Veach and Guibas 1995).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.light.drawing.rounds import drawn_at, in_rounds
from rsgen.light.drawing.specular import first_scatterer, transmitted
from rsgen.light.places.sampling import CHANNELS, about_normal, chunks, in_channels, r2, rotation
from rsgen.light.places.surface_points import SurfacePoints

MANY_EMITTERS = 24  # more are sampled together, as one
_ROUNDS = 6  # the last one ends at twice as many samples as are asked for
_AT_ONCE = 4  # lamps that scatter at a place: half shadows of more seldom meet
_FIRST_LOOK = 2
_NEAR_RAYS, _NEAR_ROUNDS = 8, 7
# Samples on lamps are trusted this much more than rays about the normal, and altogether where less were left to these.
_LIGHT_TRUST = 64.0
_LEAST_LEFT = 0.01


def lamps_of(scene: Any) -> list[Any]:
    """All emitters but the sky."""
    return [emitter for emitter in scene.emitters() if not emitter.is_environment()]


def first_look(
    scene: Any, points: SurfacePoints, which: IntArray, follow: bool, report: Callable[[float], None]
) -> Float32Array:
    """Direct irradiance (n, 4) from all lamps by a sample of each, or by the second where the first found none."""
    kinds = _kinds(scene)
    total = np.zeros((len(which), CHANNELS), np.float32)
    for look in range(_FIRST_LOOK):
        dark = np.flatnonzero(total.max(axis=1) <= 0)
        found = np.zeros((len(dark), CHANNELS), np.float32)
        for k, (emitter, dimension, _) in enumerate(kinds):
            draw = _draw(scene, emitter, dimension, points, which[dark], follow)
            count = 1 if emitter is not None else MANY_EMITTERS

            def share(f: float, done: float = look + k / len(kinds)) -> None:
                report((done + f / len(kinds)) / _FIRST_LOOK)

            found += draw(np.arange(len(dark)), look * count, count, share).sum(axis=0) / count
        total[dark] = found
    return total


def lamp_light(
    scene: Any, points: SurfacePoints, which: IntArray, patch: IntArray, samples: int, follow: bool,
    light: FloatArray, scatter: float, report: Callable[[float], None],
) -> tuple[Float32Array, FloatArray]:  # fmt: skip
    """Direct irradiance from all lamps but the sky, with `follow` through thin panes too.

    samples: of each lamp, at most twice as many where they scatter and a sixteenth where they do not; light (n,): all
    light of the points, about, in grey. Returns means (2, n, 4) of two halves of what was drawn, and the error (n,)
    left (see `rounds`).
    """
    kinds = _kinds(scene)
    means, square = np.zeros((2, len(which), CHANNELS), np.float32), np.zeros(len(which))
    for k, (emitter, dimension, delta) in enumerate(kinds):
        draw = _draw(scene, emitter, dimension, points, which, follow)
        count = samples * (1 if emitter is not None else MANY_EMITTERS)
        first, rounds = (2, 1) if delta else (max(2, count >> (_ROUNDS - 2)), _ROUNDS)

        def share(f: float, k: int = k) -> None:
            report(0.9 * (k + f) / len(kinds))

        own, left = in_rounds(
            draw, patch, lambda _: light, scatter / math.sqrt(min(len(kinds), _AT_ONCE)), first, rounds, math.inf, share
        )
        means += own
        square += left**2

    near = near_lamps(scene, points.position[which])
    if not len(near):
        return means, np.sqrt(square)

    def sample(at: Sequence[Any], _: IntArray, begin: int, count: int) -> Any:
        p, n, number = at
        return about_normal(p, n, number, begin, count, 111, left_to_rays(scene, p, n, follow))

    draw = drawn_at(which[near], partial(chunks, points), sample)
    effort = 2.0 * samples * len(which) / len(near)
    own, left = in_rounds(
        draw, patch[near], lambda _: light[near], scatter, _NEAR_RAYS, _NEAR_ROUNDS, effort,
        lambda f: report(0.9 + 0.1 * f),
    )  # fmt: skip
    means[:, near] += own
    square[near] += left**2
    return means, np.sqrt(square)


def near_lamps(scene: Any, position: Float32Array) -> IntArray:
    """Which places (n, 3) are so near a lamp that anything can be left to rays there (see `_light_share`)."""
    near = np.zeros(len(position), bool)
    for lamp in lamps_of(scene):
        shape = lamp.get_shape()
        if shape is None:
            continue
        if len(scene.emitters()) > MANY_EMITTERS or int(lamp.flags()) & int(mi.EmitterFlags.SpatiallyVarying):
            return np.arange(len(position))
        # Of samples spread over an area A the density, by solid angle, is d² / A at least; so is a sphere's own.
        reach = math.sqrt(float(shape.surface_area()[0]) / (math.pi * _LIGHT_TRUST * _LEAST_LEFT))
        box = shape.bbox()
        off = np.clip(position, np.float32(box.min), np.float32(box.max)) - position
        near |= np.einsum("ij,ij->i", off, off) < reach**2
    return np.flatnonzero(near)


def _kinds(scene: Any) -> list[tuple[Any, int, bool]]:
    """What is sampled by itself: (emitter or None for any, number of its random numbers, one sample tells all)."""
    lamps = lamps_of(scene)
    if len(lamps) > MANY_EMITTERS:
        return [(None, 0, False)]
    return [(lamp, k, int(lamp.flags()) & int(mi.EmitterFlags.Delta) != 0) for k, lamp in enumerate(lamps)]


def _registry_id(emitter: Any) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter))[0])


def _draw(scene: Any, emitter: Any, dimension: int, points: SurfacePoints, which: IntArray, follow: bool) -> Any:
    def sample(at: Sequence[Any], _: IntArray, begin: int, count: int) -> Any:
        return _from_emitter(scene, emitter, *at, begin, count, dimension, follow)

    return drawn_at(which, partial(chunks, points), sample)


@dr.syntax
def _from_emitter(scene, emitter, p, n, number, begin, samples, dimension, follow):
    """Sums over two halves of the samples `begin` to `begin + samples` of irradiance at p (normal n) from one emitter.

    If that is None, from random ones but the sky.
    """
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    it.t = mi.Float(1)
    it.n = mi.Normal3f(n)
    # Neither is part of the program: what is compiled for one lamp serves for all.
    first_dimension = dr.opaque(mi.UInt32, 2 * dimension)
    offset = mi.Point2f(rotation(number, first_dimension), rotation(number, first_dimension + 1))
    lamp = dr.reinterpret_array(mi.EmitterPtr, dr.opaque(mi.UInt32, 0 if emitter is None else _registry_id(emitter)))
    i = dr.opaque(mi.UInt32, begin)
    end = i + dr.opaque(mi.UInt32, samples)
    even, odd = mi.Vector4f(0), mi.Vector4f(0)
    while i < end:
        u = r2(i, offset)
        if dr.hint(emitter is None, mode="scalar"):
            ds, value = scene.sample_emitter_direction(it, u, False)
            if dr.hint(scene.environment() is not None, mode="scalar"):
                value = dr.select(ds.emitter == mi.EmitterPtr(scene.environment()), 0, value)
        else:
            ds, value = lamp.sample_direction(it, u)
        cosine = dr.dot(n, ds.d)
        lit = (cosine > 0) & (ds.pdf > 0) & (dr.max(value) > 0)
        arrives = transmitted(scene, p, ds.d, ds.dist, lit, follow)
        light = value * cosine * dr.select(ds.delta, 1, _light_share(ds.pdf, cosine))
        light = in_channels(dr.select(lit, light * arrives, 0), cosine)
        first = (i & 1) == 0
        even += dr.select(first, light, 0)
        odd += dr.select(first, 0, light)
        i += 1
    return even, odd


def _light_share(light_pdf: Any, cosine: Any) -> Any:
    """The light samples' part in the balance heuristic with cosine-distributed rays."""
    # Written so that a grazing emitter's infinite density gives 1, and 0 / 0 does not occur.
    left = dr.maximum(cosine, 0) * dr.inv_pi / dr.maximum(_LIGHT_TRUST * light_pdf, 1e-20)
    return dr.select(left < _LEAST_LEFT, 1, dr.rcp(1 + left))


def left_to_rays(scene: Any, p: Any, n: Any, follow: bool) -> Callable[[Any, Any, Any], Any]:
    """What rays from p about n bring of the light that `_from_emitter` leaves to them (see `about_normal`)."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    it.n = mi.Normal3f(n)
    any_lamp = len(scene.emitters()) > MANY_EMITTERS

    def light_along(ray: Any, _: Any, pick: Any) -> Any:
        cosine = dr.dot(n, ray.d)
        _, si, _, through, turned = first_scatterer(scene, ray, pick, follow, mi.Bool(True))
        emitter = si.emitter(scene)
        lamp = (emitter != dr.zeros(mi.EmitterPtr)) & si.is_valid() & ~turned  # the others are `sky_light`'s
        towards = mi.DirectionSample3f(scene, si, it)
        density = scene.pdf_emitter_direction if any_lamp else emitter.pdf_direction
        left_out = 1 - _light_share(density(it, towards, lamp), cosine)
        return dr.select(lamp, dr.pi * through * emitter.eval(si, lamp) * left_out, 0)

    return light_along
