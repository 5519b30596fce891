"""A keyframe's surface and points in passes over rows, against plain twins on images full of holes and edges."""

from __future__ import annotations

import numpy as np
import pytest
import surface_twin
from rstrack_util import ENGINE, small_camera

from rsgen.geometry.camera import Camera
from rstrack.images.pyramid import masked_pyramid
from rstrack.keyframes.keyframe import level_points, pyramid_level, strides
from rstrack.keyframes.surface import on_one_surface, surface_bends, surface_roughness, surface_slopes


def broken(seed: int, height: int, width: int) -> np.ndarray:
    """Inverse depth (h, w) of slanted planes with steps about as large as edges, noise and holes."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    rho = 0.5 + 2e-3 * x - 1e-3 * y + rng.normal(0.0, 3e-3, (height, width))
    rho = rho * np.where(rng.random((height, width)) < 0.1, 1.04, 1.0)
    return np.where(rng.random((height, width)) < 0.15, 0.0, rho).astype(np.float32)


@pytest.mark.parametrize("shape", [(23, 31), (6, 40), (40, 7)])
def test_slopes_and_what_comes_of_them_are_their_twins(shape: tuple[int, int]) -> None:
    fx, fy = 31.0, 29.0
    rho = broken(1, *shape)
    found, want = surface_slopes(rho, fx, fy), surface_twin.slopes(rho, fx, fy)
    for got, expected in zip(found, want, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-5)
    assert np.abs(want[0]).max() > 0.05
    bends = surface_bends(*found, fx, fy)
    rough = surface_roughness(rho, *found, fx, fy)
    np.testing.assert_allclose(rough, surface_twin.roughness(rho, *found, fx, fy), rtol=1e-5, atol=1e-9)
    assert (bends[0][:, [0, -1]] == 0).all() and (bends[1][[0, -1]] == 0).all()
    np.testing.assert_allclose(
        np.maximum(*bends)[rho > 0], (rough * rho.astype(float) ** 2 / 0.625)[rho > 0], rtol=1e-5
    )
    np.testing.assert_array_equal(on_one_surface(rho), surface_twin.one_surface(rho))


@pytest.mark.parametrize("size", [(160, 120), (321, 241)])
def test_points_are_their_twins(size: tuple[int, int]) -> None:
    camera: Camera = small_camera("radtan", *size)
    rng = np.random.default_rng(2)
    rho = broken(3, size[1], size[0])
    rays = camera.unproject(camera.pixel_grid())[..., :2]
    intensity = rng.random(rho.shape).astype(np.float32)
    intensity[rng.random(rho.shape) < 0.1] = np.nan
    images = masked_pyramid(intensity, np.isfinite(intensity) & (rho > 0))
    found = level_points(ENGINE, rho, rays, intensity)
    for sampling, (points, stride) in enumerate(zip(found, strides(*size), strict=True)):
        level = pyramid_level(sampling)
        want = surface_twin.points(rho, rays, *images[level], stride, level)
        for got, expected in zip((points.x, points.y, points.z, points.intensity), want, strict=False):
            np.testing.assert_allclose(got.numpy(), expected.ravel(), rtol=1e-5, atol=1e-6)
        z, slope = want[2], want[4]
        # Scales, from some of the points.
        assert points.median_depth == pytest.approx(np.median(z[z > 0]), rel=0.02)
        focal = 1.0 / np.diff(rays[0, :, 0]).mean()
        assert points.bound == pytest.approx(2.0 * focal * np.percentile(slope[slope >= 0], 99.5), rel=0.1)
