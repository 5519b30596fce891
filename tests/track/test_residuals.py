"""The two error terms: zero at the truth, gradients against finite differences, sums against a NumPy twin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from rstrack_util import (
    ENGINE,
    SCANS,
    T_COLOR_DEPTH,
    color_input,
    depth_input,
    disturbed,
    exact_reference,
    exposure,
    hand_held,
    make_terms,
    moved,
    plane_before,
    small_camera,
)
from scipy import stats
from util import numeric_jacobian

from rsgen.device.projection import project_rolling
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment import block_sums, residuals
from rstrack.alignment.linearise import Linearised, Terms
from rstrack.alignment.student_t import LEAST_CURVATURE, NU, scale_step, weight
from rstrack.images import line_poses as lines
from rstrack.images.blur import blur_length, blur_weight
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.keyframes.keyframe import Reference

NORMALS = [(0.5, -0.2, 1.0), (-0.3, 0.6, 1.0), (0.1, 0.1, 1.0)]
REF_STAMP, STAMP = 0.43, 0.465
DEPTH, COLOR = small_camera("radtan"), small_camera("fisheye", 72, 54)
# Scan of the reference: None if it is rectified.
CASES = [*[(None, scan) for scan in SCANS], ("top-bottom", "top-bottom"), ("right-left", "left-right")]


@dataclass(frozen=True)
class Setting:
    """A plane, its reference and one image of it; `term` linearises around a spline with scale σ."""

    truth: Spline
    ref: Reference
    image: DepthImage | ColorImage
    terms: Terms

    def term(self, spline: Spline, sigma: float, level: int = 0) -> Linearised:
        if isinstance(self.image, DepthImage):
            return self.terms.geometric(self.image, self.ref, spline, level, sigma)
        return self.terms.photometric(self.image, self.ref, spline, level, sigma)


def setting(
    kind: str, ref_scan: str | None, scan: str, normal: tuple[float, float, float] = NORMALS[0],
    terms: Terms | None = None,
) -> Setting:  # fmt: skip
    """Points that are looked at lie far enough from all borders for the same ones to count wherever images move."""
    truth = hand_held(1)
    plane = plane_before(truth.pose(REF_STAMP), normal)
    geometric = kind == "geometric"
    # Only a reference that is not rectified may be distorted.
    ref_image = exposure(REF_STAMP, ref_scan, DEPTH if ref_scan else small_camera())  # type: ignore[arg-type]
    ref = exact_reference(plane.cast, truth, ref_image, 0 if geometric else 8)
    image: DepthImage | ColorImage
    if geometric:
        image = depth_input(plane.cast, truth, exposure(STAMP, scan, DEPTH), 8)  # type: ignore[arg-type]
    else:
        image = color_input(plane.cast, truth, exposure(STAMP + 0.007, scan, COLOR, T_COLOR_DEPTH, 0.02))  # type: ignore[arg-type]
    return Setting(truth, ref, image, terms or make_terms(DEPTH))


@pytest.fixture(autouse=True)
def exact_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line's pose from the spline: with these small images a block of eight would take 5 ms."""
    monkeypatch.setattr(lines, "_LINES_PER_NODE", 1)


@pytest.fixture
def one_line_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line its own block, so that nothing but rounding is approximate."""
    monkeypatch.setattr(block_sums, "LINES_PER_BLOCK", 1)
    monkeypatch.setattr(block_sums, "LINES_PER_PAIR_BLOCK", 1)


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


@pytest.mark.parametrize("kind", ["geometric", "photometric"])
@pytest.mark.parametrize(("ref_scan", "scan"), CASES)
def test_gradient_is_that_of_the_cost(kind: str, ref_scan: str | None, scan: str, one_line_blocks: None) -> None:
    terms = make_terms(DEPTH)
    sigma = 0.01 if kind == "geometric" else 0.02
    # The geometric term sees three motions of a plane; one plane more lets all six be seen.
    normals = NORMALS[:2] if kind == "geometric" and ref_scan is None else NORMALS[:1]
    for normal in normals:
        s = setting(kind, ref_scan, scan, normal, terms)
        around = disturbed(s.truth, 5)
        lin = s.term(around, sigma)
        numeric, counts = cost_gradient(s, around, lin, sigma)
        assert counts == {lin.count}, "the mask is not fixed"
        scale = np.abs(numeric).max()
        assert scale > 100.0
        # Kinks of bilinear interpolation, and of normals that change from pixel to pixel, leave the rest.
        limit = 2e-4 if kind == "geometric" and ref_scan is None else 5e-3
        np.testing.assert_allclose(lin.model.g, numeric, atol=limit * scale)


def cost_gradient(
    s: Setting, around: Spline, lin: Linearised, sigma: float, level: int = 0
) -> tuple[np.ndarray, set[int]]:
    """Derivative of the cost by left increments of the model's control points, and the counts of pixels that it saw."""
    counts = set()

    def cost(x: np.ndarray) -> np.ndarray:
        there = s.term(moved(around, x.reshape(-1, 6), lin.model.first), sigma, level)
        counts.add(there.count)
        return np.array(there.cost)

    return numeric_jacobian(cost, len(lin.model.g)), counts


def test_gradient_at_a_coarser_level() -> None:
    s = setting("photometric", None, "top-bottom")
    around = disturbed(s.truth, 5)
    lin = s.term(around, 0.02, 1)
    numeric, _ = cost_gradient(s, around, lin, 0.02, 1)
    np.testing.assert_allclose(lin.model.g, numeric, atol=0.02 * np.abs(numeric).max())


@pytest.mark.parametrize("kind", ["geometric", "photometric"])
def test_blocks_of_lines_lose_little(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    s = setting(kind, None, "top-bottom")
    around = disturbed(s.truth, 5)
    blocks = s.term(around, 0.01).model
    monkeypatch.setattr(block_sums, "LINES_PER_BLOCK", 1)
    single = setting(kind, None, "top-bottom").term(around, 0.01).model
    assert blocks.first == single.first
    for name in ("g", "H"):
        exact = getattr(single, name)
        # Here a block takes 5 ms; at 480 lines it takes 0.5.
        np.testing.assert_allclose(getattr(blocks, name), exact, atol=0.02 * np.abs(exact).max())


@pytest.mark.parametrize("kind", ["geometric", "photometric"])
def test_curvature_is_that_of_the_cost(kind: str, one_line_blocks: None) -> None:
    s = setting(kind, None, "left-right")
    # With residuals of zero H is exact, apart from the curvature of the pixel's path, times zero.
    lin = s.term(s.truth, 0.01)
    numeric = numeric_jacobian(
        lambda x: s.term(moved(s.truth, x.reshape(-1, 6), lin.model.first), 0.01).model.g, len(lin.model.g), 3e-4
    )
    np.testing.assert_allclose(lin.model.H, numeric, atol=0.01 * np.abs(numeric).max())
    # Away from it, Newton's weight rather than the one of reweighted least squares: here errors are about σ/2, and the
    # factor (ν − s²)/(ν + s²) takes off a tenth.
    around = disturbed(s.truth, 5)
    sigma = 2.0 * s.term(around, 0.01).next_sigma
    H = s.term(around, sigma).model.H
    lin = s.term(around, sigma)
    numeric = numeric_jacobian(
        lambda x: s.term(moved(around, x.reshape(-1, 6), lin.model.first), sigma).model.g, len(lin.model.g), 3e-4
    )
    limit = 0.01 if kind == "geometric" else 0.05
    np.testing.assert_allclose(H, numeric, atol=limit * np.abs(numeric).max())


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


def test_row_shift_is_the_movement_in_pixels() -> None:
    s = setting("geometric", None, "top-bottom")
    lin = s.term(s.truth, 0.01)
    R = s.ref.T_world_base[:3, :3]
    count = len(s.truth.control_points)
    sideways, turn = np.tile([*(R @ [0.01, 0.0, 0.0]), 0, 0, 0], (count, 1)), np.zeros((count, 6))
    assert lin.row_shift(sideways, 48.0, 2.0) == pytest.approx(48.0 * 0.01 / 2.0)
    # A turn about the base frame's own y axis, through its own origin.
    turn[:] = se3.adjoint(s.ref.T_world_base) @ [0.0, 0.0, 0.0, 0.0, 0.005, 0.0]
    assert lin.row_shift(turn, 48.0, 2.0) == pytest.approx(48.0 * 0.005)
    # Control points that the image does not depend on.
    turn[lin.model.first : lin.model.last] = 0.0
    assert lin.row_shift(turn, 48.0, 2.0) == 0.0


@pytest.mark.parametrize("scan", ["top-bottom", "right-left"])
def test_blur_weights_are_those_of_equation_13(scan: str) -> None:
    s, sigma_px = setting("photometric", None, scan), 0.7
    lens, stamp, T_cam_body = s.image.exposure.lens, s.image.exposure.stamp, s.image.exposure.T_cam_body
    points = s.ref.points[0]
    table = ENGINE.upload(lines.from_base_table(s.truth, s.ref.T_world_base, s.image.exposure))
    seen = project_rolling(lens, table, (points.x, points.y, points.z), ENGINE.UInt, ENGINE.Int)
    on = (points.z.numpy() > 0) & seen.valid.numpy()
    found = blur_weight(blur_length(lens, seen.pixel_speed), 1.0 / sigma_px**2).numpy()[on]
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
