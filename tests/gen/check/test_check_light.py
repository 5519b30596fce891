"""How right light is, told from noisy pictures."""

from __future__ import annotations

import numpy as np
import pytest

from rsgen.srgb import psnr_without_noise


@pytest.mark.parametrize("wrong", [0.02, 0.0])
def test_noise_is_no_error_and_makes_unsure(wrong: float) -> None:
    """Ten times as much noise as error: the error is found, and what is told as sure is, most of the time."""
    rng = np.random.default_rng(7)
    true = rng.uniform(0.2, 0.8, (72, 96, 3))
    error = wrong * rng.normal(size=true.shape)
    expected = np.inf if not wrong else -10 * np.log10(np.mean(error**2))
    found = []
    for _ in range(40):
        first, second, one, other = (true + 0.05 * rng.normal(size=true.shape) for _ in range(4))
        found.append(psnr_without_noise((first + error, second + error), (one, other)))
    psnr, least = np.array(found).T
    assert (least < psnr).all() and (least <= expected).mean() >= 0.9
    if wrong:
        assert psnr.mean() == pytest.approx(expected, abs=0.15) and least.mean() > expected - 1.0
    else:  # nothing is wrong, and more than this cannot be told
        assert least.min() > 38
