"""What all of the baking starts from: points in chunks, and random numbers that are the same each time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import FloatArray
from rsgen.device.arrays import aligned
from rsgen.light.places.surface_points import SurfacePoints

CHANNELS = 4  # of light: see `in_channels`
_ETA = 1.5  # of lacquer
_GETS_IN = 0.90822  # of light from all sides alike: the mean over cosine-distributed directions of what Fresnel lets in
_CHUNK = 1 << 20


def in_channels(light: Any, cosine: Any) -> Any:
    """(Vector4f) irradiance by one direction, of this cosine: red, green, blue, and how much of it gets into lacquer.

    The last as a part of what would get in were it from all sides, in grey: what is beneath lacquer is lit by so much
    less by what comes at a glance, and by 6 % more by what comes straight.
    """
    gets_in = (1 - mi.fresnel(dr.clip(cosine, 0, 1), _ETA)[0]) / _GETS_IN
    return mi.Vector4f(light.x, light.y, light.z, dr.mean(light) * gets_in)


def rotation(index: Any, dimension: Any) -> Any:
    """Uniform offset in [0, 1) from a hash of a point's number and a dimension."""
    return mi.sample_tea_float32(index, mi.UInt32(dimension), 4)


def r2(i: Any, offset: Any) -> Any:
    """Point i of the R2 low-discrepancy sequence (Roberts 2018), rotated by `offset`."""
    x = offset.x + mi.Float(i) * 0.7548776662466927
    y = offset.y + mi.Float(i) * 0.5698402909980532
    return mi.Point2f(x - dr.floor(x), y - dr.floor(y))


@dr.syntax
def about_normal(p, n, number, begin, count, dimension, light_along):
    """Sums (Vector4f) over two halves of the cosine-distributed rays `begin` to `begin + count` from p about n.

    dimension: the first of three for random numbers (see `rotation`). light_along: of (ray, its number i, a uniform
    number for lots) π times the radiance that comes along it: with pdf cosθ/π, ∫ L cosθ dω is the mean of πL.
    """
    frame = mi.Frame3f(n)
    offset = mi.Point2f(rotation(number, dimension), rotation(number, dimension + 1))
    lobe = rotation(number, dimension + 2)
    i = dr.opaque(mi.UInt32, begin)
    end = i + dr.opaque(mi.UInt32, count)
    even, odd = mi.Vector4f(0), mi.Vector4f(0)
    while i < end:
        d = mi.warp.square_to_cosine_hemisphere(r2(i, offset))
        pick = lobe + mi.Float(i) * 0.6180339887498949
        pick -= dr.floor(pick)
        light = in_channels(light_along(mi.Ray3f(p, frame.to_world(d)), i, pick), d.z)
        first = (i & 1) == 0
        even += dr.select(first, light, 0)
        odd += dr.select(first, 0, light)
        i += 1
    return even, odd


def shaded_nearby(scene: Any, points: SurfacePoints, which: NDArray, within_m: float, rays: int) -> FloatArray:
    """Part (n,) of the light from all sides that things less than `within_m` away would take, the farther the less."""
    within, out = dr.opaque(mi.Float, within_m), np.zeros(len(which))

    def taken_along(ray: Any, _: Any, __: Any) -> Any:
        ray.maxt = within
        pi = scene.ray_intersect_preliminary(ray, coherent=False)
        return mi.Color3f(dr.select(pi.is_valid(), 1 - dr.square(pi.t / within), 0))

    for begin, part, p, n, number in chunks(points, which, lambda _: None):
        even, odd = about_normal(p, n, number, 0, rays, 0, taken_along)
        out[begin : begin + len(part)] = np.array(even.x + odd.x) / rays
    return out


def chunks(
    points: SurfacePoints, which: NDArray, report: Callable[[float], None], size: int = _CHUNK
) -> Iterator[tuple[int, NDArray, Any, Any, Any]]:
    """(first of them, their numbers, ray origins, normals and numbers on the device) of `which`, `size` at a time."""
    origin, normal = points.on_device
    for begin in range(0, len(which), size):
        part = which[begin : begin + size]
        number = mi.UInt32(aligned(part, np.uint32))
        yield begin, part, dr.gather(mi.Point3f, origin, number), dr.gather(mi.Vector3f, normal, number), number
        report(min(1.0, (begin + len(part)) / len(which)))
