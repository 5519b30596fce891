"""Lenses by where they put points: against the closed form of a focal length, and Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsgen.geometry.camera import Camera
from rstrack.calibration.findings.lens_pixels import displacement_px, rms, sigma_px
from rstrack.calibration.unknowns.parameters import LENS, changed

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
    root = rng.standard_normal((8, 8)) * np.array([2e-3, 2e-3, 5e-3, 5e-3, 2e-3, 2e-3, 5e-4, 5e-4])[:, None]
    drawn = [displacement_px(BENT, changed(BENT, root @ rng.standard_normal(len(LENS)))) for _ in range(800)]
    scatter = np.sqrt(np.mean(np.square(drawn).sum(axis=2), axis=0))
    # Those that lie on the image's rim leave it, in some of the drawn lenses.
    inside = np.isfinite(scatter)
    np.testing.assert_allclose(sigma_px(BENT, root @ root.T)[inside], scatter[inside], rtol=0.15)
    assert np.count_nonzero(inside) > 500
