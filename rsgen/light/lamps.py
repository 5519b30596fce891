"""Direct light of lamps on points of surfaces, sampled from each lamp as much as its scatter needs.

Where a lamp all but touches a surface, samples on it scatter without bound (1 / d²): there rays about the normal take
over, by the balance heuristic (Veach and Guibas 1995).

While light is baked, the glass of a bulb bends nothing: rays from a wall find a filament through curved glass one time
in a hundred thousand, which makes specks a hundred times too bright and darkness between them. What a bulb holds back
on one side it sends out at the other, so nearly all its light gets out, in the glass's colour. Cameras see the glass.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.device.arrays import aligned
from rsgen.light.sampling import (
    CHANNELS,
    about_normal,
    in_channels,
    in_halves,
    interaction,
    part_of,
    r2,
    rotation,
    sampled_adaptively,
    sampler_at,
)
from rsgen.light.specular import first_scatterer, transmitted
from rsgen.light.surface_points import SamplePoints
from rsgen.render.irradiance import registry_id
from rsgen.scene.rays import RAY_OFFSET_M

MANY_EMITTERS = 24  # more are sampled together, as one
_ROUNDS = 6  # the last one ends at twice as many samples as are asked for
_AT_ONCE = 4  # lamps that scatter at a place: half shadows of more seldom meet
_FIRST_LOOK = 2
_NEAR_RAYS, _NEAR_ROUNDS = 8, 7
# Samples on lamps are trusted this much more than rays about the normal, and altogether where less were left to these.
_LIGHT_TRUST = 64.0
_LEAST_LEFT = 0.01
_BULB_M = 0.3  # a lamp in a room of glass is in no bulb
_BULB_RAYS = 512  # from each lamp, all around
_ENCLOSED = 0.7  # of those that leave the lamp: the rest may meet its socket
_BULB_PART = 0.02  # of them, that meet what is a part of a bulb
_BULB_WALLS = 4  # of glass, one within the other
_BENDS = int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.GlossyTransmission)
_NO_GLASS = int(mi.BSDFFlags.Null) | int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.DiffuseTransmission)


def lamps_of(scene: Any) -> list[Any]:
    """All emitters but the sky."""
    return [emitter for emitter in scene.emitters() if not emitter.is_environment()]


def first_look(
    scene: Any, points: SamplePoints, which: IntArray, follow: bool, report: Callable[[float], None]
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
            part = part_of(report, (look + k / len(kinds)) / _FIRST_LOOK, 1 / len(kinds) / _FIRST_LOOK)
            found += draw(np.arange(len(dark)), look * count, count, part).sum(axis=0) / count
        total[dark] = found
    return total


def lamp_light(
    scene: Any, points: SamplePoints, which: IntArray, patch: IntArray, samples: int, follow: bool,
    light: FloatArray, scatter: float, report: Callable[[float], None],
) -> tuple[Float32Array, FloatArray]:  # fmt: skip
    """Direct irradiance from all lamps but the sky, with `follow` through thin panes too.

    samples: of each lamp, at most twice as many where they scatter and a sixteenth where they do not; light (n,): all
    light of the points, about, in grey. Returns means (2, n, 4) of two halves of what was drawn, and the error (n,)
    left (see `sampled_adaptively`).
    """
    kinds = _kinds(scene)
    means, square = np.zeros((2, len(which), CHANNELS), np.float32), np.zeros(len(which))
    for k, (emitter, dimension, delta) in enumerate(kinds):
        draw = _draw(scene, emitter, dimension, points, which, follow)
        count = samples * (1 if emitter is not None else MANY_EMITTERS)
        first, rounds = (2, 1) if delta else (max(2, count >> (_ROUNDS - 2)), _ROUNDS)
        most = scatter / math.sqrt(min(len(kinds), _AT_ONCE))
        part = part_of(report, 0.9 * k / len(kinds), 0.9 / len(kinds))
        own, left = sampled_adaptively(draw, patch, lambda _: light, most, first, rounds, math.inf, part)
        means += own
        square += left**2

    near = near_lamps(scene, points.position[which])
    if not len(near):
        return means, np.sqrt(square)

    def sample(at: Sequence[Any], _: IntArray, begin: int, count: int) -> Any:
        p, n, number = at
        return about_normal(p, n, number, begin, count, 111, left_to_rays(scene, p, n, follow))

    draw = sampler_at(points, which[near], sample)
    effort = 2.0 * samples * len(which) / len(near)
    own, left = sampled_adaptively(
        draw, patch[near], lambda _: light[near], scatter, _NEAR_RAYS, _NEAR_ROUNDS, effort,
        part_of(report, 0.9, 0.1),
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
    """What is sampled by itself: (emitter, None for any; number of its random numbers; whether one sample is exact)."""
    lamps = lamps_of(scene)
    if len(lamps) > MANY_EMITTERS:
        return [(None, 0, False)]
    return [(lamp, k, int(lamp.flags()) & int(mi.EmitterFlags.Delta) != 0) for k, lamp in enumerate(lamps)]


def _draw(scene: Any, emitter: Any, dimension: int, points: SamplePoints, which: IntArray, follow: bool) -> Any:
    def sample(at: Sequence[Any], _: IntArray, begin: int, count: int) -> Any:
        p, n, number = at
        return _from_emitter(scene, emitter, p, n, number, begin, count, dimension, follow)

    return sampler_at(points, which, sample)


def _from_emitter(
    scene: Any, emitter: Any, p: Any, n: Any, number: Any, begin: int, samples: int, dimension: int, follow: bool
) -> tuple[Any, Any]:
    """Sums over two halves of the samples `begin` to `begin + samples` of irradiance at p (normal n) from one emitter.

    If that is None, from random ones but the sky.
    """
    it = interaction(p, n)
    offset = mi.Point2f(rotation(number, 2 * dimension), rotation(number, 2 * dimension + 1))
    # Not part of the program: what is compiled for one lamp serves for all.
    lamp = dr.reinterpret_array(mi.EmitterPtr, dr.opaque(mi.UInt32, 0 if emitter is None else registry_id(emitter)))

    def light(i: Any) -> Any:
        u = r2(i, offset)
        if emitter is None:
            ds, value = scene.sample_emitter_direction(it, u, False)
            if scene.environment() is not None:
                value = dr.select(ds.emitter == mi.EmitterPtr(scene.environment()), 0, value)
        else:
            ds, value = lamp.sample_direction(it, u)
        cosine = dr.dot(n, ds.d)
        lit = (cosine > 0) & (ds.pdf > 0) & (dr.max(value) > 0)
        arrives = transmitted(scene, p, ds.d, ds.dist, lit, follow)
        brought = value * cosine * dr.select(ds.delta, 1, _light_share(ds.pdf, cosine))
        # What misses a lamp with a picture has no direction: a cosine that is NaN would be in the sum, times 0.
        return in_channels(dr.select(lit, brought * arrives, 0), dr.select(lit, cosine, 0))

    return in_halves(begin, samples, light)


def _light_share(light_pdf: Any, cosine: Any) -> Any:
    """The light samples' part in the balance heuristic with cosine-distributed rays."""
    # Written so that a grazing emitter's infinite density gives 1, and 0 / 0 does not occur.
    left = dr.maximum(cosine, 0) * dr.inv_pi / dr.maximum(_LIGHT_TRUST * light_pdf, 1e-20)
    return dr.select(left < _LEAST_LEFT, 1, dr.rcp(1 + left))


def left_to_rays(scene: Any, p: Any, n: Any, follow: bool) -> Callable[[Any, Any, Any], Any]:
    """What rays from p about n bring of the light that `_from_emitter` leaves to them (see `about_normal`)."""
    it = interaction(p, n)
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


@contextlib.contextmanager
def straight_through_bulbs(scene: Any) -> Iterator[list[Any]]:
    """While open, light goes straight through the glass around lamps; yields the shapes that it is."""
    shapes = bulbs(scene)
    glass = [shape.bsdf() for shape in shapes]
    try:
        for shape, own in zip(shapes, glass, strict=True):
            shape.set_bsdf(_colour_alone(own))
        yield shapes
    finally:
        for shape, own in zip(shapes, glass, strict=True):
            shape.set_bsdf(own)


def bulbs(scene: Any) -> list[Any]:
    """Shapes of glass that are less than 30 cm around a lamp on nearly all sides, up to four within each other."""
    shapes = {registry_id(shape): shape for shape in scene.shapes()}
    lamps = [lamp.get_shape() for lamp in lamps_of(scene) if lamp.get_shape() is not None]
    if not lamps or not any(_is_glass(shape) for shape in shapes.values()):
        return []
    lamp = np.repeat(np.arange(len(lamps)), _BULB_RAYS)
    own = np.array([registry_id(shape) for shape in lamps], np.uint32)[lamp]
    ray = _all_around(own)
    found: set[int] = set()
    going = np.ones(len(lamp), bool)
    for _ in range(_BULB_WALLS):
        si = scene.ray_intersect(ray, mi.Bool(aligned(going)))
        met, near = np.array(dr.reinterpret_array(mi.UInt32, si.shape)), np.array(si.t) < _BULB_M
        leaves = going & (met != own)
        glass = leaves & near & np.isin(met, [k for k, shape in shapes.items() if _is_glass(shape)])
        share = np.bincount(lamp, glass) / np.maximum(np.bincount(lamp, leaves), 1)
        going = glass & (share >= _ENCLOSED)[lamp]
        if not going.any():
            break
        number, count = np.unique(met[going], return_counts=True)
        found |= {int(k) for k, n in zip(number, count, strict=True) if n >= _BULB_PART * _BULB_RAYS}
        ray = si.spawn_ray(ray.d)
    return [shapes[k] for k in sorted(found)]


def _all_around(own: NDArray[np.uint32]) -> Any:
    """Rays from places on the shapes of these numbers (n,), in all directions."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(own))
    place = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(aligned(own, np.uint32))).sample_position(0, sampler.next_2d())
    d = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    return mi.Ray3f(place.p + RAY_OFFSET_M * dr.sign(dr.dot(place.n, d)) * place.n, d)


def _is_glass(shape: Any) -> bool:
    flags = 0 if shape.bsdf() is None else int(shape.bsdf().flags())
    return bool(flags & _BENDS) and not flags & _NO_GLASS


def _colour_alone(glass: Any) -> Any:
    """What lets light straight on, with this glass's mean colour."""
    parameters = mi.traverse(glass)
    colour = np.ones(1)
    for name in parameters.keys():  # noqa: SIM118
        if name.endswith("specular_transmittance.value"):
            colour = np.array(parameters[name]).ravel()
        elif name.endswith("specular_transmittance.data"):
            colour = np.array(parameters[name]).mean(axis=(0, 1))
    tint = {"type": "rgb", "value": np.broadcast_to(colour, 3).tolist()}
    return mi.load_dict({"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0, "specular_transmittance": tint})
