"""Kernels that are traced once and replayed: `drjit.freeze`, made safe against Python's garbage collector.

While Dr.Jit records, it cannot release an array that was made from a NumPy array, nor a Mitsuba scene: a destructor
throws, and that ends the process ("enqueue_host_func(): this function cannot be recorded"). Objects in reference
cycles, such as the locals of a traceback, are released by the garbage collector at any moment; so it waits meanwhile.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from typing import Any, TypeVar

import drjit as dr

Inputs = TypeVar("Inputs")


def recorded_from(inputs: type[Inputs]) -> Callable[[Callable[[Inputs], Any]], Callable[[Inputs], Any]]:
    """`recorded` for a function whose one argument is a dataclass of Dr.Jit arrays: named, not in an order to remember.

    The arrays are handed over one by one: `drjit.freeze` takes 50 µs to look into a dataclass.
    """
    names = [field.name for field in fields(inputs)]  # type: ignore[arg-type]

    def decorate(function: Callable[[Inputs], Any]) -> Callable[[Inputs], Any]:
        frozen = recorded(lambda *arrays: function(inputs(*arrays)))
        return lambda given: frozen(*(getattr(given, name) for name in names))

    return decorate


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
