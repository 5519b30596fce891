"""Numbers that kernels are handed instead of having them compiled in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import pytest
from rstrack_util import ENGINE

from rsgen.device.arrays import Numbers, quotient, recorded_with


@dataclass(frozen=True)
class Line(Numbers):
    COMPILED = ("is_falling",)

    slope: float
    first: int
    is_falling: bool


@dataclass(frozen=True)
class Input:
    x: Any


def kernel_of(line: Line) -> Any:
    @recorded_with(ENGINE, Input, line)
    def kernel(given: Input, line: Line) -> Any:
        assert not isinstance(line.slope, float) and not isinstance(line.first, int)
        on = ENGINE.Float(dr.arange(ENGINE.UInt, dr.width(given.x)) + line.first) * line.slope
        return given.x - on if line.is_falling else given.x + on

    return kernel


def test_a_kernel_computes_with_the_numbers_that_it_is_handed() -> None:
    x = ENGINE.upload(np.arange(5))
    hashes = []
    for line in (Line(2.0, 3, False), Line(-0.5, 7, False), Line(2.0, 3, True)):
        kernel = kernel_of(line)
        sign = -1.0 if line.is_falling else 1.0
        for _ in range(2):  # traced, and replayed
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                dr.kernel_history_clear()
                got = kernel(Input(x)).numpy()
                hashes.append({entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])})
            np.testing.assert_array_equal(got, np.arange(5) + sign * (np.arange(5) + line.first) * line.slope)
    assert hashes[0] == hashes[1] == hashes[2] == hashes[3] != hashes[4] == hashes[5]


@pytest.mark.parametrize("by", [1, 3, 7, 160, 641, 1920, 3840, 4_000_000])
def test_quotients_are_exact(by: int) -> None:
    most = 4_000_000
    rng = np.random.default_rng(by)
    edges = np.arange(0, most, by)[:2000]
    number = np.unique(np.concatenate([rng.integers(0, most, 5000), edges, np.maximum(edges, 1) - 1]))
    at = ENGINE.UInt(number.astype(np.uint32))
    for one in (by, dr.opaque(ENGINE.UInt, by)):
        np.testing.assert_array_equal(quotient(at, one).numpy(), number // by)
