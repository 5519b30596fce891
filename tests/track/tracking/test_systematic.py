"""What images have in common beyond their noise, learnt from how far they disagree: simulated frames."""

import numpy as np
import pytest
import scipy.stats

from rstrack.tracking.judgement import uncertainty
from rstrack.tracking.judgement.uncertainty import SYSTEMATIC_PX, Systematic, of_pixels

FOCAL, DEPTH = 500.0, 2.0


def learnt(sigma_px: float, noise_px: float, frames: int, seed: int = 3, assumed: float = 1.0) -> float:
    """From frames whose two images both have errors of sigma_px, and noise, assumed to be so many times larger."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6)) + 3.0 * np.eye(6)
    size = np.sqrt(of_pixels(1.0, FOCAL, DEPTH))
    noise = size @ A @ A.T @ size * noise_px**2 / 9.0
    known = Systematic()
    for _ in range(frames):
        apart = rng.multivariate_normal(np.zeros(6), noise + 2.0 * of_pixels(sigma_px, FOCAL, DEPTH))
        known = known.with_frame(apart, assumed**2 * noise, FOCAL, DEPTH)
    return known.px


@pytest.mark.parametrize("sigma", [0.002, 0.004, 0.008])
def test_errors_that_images_do_not_share_are_found(sigma: float) -> None:
    # The first value counts as one frame beside some thirty.
    expected = np.sqrt((SYSTEMATIC_PX**2 + 30 * sigma**2) / 31)
    found = np.median([learnt(sigma, 0.5 * sigma, 90, seed) for seed in range(9)])
    assert found == pytest.approx(expected, rel=0.2)


def test_nothing_is_learnt_from_noise() -> None:
    assert Systematic().px == SYSTEMATIC_PX
    assert learnt(0.002, 1.0, 60) == SYSTEMATIC_PX
    # Nor where there is less noise than was assumed, as with a camera that is better than its file says.
    assert learnt(0.002, 1.0, 60, assumed=4.0) == SYSTEMATIC_PX


def test_it_is_never_more_than_where_nothing_is_known() -> None:
    assert learnt(1.0, 0.002, 60) == SYSTEMATIC_PX


def test_likelihoods_are_those_of_normal_distances() -> None:
    rng = np.random.default_rng(4)
    spread, off = rng.uniform(1e-6, 1e-4, 6), rng.normal(size=6) * 1e-2
    found = uncertainty._likelihoods(off**2, spread)
    true = [scipy.stats.norm.logpdf(off, scale=np.sqrt(spread + 2.0 * sigma**2)).sum() for sigma in uncertainty._GRID]
    np.testing.assert_allclose(np.diff(found), np.diff(true), rtol=1e-9)
