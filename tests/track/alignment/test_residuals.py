"""The two error terms: zero at the truth, gradients against finite differences, sums against a NumPy twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rstrack_util import (
    ENGINE,
    disturbed,
    make_terms,
    moved,
    plane_before,
)
from scipy import stats
from term_setting import CASES, DEPTH, NORMALS, REF_STAMP, Setting, setting

from rsgen.device.projection import project_rolling
from rsgen.geometry import se3
from rstrack.alignment import residuals
from rstrack.alignment.linearise import Linearised
from rstrack.alignment.weights import LEAST_CURVATURE, NU, scale_step, weight
from rstrack.images import line_poses as lines
from rstrack.images.sampling import Blur, blur_length, blur_weight


@pytest.fixture(autouse=True)
def exact_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line's pose from the spline: with these small images a block of eight would take 5 ms."""
    monkeypatch.setattr(lines, "NODES", 10**6)


def settled_sigma(s: Setting, start: float) -> Linearised:
    lin = s.term(s.truth, start)
    for _ in range(8):
        lin = s.term(s.truth, lin.next_sigma)
    return lin


@pytest.mark.parametrize(("ref_scan", "scan"), CASES)
def test_errors_vanish_at_the_true_spline(ref_scan: str | None, scan: str) -> None:
    terms = make_terms(DEPTH)
    depth = settled_sigma(setting("geometric", ref_scan, scan, terms=terms), 1e-3)
    color = settled_sigma(setting("photometric", ref_scan, scan, terms=terms), 1e-2)
    assert depth.count > 350 and color.count > 300
    # A rectified plane's inverse depth is affine in the pixel; that of a rolling image only nearly. One step of 8 bits
    # is 4e-3; what is left of the colour is the error of bilinear interpolation.
    assert depth.next_sigma < (1e-6 if ref_scan is None else 1e-4)
    assert color.next_sigma < 1e-3
    wrong = setting("geometric", ref_scan, scan, terms=terms)
    assert wrong.term(disturbed(wrong.truth, 3), 1e-2).next_sigma > 1e-3


def test_curvature_never_turns_negative() -> None:
    s, sigma = setting("geometric", None, "top-bottom"), 0.005
    # Errors of up to 4.8 σ: Student's t is concave beyond 2.2.
    shift = 2.4 * sigma * plane_before(s.truth.pose(REF_STAMP), NORMALS[0]).normal
    away = s.term(moved(s.truth, np.tile([*shift, 0.0, 0.0, 0.0], (len(s.truth.control_points), 1))), sigma)
    near = s.term(s.truth, sigma)
    assert away.count == near.count
    # What counts more for being near is further out.
    kept = LEAST_CURVATURE * weight(np.array([2.4 * residuals.NEAREST, 2.0])) / weight(0.0)
    assert kept[0] < np.trace(away.model.H) / np.trace(near.model.H) < kept[1]
    assert np.linalg.eigvalsh(away.model.H).min() > -1e-6 * np.trace(away.model.H)  # fixed point


def test_weight_is_the_slope_of_the_cost() -> None:
    s = np.linspace(-6.0, 6.0, 25)
    cost = lambda s: 0.5 * (NU + 1.0) * np.log1p(s * s / NU)  # noqa: E731
    numeric = (cost(s + 1e-5) - cost(s - 1e-5)) / 2e-5
    np.testing.assert_allclose(weight(s) * s, numeric, atol=1e-9)
    # ... which is the density of Student's t, up to a constant.
    np.testing.assert_allclose(cost(s) - cost(0.0), stats.t.logpdf(0.0, NU) - stats.t.logpdf(s, NU), atol=1e-12)


def test_scale_converges_to_that_of_the_distribution() -> None:
    r = np.random.default_rng(4).standard_t(NU, 20000) * 0.013
    sigma = 1.0
    for _ in range(60):
        s = r / sigma
        sigma = scale_step(sigma, float((weight(s) * s * s).sum()), len(r), 1e-4)
    likelihood = stats.t.fit(r, fdf=NU, floc=0.0)[2]
    assert sigma == pytest.approx(likelihood, rel=1e-4) and sigma == pytest.approx(0.013, rel=0.02)
    assert scale_step(0.5, 0.0, 0, 1e-4) == 0.5
    assert scale_step(0.5, 1e-12, 10, 1e-4) == 1e-4


@pytest.mark.parametrize("scan", ["top-bottom", "right-left"])
def test_blur_weights_are_those_of_equation_13(scan: str) -> None:
    s, sigma_px = setting("photometric", None, scan), 0.7
    lens, stamp, T_cam_body = s.image.exposure.lens, s.image.exposure.stamp, s.image.exposure.T_cam_body
    points = s.ref.points[0]
    table = ENGINE.upload(lines.from_base_table(s.truth, s.ref.T_world_base, s.image.exposure))
    seen = project_rolling(lens, table, (points.x, points.y, points.z), ENGINE.UInt, ENGINE.Int)
    on = (points.z.numpy() > 0) & seen.valid.numpy()
    found = blur_weight(blur_length(seen.pixel_speed, Blur.of(lens, sigma_px).lines), 1.0 / sigma_px**2).numpy()[on]
    p_base = np.stack([a.numpy()[on] for a in (points.x, points.y, points.z)], axis=-1).astype(float)
    p_world = se3.transform(s.ref.T_world_base, p_base)
    middle = lens.shutter.line_mid_time(stamp, seen.line.numpy()[on].astype(float), lens.camera)
    ends = [
        lens.camera.project(se3.transform(T_cam_body @ se3.inverse(s.truth.pose(middle + dt)), p_world))[0]
        for dt in (-0.5 * lens.shutter.exposure_s, 0.5 * lens.shutter.exposure_s)
    ]
    length = np.linalg.norm(ends[1] - ends[0], axis=-1)
    assert len(length) > 300 and length.max() > 0.2
    np.testing.assert_allclose(found, np.exp(-length / sigma_px**2), rtol=5e-3)


def test_blurred_points_count_less() -> None:
    plain, weighted = (
        setting("photometric", None, "top-bottom", terms=replace(make_terms(DEPTH), blur_sigma_px=sigma))
        for sigma in (0.0, 0.7)
    )
    around = disturbed(plain.truth, 5)
    a, b = plain.term(around, 0.02), weighted.term(around, 0.02)
    assert a.count == b.count and 0.05 < np.trace(b.model.H) / np.trace(a.model.H) < 0.9
