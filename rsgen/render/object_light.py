"""How moving things are lit, and what light they take from the surfaces around them, both approximately.

An object's matte surface is lit by what arrives at its middle, as a function of the direction it faces: irradiance of
spherical harmonics up to the second order (Ramamoorthi and Hanrahan, SIGGRAPH 2001), gathered along its path.
Around it, surfaces lose the share of their sky that an ellipsoid in its place covers, as if light came evenly from
everywhere: the exact form factor of a ball (Quilez, "sphere ambient occlusion", 2014), in coordinates in which the
ellipsoid is one.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from rsgen.array_types import FloatArray

HARMONICS = 9
_BANDS = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4], [1, 3, 5])
# 0.5 sqrt(1/pi), sqrt(3/4pi), 0.5 sqrt(15/pi), 0.25 sqrt(5/pi), 0.25 sqrt(15/pi)
_K = 0.5 * np.sqrt(np.array([1, 3, 15, 5, 15]) / np.pi) * np.array([1, 1, 1, 0.5, 0.5])


def harmonics(d: Any) -> list[Any]:
    """The nine real spherical harmonics up to order two of a unit direction with x, y and z: floats, or arrays."""
    x, y, z = d
    k0, k1, k2, k3, k4 = (float(k) for k in _K)
    first = [k0 + 0 * x, k1 * y, k1 * z, k1 * x]
    return [*first, k2 * x * y, k2 * y * z, k3 * (3 * z * z - 1), k2 * x * z, k4 * (x * x - y * y)]


def irradiance_coefficients(radiance: FloatArray) -> FloatArray:
    """Coefficients (..., 9, 3) of irradiance by the normal from those of radiance by the direction."""
    return radiance * _BANDS[:, None]


def covered(distance: tuple[Any, Any, Any], normal: tuple[Any, Any, Any]) -> Any:
    """Share of the cosine-weighted hemisphere about `normal` (unit) that a unit ball covers.

    distance: from the surface point to the ball's middle, in its radii. Points inside the ball count as just outside.
    """
    squared = distance[0] ** 2 + distance[1] ** 2 + distance[2] ** 2
    h2 = dr.maximum(squared, 1.0001)
    cosine = dr.clip(sum(a * b for a, b in zip(distance, normal, strict=True)) * dr.rsqrt(dr.maximum(squared, 1e-12)),
                     -0.9999, 0.9999)  # fmt: skip
    above = dr.maximum(cosine, 0.0) / h2
    cut = 1.0 - h2 * cosine * cosine  # above 0 where the surface's own plane cuts the ball
    root, out = dr.sqrt(dr.maximum(cut, 1e-9)), dr.sqrt(h2 - 1.0)
    edge = dr.clip(-cosine * out * dr.rsqrt(1.0 - cosine * cosine), -1.0, 1.0)
    across = (cosine * dr.acos(edge) - root * out) / h2 + dr.atan(root / out)
    return dr.clip(dr.select(cut > 1e-3, across * dr.inv_pi, above), 0.0, 1.0)
