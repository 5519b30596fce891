"""When a keyframe is left behind: how much of it is still seen."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from rstrack.options import Options
from rstrack.tracking.succession import Succession


def seen(keyframe: int, pixels: int) -> Any:
    lin, ref = SimpleNamespace(count=pixels), SimpleNamespace(index=keyframe)
    return [SimpleNamespace(is_linearised=True, lin=lin, pixels=pixels, ref=ref)]


def test_who_comes_back_to_a_keyframe_may_see_half_of_it() -> None:
    """Regression: all that a lost frame saw where it was found again counted as the whole keyframe.

    None was made then, however little was left of it.
    """
    nothing = cast(Any, None)
    store = cast(Any, SimpleNamespace(use=lambda found: None))
    succession = Succession(nothing, store, Options(), nothing, nothing)
    assert [succession.overlap(seen(3, n)) for n in (800, 1000, 600)] == [1.0, 1.0, 0.6]
    succession._refer_to(cast(Any, SimpleNamespace(index=7)))
    assert [succession.overlap(seen(7, n)) for n in (500, 400)] == [1.0, pytest.approx(0.8)]
    succession.use(cast(Any, SimpleNamespace(index=3)), nothing)
    assert succession.overlap(seen(3, 500)) == 0.5
    # One that is made again of the same frame, rectified, is another.
    succession._refer_to(cast(Any, SimpleNamespace(index=3)))
    assert succession.overlap(seen(3, 500)) == 1.0
    assert succession.overlap([SimpleNamespace(is_linearised=False)]) == 0.0  # type: ignore[list-item]
