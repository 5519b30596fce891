"""Numbers in [0, 1) for the samples of a pixel: Sobol's sequence, scrambled by Owen's method for each pixel.

The first 2^n samples of a pixel are stratified in each dimension, and in the first two together. Where an edge crosses
the pixel their squared error falls with n^-1.5, that of random ones with n^-1 (Mitchell 1996).

Importing this module needs an active Mitsuba variant (`rsgen.device.backend.mitsuba()`).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import qmc

from rsgen.device.arrays import aligned

_BITS = 32
# Multipliers of the hash that scrambles a number's bits from the lowest up: N. Vegdahl's, after Laine and Karras,
# "Stratified Sampling for Stochastic Transparency" (2011); see Burley, "Practical Hash-based Owen Scrambling" (2020).
_MULTIPLIERS = (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6)


class PixelSamples:
    """Samples 0..count-1 of any pixel, in so many dimensions."""

    def __init__(self, count: int, dimensions: int) -> None:
        points = qmc.Sobol(dimensions, scramble=False, bits=_BITS).random_base2(max(0, (count - 1).bit_length()))
        bits = np.ldexp(points, _BITS).astype(np.uint32)
        self.table = [mi.UInt32(aligned(_reversed(column), np.uint32)) for column in bits.T]

    def at(self, sample: Any, pixel: Any, key: Any, first: int, dimensions: int) -> list[Any]:
        """Uniform numbers (Float) of samples of pixels, both UInt32: `dimensions` from `first` on; key: UInt32."""
        numbers = []
        for k in range(first, first + dimensions):
            bits = dr.gather(mi.UInt32, self.table[k], sample) + mi.sample_tea_32(pixel, key + k, 4)[0]
            for multiplier in _MULTIPLIERS:
                bits ^= bits * multiplier
            numbers.append(mi.Float(dr.brev(bits) >> 8) * 2.0**-24)
        return numbers


def _reversed(bits: Any) -> Any:
    """uint32 (n,) with their bits in the opposite order."""
    as_bits = np.unpackbits(bits.astype("<u4").view(np.uint8).reshape(-1, 4), axis=1, bitorder="little")
    return np.packbits(as_bits[:, ::-1], axis=1, bitorder="little").view("<u4")[:, 0]
