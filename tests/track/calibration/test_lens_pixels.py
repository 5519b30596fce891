"""Lenses by where they put points: against the closed form of a focal length, and Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rstrack.calibration.figures import displacement_px, lens_map, rms, sigma_px
from rstrack.calibration.parameters import LENS, changed

BENT = Camera(640, 480, 525.0, 524.0, 318.0, 241.0, "radtan", (0.1, -0.2, 1e-3, -2e-3, 0.0))


def test_a_longer_focal_length_moves_points_away_from_the_centre_by_its_part() -> None:
    plain = replace(BENT, model="pinhole", distortion=())
    moved = displacement_px(plain, replace(plain, fx=1.02 * plain.fx, cy=plain.cy + 3.0))
    pixels = plain.pixel_grid()[::20, ::20].reshape(-1, 2)
    np.testing.assert_allclose(moved[:, 0], 0.02 * (pixels[:, 0] - plain.cx), atol=1e-9)
    np.testing.assert_allclose(moved[:, 1], 3.0, atol=1e-9)
    assert rms(moved) == pytest.approx(float(np.sqrt((moved**2).sum(axis=1).mean())))


def test_sigma_of_points_is_what_drawn_lenses_scatter_by() -> None:
    rng = np.random.default_rng(3)
    root = rng.standard_normal((9, 9)) * np.array([2e-3, 2e-3, 5e-3, 5e-3, 2e-3, 2e-3, 5e-4, 5e-4, 2e-3])[:, None]
    drawn = [displacement_px(BENT, changed(BENT, root @ rng.standard_normal(len(LENS)))) for _ in range(800)]
    scatter = np.sqrt(np.mean(np.square(drawn).sum(axis=2), axis=0))
    # Those that lie on the image's rim leave it, in some of the drawn lenses.
    inside = np.isfinite(scatter)
    np.testing.assert_allclose(sigma_px(BENT, root @ root.T)[inside], scatter[inside], rtol=0.15)
    assert np.count_nonzero(inside) > 500


@pytest.mark.parametrize("part", [-1.2, float("nan")])
def test_a_lens_that_nothing_holds_is_said_in_one_line(part: float) -> None:
    step = np.zeros(len(LENS))
    step[1] = part
    with pytest.raises(UserError, match=r"nothing in these frames holds the focal length: choose --frames"):
        changed(BENT, step)


def test_a_picture_has_some_of_the_points_each_with_its_displacement_and_sigma() -> None:
    moved = replace(BENT, cx=BENT.cx + 2.0)
    shown = lens_map(BENT, moved, 1e-6 * np.eye(len(LENS)))
    at, by, sigma = (np.array(shown[name]) for name in ("at_px", "moved_px", "sigma_px"))
    assert at.shape == by.shape == (16 * 12, 2) and sigma.shape == (16 * 12, 1)
    assert set(at[:, 0]) == set(range(0, 640, 40)) and set(at[:, 1]) == set(range(0, 480, 40))
    np.testing.assert_allclose(by, [[2.0, 0.0]] * len(by), atol=1e-3)
    assert (sigma > 0.5).all() and sigma[0] > sigma[len(sigma) // 2 + 8]
