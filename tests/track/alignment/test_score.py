"""How far images pull: rigid motions of known size, balance, and what is not seen."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pose_terms import PoseTerms, sighting
from rstrack_util import hand_held

from rsgen.geometry import se3
from rstrack.alignment.observation import Observation, Scores, scores
from rstrack.alignment.spline_state import SplineState

TRUTH = hand_held(3)
TIMES = np.linspace(0.40, 0.43, 9)
MID = float(TIMES.mean())


class OfDepth(Observation):
    """A sighting that counts as a depth image."""

    @property
    def is_depth(self) -> bool:
        return True


def sight(
    v: Any = (0, 0, 0), phi: Any = (0, 0, 0), weight: float = 1e6, kind: type[Observation] = Observation,
    growing: bool = False,
) -> Any:  # fmt: skip
    """An image that saw the camera shifted by v (m) and turned by phi (rad) about where it is at mid readout.

    growing: by that in the last line, by its opposite in the first, and linearly between them.
    """
    about = np.eye(4)
    about[:3, 3] = TRUTH.pose(MID)[:3, 3]
    share = np.linspace(-1.0, 1.0, len(TIMES)) if growing else np.ones(len(TIMES))
    T = about @ se3.exp(share[:, None] * np.array([*v, *phi])) @ se3.inverse(about)
    made = sighting(TIMES, T @ TRUTH.pose(TIMES))
    made.image.exposure = SimpleNamespace(first_time=TIMES[0], mid_time=MID, last_time=TIMES[-1])  # type: ignore[attr-defined]
    made = kind(0, made.image, made.ref, independent=weight)
    made.linearise(PoseTerms(), SplineState(TRUTH), 0)  # type: ignore[arg-type]
    return made


def test_lines_that_are_exposed_at_once_have_no_first_and_last() -> None:
    one = sight((3e-3, 0, 0), growing=True)
    one.image.exposure = SimpleNamespace(first_time=MID, mid_time=MID, last_time=MID)
    assert (
        scores([one], SplineState(TRUTH)).sigmas[0] < 0.1 < scores([sight((3e-3, 0, 0))], SplineState(TRUTH)).sigmas[0]
    )


def test_images_that_disagree_balance_each_other_but_pull_alone() -> None:
    found = scores([sight((2e-3, 0, 0), kind=OfDepth), sight((-2e-3, 0, 0))], SplineState(TRUTH))
    assert found.sigmas[0] < 0.1 < 5.0 < min(found.sigmas[1:])


def test_what_is_hardly_seen_hardly_pulls_and_what_was_not_seen_at_all() -> None:
    assert scores([sight((2e-3, 0, 0), weight=0.1)], SplineState(TRUTH)).sigmas[0] < 0.01
    none = scores([sighting(TIMES, TRUTH.pose(TIMES))], SplineState(TRUTH))
    assert np.isnan(none.sigmas).all()


def test_they_are_those_of_the_state_not_of_the_linearisation() -> None:
    state, one = SplineState(TRUTH), sight((2e-3, 0, 0))
    state.apply(0, np.tile([2e-3, 0.0, 0.0, 0.0, 0.0, 0.0], (len(state.points), 1)))
    assert scores([one], state).sigmas[0] < 0.1


def test_what_rounding_leaves_of_an_unseen_motion_is_no_information(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: inverted, an information below zero is a small covariance, and a pose that slid was known."""
    H = np.diag([4.0, 3.0, -1e-3, 5.0, 6.0, 7.0, *np.ones(6)])
    monkeypatch.setattr(Observation, "steady", lambda *_: (H, np.zeros(12)))
    R = SplineState(TRUTH).spline.pose(MID)[:3, :3]
    turn = np.kron(np.eye(2), R)
    want = turn.T @ np.diag([4.0, 3.0, 0.0, 5.0, 6.0, 7.0]) @ turn
    np.testing.assert_allclose(scores([sight()], SplineState(TRUTH)).formal, want, atol=1e-12)


def test_pulls_are_counted_in_sigmas_of_what_the_images_tell() -> None:
    found = scores([sight((3e-3, 0, 0), kind=OfDepth), sight((-2e-3, 0, 0))], SplineState(TRUTH))
    one = 1e-3 / np.sqrt(len(TIMES))  # σ of nine lines, each known to 1 m and counted a million times
    np.testing.assert_allclose(found.sigmas, [0.5e-3 / one * np.sqrt(2), 3e-3 / one, 2e-3 / one], rtol=0.01)


def test_what_images_tell_of_the_pose_is_what_all_their_lines_do() -> None:
    # Every line's twist in the world is known to 1 m and 1 rad; an increment of the pose at mid readout moves them all.
    Ad = se3.adjoint(TRUTH.pose(MID))
    found = scores([sight()], SplineState(TRUTH))
    H = 1e6 * len(TIMES) * Ad.T @ Ad
    np.testing.assert_allclose(found.formal, H, rtol=1e-3, atol=1e-6 * H.max())
    assert (found.information == found.formal).all()


def test_images_that_pull_further_than_noise_tell_less() -> None:
    found = scores([sight((3e-3, 0, 0), weight=1e8)], SplineState(TRUTH))
    assert found.excess > 5.0
    np.testing.assert_allclose(found.information * found.excess**2, found.formal)


def test_sigmas_are_too_small_by_as_much_as_images_pull_further_than_noise() -> None:
    nan = float("nan")
    # Twelve numbers: χ² is about that.
    assert Scores((3.0, 2.0, nan)).excess == Scores().excess == 1.0
    assert Scores((1.0, 12.0, 5.0)).excess == pytest.approx(12.0 / np.sqrt(12.0))
