"""The sRGB tone curve (IEC 61966-2-1), both ways, in the width of what it is given."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Width = TypeVar("Width", bound=np.floating[Any])


def encode(linear: npt.NDArray[Width]) -> npt.NDArray[Width]:
    """sRGB in [0, 1] of linear values in [0, 1]; any shape."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decode(encoded: npt.NDArray[Width]) -> npt.NDArray[Width]:
    """Linear values in [0, 1] of sRGB in [0, 1]; any shape."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
