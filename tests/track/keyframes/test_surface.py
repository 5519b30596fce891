"""What a keyframe's inverse depth shows of its surfaces: slopes, edges, roughness; against planes and plain NumPy."""

from __future__ import annotations

import cv2
import numpy as np
from rstrack_util import small_camera

from rsgen.geometry.camera import Camera
from rstrack.images.sampling import EDGE
from rstrack.keyframes.surface import on_one_surface, surface_bends, surface_roughness, surface_slopes

SHAPE = (120, 160)


def camera_of(model: str) -> Camera:
    return small_camera(model, SHAPE[1], SHAPE[0])


def plane_rho(camera: Camera, m: tuple[float, float, float]) -> np.ndarray:
    """Inverse depth of the plane m · p = 1."""
    return (camera.unproject(camera.pixel_grid()) @ np.array(m)).astype(np.float32)


def test_slopes_of_a_plane_are_exact() -> None:
    camera = camera_of("pinhole")
    for m in ((0.1, -0.05, 0.5), (0.0, 0.0, 0.4), (-0.2, 0.2, 0.6)):
        slope_x, slope_y = surface_slopes(plane_rho(camera, m), camera.fx, camera.fy)
        np.testing.assert_allclose(slope_x, m[0], atol=2e-6)
        np.testing.assert_allclose(slope_y, m[1], atol=2e-6)


def test_slopes_are_not_smeared_across_edges_and_holes() -> None:
    camera = camera_of("pinhole")
    near, far = (0.1, -0.05, 0.8), (-0.1, 0.02, 0.4)
    rho = plane_rho(camera, near)
    left, below = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    left[:, :70], below[80:] = True, True
    other = left | below
    rho[other] = plane_rho(camera, far)[other]
    hole = np.zeros(SHAPE, bool)
    hole[20:30, 100:120] = True
    rho[hole] = 0.0
    slope_x, slope_y = surface_slopes(rho, camera.fx, camera.fy)
    # Within two pixels of the edge the window holds pixels of both planes: it may mean, but never differentiate, both.
    reach = cv2.dilate(other.astype(np.uint8), np.ones((5, 5))) != cv2.erode(other.astype(np.uint8), np.ones((5, 5)))
    for slope, a, b in ((slope_x, near[0], far[0]), (slope_y, near[1], far[1])):
        want = np.where(other, b, a)
        known = ~reach & (cv2.erode(hole.astype(np.uint8), np.ones((5, 5))) == 0)
        np.testing.assert_allclose(slope[known], want[known], atol=1e-5)
        assert slope[reach].min() > min(a, b) - 1e-5 and slope[reach].max() < max(a, b) + 1e-5
    assert (slope_x[24:26, 105:115] == 0).all()


def test_one_surface_is_what_has_no_edge_beside_it() -> None:
    rho = np.full((9, 11), 0.5, np.float32)
    rho[:, 6:] = 0.5 * (1.0 + 2.0 * EDGE)
    rho[2, 2] = 0.0
    rho[7, 8] *= 1.0 + 0.5 * EDGE
    want = np.ones(rho.shape, bool)
    want[:, 5:7] = False  # beside the step
    want[2, 1:4] = want[1:4, 2] = False  # the hole and its neighbours
    np.testing.assert_array_equal(on_one_surface(rho), want)


def test_roughness_is_the_chords_error_where_walls_meet() -> None:
    camera = Camera(160, 120, 120.0, 118.0, 79.5, 59.5)
    x = (camera.pixel_grid()[..., 0] - camera.cx) / camera.fx
    # Two walls m·p = 1 that meet at x = 0 and differ in slope by 0.4.
    rho = (0.5 + np.where(x < 0, 0.1, -0.3) * x).astype(np.float32)
    slopes = surface_slopes(rho, camera.fx, camera.fy)
    rough = surface_roughness(rho, *slopes, camera.fx, camera.fy)
    # Bilinear interpolation at x = 0, between pixel centres at -1/2 and 1/2 px, against the corner itself.
    chord = 0.5 * (rho[60, 79] + rho[60, 80]) - 0.5
    np.testing.assert_allclose(rough[60, 79:81], abs(chord) / 0.5**2 * 0.5, rtol=0.25)
    assert rough[60, :70].max() < 1e-6 and rough[60, 90:].max() < 1e-6


def plain_slope(rho: np.ndarray, axis: int, focal: float) -> np.ndarray:
    """`surface_slopes` along one axis, as NumPy has it."""
    r = rho if axis == 1 else rho.T
    step = r[:, 1:] - r[:, :-1]
    both = (r[:, 1:] > 0) & (r[:, :-1] > 0) & (np.abs(step) < np.float32(EDGE) * r[:, 1:])
    total, count = np.zeros_like(r), np.zeros_like(r)
    for side in (slice(None, -1), slice(1, None)):
        total[:, side] += np.where(both, step, 0)
        count[:, side] += both
    if axis == 0:
        total, count = total.T, count.T
    mean, share = (cv2.boxFilter(np.ascontiguousarray(a), -1, (5, 5)) for a in (total, count))
    return np.float32(focal) * mean / np.maximum(share, np.float32(1e-3))


def plain_on_one_surface(rho: np.ndarray) -> np.ndarray:
    valid = rho > 0
    for a, b, here, there in (
        (rho[1:], rho[:-1], valid[1:], valid[:-1]), (rho[:, 1:], rho[:, :-1], valid[:, 1:], valid[:, :-1])
    ):  # fmt: skip
        edge = np.abs(a - b) > np.float32(EDGE) * np.maximum(a, b)
        here &= ~edge
        there &= ~edge
    return valid


def test_compiled_loops_give_the_bits_of_plain_numpy() -> None:
    rng = np.random.default_rng(4)
    camera, shape = Camera(61, 47, 52.3, 51.7, 30.1, 23.3), (47, 61)
    rho = (0.5 + 0.004 * rng.standard_normal(shape)).astype(np.float32)
    rho[rng.random(shape) < 0.1] = 0.0
    rho[20:, 30:] *= np.float32(1.5)
    slopes = surface_slopes(rho, camera.fx, camera.fy)
    for got, axis, focal in zip(slopes, (1, 0), (camera.fx, camera.fy), strict=True):
        np.testing.assert_array_equal(got, plain_slope(rho, axis, focal))
    np.testing.assert_array_equal(on_one_surface(rho), plain_on_one_surface(rho))
    assert 0.1 < on_one_surface(rho).mean() < 0.9
    z = np.divide(np.float32(1.0), rho, out=np.zeros_like(rho), where=rho > 0)
    bends = np.maximum(*surface_bends(*slopes, camera.fx, camera.fy))
    rough = surface_roughness(rho, *slopes, camera.fx, camera.fy)
    np.testing.assert_array_equal(rough, np.float32(5 / 8) * z * z * bends)
