"""Where light comes from, learned: for each place a histogram over directions that new ones are drawn from.

As in path guiding (Müller, Gross, Novák, CGF 2017), with cells and bins of one size: a window takes up a few bins.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import Float32Array, FloatArray
from rsgen.device.arrays import aligned

# Bins around the vertical and along it: of equal solid angle.
_AROUND, _ALONG = 32, 16
BINS = _AROUND * _ALONG
# Part of the directions that is drawn evenly, and part of a bin's light that its neighbours get: what the first look
# missed must not be missed for ever.
_EVENLY, _SPILL = 0.1, 0.15
_CHUNK = 8192  # cells at a time


class Guide:
    """Densities of directions for each cell; no dataclass, which Dr.Jit's loops would take apart as their state."""

    def __init__(self, cumulative: Any) -> None:
        """cumulative: Float, for each cell its bins' distribution function, the last being 1."""
        self.cumulative = cumulative

    @classmethod
    def learned(cls, seen: Float32Array) -> Guide:
        """From the light (cells, BINS) that samples, drawn evenly, have brought from each bin."""
        cumulative = np.empty_like(seen)
        for begin in range(0, len(seen), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            cumulative[part] = _distribution(seen[part].reshape(-1, _ALONG, _AROUND).astype(np.float64))
        return cls(mi.Float(aligned(cumulative)))

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
