"""One image against one reference: what is summed, chained to the control points, gated, floored and hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import synthetic
from rstrack_util import (
    ENGINE,
    depth_input,
    depth_of,
    disturbed,
    exact_reference,
    exposure,
    make_terms,
    maker,
    moved,
    plane_before,
    small_camera,
)
from term_setting import CASES, DEPTH, NORMALS, REF_STAMP, Setting, setting
from util import numeric_jacobian

from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment import block_sums, linearise
from rstrack.alignment.block_sums import BlockSums
from rstrack.alignment.linearise import Linearised, Terms
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.observation import Observation
from rstrack.alignment.residuals import whole_image_unit
from rstrack.alignment.spline_state import SplineState
from rstrack.images import line_poses as lines
from rstrack.images.pyramid import ColorImage, DepthImage, depth_image


@pytest.fixture(autouse=True)
def exact_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line's pose from the spline: with these small images a block of eight would take 5 ms."""
    monkeypatch.setattr(lines, "NODES", 10**6)


@pytest.fixture
def one_line_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line its own block, so that nothing but rounding is approximate."""
    monkeypatch.setattr(block_sums, "BLOCKS", 10**6)
    monkeypatch.setattr(block_sums, "PAIR_BLOCKS", 10**6)


@pytest.fixture
def known_brightness(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gain and offset are not estimated, so that the gradient is that of the motion alone."""
    monkeypatch.setattr(linearise, "SIGMA", np.full(2, 1e-9))


# -- the chain to the control points ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["geometric", "photometric"])
@pytest.mark.parametrize(("ref_scan", "scan"), CASES)
def test_gradient_is_that_of_the_cost(
    kind: str, ref_scan: str | None, scan: str, one_line_blocks: None, known_brightness: None
) -> None:
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


def test_gradient_at_a_coarser_level(known_brightness: None) -> None:
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
    monkeypatch.setattr(block_sums, "BLOCKS", 10**6)
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


def test_row_shift_is_the_movement_in_pixels() -> None:
    s = setting("geometric", None, "top-bottom")
    lin = s.term(s.truth, 0.01)
    R = s.ref.T_world_base[:3, :3]
    count = len(s.truth.control_points)
    own = lambda increments: increments[lin.model.first : lin.model.last]  # noqa: E731
    sideways, turn = np.tile([*(R @ [0.01, 0.0, 0.0]), 0, 0, 0], (count, 1)), np.zeros((count, 6))
    assert lin.row_shift(own(sideways), 48.0, 2.0) == pytest.approx(48.0 * 0.01 / 2.0)
    # A turn about the base frame's own y axis, through its own origin.
    turn[:] = se3.adjoint(s.ref.T_world_base) @ [0.0, 0.0, 0.0, 0.0, 0.005, 0.0]
    assert lin.row_shift(own(turn), 48.0, 2.0) == pytest.approx(48.0 * 0.005)
    # Control points that the image does not depend on.
    turn[lin.model.first : lin.model.last] = 0.0
    assert lin.row_shift(own(turn), 48.0, 2.0) == 0.0


def still(T_world_depth: np.ndarray) -> Spline:
    return Spline(np.repeat(T_world_depth[None], 5, axis=0), -1.0, 2.0)


@pytest.mark.parametrize(("rows", "least", "most"), [(1, 0.3, 2.5), (8, 3.0, 40.0)])
def test_errors_of_neighbouring_lines_are_seen_where_all_are_exposed_at_once_too(
    rows: int, least: float, most: float
) -> None:
    camera = small_camera(width=160, height=120)
    T, image = synthetic.make_spline(0.7).pose(0.0), exposure(0.02, None, camera)
    z = depth_of(synthetic.cast, still(T), image)
    ref = maker(camera).rectified(1, depth_image(ENGINE, image, z, 100.0), (), still(T), None)
    # Errors that are the same over an eighth of an image's width, and over so many lines.
    noise = np.random.default_rng(2).normal(0.0, 2e-3, (camera.height // rows, 160 if rows == 1 else 8))
    noise = noise.repeat(rows, axis=0).repeat(camera.width // noise.shape[1], axis=1)
    terms = Terms(ENGINE, maker(camera).device_rays)
    lin = terms.geometric(depth_image(ENGINE, image, z + noise, 100.0), ref, still(T), 0, 2e-3)()
    assert least < lin.inflation < most


@pytest.mark.parametrize(("rows", "least", "most"), [(1, 0.3, 2.5), (8, 3.0, 60.0)])
def test_errors_of_neighbouring_lines_are_seen_against_a_rolling_reference_too(
    rows: int, least: float, most: float
) -> None:
    camera, truth = small_camera(width=160, height=120), synthetic.make_spline()
    image = exposure(0.30, "top-bottom", camera)
    ref = maker(camera).rolling(1, depth_input(synthetic.cast, truth, exposure(0.25, "top-bottom", camera)), (), truth)
    noise = np.random.default_rng(2).normal(0.0, 2e-3, (camera.height // rows, 160 if rows == 1 else 8))
    noise = noise.repeat(rows, axis=0).repeat(camera.width // noise.shape[1], axis=1)
    seen = depth_image(ENGINE, image, depth_of(synthetic.cast, truth, image) + noise, 100.0)
    lin = Terms(ENGINE, maker(camera).device_rays).geometric(seen, ref, truth, 0, 2e-3)()
    assert lin.sums.H.shape[1] > 1 and least < lin.inflation < most


@pytest.mark.parametrize("off_by", [1e-9, 1e-3, 1.0])
def test_what_a_depth_image_is_off_by_as_a_whole_is_no_part_of_the_model(off_by: float) -> None:
    truth, image = synthetic.make_spline(), exposure(0.30, "top-bottom", DEPTH)
    ref, seen = exact_reference(synthetic.cast, truth, exposure(0.25, None)), depth_input(synthetic.cast, truth, image)
    sigma, spline = 0.02, disturbed(truth, 11, 0.02)
    plain, lin = (
        shipped(depth_image=depth_image).geometric(seen, ref, spline, 0, sigma)() for depth_image in (0.0, off_by)
    )
    together = np.tile(np.eye(6), (len(lin.model.g) // 6, 1)) @ se3.adjoint(ref.T_world_base)
    own, unit = lin.sums.columns, whole_image_unit(ref.median_depth)
    assert own is not None
    coupling = own.coupling.sum(axis=(0, 1)) / unit / sigma**2
    system = own.H / (sigma * unit) ** 2 + np.eye(3) / off_by**2
    H = lin.sums.H.sum(axis=(0, 1)) / sigma**2 - coupling @ np.linalg.solve(system, coupling.T)
    g = lin.sums.g.sum(axis=(0, 1)) / sigma - coupling @ np.linalg.solve(system, own.g / unit / sigma)
    np.testing.assert_allclose(together.T @ lin.model.H @ together, H, rtol=1e-6, atol=1e-9 * np.abs(H).max())
    np.testing.assert_allclose(together.T @ lin.model.g, g, rtol=1e-6, atol=1e-9 * np.abs(g).max())
    assert lin.cost == plain.cost
    lost = np.linalg.norm(plain.model.H - lin.model.H) / np.linalg.norm(plain.model.H)
    assert lost < 1e-6 if off_by == 1e-9 else lost > 0.1


def test_where_a_depth_image_is_off_as_a_whole_its_model_tells_how_its_cost_changes() -> None:
    truth, image = synthetic.make_spline(), exposure(0.30, "top-bottom", DEPTH)
    z, rays = depth_of(synthetic.cast, truth, image), DEPTH.unproject(DEPTH.pixel_grid())
    bent = np.where(z > 0, z / (1.0 + z * (4e-3 + 6e-3 * rays[..., 0] - 4e-3 * rays[..., 1])), 0.0)
    ref = exact_reference(synthetic.cast, truth, exposure(0.25, None))
    terms = Terms(ENGINE, maker(DEPTH).device_rays, depth_image=0.01)
    o, state = Observation(0, depth_image(ENGINE, image, bent, 100.0), ref), SplineState(truth)
    for _ in range(15):
        o.linearise(terms, state, 0)
    off = o.nuisance(state) * whole_image_unit(ref.median_depth)
    np.testing.assert_allclose(off, [-4e-3, -6e-3, 4e-3], atol=1e-4)
    costs = []
    for step in (0.0, 2e-3):
        o.linearisation = replace(o.linearisation, sigma=0.02)
        state.apply(0, step * np.random.default_rng(4).normal(size=(len(state.points), 6)))
        expected = o.change(state)
        o.linearise(terms, state, 0)
        costs.append(o.lin.cost)
    assert costs[1] - costs[0] == pytest.approx(expected, rel=0.1) and expected > 1.0


# -- gates, floors and what is left out -----------------------------------------------------------------------------


def shipped(**settings: float) -> Terms:
    """The terms as the trackers have them."""
    return Terms(ENGINE, maker(small_camera()).device_rays, **settings)  # type: ignore[arg-type]


def frontal(kind: str = "geometric", terms: Terms | None = None) -> Setting:
    """A wall at 2 m across the camera's axis, with the gates and floors that the trackers have."""
    return setting(kind, None, "top-bottom", (0.0, 0.0, 1.0), terms or shipped(), small_camera())


def off_by(s: Setting, distance: float) -> Spline:
    """The true spline, moved towards the wall."""
    n = plane_before(s.truth.pose(REF_STAMP), (0.0, 0.0, 1.0)).normal
    return moved(s.truth, np.tile([*(distance * n), 0.0, 0.0, 0.0], (len(s.truth.control_points), 1)))


@pytest.mark.parametrize(
    ("level", "sigma", "gate"),
    [
        (0, 1e-3, 5e-3),  # five σ
        (0, 1e-4, 2e-3),  # but at least ten times the smallest credible σ
        (0, 0.02, 0.05),  # and at most as on the level above
        (1, 1e-3, 0.05),
        (2, 1e-3, 0.3),
    ],
)
def test_depth_beyond_the_gate_is_left_out(level: int, sigma: float, gate: float) -> None:
    s = frontal()
    everything = s.term(s.truth, sigma, level).count
    assert everything > 700 / 4**level / 2
    if not (level == 0 and sigma < 0.01):
        gate *= s.ref.median_depth  # grows with the distance
    # (median depth / z)² of the wall differs by a few percent, and so do the residuals.
    assert s.term(off_by(s, 0.9 * gate), sigma, level).count == everything
    assert s.term(off_by(s, 1.1 * gate), sigma, level).count == 0


def test_what_lies_behind_the_keyframes_surface_is_hidden_and_no_misfit() -> None:
    s = frontal()
    assert isinstance(s.image, DepthImage)
    z = ENGINE.download(s.image.z, (48, 64))
    counts = []
    for by in (-0.3, 0.3):  # in front of the wall it contradicts it
        part = np.where(np.arange(64) < 32, z + by, z) * (z > 0)
        seen = replace(s, image=replace(s.image, z=ENGINE.upload(part))).term(s.truth, 1e-3)
        counts.append((seen.count, seen.sums.compared))
    (front, front_of), (behind, behind_of) = counts
    assert front < 0.6 * front_of and behind == behind_of and behind == pytest.approx(front, rel=0.02)


@pytest.mark.parametrize(("sigma", "limit"), [(8e-3, 2e-3), (1e-4, 1.25e-3)])  # f = 48 px: 5e-3 m credible
def test_pixels_whose_interpolation_errs_by_more_than_a_quarter_of_sigma_weigh_less(sigma: float, limit: float) -> None:
    s = frontal()

    def information(rough: np.ndarray) -> np.ndarray:
        ref = replace(s.ref, roughness=ENGINE.upload(rough))
        return replace(s, ref=ref).term(s.truth, sigma).model.H

    smooth, rough = information(np.zeros((48, 64))), np.ones((48, 64))
    np.testing.assert_allclose(information(0.99 * limit * rough), smooth, rtol=1e-6)
    # Residuals are divided by the square of what is too much, and the information by its fourth power.
    np.testing.assert_allclose(information(2.0 * limit * rough), smooth / 16.0, atol=1e-4 * np.abs(smooth).max())
    # Pixel by pixel: the wall's left half.
    rough[:, :32] = 1e6
    half = np.trace(information(rough * np.where(rough > 1, 1.0, 0.0))) / np.trace(smooth)
    assert 0.3 < half < 0.7


@pytest.mark.parametrize(
    ("kind", "step", "floor"),
    [("photometric", 0.0, 1.0 / 255.0), ("geometric", 0.0, 2e-4), ("geometric", 1e-4, 2e-4), ("geometric", 1e-3, None)],
)
def test_scales_have_floors_and_rounding_of_depth_is_one(kind: str, step: float, floor: float | None) -> None:
    s = frontal(kind)
    if isinstance(s.image, DepthImage):
        s = replace(s, image=replace(s.image, resolution=step))  # 1/m
    want = step * s.ref.median_depth**2 / np.sqrt(12.0) if floor is None else floor
    sigma = 1e-3 if kind == "geometric" else 0.02
    lin = s.term(s.truth, sigma)
    assert lin.floor == pytest.approx(want) and (floor is not None or want > 1e-3)
    for _ in range(5):
        lin = s.term(s.truth, lin.next_sigma)
    assert lin.next_sigma == lin.floor  # errors are smaller than that
    assert s.term(disturbed(s.truth, 3, 0.01), sigma).next_sigma > (2.0 if floor else 1.0) * lin.floor


@pytest.mark.parametrize(("share", "shown"), [(0.97, True), (0.955, False), (0.0, True)])
def test_points_behind_what_a_depth_image_shows_are_hidden(share: float, shown: bool) -> None:
    # 2 m away, what is seen has to be 3 % and 2 cm nearer, that is at 1.922 m; what is not known hides nothing.
    wall = frontal()
    color = frontal("photometric", wall.terms)
    assert isinstance(wall.image, DepthImage) and isinstance(color.image, ColorImage)
    seen = ENGINE.download(wall.image.z, (48, 64))
    nearer = np.where(np.arange(64) < 32, share, 1.0) * seen
    occluder = replace(wall.image, z=ENGINE.upload(nearer))
    for level in (0, 1):
        visible = wall.terms.visible(occluder, color.ref, color.truth, level)
        lin = wall.terms.photometric(color.image, color.ref, color.truth, level, 0.02, None, visible)()
        everything = color.term(color.truth, 0.02, level).count
        assert everything > 30
        assert lin.count == everything if shown else 0.3 * everything < lin.count < 0.7 * everything


def test_slopes_of_an_earlier_state_change_the_model_but_not_what_is_seen() -> None:
    s = setting("geometric", None, "top-bottom")
    around = disturbed(s.truth, 5)
    assert isinstance(s.image, DepthImage)
    own, same, other = (
        s.terms.geometric(s.image, s.ref, around, 0, 0.01, slopes_at)() for slopes_at in (None, around, s.truth)
    )
    np.testing.assert_array_equal(own.model.H, same.model.H)
    assert (own.cost, own.count, own.next_sigma) == (other.cost, other.count, other.next_sigma)
    # By no more than the increments between the two, 4 mrad.
    off = np.abs(other.model.g - own.model.g).max() / np.abs(own.model.g).max()
    assert 0.0 < off < 0.02


# -- motions that are seen --------------------------------------------------------------------------------------------


def test_observability_is_zero_where_a_motion_is_not_seen() -> None:
    truth, image = synthetic.make_spline(), exposure(0.30, "bottom-top", small_camera())
    terms = replace(shipped(), smooth=1e9)  # in images as small as these every corner of the room is rough
    for cast, least, most in (
        (synthetic.cast, 1e-3, 1.0),
        (plane_before(truth.pose(0.25), (0.3, 0.2, 1.0)).cast, 0.0, 1e-5),  # rounding to fixed point
    ):
        ref = exact_reference(cast, truth, exposure(0.25, None))
        lin = terms.geometric(depth_input(cast, truth, image), ref, truth, 0, 0.01)()
        assert lin.count > 400 and least <= abs(lin.observability) < most


def test_rotations_are_seen_by_the_scenes_depth() -> None:
    alike = BlockSums(np.diag([1.0, 1.0, 1.0, 4.0, 4.0, 4.0])[None, None] * 5, np.zeros((1, 1, 6)), 0.0, 0.0, 10)
    unseen = BlockSums(0.0 * alike.H, alike.g, 0.0, 0.0, 0)
    for sums, expected in ((alike, 0.5), (unseen, 0.0)):
        model = Quadratic(0, np.zeros((24, 24)), np.zeros(24))
        lin = Linearised(model, np.zeros((1, 6, 24)), 1.0, 1.0, 0.0, 1.0, 2.0, sums)
        assert lin.observability == pytest.approx(expected)
