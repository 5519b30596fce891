"""Every reason for which a frame counts as lost, and each limit from both sides."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsgen.geometry import se3
from rstrack.alignment.optimizer import Solved
from rstrack.alignment.pull import Pulls
from rstrack.tracking.judgement.fault import Fault
from rstrack.tracking.judgement.lost_track import FitHistory, implausible, is_settled

NOTHING, UNSETTLED = Fault.NOTHING_SEEN, Fault.UNSETTLED


def term(
    kind: str, sigma: float, count: int = 5000, floor: float = 0.0, fit: float = 1.0, distance: float = 1.0,
    observability: float = 1.0, fx: float = 500.0, inflation: float = 1.0, contrast: float = np.inf,
) -> Any:  # fmt: skip
    """An observation of a linearised image: its scale, pixels, smallest credible scale, part that fits, how far away
    (m) what it shows is, how well it tells all motions, the reference's focal length (px), how many of its pixels
    tell as much as one (usually two), and what colours are expected to differ by."""
    lin = SimpleNamespace(count=count, next_sigma=sigma, floor=floor, fit=fit, observability=observability)
    lin.contrast = contrast
    lens = SimpleNamespace(camera=SimpleNamespace(fx=fx))
    ref = SimpleNamespace(median_depth=distance, lens=lens)
    o = SimpleNamespace(
        is_depth=kind == "depth", is_linearised=True, lin=lin, pixels=count, ref=ref, inflation=inflation,
        independent=0.5,
    )  # fmt: skip
    o.count_as = lambda independent: setattr(o, "independent", independent)
    return o


def fault(
    history: FitHistory, terms: Iterable[Any], shift: float = 0.05, expected: int = 5000, pulled: Pulls | None = None,
    new: bool = False, colorless: bool = False,
) -> str:  # fmt: skip
    return history.fault(list(terms), Solved(last_shift=shift), expected, pulled, new, colorless)


def test_errors_of_depth_may_grow_with_the_square_of_the_distance() -> None:
    history = FitHistory()
    for _ in range(5):
        assert fault(history, [term("depth", 3e-3)]) == ""
    assert fault(history, [term("depth", 0.015)]) == ""
    assert fault(history, [term("depth", 0.02)]) == Fault.MISFIT
    assert fault(history, [term("depth", 0.06, distance=3.0)]) == ""
    assert fault(history, [term("depth", 0.10, distance=3.0)]) == Fault.MISFIT  # three times what is worst at a metre


def test_colours_that_differ_from_the_keyframe_by_more_than_it_shows_are_another_places() -> None:
    history = FitHistory()
    assert fault(history, [term("depth", 3e-3), term("color", 0.10, contrast=0.11)]) == ""
    assert fault(history, [term("depth", 3e-3), term("color", 0.10, contrast=0.09)]) == Fault.MISFIT
    # A plain wall shows less than the camera's noise, and is the same place all the same.
    assert fault(history, [term("depth", 3e-3), term("color", 0.02, contrast=0.01)]) == ""


def after(kind: str, sigmas: Iterable[float]) -> FitHistory:
    """With frames of such scales behind it."""
    history = FitHistory()
    for sigma in sigmas:
        assert fault(history, [term(kind, sigma)]) == ""
    return history


def test_a_frame_without_images_is_lost() -> None:
    assert fault(FitHistory(), []) == NOTHING
    assert fault(FitHistory(), [SimpleNamespace(is_depth=True, is_linearised=False)]) == NOTHING


@pytest.mark.parametrize(("expected", "least"), [(0, 60), (750, 60), (10_000, 800), (76_800, 6144)])
@pytest.mark.parametrize("kind", ["depth", "color"])
def test_every_term_needs_60_pixels_and_8_percent_of_what_is_expected(kind: str, expected: int, least: int) -> None:
    good = term("color" if kind == "depth" else "depth", 1e-3, 10_000)
    assert fault(FitHistory(), [good, term(kind, 1e-3, least)], expected=expected) == ""
    assert fault(FitHistory(), [good, term(kind, 1e-3, least - 1)], expected=expected) == Fault.NOTHING_SEEN


@pytest.mark.parametrize(("kind", "least"), [("depth", 0.65), ("color", 0.8)])
def test_most_of_what_is_compared_has_to_fit(kind: str, least: float) -> None:
    assert fault(FitHistory(), [term(kind, 1e-3, fit=least)]) == ""
    assert fault(FitHistory(), [term(kind, 1e-3, fit=least - 0.001)]) == Fault.MISFIT


def test_lines_that_still_move_by_more_than_two_pixels_have_not_been_found() -> None:
    assert fault(FitHistory(), [term("depth", 1e-3)], shift=2.0) == ""
    assert fault(FitHistory(), [term("depth", 1e-3)], shift=2.001) == UNSETTLED
    assert fault(FitHistory(), [term("depth", 1e-3)], shift=float("inf")) == UNSETTLED


@pytest.mark.parametrize(
    ("kind", "usual", "limit"),
    [
        ("depth", None, 0.03),  # nothing to compare with: what no aligned images have
        ("depth", 0.02, 0.03),  # nor after frames that fit badly
        ("depth", 1e-3, 6e-3),  # six times the usual
        ("depth", 1e-4, 2e-3),  # but two millimetres are always fine
        ("color", None, 0.12),
        ("color", 0.1, 0.12),
        ("color", 0.01, 0.06),
        ("color", 0.001, 0.03),
    ],
)
def test_errors_are_compared_with_those_of_frames_before(kind: str, usual: float | None, limit: float) -> None:
    before = [] if usual is None else [usual] * 3
    assert fault(after(kind, before), [term(kind, 0.999 * limit)]) == ""
    assert fault(after(kind, before), [term(kind, 1.001 * limit)]) == Fault.MISFIT
    # The other term does not make up for it.
    good = term("color" if kind == "depth" else "depth", 1e-4)
    for terms in ((good, term(kind, 1.001 * limit)), (term(kind, 1.001 * limit), good)):
        assert fault(after(kind, before), terms) == Fault.MISFIT


def test_a_camera_that_repeats_its_rounding_may_err_by_two_and_a_half_times_that() -> None:
    # At rest its errors are far smaller than the rounding of its depth, of 4 mm here.
    for sigma, says in ((0.0099, ""), (0.0101, Fault.MISFIT)):
        assert fault(after("depth", [1e-4] * 5), [term("depth", sigma, floor=4e-3)]) == says
    # Not beyond what no aligned images have.
    assert fault(FitHistory(), [term("depth", 0.0301, floor=0.02)]) == Fault.MISFIT


def test_the_usual_is_the_median_of_the_last_thirty_good_frames() -> None:
    history = after("depth", [1e-3] * 7 + [5e-3] * 4)
    assert fault(history, [term("depth", 6.1e-3)]) == Fault.MISFIT and fault(history, [term("depth", 5.9e-3)]) == ""
    # Half of the last thirty are of one kind, half of the other: one more or less, and either would be the median.
    for sigma, says in ((8.9e-3, ""), (9.1e-3, Fault.MISFIT)):
        assert fault(after("depth", [1e-3] * 16 + [2e-3] * 15), [term("depth", sigma)]) == says


def test_bad_does_not_become_usual() -> None:
    # Each step is allowed by the one before; twice the best that was usual is as far as it goes.
    history = after("depth", [1e-3] * 30 + [2.5e-3] * 30 + [6e-3] * 40)
    assert fault(history, [term("depth", 11.9e-3)]) == "" and fault(history, [term("depth", 12.1e-3)]) == Fault.MISFIT


def test_lost_frames_are_not_what_is_usual() -> None:
    history = after("depth", [1e-3] * 3)
    for _ in range(50):
        assert fault(history, [term("depth", 7e-3)]) == Fault.MISFIT
        # Neither are those whose colour did not fit, or that did not settle.
        assert fault(history, [term("depth", 5e-3), term("color", 0.2)]) == Fault.MISFIT
        assert fault(history, [term("depth", 5e-3)], shift=3.0) == UNSETTLED
    assert fault(history, [term("depth", 6.1e-3)]) == Fault.MISFIT


def test_nothing_is_usual_of_a_start_that_failed() -> None:
    """Regression: a Kinect at rest repeats its steps. When it moved depth fitted ten times worse, and no start was good
    enough ever after."""
    history = after("depth", [1e-3] * 15)
    assert fault(history, [term("depth", 1e-2)]) == Fault.MISFIT
    history.forget()
    assert fault(history, [term("depth", 1e-2)]) == ""


def test_depth_and_colour_are_remembered_apart() -> None:
    history = FitHistory()
    for _ in range(5):
        assert fault(history, [term("depth", 1e-3), term("color", 0.015)]) == ""
    assert fault(history, [term("depth", 1e-3), term("color", 0.089)]) == ""
    assert fault(history, [term("depth", 1e-3), term("color", 0.091)]) == Fault.MISFIT
    assert fault(history, [term("depth", 6.1e-3), term("color", 0.015)]) == Fault.MISFIT


def test_both_terms_may_not_fit_badly_at_once() -> None:
    """Limits of 0.03 m and 0.12 to begin with, of which each alone may reach all, and both 0.45 in geometric mean.

    Where a piece begins; elsewhere a wrong pose shows in its innovation.
    """
    for depth, color, says in (
        (0.44, 0.45, ""),
        (0.46, 0.45, Fault.MISFIT),
        (0.2, 1.0, ""),
        (0.21, 1.0, Fault.MISFIT),
    ):
        assert fault(FitHistory(), [term("depth", 0.03 * depth), term("color", 0.12 * color)], new=True) == says
    assert fault(FitHistory(), [term("depth", 0.03)]) == fault(FitHistory(), [term("color", 0.12)]) == ""


@pytest.mark.parametrize(("fx", "limit"), [(500.0, 5e-3), (240.0, 5e-3), (120.0, 1.25e-3)])
def test_depth_that_hardly_tells_a_motion_has_to_fit_as_usual(fx: float, limit: float) -> None:
    for observability, part, says in (
        (1.01 * limit, 1.0, ""),
        (0.99 * limit, 0.32, ""),
        (0.99 * limit, 0.34, Fault.MISFIT),
    ):
        seen = term("depth", 0.03 * part, observability=observability, fx=fx)
        assert fault(FitHistory(), [seen], new=True) == says
        assert fault(FitHistory(), [seen, term("color", 1e-3)], new=True) == ""  # colour tells the rest


def test_a_rolling_shutter_taken_for_a_global_one_may_make_both_fit_badly() -> None:
    for modelled, says in ((True, Fault.MISFIT), (False, "")):
        assert fault(FitHistory(modelled), [term("depth", 0.028), term("color", 0.11)], new=True) == says


def test_colours_that_were_left_out_speak_against_depth_that_fits_badly() -> None:
    for depth, says in ((0.33, ""), (0.34, Fault.MISFIT)):  # 0.45² / 0.6
        assert fault(FitHistory(), [term("depth", 0.03 * depth)], colorless=True, new=True) == says
        assert fault(FitHistory(), [term("depth", 0.03 * depth)], new=True) == ""


def test_all_misfits_are_named() -> None:
    bad, good = term("color", 0.5), term("depth", 1e-3)
    assert FitHistory().misfits([good, bad], 5000) == [(bad, Fault.MISFIT)]


@pytest.mark.parametrize(
    ("name", "usual", "limit"),
    [
        ("whole", 4e-3, 16e-3),
        ("whole", 1e-5, 6e-3),
        ("depth", 3e-3, 21e-3),
        ("color", 1e-4, 8e-3),
    ],
)
def test_where_a_piece_begins_images_that_pull_much_more_than_usual_are_elsewhere(
    name: str, usual: float, limit: float
) -> None:
    def pulled(metres: float, sigmas: float) -> Pulls:
        return Pulls(**({"whole": 0.0, "depth": 0.0, "color": 0.0} | {name: metres}), sigmas=(sigmas,) * 3)

    history, good = FitHistory(), [term("depth", 1e-3)]
    for k in range(10):
        assert fault(history, good, pulled=pulled(1.0 if k == 4 else usual, 2.0)) == ""
    for _ in range(20):
        assert fault(history, good, pulled=pulled(1.01 * limit, 50.0), new=True) is Fault.MOTION
    assert fault(history, good, pulled=pulled(0.99 * limit, 50.0), new=True) == ""
    # What is not there does not pull, and where it is not judged nothing is said or learnt.
    assert fault(history, good, pulled=pulled(float("nan"), 50.0), new=True) == fault(history, good, new=True) == ""
    assert fault(history, good, pulled=pulled(9.0, 50.0)) == "", "elsewhere its innovation is judged"


def pulled_before(frames: int = 10, sigmas: float = 1.0) -> FitHistory:
    """The usual at one metre: three millimetres each."""
    made = FitHistory()
    for _ in range(frames):
        assert fault(made, [term("depth", 1e-3)], pulled=Pulls(3e-3, 3e-3, 3e-3, (sigmas,) * 3)) == ""
    return made


@pytest.mark.parametrize(("usual", "limit"), [(1.0, 5.0), (3.0, 9.0)])
def test_pulls_within_noise_or_as_far_from_it_as_usual_are_none(usual: float, limit: float) -> None:
    for sigmas, says in ((0.98 * limit, ""), (1.02 * limit, Fault.MOTION)):
        pulled = Pulls(0.04, 3e-3, 3e-3, (sigmas,) * 3)
        assert fault(pulled_before(sigmas=usual), [term("depth", 1e-3)], pulled=pulled, new=True) == says


def test_pulls_of_what_is_far_away_may_be_larger() -> None:
    far = [term("depth", 1e-3, distance=3.0)]
    # Four times the usual at one metre, nine times that at three.
    for metres, says in ((0.107, ""), (0.109, Fault.MOTION)):
        assert fault(pulled_before(), far, pulled=Pulls(metres, 3e-3, 3e-3, (5.5,) * 3), new=True) == says
    # It is learnt as it would be at one metre.
    learnt, usual = pulled_before(), Pulls(4e-3, 3e-3, 3e-3, (1.0,) * 3)
    for _ in range(30):
        assert fault(learnt, far, pulled=usual.scaled(9.0)) == ""
    for factor, says in ((3.9, ""), (4.1, Fault.MOTION)):
        pulled = Pulls(factor * 4e-3, 3e-3, 3e-3, (5.5,) * 3)
        assert fault(learnt, [term("depth", 1e-3)], pulled=pulled, new=True) == says


@pytest.mark.parametrize(
    ("metres", "sigmas", "distance", "is_far"),
    [(0.07, 7.0, 1.0, True), (0.05, 50.0, 1.0, False), (0.9, 5.5, 1.0, False), (0.07, 7.0, 3.0, False)],
)
def test_whatever_is_usual_images_may_not_pull_by_so_much(
    metres: float, sigmas: float, distance: float, is_far: bool
) -> None:
    """Regression: a track by depth alone that began before a wall slid by metres without a word."""
    wall, slides = (
        [term("depth", 1e-3, distance=distance)],
        Pulls(metres, metres, float("nan"), (sigmas, sigmas, np.nan)),
    )
    assert fault(FitHistory(), wall, pulled=slides, new=True) == (Fault.MOTION if is_far else "")


def test_what_three_quarters_of_the_frames_do_not_show_does_not_become_usual() -> None:
    odd_one = Pulls(0.1, 3e-3, 3e-3, (4.9,) * 3)  # far, but within noise
    for share, says in ((21, Fault.MOTION), (23, "")):
        history = pulled_before(30 - share)
        for _ in range(share):
            assert fault(history, [term("depth", 1e-3)], pulled=odd_one) == ""
        assert fault(history, [term("depth", 1e-3)], pulled=Pulls(0.05, 3e-3, 3e-3, (15.0,) * 3), new=True) == says


def test_an_alignment_that_noise_ended_is_settled_however_far_its_last_step_went() -> None:
    assert not is_settled(Solved(last_shift=2.1)) and is_settled(Solved(last_shift=2.1, is_within_noise=True))


def test_a_coarse_level_is_hopeless_where_neither_term_fits() -> None:
    bad, good = term("depth", 1e-3, fit=0.64), term("color", 1e-3, fit=0.81)
    history = FitHistory()
    assert history.is_hopeless([bad]) and history.is_hopeless([]) and not history.is_hopeless([bad, good])
    assert history.is_hopeless([bad, term("color", 1e-3, fit=0.79)])
    # Not where as much as is missing may be left out yet, since it moves.
    assert not history.is_hopeless([term("depth", 1e-3, fit=0.4)], moving=0.4)
    assert history.is_hopeless([term("depth", 1e-3, fit=0.4)], moving=0.3)
    assert history.is_hopeless([SimpleNamespace(is_linearised=False)])  # type: ignore[list-item]


@pytest.mark.parametrize(("axis", "limit"), [(0, 0.15), (2, 0.15), (4, np.radians(4.0) + 0.2)])
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_no_hand_moves_so_fast(axis: int, limit: float, share: float) -> None:
    dt = np.sqrt(1e-3)
    T = se3.exp(np.array([0.3, -0.2, 0.1, 0.5, 0.4, -0.3]))
    assert implausible(T, T @ se3.exp(share * limit * np.eye(6)[axis]), dt) == (share > 1.0)


def test_a_coarse_level_is_hopeless_where_neither_term_is_near_its_limit() -> None:
    history = after("depth", [1e-3] * 10)
    near, far = term("depth", 11.9e-3), term("depth", 12.1e-3)
    assert history.is_hopeless([far]) and not history.is_hopeless([near])
    assert not history.is_hopeless([far, term("color", 0.1)]) and history.is_hopeless([far, term("color", 0.3)])


def test_nothing_is_begun_anew_from_lines_that_do_not_hang_together() -> None:
    for inflation, says in ((19.9, ""), (20.1, Fault.MOTION)):
        images = [term("depth", 1e-3, inflation=99.0), term("color", 1e-3, inflation=inflation)]
        assert fault(pulled_before(), images, new=True) == says
        assert fault(pulled_before(), images) == ""


@pytest.mark.parametrize(
    ("kind", "usual", "limit"), [("depth", 2e-3, 7e-3), ("color", 0.01, 0.035), ("color", 1e-3, 0.03)]
)
def test_where_a_piece_begins_images_have_to_fit_nearly_as_usual(kind: str, usual: float, limit: float) -> None:
    assert fault(after(kind, [usual] * 3), [term(kind, limit)], new=True) == ""
    assert fault(after(kind, [usual] * 3), [term(kind, 1.01 * limit)], new=True) == Fault.MISFIT
    if limit > 0.03 or kind == "depth":  # beyond what is harmless anywhere
        assert fault(after(kind, [usual] * 3), [term(kind, 1.01 * limit)]) == ""
