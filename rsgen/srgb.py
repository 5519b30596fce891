"""The sRGB tone curve (IEC 61966-2-1), both ways, in the width of what it is given, and the PSNR of noisy pictures."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Width = TypeVar("Width", bound=np.floating[Any])
Picture = npt.NDArray[np.float64]

_LEAST_ERROR = 1e-6  # squared: less than that cannot be distinguished from none
_SURE = 2.0  # standard errors


def encode(linear: npt.NDArray[Width]) -> npt.NDArray[Width]:
    """sRGB in [0, 1] of linear values in [0, 1]; any shape."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decode(encoded: npt.NDArray[Width]) -> npt.NDArray[Width]:
    """Linear values in [0, 1] of sRGB in [0, 1]; any shape."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def psnr_without_noise(ours: tuple[Picture, Picture], theirs: tuple[Picture, Picture]) -> tuple[float, float]:
    """PSNR in dB between two noisy pictures (..., 3) in 0..1, and what it is at least, two standard errors.

    Of each there are two, of samples that are independent of each other: noise has no part in products of differences
    that share none of them, on average.
    """
    (first, second), (one, other) = ours, theirs
    square = ((first - one) * (second - other) + (second - one) * (first - other)).mean(axis=-1) / 2
    error, unsure = max(float(square.mean()), 0.0), float(square.std()) / square.size**0.5
    psnr, least = (float(-10 * np.log10(max(e, _LEAST_ERROR))) for e in (error, error + _SURE * unsure))
    return psnr, least
