"""The per-pixel engine: Dr.Jit's array types of one backend, and moving arrays between it and NumPy.

The same kernels run on `llvm` (CPU) and `cuda`. Sums over pixels are kept in 32-bit integers (fixed point): integer
addition does not depend on the order in which threads arrive, so a run gives the same bits every time and the two
backends differ only by the rounding of single pixels.

Kernels are traced once and replayed (`drjit.freeze`). While Dr.Jit records, it cannot release an array that was made
from a NumPy array, nor a Mitsuba scene: a destructor throws, and that ends the process ("enqueue_host_func(): this
function cannot be recorded"). The garbage collector may release objects in reference cycles, such as the locals of a
traceback, at any moment, so it is off meanwhile.
"""

from __future__ import annotations

import gc
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, wraps
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import numpy.typing as npt

from rsgen.device.backend import VARIANTS, Backend, select

# Dr.Jit keys recorded kernels on the alignment of the buffers it is handed.
_ALIGNMENT = 64
Inputs = TypeVar("Inputs")


def aligned(array: npt.ArrayLike, dtype: npt.DTypeLike = np.float32) -> npt.NDArray[Any]:
    """Flat copy of `array`, of a type of four bytes, whose buffer begins where Dr.Jit likes it: else kernels are
    compiled anew, for every combination of arguments that do and that do not."""
    source = np.asarray(array)
    raw: npt.NDArray[Any] = np.empty(source.size + _ALIGNMENT // 4, dtype)
    start = (-raw.ctypes.data % _ALIGNMENT) // 4
    copy = raw[start : start + source.size]
    copy.reshape(source.shape)[...] = source
    return copy


def vectors(kind: Any, rows: npt.ArrayLike) -> Any:
    """Rows (n, k) on the device, as Dr.Jit's `kind` of k floats each."""
    import drjit as dr

    return kind(*(dr.value_t(kind)(aligned(column)) for column in np.asarray(rows).T))


def rows_of(vector: Any) -> npt.NDArray[Any]:
    """Rows (n, k) of a device vector of k components, computed first and fetched one by one.

    Dr.Jit itself would lay them out in one array by a kernel that is compiled anew for every n.
    """
    import drjit as dr

    dr.eval(vector)
    return np.stack(np.broadcast_arrays(*(np.array(component) for component in vector)), axis=-1)


@dataclass(frozen=True)
class Engine:
    """Array types of one Dr.Jit backend."""

    backend: str
    Float: Any
    UInt: Any
    Int: Any
    Bool: Any

    def upload(self, array: npt.ArrayLike) -> Any:
        """Flat float32 copy of `array` on the device."""
        return self.Float(aligned(array))

    def download(self, array: Any, shape: tuple[int, ...]) -> npt.NDArray[Any]:
        """NumPy copy of a device array."""
        return np.array(array.numpy().reshape(shape))


@dataclass(frozen=True)
class Kernels:
    """Kernels that have been made, so that each is compiled once: kernels(make, *what) is make(e, *what)."""

    e: Engine
    _made: dict[Any, Any] = field(default_factory=dict)

    def __call__(self, make: Callable[..., Callable[..., Any]], *what: Any) -> Callable[..., Any]:
        """The kernel, made now if it has not been."""
        if (make, *what) not in self._made:
            self._made[make, *what] = make(self.e, *what)
        kernel: Callable[..., Any] = self._made[make, *what]
        return kernel


@cache
def engine(backend: Backend = "auto") -> Engine:
    """The engine of a backend; `auto` takes CUDA where a device answers. Raises UserError if it cannot work here."""
    variant = select(backend)
    name = next(key for key, value in VARIANTS.items() if value == variant)
    module = importlib.import_module(f"drjit.{name}")
    return Engine(name, module.Float, module.UInt, module.Int, module.Bool)


class Numbers:
    """Base of dataclasses whose numbers are arguments of kernels, not constants: other values need no other kernel.

    COMPILED: names of the fields that are constants all the same.
    """

    COMPILED: ClassVar[tuple[str, ...]] = ()

    def _names(self) -> list[str]:
        return [field.name for field in fields(self) if field.name not in self.COMPILED]  # type: ignore[arg-type]

    @property
    def numbers(self) -> list[float]:
        """All others, in order; whole numbers stay whole on the device."""
        return [getattr(self, name) for name in self._names()]

    def traced(self, numbers: Sequence[Any]) -> Self:
        """The same with the device's `numbers`, for the function that becomes the kernel."""
        return replace(self, **dict(zip(self._names(), numbers, strict=True)))  # type: ignore[type-var]


def recorded_with(
    e: Engine, inputs: type[Inputs], *what: Numbers
) -> Callable[[Callable[..., Any]], Callable[[Inputs], Any]]:  # fmt: skip
    """`recorded` for a function of a dataclass of arrays and of `what`, which has the device's numbers then.

    The arrays are handed over one by one: `drjit.freeze` takes 50 µs to look into a dataclass.
    """
    names = [field.name for field in fields(inputs)]  # type: ignore[arg-type]
    counts = [len(one.numbers) for one in what]
    numbers = [_handed(e, number) for one in what for number in one.numbers]

    def decorate(function: Callable[..., Any]) -> Callable[[Inputs], Any]:
        def of_arrays(*arrays: Any) -> Any:
            given, rest = inputs(*arrays[: len(names)]), list(arrays[len(names) :])
            traced = []
            for one, count in zip(what, counts, strict=True):
                traced.append(one.traced(rest[:count]))
                del rest[:count]
            return function(given, *traced)

        # What a recorded function refers to is looked through at every call: nothing but a function costs nothing.
        frozen = recorded(lambda *arrays: of_arrays(*arrays))
        return lambda given: frozen(*(getattr(given, name) for name in names), *numbers)

    return decorate


def _handed(e: Engine, number: float) -> Any:
    return e.UInt(aligned([number], np.uint32)) if isinstance(number, int) else e.upload(number)


def quotient(number: Any, by: Any) -> Any:
    """number // by, exact for whole numbers below four million.

    The device divides integers by constants in one go, and one by one by an argument of the kernel.
    """
    import drjit as dr

    if isinstance(by, int):
        return number // by
    Float = dr.float32_array_t(number)
    return type(number)((Float(number) + 0.5) * dr.rcp(Float(by)))


def recorded(function: Callable[..., Any], state: Callable[..., Any] | None = None) -> Callable[..., Any]:
    """`function` of Dr.Jit arrays, traced on its first call with arguments of a kind and replayed on the others.

    state: of the same arguments, what else on the device it depends on.
    """
    import drjit as dr

    frozen = dr.freeze(function, state_fn=state)

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
