"""Lamps inside glass: the glass of a bulb is as if it bent nothing while light is baked.

Rays from a wall find a filament through curved glass one time in a hundred thousand: specks a hundred times too bright,
and darkness between them. What a bulb holds back on one side it sends out at the other, so that all its light gets out,
and nearly as if there were no glass but for its colour. How it is seen by a camera is not changed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen.device.arrays import aligned
from rsgen.light.drawing.lamps import lamps_of
from rsgen.light.places.surface_points import OFFSET_M
from rsgen.render.irradiance import registry_id

_NEAR_M = 0.3  # a lamp in a room of glass is in no bulb
_RAYS = 512  # from each lamp, all around
_ENCLOSED = 0.7  # of those that leave the lamp: the rest may meet its socket
_PART = 0.02  # of them, that meet what is a part of a bulb
_WALLS = 4  # of glass, one within the other
_BENDS = int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.GlossyTransmission)
_NO_GLASS = int(mi.BSDFFlags.Null) | int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.DiffuseTransmission)


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
    lamp = np.repeat(np.arange(len(lamps)), _RAYS)
    own = np.array([registry_id(shape) for shape in lamps], np.uint32)[lamp]
    ray = _all_around(own)
    found: set[int] = set()
    going = np.ones(len(lamp), bool)
    for _ in range(_WALLS):
        si = scene.ray_intersect(ray, mi.Bool(aligned(going)))
        met, near = np.array(dr.reinterpret_array(mi.UInt32, si.shape)), np.array(si.t) < _NEAR_M
        leaves = going & (met != own)
        glass = leaves & near & np.isin(met, [k for k, shape in shapes.items() if _is_glass(shape)])
        share = np.bincount(lamp, glass) / np.maximum(np.bincount(lamp, leaves), 1)
        going = glass & (share >= _ENCLOSED)[lamp]
        if not going.any():
            break
        number, count = np.unique(met[going], return_counts=True)
        found |= {int(k) for k, n in zip(number, count, strict=True) if n >= _PART * _RAYS}
        ray = si.spawn_ray(ray.d)
    return [shapes[k] for k in sorted(found)]


def _all_around(own: NDArray[np.uint32]) -> Any:
    """Rays from places on the shapes of these numbers (n,), in all directions."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(own))
    place = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(aligned(own, np.uint32))).sample_position(0, sampler.next_2d())
    d = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    return mi.Ray3f(place.p + OFFSET_M * dr.sign(dr.dot(place.n, d)) * place.n, d)


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
