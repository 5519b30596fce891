"""Compiled functions: loops over a few numbers, or over rows of pixels on the host, that NumPy's calls cost more than.

Numba compiles a function when a machine first calls it, in a second or so, and stores it beside its file.
"""

from __future__ import annotations

from typing import Any

import numba


def compiled(function: Any) -> Any:
    """A function of numbers, tuples and arrays, compiled; divisions by zero give what NumPy's do."""
    try:
        return numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # there is no folder to store it in
        return numba.njit(error_model="numpy")(function)
