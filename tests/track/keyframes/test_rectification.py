"""Keyframes against closed-form images: rectified depth, registered colour, fusion, normals, pyramids over holes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import synthetic
from rstrack_util import (
    ENGINE,
    SCANS,
    T_COLOR_DEPTH,
    color_input,
    depth_input,
    depth_of,
    exact_reference,
    exposure,
    hand_held,
    intensity_of,
    maker,
    plane_before,
    small_camera,
)

from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import project_rolling
from rsgen.geometry.spline import Spline
from rstrack.images.line_poses import Exposure, from_base_table, to_base_table
from rstrack.images.pyramid import depth_image
from rstrack.images.sampling import EDGE
from rstrack.keyframes.keyframe import (
    Reference,
    rectified_lens,
    strides,
)
from rstrack.keyframes.rectification import ColorInput, RectifyInput, color_kernel, rectify_kernel

WIDTH, HEIGHT = 160, 120
STAMP = 0.42
SHAPE = (HEIGHT, WIDTH)


def camera_of(model: str) -> Camera:
    return small_camera(model, WIDTH, HEIGHT)


def download(array: object, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    return ENGINE.download(array, shape).astype(float)


def true_depth(cast: object, spline: Spline, ref: Reference) -> np.ndarray:
    """Closed-form depth of a rectified reference's pixels."""
    still = Spline(np.repeat(ref.T_world_base[None], 4, axis=0), ref.t - 1.0, 2.0)
    return depth_of(cast, still, Exposure(ref.lens, ref.t, np.eye(4)))  # type: ignore[arg-type]


def edges(z: np.ndarray, reach: int) -> np.ndarray:
    """Pixels within `reach` of a jump or bend of depth."""
    rho = (1.0 / z).astype(np.float32)
    bent = np.abs(cv2.Laplacian(rho, cv2.CV_32F)) > 1e-3 * rho
    return cv2.dilate(bent.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1))).astype(bool)


@pytest.mark.parametrize(
    ("model", "scan"), [*[("pinhole", scan) for scan in SCANS], ("radtan", "top-bottom"), ("fisheye", "left-right")]
)
def test_rectified_depth_is_that_of_a_global_shutter(model: str, scan: str) -> None:
    truth = synthetic.make_spline()
    image = exposure(STAMP, scan, camera_of(model))  # type: ignore[arg-type]
    depth = depth_input(synthetic.cast, truth, image)
    ref = maker(camera_of(model)).rectified(3, depth, (), truth, None)
    assert ref.lens.lines == 1 and ref.lens.camera.model == "pinhole" and ref.rolling is None
    assert (ref.index, ref.stamp, ref.t) == (3, STAMP, image.mid_time)
    rho, z = download(ref.inverse_depth), true_depth(synthetic.cast, truth, ref)
    error = np.abs(rho * z - 1.0)
    found = rho > 0
    smooth = ~edges(z, 4)
    plane = smooth & (np.abs(true_depth(cast_box, truth, ref) - z) < 1e-9)
    inside = np.zeros(SHAPE, bool)
    inside[8:-8, 8:-8] = True
    # Distortion bends lines between pixels: interpolation is exact only for a pinhole. The last pixels at the border
    # may be taken from up to _SETTLED pixels away.
    median, most = (1e-6, 2e-5) if model == "pinhole" else (1e-5, 1e-4)
    assert np.median(error[found & plane]) < median
    assert error[found & plane & inside].max() < most and error[found & plane].max() < 5e-4
    assert np.percentile(error[found & smooth], 99) < 5e-4  # the ball bends between pixels
    # At the ball's outline a pixel may show the wall that the ball hides at mid readout.
    assert (error[found] > EDGE).mean() < 2e-3
    # Holes: at the ball's outline, and where the border saw nothing at mid readout.
    holes = ~found & inside
    assert found.mean() > 0.9
    assert not (holes & smooth).any() and holes.mean() < 0.05
    # Left as it is, the depth would be wrong.
    raw = depth_of(synthetic.cast, truth, image)
    assert np.percentile(np.abs(raw / z - 1.0)[smooth], 90) > 100 * median


def cast_box(p: np.ndarray, d: np.ndarray) -> np.ndarray:
    """The box without its ball."""
    with np.errstate(divide="ignore"):
        return np.max((synthetic.BOX[:, *([None] * (p.ndim - 1))] - p) / d, axis=0).min(axis=-1)


def test_rectification_knows_where_each_pixel_comes_from() -> None:
    truth, camera = synthetic.make_spline(), camera_of("radtan")
    image = exposure(STAMP, "bottom-top", camera)
    base = rectified_lens(camera)
    T_world_base = truth.pose(image.mid_time)
    depth = depth_input(cast_box, truth, image)
    kernel = rectify_kernel(ENGINE, image.lens, base)
    to_base = ENGINE.upload(to_base_table(truth, T_world_base, image))
    rho, x, y = (download(a) for a in kernel(RectifyInput(depth.inverse_z, *maker(camera).device_rays, to_base)))
    found = rho > 0
    p = se3.transform(T_world_base, base.camera.backproject(base.camera.pixel_grid(), 1.0 / np.where(found, rho, 1.0)))
    uv, _, valid = project_rolling(truth, np.eye(4), camera, image.lens.shutter, STAMP, p[found])
    assert valid.mean() > 0.99
    # One more step follows after the last check, so that they are better than what is let through.
    assert np.nanmax(np.abs(np.stack([x[found], y[found]], axis=-1) - uv)) < 0.01


def test_missing_depth_stays_missing() -> None:
    truth, camera = hand_held(2), camera_of("pinhole")
    image = exposure(STAMP, "top-bottom", camera)
    plane = plane_before(truth.pose(STAMP), (0.2, 0.1, 1.0))
    z = depth_of(plane.cast, truth, image)
    z[40:60, 70:100] = 0.0
    ref = maker(camera).rectified(0, depth_image(ENGINE, image, z, 100.0), (), truth, None)
    rho = download(ref.inverse_depth)
    assert (rho[43:57, 73:97] == 0).all()
    assert (rho[[36, 63], 66:104] > 0).all() and (rho[36:64, [66, 103]] > 0).all()
    assert np.abs(rho * true_depth(plane.cast, truth, ref) - 1.0)[rho > 0].max() < 1e-4
    nothing = maker(camera).rectified(0, depth_image(ENGINE, image, np.zeros(SHAPE), 100.0), (), truth, None)
    assert not download(nothing.inverse_depth).any()


# -- colour --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ref_scan", "scan"), [(None, "top-bottom"), (None, "right-left"), ("left-right", "bottom-top")]
)
def test_registered_colour_is_the_texture_there(ref_scan: str | None, scan: str) -> None:
    truth = hand_held(5)
    camera, colour = camera_of("radtan" if ref_scan else "pinhole"), small_camera("fisheye", 180, 130)
    plane = plane_before(truth.pose(STAMP), (0.3, -0.2, 1.0))
    ref = exact_reference(plane.cast, truth, exposure(STAMP, ref_scan, camera))  # type: ignore[arg-type]
    seen_at = exposure(STAMP + 0.012, scan, colour, T_COLOR_DEPTH, 0.02)  # type: ignore[arg-type]
    image = color_input(plane.cast, truth, seen_at)
    m = maker(camera)
    depth = depth_input(plane.cast, truth, exposure(STAMP, ref_scan, camera))  # type: ignore[arg-type]
    made = m.rolling(0, depth, (image,), truth)
    assert made.rolling is (depth.exposure if ref_scan else None)
    # The maker's points are those of a reference with closed-form intensities, pixel by pixel.
    for level, (got, want) in enumerate(zip(made.points, ref.points, strict=True)):
        there, expected = got.z.numpy() > 0, want.z.numpy() > 0
        np.testing.assert_array_equal(got.z.numpy()[there], want.z.numpy()[there])
        assert there.sum() > 0.85 * expected.sum()
        inner = there if level == 0 else interior(there, level)
        error = np.abs(got.intensity.numpy() - want.intensity.numpy())[inner]
        # Bilinear interpolation of the texture; level 0 is 4e-4 in an 8-bit image's 4e-3.
        assert error.max() < 1e-3


def interior(flat: np.ndarray, level: int) -> np.ndarray:
    """Points of a level away from the border of what is known, where a pyramid mixes different neighbours."""
    stride = strides(WIDTH, HEIGHT)[level]
    grid = flat.reshape(-(-HEIGHT // stride), -(-WIDTH // stride)).astype(np.uint8)
    return cv2.erode(grid, np.ones((5, 5)), borderValue=0).astype(bool).ravel()


def test_points_outside_the_colour_image_have_no_colour() -> None:
    truth, camera = hand_held(5), camera_of("pinhole")
    plane = plane_before(truth.pose(STAMP), (0.0, 0.0, 1.0))
    ref = exact_reference(plane.cast, truth, exposure(STAMP, None, camera))
    half = Camera(80, HEIGHT, camera.fx, camera.fy, camera.cx, camera.cy)
    seen_at = exposure(STAMP, None, half)
    kernel = color_kernel(ENGINE, seen_at.lens, ref.lens)
    image = color_input(plane.cast, truth, seen_at)
    grid = maker(camera).device_rays
    table = ENGINE.upload(from_base_table(truth, ref.T_world_base, seen_at))
    zero = ENGINE.upload(np.zeros(12))
    value, seen = kernel(ColorInput(ref.inverse_depth, *grid, zero, image.levels[0], table))
    value, seen = download(value), download(seen)
    assert seen[1:-2, 1:78].all()
    assert not seen[:, 80:].any() and not value[:, 80:].any()
    np.testing.assert_allclose(value[1:-2, 1:78], intensity_of(plane.cast, truth, seen_at)[1:-2, 1:78], atol=1e-4)


# -- fusion --------------------------------------------------------------------------------------------------------


NOISE = 0.002


def still_spline(T_world_body: np.ndarray) -> Spline:
    return Spline(np.repeat(T_world_body[None], 12, axis=0), 0.0, 0.1)


def moving_away(seed: int) -> Spline:
    """A camera that stands about 10 cm and 0.1 rad from the identity and moves on from there."""
    spline = hand_held(seed)
    start = se3.inverse(spline.pose(STAMP))
    offset = se3.exp(np.random.default_rng(seed).normal(size=6) * 0.06)
    return Spline(offset @ start @ spline.control_points, spline.t0, spline.dt)


def flat(camera: Camera, plane: object, noise: np.ndarray | float = 0.0) -> Reference:
    """A keyframe at the identity that looks at a plane."""
    image = exposure(STAMP, None, camera)
    z = depth_of(plane.cast, still_spline(np.eye(4)), image) + noise  # type: ignore[attr-defined]
    return maker(camera).rolling(0, depth_image(ENGINE, image, z, 100.0), (), still_spline(np.eye(4)))


def test_fusion_averages_noise_away() -> None:
    rng, camera = np.random.default_rng(1), camera_of("pinhole")
    plane = plane_before(np.eye(4), (0.35, -0.25, 1.0))
    m = maker(camera)
    ref = flat(camera, plane, rng.normal(size=SHAPE) * NOISE)
    z = true_depth(plane.cast, still_spline(np.eye(4)), ref)
    # The normals that fusion uses are those of the unspoilt plane: their noise is another matter.
    clean = flat(camera, plane)
    ref = replace(ref, slope_x=clean.slope_x, slope_y=clean.slope_y)
    count = 8
    for seed in range(count):
        spline = moving_away(seed)
        image = exposure(STAMP, "top-bottom", camera)
        noisy = depth_of(plane.cast, spline, image) + rng.normal(size=SHAPE) * NOISE
        ref = m.fused(ref, depth_image(ENGINE, image, noisy, 100.0), spline)
    weight = download(ref.weight)
    full = weight == count + 1
    assert full.mean() > 0.5 and weight.max() == count + 1
    error = (1.0 / download(ref.inverse_depth) - z)[full]
    # Bilinear interpolation averages four neighbours: 4/9 of the variance on average.
    expected = NOISE * np.sqrt(1.0 + count * 4.0 / 9.0) / (count + 1)
    assert np.std(error) == pytest.approx(expected, rel=0.1)
    assert abs(error.mean()) < 5.0 * expected / np.sqrt(full.sum() / 9)


def test_a_shifted_plane_shifts_the_keyframe_along_its_normal() -> None:
    # 50 degrees of slant, and a source that looks at it from elsewhere: depths differ by other amounts in each camera.
    camera, normal = camera_of("pinhole"), (1.2, 0.1, 1.0)
    plane = plane_before(np.eye(4), normal)
    shift = 0.01
    shifted = replace(plane, offset=plane.offset + shift)
    T = se3.exp(np.array([0.3, 0.0, -0.2, 0.0, -0.2, 0.1]))
    m, ref = maker(camera), flat(camera, plane)
    image = exposure(STAMP, None, camera)
    depth = depth_input(shifted.cast, still_spline(T), image)
    fused = m.fused(ref, depth, still_spline(T))
    touched = download(fused.weight) == 2.0
    assert touched.mean() > 0.2
    before, after = (true_depth(p.cast, still_spline(np.eye(4)), ref) for p in (plane, shifted))
    moved = 1.0 / download(fused.inverse_depth) - before
    np.testing.assert_allclose(moved[touched], 0.5 * (after - before)[touched], rtol=0.02)
    assert np.abs(moved[~touched]).max() < 1e-5
    # A depth difference taken over as it is would be wrong by a tenth and more: z changes by shift / (n · ray).
    p = camera.unproject(camera.pixel_grid()) * before[..., None]
    ray_there = (p - T[:3, 3]) / se3.transform(np.linalg.inv(T), p)[..., 2:]
    ratio = (ray_there @ plane.normal) / ((p @ plane.normal) / before)
    assert np.median(np.abs(ratio - 1.0)[touched]) > 0.1


def test_surfaces_that_disagree_are_left_alone() -> None:
    camera = camera_of("pinhole")
    plane = plane_before(np.eye(4), (0.2, 0.1, 1.0))
    ref, m, image = flat(camera, plane), maker(camera), exposure(STAMP, "top-bottom", camera)
    still = still_spline(np.eye(4))
    z = depth_of(plane.cast, still, image)
    for offset, agrees in ((0.08, False), (-0.08, False), (0.03, True)):
        fused = m.fused(ref, depth_image(ENGINE, image, z + offset, 100.0), still)
        changed = download(fused.inverse_depth) != download(ref.inverse_depth)
        assert changed.mean() == pytest.approx(1.0 if agrees else 0.0, abs=0.05)
        assert download(fused.weight).max() == (2.0 if agrees else 1.0)
    # Holes of either image.
    z[:, 50:70] = 0.0
    fused = m.fused(ref, depth_image(ENGINE, image, z, 100.0), still)
    np.testing.assert_array_equal(download(fused.weight)[:, 50:70], 1.0)
    hole = depth_image(ENGINE, exposure(STAMP, None, camera), np.zeros(SHAPE), 100.0)
    empty = m.rolling(0, hole, (), still)
    assert not download(m.fused(empty, depth_image(ENGINE, image, z, 100.0), still).inverse_depth).any()


def test_weights_are_capped() -> None:
    camera, still = camera_of("pinhole"), still_spline(np.eye(4))
    plane = plane_before(np.eye(4), (0.0, 0.0, 1.0))
    ref, m = flat(camera, plane), maker(camera)
    depth = depth_input(plane.cast, still, exposure(STAMP, "top-bottom", camera))
    for _ in range(40):
        ref = m.fused(ref, depth, still)
    assert 5.0 < download(ref.weight).max() <= 30.0
    np.testing.assert_allclose(1.0 / download(ref.inverse_depth), 2.0, rtol=1e-5)


def test_a_new_keyframe_inherits_depth_and_fills_its_holes() -> None:
    camera, truth = camera_of("pinhole"), hand_held(6)
    plane = plane_before(truth.pose(STAMP), (0.2, -0.3, 1.0))
    m = maker(camera)
    older = m.rectified(0, depth_input(plane.cast, truth, exposure(STAMP, "top-bottom", camera)), (), truth, None)
    image = exposure(STAMP + 0.1, "top-bottom", camera)
    z = depth_of(plane.cast, truth, image)
    z[50:70, 60:90] = 0.0
    depth = depth_image(ENGINE, image, z, 100.0)
    alone, made = m.rectified(3, depth, (), truth, None), m.rectified(3, depth, (), truth, older)
    assert (download(alone.inverse_depth)[54:66, 64:86] == 0).all()
    rho, weight = download(made.inverse_depth), download(made.weight)
    assert (rho[54:66, 64:86] > 0).all() and (weight[54:66, 64:86] == 1.0).all()
    assert (weight == 2.0).mean() > 0.6
    z = true_depth(plane.cast, truth, made)
    assert np.abs(rho * z - 1.0)[rho > 0].max() < 3e-5
