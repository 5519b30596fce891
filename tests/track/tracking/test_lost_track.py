"""Every reason for which a frame counts as lost."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsgen.geometry import se3
from rstrack.alignment.optimizer import Solved
from rstrack.tracking.frame_report import Fault
from rstrack.tracking.judgement.lost_track import RunningScales, implausible, is_hopeless, is_settled, lost, misfits

NOTHING, UNSETTLED = Fault.NOTHING_SEEN, Fault.UNSETTLED


def term(
    kind: str, sigma: float, count: int = 5000, fit: float = 1.0, distance: float = 1.0, contrast: float = np.inf
) -> Any:  # fmt: skip
    """An observation of a linearised image: its scale, pixels, part that fits, how far away (m) what it shows is, and
    what colours are expected to differ by."""
    lin = SimpleNamespace(count=count, next_sigma=sigma, fit=fit, contrast=contrast)
    ref = SimpleNamespace(median_depth=distance)
    return SimpleNamespace(is_depth=kind == "depth", is_linearised=True, lin=lin, pixels=count, ref=ref)


def fault(terms: Iterable[Any], shift: float = 0.05, expected: int = 5000) -> str:
    return lost(list(terms), Solved(last_shift=shift), expected)


def test_colours_that_differ_from_the_keyframe_by_more_than_it_shows_are_another_places() -> None:
    assert fault([term("depth", 3e-3), term("color", 0.10, contrast=0.11)]) == ""
    assert fault([term("depth", 3e-3), term("color", 0.10, contrast=0.09)]) == Fault.MISFIT
    # A plain wall shows less than the camera's noise, and is the same place all the same.
    assert fault([term("depth", 3e-3), term("color", 0.02, contrast=0.01)]) == ""


def test_a_frame_without_images_is_lost() -> None:
    assert fault([]) == NOTHING
    assert fault([SimpleNamespace(is_depth=True, is_linearised=False)]) == NOTHING
    assert fault([term("depth", 1e-3, 0)], shift=float("inf")) == NOTHING


@pytest.mark.parametrize(("expected", "least"), [(10, 1), (10_000, 800)])
@pytest.mark.parametrize("kind", ["depth", "color"])
def test_every_term_needs_8_percent_of_what_is_expected(kind: str, expected: int, least: int) -> None:
    good = term("color" if kind == "depth" else "depth", 1e-3, 10_000)
    assert fault([good, term(kind, 1e-3, least)], expected=expected) == ""
    assert fault([good, term(kind, 1e-3, least - 1)], expected=expected) == Fault.NOTHING_SEEN


@pytest.mark.parametrize(("kind", "least"), [("depth", 0.65), ("color", 0.8)])
def test_most_of_what_is_compared_has_to_fit(kind: str, least: float) -> None:
    assert fault([term(kind, 1e-3, fit=least)]) == ""
    bad, good = term(kind, 1e-3, fit=least - 0.001), term("depth", 1e-3)
    assert fault([bad]) == Fault.MISFIT and misfits([good, bad], 5000) == [(bad, Fault.MISFIT)]


def test_rows_that_still_move_by_more_than_two_pixels_have_not_been_found() -> None:
    assert fault([term("depth", 1e-3)], shift=2.0) == ""
    assert fault([term("depth", 1e-3)], shift=2.001) == UNSETTLED
    assert fault([term("depth", 1e-3)], shift=float("inf")) == UNSETTLED
    assert is_settled(Solved(last_shift=2.1, is_within_noise=True)), "noise ended it"
    assert not is_settled(Solved(last_shift=2.1, is_cut=True)), "it may be anywhere"


def test_a_coarse_level_is_hopeless_where_neither_term_fits() -> None:
    bad, good = term("depth", 1e-3, fit=0.64), term("color", 1e-3, fit=0.81)
    assert is_hopeless([bad]) and is_hopeless([]) and not is_hopeless([bad, good])
    assert is_hopeless([bad, term("color", 1e-3, fit=0.79)])
    # Not where as much as is missing may be left out yet, since it moves.
    assert not is_hopeless([term("depth", 1e-3, fit=0.4)], moving=0.4)
    assert is_hopeless([term("depth", 1e-3, fit=0.4)], moving=0.3)
    assert is_hopeless([SimpleNamespace(is_linearised=False)])  # type: ignore[list-item]


@pytest.mark.parametrize(("axis", "limit"), [(0, 0.15), (2, 0.15), (4, np.radians(4.0) + 0.2)])
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_no_hand_moves_so_fast(axis: int, limit: float, share: float) -> None:
    dt = np.sqrt(1e-3)
    T = se3.exp(np.array([0.3, -0.2, 0.1, 0.5, 0.4, -0.3]))
    assert implausible(T, T @ se3.exp(share * limit * np.eye(6)[axis]), dt) == (share > 1.0)


def after(kind: str, sigmas: Iterable[float]) -> RunningScales:
    """With frames of such scales behind it."""
    scales = RunningScales()
    for sigma in sigmas:
        scales.learn([term(kind, sigma)])
    return scales


@pytest.mark.parametrize(
    ("kind", "median", "limit"),
    [("depth", 2e-3, 7e-3), ("depth", 1e-4, 2e-3), ("color", 0.01, 0.035), ("color", 1e-3, 0.03)],
)
def test_where_a_segment_begins_images_have_to_fit_nearly_as_before(kind: str, median: float, limit: float) -> None:
    before, other = after(kind, [median] * 3), term("color" if kind == "depth" else "depth", 0.5)
    assert not before.exceeded([other, term(kind, 0.99 * limit)]), "no scale is known of the other one"
    odd = term(kind, 1.01 * limit)
    assert before.exceeded([other, odd]) == [odd]


def test_scales_are_medians_of_the_last_thirty_good_frames_depth_s_at_one_metre() -> None:
    scales = after("depth", [1e-3] * 16 + [2e-3] * 15)
    for sigma, is_more in ((5.2e-3, False), (5.3e-3, True)):
        assert bool(scales.exceeded([term("depth", sigma)])) is is_more
        assert bool(scales.exceeded([term("depth", 4.0 * sigma, distance=2.0)])) is is_more
    scales.reset()  # a start that failed
    assert not scales.exceeded([term("depth", 1e-2)])
