"""The depth cameras' models against their formulas on planes, and the projector's shadow against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from rendering import SCANS, constant_twist, mi, pixel_rays, pixel_times

from rsgen.config.cameras import DepthNoiseConfig
from rsgen.config.presets import with_presets
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.images import DepthRenderer
from rsgen.sensors import depth
from rsgen.sensors.depth import apply_depth_noise
from rsgen.sensors.projectors import Projector
from rsgen.sensors.seed import noise_generator

CAMERA = Camera(320, 240, 285.0, 285.0, 159.5, 119.5)
RADTAN = Camera(320, 240, 285.0, 283.0, 163.0, 117.0, "radtan", (-0.15, 0.04, 0.003, -0.002, -0.01))
BF = 0.075 * 285.0
QUIET = {
    "min_range_m": 0.0, "max_range_m": 1e3, "lateral_sigma_px": 0.0, "disparity_sigma_px": 0.0,
    "disparity_step_px": 0.0, "edge_dropout": 0.0, "grazing_deg": (90.0, 90.0), "flying_pixels": 0.0,
}  # fmt: skip


def settings(model: str, **changes: object) -> DepthNoiseConfig:
    return DepthNoiseConfig.model_validate(QUIET | {"model": model} | changes)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def flat(z: float) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), z, np.float32)


def plane(normal: tuple[float, float, float], distance: float, camera: Camera = CAMERA) -> tuple[Any, Any]:
    """Planar z (h, w) of the plane normal · p = distance (where in front, else 0), and the rays' incidence, rad."""
    rays = camera.unproject(camera.pixel_grid())
    n = np.array(normal) / np.linalg.norm(normal)
    facing = rays @ n
    with np.errstate(divide="ignore"):
        z = np.where(facing > 1e-3, distance / facing, 0)
    return z.astype(np.float32), np.arccos(np.clip(facing / np.linalg.norm(rays, axis=-1), -1, 1))


def two_planes(near: float = 1.0, far: float = 2.0, column: int = 150) -> np.ndarray:
    return np.where(np.arange(CAMERA.width) < column, near, far).astype(np.float32) * np.ones((CAMERA.height, 1), "f4")


# --- structured light


@pytest.mark.parametrize("z0", [0.8, 1.6, 3.2])
@pytest.mark.parametrize("slope", [0.011, 0.13])
def test_sigma_of_the_kinect_model_follows_the_formula(z0: float, slope: float) -> None:
    d = BF / z0 + slope * (np.arange(CAMERA.width) - 159.5) + 0.0 * np.arange(CAMERA.height)[:, None]
    z = (BF / np.maximum(d, 0.5)).astype(np.float32)
    config = settings("kinect", lateral_sigma_px=0.5, disparity_sigma_px=0.03, disparity_step_px=0.125)
    used = np.s_[5:-5, 5:-5][0], (d[0] > 1.5).nonzero()[0][5:-5]
    noisy = apply_depth_noise(z, CAMERA, config, rng())
    # sigma_z = z² / (b f) · sigma_d to first order; in disparity it is exact.
    error = (BF / noisy - d)[used]
    expected = np.sqrt(0.03**2 + 0.125**2 / 12 + (0.5 * slope) ** 2)
    assert error.std() == pytest.approx(expected, rel=0.02)
    assert abs(error.mean()) < 5 * expected / np.sqrt(error.size)
    middle = (np.s_[:], np.s_[140:180])
    if slope < 0.1:
        sigma_z = (noisy - z)[middle].std()
        assert sigma_z == pytest.approx(z0**2 / BF * expected, rel=0.05)


def test_sigma_without_quantisation_is_quadratic_in_the_distance() -> None:
    config = settings("kinect", disparity_sigma_px=0.03)
    distances = np.array([0.5, 1.0, 2.0, 4.0])
    sigma = [(apply_depth_noise(flat(z), CAMERA, config, rng()) - z).std(dtype=np.float64) for z in distances]
    # 76800 samples: standard error 0.26 %; the second order of z(d) at 4 m adds 0.1 %.
    assert np.abs(sigma / (distances**2 / BF * 0.03) - 1).max() < 0.015


def test_depths_lie_on_the_steps_of_the_disparity() -> None:
    config = settings("kinect", disparity_sigma_px=0.2, disparity_step_px=0.125)
    values = np.unique(apply_depth_noise(flat(2.0), CAMERA, config, rng()))
    steps = 8 * BF / values.astype(np.float64)
    assert len(values) > 8 and np.abs(steps - np.rint(steps)).max() < 1e-4
    assert np.abs(np.diff(steps) + 1).max() < 1e-4
    middle = values[:-1] * values[1:]
    assert np.allclose(np.diff(values), middle / (8 * BF), rtol=1e-4)


def test_the_formula_is_that_of_barron_and_malik() -> None:
    # z = 35130 / floor(35130 / z + N(0, 1/6) + 1/2) in cm, without noise.
    camera = Camera(64, 48, 351.30 / 8 / 0.075, 500.0, 31.5, 23.5)
    z = plane((0.3, -0.2, 1.0), 2.0, camera)[0]
    ours = apply_depth_noise(z, camera, settings("kinect", disparity_step_px=0.125), rng())
    theirs = 35130 / np.floor(35130 / (100 * z.astype(np.float64)) + 0.5) / 100
    assert np.isclose(ours, theirs, rtol=1e-6).mean() > 0.999  # the rest: float32 at a rounding's tie
    assert DepthNoiseConfig().disparity_sigma_px == pytest.approx(1 / 6 / 8)


def test_a_lateral_shift_makes_no_points_between_near_and_far() -> None:
    config = settings("kinect", lateral_sigma_px=0.5)
    noisy = apply_depth_noise(two_planes(), CAMERA, config, rng())
    assert np.abs(noisy[:, 147:153, None] - np.float32([1, 2])).min(-1).max() < 1e-5
    # P(N(0, 1/2) > 1/2) = 15.9 % of the pixels beside the jump show the other side.
    assert (noisy[:, 149] > 1.5).mean() == pytest.approx(0.1587, abs=5 * np.sqrt(0.16 * 0.84 / CAMERA.height))
    assert np.abs(noisy[:, 155:] - 2).max() < 1e-5


def test_edges_drop_out_on_both_sides_of_a_jump_only() -> None:
    z = two_planes()
    z[:, 250:] = 0
    noisy = apply_depth_noise(z, CAMERA, settings("kinect", edge_dropout=0.6), rng())
    lost = (noisy == 0).mean(0)
    beside = [149, 150, 249]
    assert lost[beside] == pytest.approx([0.6] * 3, abs=5 * np.sqrt(0.24 / CAMERA.height))
    assert (np.delete(lost[:250], beside) == 0).all() and (lost[250:] == 1).all()


# --- angles


@pytest.mark.parametrize("camera", [CAMERA, RADTAN], ids=["pinhole", "radtan"])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (2.0, 0.3, 1.0), (-0.2, 3.0, 1.0), (-1.5, -1.5, 0.8)], ids=str)
def test_incidence_of_planes(camera: Camera, normal: tuple[float, float, float]) -> None:
    z, expected = plane(normal, 1.5, camera)
    seen = (z > 0.3) & (z < 20)
    inner = np.zeros_like(seen)
    inner[1:-1, 1:-1] = seen[1:-1, 1:-1] & seen[:-2, 1:-1] & seen[2:, 1:-1] & seen[1:-1, :-2] & seen[1:-1, 2:]
    angle = depth.incidence(depth.disparity(z, BF), camera)
    # arccos of a float32 cosine near 1 knows an angle of 0 to 0.03 degrees only.
    assert inner.sum() > 5000 and np.rad2deg(np.abs(angle - expected)[inner]).max() < 0.1
    assert (angle[z == 0] == np.float32(np.pi / 2)).all()


def test_incidence_keeps_to_one_side_of_an_edge() -> None:
    angle = depth.incidence(depth.disparity(two_planes(), BF), CAMERA)
    assert np.rad2deg(np.abs(angle - plane((0, 0, 1), 1.0)[1])).max() < 0.1


@pytest.mark.parametrize("model", ["kinect", "tof"])
def test_dropouts_rise_with_the_angle_as_set(model: str) -> None:
    z, angle = plane((0.0, 3.9, 1.0), 1.0)
    config = settings(model, grazing_deg=(60.0, 80.0), axial_base_m=0, axial_growth_per_m=0)
    lost = apply_depth_noise(z, CAMERA, config, rng()) == 0
    degrees = np.rad2deg(angle)
    bins = 0
    for low in range(46, 88, 2):
        here = (degrees >= low) & (degrees < low + 2) & (z > 0)
        if (count := here.sum()) < 500:
            continue
        bins += 1
        p = np.clip((degrees[here] - 60) / 20, 0, 1).mean()
        assert lost[here].mean() == pytest.approx(p, abs=5 * np.sqrt(p * (1 - p) / count) + 0.005)
    assert bins > 12 and lost[(degrees > 80.2) & (z > 0)].all() and not lost[(degrees < 59.8) & (z > 0)].any()


# --- time of flight, Gaussian


def test_sigma_of_time_of_flight_is_nguyens() -> None:
    for z0 in (0.6, 1.5, 3.5):
        noisy = apply_depth_noise(flat(z0), CAMERA, settings("tof"), rng())
        sigma = 0.0012 + 0.0019 * (z0 - 0.4) ** 2
        assert (noisy - z0).std(dtype=np.float64) == pytest.approx(sigma, rel=0.015)
        assert (noisy - z0).mean(dtype=np.float64) == pytest.approx(0, abs=5 * sigma / np.sqrt(noisy.size))
    angle = np.float32(np.deg2rad([59.0, 61.0, 75.0]))
    steep = 1e-4 / np.sqrt(2.0) * (angle / (np.pi / 2 - angle)) ** 2 * [0, 1, 1]
    sigma = depth.axial_sigma(np.full(3, 2.0, np.float32), angle, 0.0012, 0.0019, 0.4)
    assert sigma == pytest.approx(0.0012 + 0.0019 * 1.6**2 + steep, rel=1e-5)


def test_pixels_fly_between_the_sides_of_a_jump() -> None:
    z = two_planes()
    z[:, 250:] = 0
    config = settings("tof", flying_pixels=0.5, axial_base_m=0, axial_growth_per_m=0)
    noisy = apply_depth_noise(z, CAMERA, config, rng())
    flies = (noisy != z).mean(0)
    assert flies[[149, 150]] == pytest.approx([0.5, 0.5], abs=5 * 0.5 / np.sqrt(CAMERA.height))
    assert flies.sum() == flies[[149, 150]].sum()
    mixed = noisy[noisy != z]
    assert (
        mixed.min() >= 1 and mixed.max() <= 2 and mixed.mean() == pytest.approx(1.5, abs=5 * 0.29 / len(mixed) ** 0.5)
    )


def test_sigma_of_the_gaussian_model_is_quadratic() -> None:
    for z0 in (0.7, 2.0, 5.0):
        noisy = apply_depth_noise(flat(z0), CAMERA, settings("gaussian"), rng())
        assert (noisy - z0).std(dtype=np.float64) == pytest.approx(1.2e-3 * z0**2, rel=0.015)
        assert (noisy - z0).mean(dtype=np.float64) == pytest.approx(0, abs=5 * 1.2e-3 * z0**2 / np.sqrt(noisy.size))


# --- all models


MODELS = ["kinect", "tof", "gaussian"]


@pytest.mark.parametrize("model", MODELS)
def test_only_the_range_is_reported(model: str) -> None:
    strips = np.float32([0.2, 0.45, 0.55, 1.0, 2.0, 3.5, 5.8, 6.2, 7.5, 9.0])
    z = np.repeat(strips, CAMERA.width // len(strips)) * np.ones((CAMERA.height, 1), np.float32)
    z[100:120] = 0
    config = DepthNoiseConfig(model=model, min_range_m=0.5, max_range_m=6.0)
    noisy = apply_depth_noise(z, CAMERA, config, rng())
    assert noisy.dtype == np.float32 and noisy.shape == z.shape and (noisy[100:120] == 0).all()
    assert noisy[noisy > 0].min() >= 0.5 and noisy[noisy > 0].max() <= 6
    reported = (noisy[130:] > 0).mean(0).reshape(len(strips), -1)[:, 3:-3].mean(-1)
    assert np.array_equal(reported > 0.5, (strips > 0.5) & (strips < 6))
    assert reported[3:6].min() == 1


@pytest.mark.parametrize("model", MODELS)
def test_a_frame_depends_on_seed_stream_and_frame_only(model: str) -> None:
    z = plane((0.3, 0.2, 1.0), 2.0)[0]
    config = DepthNoiseConfig(model=model, disparity_step_px=0)

    def frame(*key: object) -> np.ndarray:
        return apply_depth_noise(z, CAMERA, config, noise_generator(*key))

    before = z.copy()
    first = frame(7, "depth", 3)
    assert np.array_equal(first, frame(7, "depth", 3)) and np.array_equal(z, before)
    for key in ((7, "depth", 4), (8, "depth", 3), (7, "color", 3)):
        other = frame(*key)
        a, b = first - z, other - z
        both = (first > 0) & (other > 0)
        correlation = np.corrcoef(np.sign(a[both]), np.sign(b[both]))[0, 1]
        assert (a != b)[both].mean() > 0.3
        assert abs(correlation) < 5 / np.sqrt(both.sum())


def test_model_none_is_exact_and_a_shadow_is_the_kinects() -> None:
    z = flat(2.0)
    shadow = np.zeros(z.shape, bool)
    shadow[:, :20] = True
    assert np.array_equal(apply_depth_noise(z, CAMERA, DepthNoiseConfig(), rng(), shadow), z)
    noisy = apply_depth_noise(z, CAMERA, settings("kinect"), rng(), shadow)
    assert np.array_equal(noisy == 0, shadow)


@pytest.mark.parametrize(
    "wrong",
    [{"model": "lidar"}, {"min_range_m": 5.0, "max_range_m": 4.0}, {"grazing_deg": (80, 70)}, {"edge_dropout": 1.5},
     {"projector_baseline_m": 0}, {"disparity_sigma_px": float("inf")}, {"sigma": 1}],
    ids=str,
)  # fmt: skip
def test_settings_out_of_range_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        DepthNoiseConfig.model_validate(wrong)


# --- shadow

NEAR, FAR, HALF = 1.5, 3.0, np.array([0.25, 0.2])
SMALL = Camera(160, 60, 200.0, 100.0, 79.5, 29.5)
BASELINE = 0.24


@pytest.fixture(scope="module")
def scene() -> Any:
    """A board of ±HALF m at z = NEAR before a wall at z = FAR, facing the origin."""
    T = mi.ScalarTransform4f

    def rectangle(z: float, x: float, y: float) -> dict[str, Any]:
        place = T().translate([0, 0, z]).rotate([0, 1, 0], 180).scale([x, y, 1])
        return {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse"}}

    return mi.load_dict({"type": "scene", "board": rectangle(NEAR, *HALF), "wall": rectangle(FAR, 9, 9)})


def test_width_and_side_of_the_shadow(scene: Any) -> None:
    renderer = DepthRenderer(scene, SMALL, Shutter())
    still = constant_twist((0, 0, 0, 0, 0, 0))
    z = renderer.render(still, 0.0)
    lit = Projector(scene, renderer.sensor, BASELINE).lights(z, still, 0.0)
    assert lit.shape == z.shape and lit.dtype == bool
    row = 30
    board = np.flatnonzero(z[row] < 2)
    dark = np.flatnonzero(~lit[row])
    # Left strip: outside the projector's field of view by b f / z.
    strip = BASELINE * SMALL.fx / FAR
    assert dark[dark < strip - 0.5].tolist() == list(range(int(strip)))
    shadow = dark[dark > strip]
    width = BASELINE * SMALL.fx * (1 / NEAR - 1 / FAR)
    assert shadow[-1] == board[0] - 1 and abs(len(shadow) - width) <= 1
    assert lit[row, board].all() and lit[row, board[-1] + 1 :].all()
    above = 2  # the wall above the board: no shadow
    assert z[above].min() > 2 and lit[above, int(strip) + 1 :].all()
    # A pattern that is wider by that strip on either side reaches all of the wall, and the shadow stays.
    wide = Projector(scene, renderer.sensor, BASELINE, 1.0 + 2.05 * strip / SMALL.width).lights(z, still, 0.0)
    assert wide[above].all() and np.flatnonzero(~wide[row]).tolist() == shadow.tolist()


@pytest.mark.parametrize("scan", SCANS)
def test_the_projector_moves_with_the_rows(scene: Any, scan: Any) -> None:
    shutter = Shutter(0.04, 0.01, scan)
    motion = constant_twist((3.0, 1.0, -0.5, 0.3, -2.0, 2.5), se3.exp(np.array([-0.15, 0.0, 0.0, 0.02, 0.05, -0.1])))
    stamp = 0.02
    renderer = DepthRenderer(scene, SMALL, shutter)
    z = renderer.render(motion, stamp)
    lit = Projector(scene, renderer.sensor, BASELINE).lights(z, motion, stamp)

    origin, ray = pixel_rays(SMALL, shutter, motion, stamp)
    R = motion(pixel_times(SMALL, shutter, stamp).ravel()).reshape(SMALL.height, SMALL.width, 4, 4)[..., :3, :3]

    def expected(R: np.ndarray, o: np.ndarray, margin: float) -> np.ndarray:
        """Lit according to geometry, with the board and the field of view grown by `margin` (m)."""
        p, projector = origin + ray * z[..., None], o + BASELINE * R[..., 0]
        s = (NEAR - projector[..., 2]) / (p[..., 2] - projector[..., 2])
        crossing = projector + s[..., None] * (p - projector)
        blocked = (s < 0.999) & (np.abs(crossing[..., :2]) < HALF + margin).all(-1)
        x, _, depth_ = np.moveaxis(np.einsum("...ji,...j->...i", R, p - projector), -1, 0)
        edge = SMALL.unproject([[-0.5, 0.0], [SMALL.width - 0.5, 0.0]])[:, 0]
        return ~blocked & (x / depth_ > edge[0] + margin) & (x / depth_ < edge[1] - margin)

    sure_lit, sure_dark = expected(R, origin, 1e-3), ~expected(R, origin, -1e-3)
    assert (sure_lit | sure_dark).mean() > 0.97 and sure_lit.mean() > 0.3 and sure_dark.mean() > 0.1
    assert lit[sure_lit].all() and not lit[sure_dark].any()
    # A projector that stayed where the first pixel's line saw it would throw quite another shadow.
    assert (expected(R[:1, :1], origin[:1, :1], 0.0) != lit).mean() > 0.01


def test_nothing_is_lit_where_nothing_is() -> None:
    empty = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [0, 0, 2.0], "radius": 0.2}})
    renderer = DepthRenderer(empty, SMALL, Shutter(0.01))
    still = constant_twist((0, 0, 0, 0, 0, 0))
    z = renderer.render(still, 0.0)
    lit = Projector(empty, renderer.sensor, BASELINE).lights(z, still, 0.0)
    assert (z == 0).any() and not lit[z == 0].any() and lit[z > 0].mean() > 0.6


def test_what_neighbours_have_in_common_has_its_size_and_reach() -> None:
    field = np.stack([depth.smooth_field((240, 320), 6.0, np.random.default_rng(k)) for k in range(6)]).astype(float)
    assert field.var() == pytest.approx(1.0, rel=0.05)
    for lag in (3, 6, 12):
        alike = [(field[:, :, :-lag] * field[:, :, lag:]).mean(), (field[:, :-lag] * field[:, lag:]).mean()]
        np.testing.assert_allclose(alike, np.exp(-((lag / 6.0) ** 2)), atol=0.03)


def test_regional_noise_moves_a_wall_by_its_size_and_is_off_by_default() -> None:
    camera = Camera(320, 240, 570.0, 570.0, 159.5, 119.5)
    z = np.full((240, 320), 3.0, np.float32)
    plain = DepthNoiseConfig(model="kinect", lateral_sigma_px=0, disparity_sigma_px=0, disparity_step_px=0)
    exact = apply_depth_noise(z, camera, plain, noise_generator(1, "depth", 0))
    common = plain.model_copy(update={"region_sigma_px": 0.1})
    moved = apply_depth_noise(z, camera, common, noise_generator(1, "depth", 0))
    np.testing.assert_allclose(exact[exact > 0], 3.0, rtol=1e-6)
    shift = (570.0 * 0.075 / moved[moved > 0].astype(float)) - 570.0 * 0.075 / 3.0
    assert shift.std() == pytest.approx(0.1, rel=0.1)


def test_the_xtion_reaches_farther_than_the_kinect() -> None:
    kinect, xtion = (with_presets({"preset": name})["depth"]["noise"] for name in ("kinect_v1", "xtion"))
    assert kinect.get("max_range_m", 8.0) < xtion["max_range_m"] == 10.0
    assert DepthNoiseConfig.model_validate(xtion).region_sigma_px > 0 and "region_sigma_px" not in kinect
