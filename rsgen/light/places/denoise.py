"""Noise of baked light taken out on the surface: averaged over neighbours on one piece that it cannot tell apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.light.places.surface_points import SurfacePoints

_NEIGHBOURS = 32
_REACH = 2.0  # spacings: of the weight's fall with distance
_CHUNK = 1 << 17


def denoised(
    points: SurfacePoints, which: IntArray, halves: NDArray, sigma: FloatArray, spacing: float, noisy: IntArray
) -> Float32Array:
    """Mean (n, 4) of two independent estimates (2, n, 4) of irradiance, smoothed where noise hides any difference.

    sigma: standard error (n,) of the mean, in grey. noisy: which of the points are looked at, the others stay.
    Each half is averaged with weights by the other (Rousselle, Manzi, Zwicker, PG 2013), so that noise does not choose
    what it is averaged with: edges of shadows stay.
    """
    out = halves.mean(axis=0).astype(np.float32)
    if not len(noisy):
        return out
    scaled = points.coordinates(_REACH * spacing, which)
    grey = halves.mean(axis=2)
    # Variance of one half: of a point that scatters more than its neighbours its own.
    half = np.maximum(2.0 * sigma**2, 0.5 * (grey[0] - grey[1]) ** 2)
    tree = cKDTree(scaled)
    k = min(_NEIGHBOURS, len(which))
    for begin in range(0, len(noisy), _CHUNK):
        part = noisy[begin : begin + _CHUNK]
        distance, near = (np.reshape(v, (-1, k)) for v in tree.query(scaled[part], k=k, workers=-1))
        spread = half[part, None] + half[near]
        smoothed = np.zeros((len(near), halves.shape[2]))
        for one, other in ((0, 1), (1, 0)):
            apart = (grey[other][part, None] - grey[other][near]) ** 2 - spread
            weight = np.exp(-0.5 * distance**2 - np.maximum(apart, 0) / np.maximum(spread, 1e-20))
            smoothed += np.einsum("nk,nkc->nc", weight, halves[one][near]) / (2 * weight.sum(axis=1, keepdims=True))
        out[part] = smoothed
    return out
