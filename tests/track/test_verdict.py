"""Second thoughts about a frame whose depth and colours do not agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_lost_track import pulled_before, term

from rstrack.alignment.optimizer import Solved
from rstrack.alignment.pull import Pulls
from rstrack.tracking.judgement import verdict as module
from rstrack.tracking.judgement.fault import Fault
from rstrack.tracking.judgement.verdict import verdict

# As before a wall with a notice board: depth pulls by a metre, colours know to 7 mm, and are drawn away by 30.
TORN = Pulls(7e-3, 0.94, 0.03, (2.3, 26.0, 5.5), depth_spread=0.036, color_spread=7e-3)
CALM = Pulls(4e-3, 0.9, 3e-3, (1.5, 1.0, 1.0), depth_spread=0.9, color_spread=7e-3)


@pytest.mark.parametrize(
    ("first", "then", "says"),
    [
        (TORN, CALM, Fault.NONE),
        (TORN, replace(CALM, whole=0.05, sigmas=(9.0, 1.0, 9.0), color=0.05), Fault.DIVIDED),
        (replace(TORN, color_spread=0.016), None, Fault.DIVIDED),
        (replace(TORN, depth_spread=6e-3), None, Fault.DIVIDED),
        (replace(TORN, color=float("nan"), color_spread=np.inf), None, Fault.PULLED),
        (CALM, None, Fault.NONE),
    ],
)
def test_depth_yields_to_colours_that_tell_the_motion(
    monkeypatch: pytest.MonkeyPatch, first: Pulls, then: Pulls | None, says: Fault
) -> None:
    depth, color = term("depth", 1e-3), term("color", 1e-3)
    answers, solved = [first, then], []
    monkeypatch.setattr(module, "pulls", lambda *_: answers.pop(0))

    def again() -> Solved:
        solved.append((depth.independent, color.independent))
        return Solved(last_shift=0.01)

    before = Solved(last_shift=0.02)
    fault, pulled, after = verdict(pulled_before(), [depth, color], before, None, 5000, True, False, again)  # type: ignore[arg-type]
    assert fault is says
    if then is None:
        assert not solved and pulled is first and after is before and depth.independent == color.independent
    else:
        assert solved == [(pytest.approx(0.5 / 26.0**2), 0.5)] and pulled is then and after.last_shift == 0.01
