"""The fixed pattern of a depth camera's error: a smooth map of inverse depth over the image, the same in each.

It is what a maker's calibration of lens, projector and baseline leaves, about a tenth of a pixel of disparity (Herrera
C. et al., PAMI 2012; Teichman et al., RSS 2013). Here it is a polynomial of the pixel.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from rsgen.array_types import Float32Array, FloatArray

_DEGREE = 6
_POWERS = tuple((i, n - i) for n in range(1, _DEGREE + 1) for i in range(n, -1, -1))
PATTERN_SIZE = len(_POWERS)
"""Coefficients of a pattern (27): products of Legendre polynomials of x and of y, of degrees 1 to 6 together.

Without a constant: one of all images alike is an error of depth's scale, which images do not show.
"""

MEAN_SQUARES = np.array([1.0 / ((2 * i + 1) * (2 * j + 1)) for i, j in _POWERS])
"""Of the polynomials (27,) over an image; any two of them are orthogonal there."""


def pattern_basis(uv: npt.ArrayLike, width: int, height: int) -> FloatArray:
    """The polynomials (n, 27) at pixels (n, 2); the middles of the outermost pixels of an image are at ± 1."""
    x, y = (2.0 * np.asarray(uv, np.float64) / (width - 1, height - 1) - 1.0).T
    of_x, of_y = legendre.legvander(x, _DEGREE), legendre.legvander(y, _DEGREE)
    return np.stack([of_x[:, i] * of_y[:, j] for i, j in _POWERS], axis=-1)


@lru_cache(maxsize=4)
def pattern_image(pattern: tuple[float, ...], width: int, height: int) -> Float32Array:
    """What is to be added to the inverse depth (h, w) of an image, 1/m."""
    v, u = np.mgrid[:height, :width]
    basis = pattern_basis(np.stack([u.ravel(), v.ravel()], axis=-1), width, height)
    return np.asarray(basis @ np.array(pattern), np.float32).reshape(height, width)
