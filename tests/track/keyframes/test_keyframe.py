"""Normals, edges, points and pyramids of references, and images as the kernels take them."""

from __future__ import annotations

import numpy as np
import pytest
from rstrack_util import (
    ENGINE,
    small_camera,
    texture,
)

from rsgen.device.lens import Lens
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import LEVELS, depth_image, depth_resolution, intensity, masked_pyramid
from rstrack.keyframes.keyframe import gradient, level_points, strides

SHAPE = (120, 160)


def camera_of(model: str) -> Camera:
    return small_camera(model, SHAPE[1], SHAPE[0])


def download(array: object, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    return ENGINE.download(array, shape).astype(float)


def slow_pyramid(image: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One level of normalised convolution: sums of value · weight and of weight over 5×5, mirrored at the border."""
    kernel = np.array([1, 4, 6, 4, 1]) / 16.0
    h, w = image.shape
    total, weight = np.zeros((-(-h // 2), -(-w // 2))), np.zeros((-(-h // 2), -(-w // 2)))
    mirror = lambda i, n: -i if i < 0 else 2 * (n - 1) - i if i >= n else i  # noqa: E731
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            for b in range(-2, 3):
                for a in range(-2, 3):
                    k = kernel[a + 2] * kernel[b + 2]
                    v, u = mirror(2 * y + b, h), mirror(2 * x + a, w)
                    total[y, x] += k * valid[v, u] * image[v, u]
                    weight[y, x] += k * valid[v, u]
    return total, weight


def test_a_pyramid_over_holes_is_normalised_convolution() -> None:
    rng = np.random.default_rng(9)
    image = rng.uniform(size=(22, 31)).astype(np.float32)
    valid = rng.uniform(size=image.shape) < 0.6
    levels = masked_pyramid(image, valid)
    total, weight = np.where(valid, image, 0.0), valid.astype(float)
    ones = np.ones(image.shape)
    for got, known in levels[1:]:
        total = slow_pyramid(total, ones)[0]
        weight = slow_pyramid(weight, ones)[0]
        ones = np.ones(total.shape)
        np.testing.assert_allclose(got, total / weight, atol=2e-6)
        sure = np.abs(weight - 0.5) > 1e-5
        np.testing.assert_array_equal(known[sure], weight[sure] > 0.5)
    assert len(levels) == LEVELS
    # What holes contain does not matter, and a constant stays one.
    spoilt = masked_pyramid(np.where(valid, image, np.float32(1e6)), valid)
    flat = masked_pyramid(np.where(valid, np.float32(0.7), np.float32(-9.0)), valid)
    for (a, _), (b, _), (c, known) in zip(levels, spoilt, flat, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_allclose(c[known], 0.7, rtol=1e-5)


def test_points_of_all_levels_lie_on_the_surface() -> None:
    camera, m = camera_of("radtan"), (0.1, -0.05, 0.5)
    rays = camera.unproject(camera.pixel_grid())[..., :2]
    rho = (rays @ np.array(m[:2]) + m[2]).astype(np.float32)
    rho[:, 90:] *= np.float32(1.5)
    colour = texture(np.concatenate([rays, np.ones((*SHAPE, 1))], axis=-1)).astype(np.float32)
    colour[:30] = np.nan
    for points, stride in zip(level_points(ENGINE, rho, rays, colour), strides(*SHAPE[::-1]), strict=True):
        shape = -(-SHAPE[0] // stride), -(-SHAPE[1] // stride)
        x, y, z, value = (download(a, shape) for a in (points.x, points.y, points.z, points.intensity))
        on = z > 0
        assert not on[: 30 // stride].any() and on[-(-60 // stride) :, : 80 // stride].all()
        assert not on[:, np.isin(np.arange(0, SHAPE[1], stride), (89, 90))].any()  # beside the edge
        factor = np.where(np.arange(0, SHAPE[1], stride) >= 90, 1.5, 1.0)
        np.testing.assert_allclose(((m[0] * x + m[1] * y + m[2] * z) * factor)[on], 1.0, atol=1e-5)
        uv, _ = camera.project(np.stack([x, y, z], axis=-1)[on])
        np.testing.assert_allclose(uv, camera.pixel_grid()[::stride, ::stride][on], atol=1e-3)
        assert points.median_depth == pytest.approx(np.median(z[on]))
        # The bound covers the slopes of the texture.
        gy, gx = np.gradient(colour[30:])
        steepest = camera.fx * np.percentile((np.hypot(gx, gy) * rho[30:]).ravel(), 95)
        assert points.bound > steepest
        inner = value[on & (np.add.outer(np.arange(shape[0]) * stride, np.zeros(shape[1])) > 60)]
        assert len(inner) and 0.0 < inner.min() < inner.max() < 1.0


def test_resolution_of_whole_disparities_is_found() -> None:
    rng = np.random.default_rng(0)
    z = rng.uniform(0.8, 4.0, (120, 160))
    disparity = np.round(8 * 42.75 / z) / 8
    assert depth_resolution((42.75 / disparity).astype(np.float32)) == pytest.approx(1 / (8 * 42.75), rel=0.02)
    with_holes = np.where(rng.random(z.shape) < 0.3, 0.0, 42.75 / disparity).astype(np.float32)
    assert depth_resolution(with_holes) == pytest.approx(1 / (8 * 42.75), rel=0.02)
    assert depth_resolution(z.astype(np.float32)) == 0.0 and depth_resolution(np.zeros((8, 8), np.float32)) == 0.0


def test_images_as_the_kernels_take_them() -> None:
    image = Exposure(Lens(Camera(3, 2, 3.0, 3.0, 1.0, 0.5), Shutter()), 0.0, np.eye(4))
    z = np.array([[0.5, np.nan, -1.0], [np.inf, 8.0, 4.0]])
    depth = depth_image(ENGINE, image, z, 6.0)
    assert depth.count == 2
    np.testing.assert_allclose(download(depth.z, (2, 3)), [[0.5, 0, 0], [0, 0, 4.0]])
    np.testing.assert_allclose(download(depth.inverse_z, (2, 3)), [[2.0, 0, 0], [0, 0, 0.25]])
    for colour, grey in (((255, 0, 0), 0.299), ((0, 255, 0), 0.587), ((0, 0, 255), 0.114), ((255, 255, 255), 1.0)):
        np.testing.assert_allclose(intensity(np.full((4, 5, 3), colour, np.uint8)), grey, atol=2.1e-3)
    # The slight blur keeps the sum.
    point = np.zeros((9, 9, 3), np.uint8)
    point[4, 4] = 255
    assert 0.2 < intensity(point)[4, 4] < 0.3 and abs(intensity(point).sum() - 1.0) < 1e-3


def test_the_gradient_at_every_so_manyth_pixel_is_numpys() -> None:
    image = np.random.default_rng(2).uniform(size=(23, 30)).astype(np.float32)
    by_y, by_x = np.gradient(image)
    for stride in (1, 2, 4):
        got_x, got_y = gradient(image, stride)
        np.testing.assert_array_equal(got_x, by_x[::stride, ::stride])
        np.testing.assert_array_equal(got_y, by_y[::stride, ::stride])
