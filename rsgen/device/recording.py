"""Kernels that are traced once and replayed: `drjit.freeze`, made safe against Python's garbage collector.

While Dr.Jit records, it cannot release an array that was made from a NumPy array, nor a Mitsuba scene: a destructor
throws, and that ends the process ("enqueue_host_func(): this function cannot be recorded"). Objects in reference
cycles, such as the locals of a traceback, are released by the garbage collector at any moment; so it waits meanwhile.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import wraps
from typing import Any

import drjit as dr


def recorded(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of Dr.Jit arrays, traced on its first call with arguments of a kind and replayed on the others."""
    frozen = dr.freeze(function)

    @wraps(function)
    def call(*args: Any) -> Any:
        collecting = gc.isenabled()
        gc.disable()
        try:
            return frozen(*args)
        finally:
            if collecting:
                gc.enable()

    return call
