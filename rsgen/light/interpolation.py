"""Thinned sets of sample points, interpolation between sets, and denoising on the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.light.surface_points import SamplePoints, in_order, row_hash

_NEIGHBOURS = 8
_SMOOTHING = 0.3  # spacings: closer sources than this count alike
_STEP, _BEYOND = 0.15, 1e-3  # spacings: of a step in a surface; what is beyond one counts for so little
_CHUNK = 1 << 18
_DENOISED_OVER = 32
_DENOISING_REACH = 2.0  # spacings: of the weight's fall with distance
_DENOISING_CHUNK = 1 << 17


def thin(
    points: SamplePoints, spacing: float, among: IntArray | None = None, steps: bool = False
) -> tuple[IntArray, IntArray]:
    """Of `among` (default: all), one in each cell of `spacing` metres, of like normals on one piece of surface.

    steps: none stands for what is a step above or below it, as the bottom of a groove is. Returns the chosen ones as
    indices into `among`, and for each of `among` which of the chosen stands for it.
    """
    position, normal, piece = points.position, points.normal, points.piece
    if among is not None:
        position, normal, piece = position[among], normal[among], piece[among]
    cell = np.floor(position / spacing)
    off_centre = ((position / spacing - cell - 0.5) ** 2).sum(axis=1)
    # A buried face must not stand for a lit one just in front of it, so pieces of surface are kept apart.
    facing = np.round(normal)
    key = row_hash(*cell.T, *facing.T, piece)
    if steps:
        above = np.einsum("ij,ij->i", position / spacing - cell, facing / np.linalg.norm(facing, axis=1, keepdims=True))
        key = row_hash(key.view(np.int64), np.floor(above / _STEP).astype(np.int64))
    del cell
    order = np.lexsort((off_centre, key))
    sorted_key = key[order]
    starts = np.concatenate([[True], sorted_key[1:] != sorted_key[:-1]])
    chosen, rank = in_order(order[starts])
    stands_for = np.empty(len(order), np.int64)
    stands_for[order] = rank[np.cumsum(starts) - 1]
    return chosen, stands_for


@dataclass(frozen=True)
class Interpolation:
    """Values at some points from those at `sources`: neighbours (n, k) among the sources and weights (n, k)."""

    neighbours: NDArray[np.int32]
    weights: Float32Array

    @classmethod
    def between(cls, points: SamplePoints, sources: NDArray, targets: NDArray, spacing: float) -> Interpolation:
        """By distance in position (in units of `spacing` metres) and normal together, within one piece of surface.

        The dark inside of a thin sheet is a millimetre from its lit outside and has the normal of the other outside.
        """
        k = min(_NEIGHBOURS, len(sources))
        tree = cKDTree(points.coordinates(spacing, sources))
        near, weights = np.empty((len(targets), k), np.int32), np.empty((len(targets), k), np.float32)
        for begin in range(0, len(targets), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            found = tree.query(points.coordinates(spacing, targets[part]), k=k, workers=-1, eps=0.2)
            distance, near[part] = (np.reshape(v, (-1, k)) for v in found)
            # Falls to zero at the furthest neighbour, so that the interpolant is continuous as neighbours change, and
            # grows without bound towards a source, so that it passes through the sources.
            falling = np.clip(1 - (distance / (distance[:, -1:] * 1.0001 + 1e-9)) ** 2, 0, 1) ** 2
            weight = (falling + 1e-6) / (distance**2 + _SMOOTHING**2)
            apart = points.position[sources[near[part]]] - points.position[targets[part], None]
            step = np.einsum("nki,ni->nk", apart, points.normal[targets[part]]) / (_STEP * spacing)
            weight *= np.exp(-(step**2)) + _BEYOND
            weights[part] = weight / weight.sum(axis=1, keepdims=True)
        return cls(near, weights)

    def __call__(self, at_sources: Float32Array) -> Float32Array:
        n, k = self.neighbours.shape
        rows = np.arange(0, n * k + 1, k)
        flat = self.weights.ravel(), self.neighbours.ravel(), rows
        return np.asarray(csr_array(flat, shape=(n, len(at_sources))) @ at_sources.astype(np.float32, copy=False))

    def spread(self, at_sources: FloatArray) -> FloatArray:
        """Standard deviation (n,), by their weights, of the values (m,) that each one is interpolated from."""
        mean, square = np.zeros((2, len(self.neighbours)))
        for weight, near in zip(self.weights.T, self.neighbours.T, strict=True):
            mean += weight * at_sources[near]
            square += weight * at_sources[near] ** 2
        return np.sqrt(np.maximum(square - mean**2, 0.0))


def denoised(
    points: SamplePoints, which: IntArray, halves: NDArray, sigma: FloatArray, spacing: float, noisy: IntArray
) -> Float32Array:
    """Mean (n, 4) of two independent estimates (2, n, 4) of irradiance, smoothed where noise hides any difference.

    sigma: standard error (n,) of the mean, in grey. noisy: which of the points are looked at, the others stay.
    Each half is averaged with weights by the other (Rousselle, Manzi, Zwicker, PG 2013), so that noise does not choose
    what it is averaged with: edges of shadows stay.
    """
    out = halves.mean(axis=0).astype(np.float32)
    if not len(noisy):
        return out
    scaled = points.coordinates(_DENOISING_REACH * spacing, which)
    grey = halves.mean(axis=2)
    # Variance of one half: of a point that scatters more than its neighbours its own.
    half = np.maximum(2.0 * sigma**2, 0.5 * (grey[0] - grey[1]) ** 2)
    tree = cKDTree(scaled)
    k = min(_DENOISED_OVER, len(which))
    for begin in range(0, len(noisy), _DENOISING_CHUNK):
        part = noisy[begin : begin + _DENOISING_CHUNK]
        distance, near = (np.reshape(v, (-1, k)) for v in tree.query(scaled[part], k=k, workers=-1))
        spread = half[part, None] + half[near]
        smoothed = np.zeros((len(near), halves.shape[2]))
        for one, other in ((0, 1), (1, 0)):
            apart = (grey[other][part, None] - grey[other][near]) ** 2 - spread
            weight = np.exp(-0.5 * distance**2 - np.maximum(apart, 0) / np.maximum(spread, 1e-20))
            smoothed += np.einsum("nk,nkc->nc", weight, halves[one][near]) / (2 * weight.sum(axis=1, keepdims=True))
        out[part] = smoothed
    return out
