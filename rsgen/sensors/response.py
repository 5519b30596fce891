"""From linear light to 8 bit: the tone curves of cameras and displays."""

from __future__ import annotations

import numpy as np

from rsgen import srgb
from rsgen.array_types import ByteArray, Float32Array


def to_srgb8(linear: Float32Array, gain: float = 1.0) -> ByteArray:
    """8-bit sRGB (IEC 61966-2-1) of linear values times `gain`, clipped to [0, 1]; any shape."""
    return quantise8(srgb.encode(np.clip(linear * np.float32(gain), 0, 1)))


def power_law(x: Float32Array, gamma: float) -> Float32Array:
    """x^(1/gamma) of linear values in [0, 1]; any shape."""
    return np.power(x, np.float32(1 / gamma))


def s_curve(y: Float32Array, contrast: float) -> Float32Array:
    """(1 − c) y + c (3y² − 2y³) of encoded values in [0, 1]; any shape.

    Keeps black, white and the middle; its slope in the middle is 1 + c/2. A stand-in for the contrast that cameras add
    to their response (Grossberg, Nayar, Modeling the Space of Camera Response Functions, PAMI 2004, shows real ones).
    """
    c = np.float32(contrast)
    return y * ((1 - c) + c * y * (3 - 2 * y))


def quantise8(y: Float32Array) -> ByteArray:
    """8-bit code of encoded values in [0, 1], rounded to the nearest; any shape."""
    return np.rint(255 * y).astype(np.uint8)
