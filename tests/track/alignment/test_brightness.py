"""Gain and offset of colour images: eliminated exactly, found where known, chained over keyframes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rstrack_util import ENGINE
from term_setting import setting

from rstrack.alignment import brightness
from rstrack.alignment.normal_equations import eliminate
from rstrack.images.pyramid import ColorImage


def test_what_is_eliminated_is_what_a_joint_solution_gives() -> None:
    rng = np.random.default_rng(3)
    A = rng.normal(size=(40, 14))
    H, g = A.T @ A, rng.normal(size=14)
    at, expected = np.array([0.1, -0.05]), np.array([0.02, 0.01])
    prior = 1.0 / np.array([0.3, 0.15]) ** 2
    joint, right = H.copy(), g.copy()
    joint[12:, 12:] += np.diag(prior)
    right[12:] += prior * (at - expected)
    x = -np.linalg.solve(joint, right)
    left = eliminate(H[:12, :12], g[:12], H[:12, 12:], H[12:, 12:], g[12:], brightness.SIGMA, at - expected)
    np.testing.assert_allclose(-np.linalg.solve(left.H, left.g), x[:12], rtol=1e-8)
    np.testing.assert_allclose(left.step + left.follow @ x[:12], x[12:], rtol=1e-8)
    np.testing.assert_allclose(left.after(at, x[:12]), at + x[12:], rtol=1e-8)


def brighter(image: ColorImage, gain: float, offset: float) -> ColorImage:
    levels = (level + (gain * (level - 0.5) + offset) for level in image.levels)
    return replace(image, levels=tuple(ENGINE.Float(level) for level in levels))


@pytest.mark.parametrize(("gain", "offset"), [(0.0, 0.0), (0.2, 0.05), (-0.3, -0.1)])
@pytest.mark.parametrize("ref_scan", [None, "top-bottom"])
def test_gain_and_offset_of_an_image_are_found(gain: float, offset: float, ref_scan: str | None) -> None:
    s = setting("photometric", ref_scan, "top-bottom")
    image, at, sigma = brighter(s.image, gain, offset), np.zeros(2), 0.05
    for _ in range(5):
        # The prior is centred on the truth, so that it does not pull; the start is not.
        known = np.array([gain, offset])
        lin = s.terms.photometric(image, s.ref, s.truth, 0, sigma, brightness=at, expected=known)()
        assert lin.nuisance is not None
        at, sigma = lin.nuisance.after(at, np.zeros(len(lin.model.g))), lin.next_sigma
    # Interpolation of such small images leaves errors of 2e-4 in intensity, which the gain takes for contrast.
    np.testing.assert_allclose(at, [gain, offset], atol=3e-3)


def test_brightness_is_chained_over_keyframes() -> None:
    a, b = np.array([0.2, 0.05]), np.array([-0.1, 0.02])
    light = np.linspace(0.1, 0.9, 5)

    def seen(x: np.ndarray, of: np.ndarray) -> np.ndarray:
        return x + of[0] * (x - 0.5) + of[1]

    np.testing.assert_allclose(seen(light, brightness.absolute(a, b)), seen(seen(light, b), a))
    np.testing.assert_allclose(brightness.relative(brightness.absolute(a, b), b), a, atol=1e-12)
    factor, offset = brightness.factor_and_offset(a)
    np.testing.assert_allclose(factor * light + offset, seen(light, a))


def test_moments_match_and_small_changes_of_the_view_are_none() -> None:
    before = np.array([0.4, 0.2])
    after = np.array([0.4 * 0.7 + 0.1, 0.2 * 0.7])
    gain, offset = brightness.matched(after, before)
    np.testing.assert_allclose([0.5 + (1 + gain) * (0.4 - 0.5) + offset, (1 + gain) * 0.2], after)
    known = np.array([0.05, 0.01])
    assert brightness.expected(known, before + 0.02, before) is known
    assert np.abs(brightness.expected(known, after, before) - known).max() > 0.05


def test_contrast_is_the_spread_of_the_reference_as_bright_as_the_image() -> None:
    rng = np.random.default_rng(5)
    light, w = rng.uniform(0.2, 0.9, 500), rng.uniform(0.1, 1.2, 500)
    columns = -np.column_stack([light - brightness.MID_GREY, np.ones(500)])
    H = (columns * w[:, None]).T @ columns
    seen = light + 0.4 * (light - 0.5) - 0.1
    expected = np.sqrt(np.cov(seen, aweights=w, ddof=0))
    assert brightness.contrast(H, np.array([0.4, -0.1])) == pytest.approx(float(expected), rel=1e-9)
    assert brightness.contrast(np.zeros((2, 2)), np.zeros(2)) == 0.0
