"""Single wild readings of an IMU, as a bus that drops a bit leaves them."""

from __future__ import annotations

import numpy as np

from rsgen.array_types import BoolArray, FloatArray

# A reading is wild that stands out from between its neighbours by so many σ of the noise, and so many times as far as
# the four around it differ: motion that sudden would show in these, too.
_SIGMAS, _TIMES = 20.0, 3.0


def wild(values: FloatArray, sigma: float) -> BoolArray:
    """Which readings (n, 3), even ones, of noise sigma are. The first and the last two are not looked at, nor what is
    beside no number."""
    found = np.zeros(values.shape, dtype=bool)
    if len(values) < 5:
        return found
    a, b, x, c, d = (values[i : len(values) - 4 + i] for i in range(5))
    usual = np.abs(b - a) + np.abs(c - b) + np.abs(d - c)
    found[2:-2] = np.abs(x - 0.5 * (b + c)) > _SIGMAS * sigma + _TIMES * usual
    return found
