"""Which of many like cases every run of the tests has: the others are for `pytest -m nightly`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def sampled(cases: Iterable[Any], every: int) -> list[Any]:
    """Arguments for `parametrize`: of each `every` cases the first, and the others marked `nightly`."""
    return [case if k % every == 0 else _late(case) for k, case in enumerate(cases)]


def _late(case: Any) -> Any:
    return pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.nightly)


QUICK_OR_ALL = [True, pytest.param(False, marks=pytest.mark.nightly)]
"""Arguments for a fixture or test that makes its cases itself: a few of them, or all."""
