"""Cameras against OpenCV, round trips over whole images, finite differences, and the limits of distortion."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from util import numeric_jacobian

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera

pytestmark = pytest.mark.filterwarnings("error")

PINHOLE = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
# Camera 1 of TUM RGB-D, a wide-angle barrel, strong tangential distortion, and the inner part of TUM VI's fisheye.
FREIBURG1 = replace(PINHOLE, model="radtan", distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633), fx=517.3, fy=516.5)
BARREL = Camera(320, 240, 170.0, 171.0, 158.0, 121.0, "radtan", (-0.25, 0.05, 1e-3, -2e-3))
TANGENTIAL = replace(PINHOLE, model="radtan", distortion=(0.0, 0.0, 0.03, -0.05))
FISHEYE = Camera(400, 400, 190.978, 190.973, 198.93, 200.897, "fisheye", (0.00348, 0.00072, -0.00205, 0.0002))
# As an Azure Kinect's colour camera reports it, and one with all eight coefficients strong.
AZURE = Camera(1280, 720, 605.7, 605.6, 637.9, 366.2, "rational",
               (0.4996, -2.6329, 5.7e-4, -1.4e-4, 1.5296, 0.3800, -2.4539, 1.4563))  # fmt: skip
RATIONAL = replace(PINHOLE, model="rational", distortion=(0.3, 0.1, 0.004, -0.003, 0.02, 0.5, 0.1, 0.01))
# The double sphere paper's BF2M2020S23 lens, one whose alpha is below a half, and one that ends before 90 degrees.
SPHERES = [
    Camera(640, 480, 313.2, 313.2, 319.5, 239.5, "double_sphere", (-0.18, 0.59)),
    Camera(640, 480, 400.0, 410.0, 310.0, 241.0, "double_sphere", (0.3, 0.4)),
    Camera(320, 240, 260.0, 260.0, 160.0, 119.0, "double_sphere", (-0.7, 0.3)),
]
CAMERAS = [PINHOLE, FREIBURG1, BARREL, TANGENTIAL, FISHEYE, AZURE, RATIONAL, *SPHERES]
NAMES = ["pinhole", "freiburg1", "barrel", "tangential", "fisheye", "azure", "rational", "ds", "ds 0.4", "ds ends"]
each_camera = pytest.mark.parametrize("camera", CAMERAS, ids=NAMES)
each_of_opencv = pytest.mark.parametrize("camera", CAMERAS[:-3], ids=NAMES[:-3])
each_sphere = pytest.mark.parametrize("camera", SPHERES, ids=NAMES[-3:])


def opencv_project(camera: Camera, p_cam: np.ndarray) -> np.ndarray:
    points, zero = p_cam.reshape(-1, 1, 3), np.zeros(3)
    if camera.model == "fisheye":
        uv = cv2.fisheye.projectPoints(points, zero, zero, camera.K, np.array(camera.distortion))[0]
    else:
        uv = cv2.projectPoints(points, zero, zero, camera.K, np.array(camera.distortion or [0.0] * 4))[0]
    return uv.reshape(*p_cam.shape[:-1], 2)


def visible_points(camera: Camera, count: int = 300) -> np.ndarray:
    """Points on the rays of random pixels, 0.3 to 8 m deep, and on the optical axis."""
    rng = np.random.default_rng(1)
    uv = rng.uniform([-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5], size=(count, 2))
    return np.concatenate([camera.backproject(uv, rng.uniform(0.3, 8.0, count)), [[0.0, 0.0, 2.0], [1e-12, 0.0, 1.0]]])


@each_of_opencv
def test_projection_agrees_with_opencv(camera: Camera) -> None:
    p = visible_points(camera)
    uv, valid = camera.project(p)
    assert valid.all()
    np.testing.assert_allclose(uv, opencv_project(camera, p), rtol=0, atol=1e-9)


@each_of_opencv
def test_unprojection_agrees_with_opencv(camera: Camera) -> None:
    uv = np.random.default_rng(2).uniform(0.2, 0.8, size=(100, 2)) * (camera.width, camera.height)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-15)
    if camera.model == "fisheye":
        xy = cv2.fisheye.undistortPoints(uv[:, None], camera.K, np.array(camera.distortion), criteria=stop)
    else:
        D = np.array(camera.distortion or [0.0] * 4)
        if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
            xy = cv2.undistortPointsIter(uv[:, None], camera.K, D, np.eye(3), np.eye(3), stop)
        else:
            xy = cv2.undistortPoints(uv[:, None], camera.K, D, criteria=stop)
    np.testing.assert_allclose(camera.unproject(uv)[:, :2], xy[:, 0], rtol=0, atol=1e-8)


def two_spheres(camera: Camera, p: np.ndarray) -> np.ndarray:
    """The paper's projection (40) in three dimensions, as Basalt has it."""
    (xi, alpha), (x, y, z) = camera.distortion, p.T
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    depth = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    return np.stack([camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy], axis=-1)


@each_sphere
def test_a_double_sphere_is_the_papers(camera: Camera) -> None:
    p = visible_points(camera)
    uv, valid = camera.project(p)
    assert valid.all()
    np.testing.assert_allclose(uv, two_spheres(camera, p), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("xi", "alpha"), [(-0.7, 0.3), (-0.9, 0.7), (-0.5, 0.0), (-0.99, 0.5), (-0.6, 1.0), (0.4, 0.9)]
)
def test_a_double_sphere_is_seen_up_to_where_it_folds(xi: float, alpha: float) -> None:
    camera = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, "double_sphere", (xi, alpha))
    end = camera.max_radius
    r = np.linspace(0.0, min(end, 50.0), 20001)[1:-1]
    p = np.stack([r, np.zeros_like(r), np.ones_like(r)], axis=-1)
    assert (np.diff(two_spheres(camera, p)[:, 0]) > 0.0).all()
    assert (two_spheres(camera, p)[:, 0] > camera.cx).all()
    # Just behind the end, where there is one: it turns back, or comes out on the other side.
    if end < 50.0:
        after = two_spheres(camera, np.array([[end * (1.0 + 1e-4), 0.0, 1.0], [end * (1.0 + 2e-4), 0.0, 1.0]]))[:, 0]
        assert after[1] < after[0] or after[0] < camera.cx
        assert camera.project([[end * 1.001, 0.0, 1.0], [end * 0.999, 0.0, 1.0]])[1].tolist() == [False, True]


@pytest.mark.parametrize("distortion", [(-1.0, 0.5), (0.2, 1.1), (0.2, -0.1), (1.2, 0.5), (0.1,)])
def test_what_is_no_double_sphere(distortion: tuple[float, ...]) -> None:
    with pytest.raises(UserError, match="double_sphere takes"):
        replace(PINHOLE, model="double_sphere", distortion=distortion)


@each_camera
def test_pixels_round_trip(camera: Camera) -> None:
    """Every seventh line, the first and the last of them."""
    uv = camera.pixel_grid()
    assert uv.shape == (camera.height, camera.width, 2)
    np.testing.assert_array_equal(uv[3, 7], [7.0, 3.0])
    uv = uv[np.unique([*range(0, camera.height, 7), camera.height - 1])]
    rays = camera.unproject(uv)
    np.testing.assert_array_equal(rays[..., 2], 1.0)
    back, valid = camera.project(rays * 3.0)
    assert valid.all() and camera.contains(back).all()
    np.testing.assert_allclose(back, uv, rtol=0, atol=1e-9)


@each_camera
def test_rays_round_trip(camera: Camera) -> None:
    rng = np.random.default_rng(3)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, 500), np.sqrt(rng.uniform(0.0, 1.0, 500))
    radius *= 0.98 * min(camera.max_radius, 3.0)
    rays = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(500)], axis=-1)
    uv, valid = camera.project(rays)
    assert valid.all()
    np.testing.assert_allclose(camera.unproject(uv), rays, rtol=0, atol=1e-10)


@each_camera
def test_project_jacobian(camera: Camera) -> None:
    for p in visible_points(camera, 20):
        numeric = numeric_jacobian(lambda d, p=p: camera.project(p + d)[0], 3, step=1e-4 * p[2])
        scale = camera.fx / p[2]
        np.testing.assert_allclose(camera.project_jacobian(p), numeric, rtol=0, atol=1e-8 * scale)


def test_pinhole_by_hand() -> None:
    uv, valid = PINHOLE.project([0.5, -0.25, 2.0])
    assert valid
    np.testing.assert_allclose(uv, [319.5 + 481.2 / 4.0, 239.5 - 60.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(PINHOLE.backproject(uv, 2.0), [0.5, -0.25, 2.0], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(PINHOLE.K, [[481.2, 0, 319.5], [0, 480, 239.5], [0, 0, 1]])


@each_camera
def test_behind_the_camera_is_not_visible(camera: Camera) -> None:
    p = np.array(
        [[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, np.inf], [0, 0, 1]]
    )
    with np.errstate(invalid="raise", divide="raise", over="raise"):
        uv, valid = camera.project(p)
        J = camera.project_jacobian(p)
    np.testing.assert_array_equal(valid, [False] * 5 + [True])
    for result in (uv, J):
        assert np.isnan(result[:5]).all() and np.isfinite(result[5]).all()


def test_points_beyond_the_fold_are_not_projected() -> None:
    # x (1 − 0.3 x²) turns back at x = 1.054: OpenCV shows a point at 1.6 inside the image.
    camera = replace(PINHOLE, model="radtan", distortion=(-0.3, 0.0, 0.0, 0.0), fx=400.0, fy=400.0)
    assert camera.max_radius == pytest.approx(1.0 / math.sqrt(0.9))
    p = np.array([[1.6, 0.0, 1.0], [1.06, 0.0, 1.0], [1.05, 0.0, 1.0]])
    assert camera.contains(opencv_project(camera, p)).all()
    np.testing.assert_array_equal(camera.project(p)[1], [False, False, True])
    farthest = 319.5 + 400.0 * 2.0 / 3.0 / math.sqrt(0.9)
    rays = camera.unproject([[farthest - 1e-3, 239.5], [farthest + 1e-3, 239.5]])
    assert np.isfinite(rays[0]).all() and np.isnan(rays[1, :2]).all()


def test_fisheye_fold_and_right_angle() -> None:
    folding = replace(FISHEYE, distortion=(-0.2, 0.0, 0.0, 0.0))
    theta = math.sqrt(1.0 / 0.6)
    assert folding.max_radius == pytest.approx(math.tan(theta))
    for angle, expected in ((theta - 1e-4, True), (theta + 1e-4, False)):
        assert folding.project([math.sin(angle), 0.0, math.cos(angle)])[1] == expected
    equidistant = replace(FISHEYE, distortion=(0.0, 0.0, 0.0, 0.0))
    right_angle = equidistant.cx + equidistant.fx * 0.5 * math.pi
    rays = equidistant.unproject([[right_angle - 0.5, equidistant.cy], [right_angle + 0.5, equidistant.cy]])
    np.testing.assert_allclose(rays[0], [math.tan(0.5 * math.pi - 0.5 / equidistant.fx), 0.0, 1.0], rtol=1e-9)
    assert np.isnan(rays[1, 0])


# Newton's whole steps went round in circles at one ray of these.
@example((0.43380560540908664, 0.214471962837414, 0.010339865489247292, 6.103515625e-05, -0.2421875))
@given(st.tuples(*[st.floats(-0.5, 0.5)] * 2, *[st.floats(-0.05, 0.05)] * 2, st.floats(-0.5, 0.5)))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_distortion_is_one_to_one_on_its_domain(distortion: tuple[float, ...]) -> None:
    camera = Camera(100, 100, 1.0, 1.0, 0.0, 0.0, "radtan", distortion)
    extent = 0.9999 * min(camera.max_radius, 2.0)
    radius, angle = np.meshgrid(np.linspace(0.02, 1.0, 30) * extent, np.linspace(0.0, 2.0 * np.pi, 73))
    rays = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones_like(radius)], axis=-1)
    uv, valid = camera.project(rays)
    assert valid.all()
    # A positive definite derivative (in x and y) on a convex domain: no two rays can share a pixel.
    assert np.linalg.eigvalsh(camera.project_jacobian(rays)[..., :2]).min() > 0.0
    inner = radius < 0.99 * extent
    np.testing.assert_allclose(camera.unproject(uv)[inner], rays[inner], rtol=0, atol=1e-7)


def test_domain_is_not_needlessly_small() -> None:
    for camera in (replace(BARREL, distortion=(-0.3, 0.0, 1e-3, -2e-3)), TANGENTIAL):
        k1, k2, p1, p2 = camera.distortion
        worst = -np.array([p2, p1]) / math.hypot(p1, p2)
        x, y = 1.0001 * camera.max_radius * worst
        r2 = x * x + y * y
        along = 1.0 + 3.0 * k1 * r2 + 5.0 * k2 * r2**2 - 6.0 * math.hypot(p1, p2) * math.sqrt(r2)
        assert along < 0.0


def test_contains_is_half_open() -> None:
    uv = [[-0.5, -0.5], [639.49, 479.49], [639.5, 0.0], [0.0, 479.5], [-0.51, 0.0], [np.nan, 0.0]]
    np.testing.assert_array_equal(PINHOLE.contains(uv), [True, True, False, False, False, False])


@each_camera
@pytest.mark.parametrize("shape", [(), (1,), (0,), (2, 3)])
def test_leading_axes(camera: Camera, shape: tuple[int, ...]) -> None:
    p = np.random.default_rng(4).uniform([-0.3, -0.3, 1.0], [0.3, 0.3, 2.0], size=(*shape, 3))
    uv, valid = camera.project(p)
    assert uv.shape == (*shape, 2) and valid.shape == shape
    assert camera.project_jacobian(p).shape == (*shape, 2, 3)
    np.testing.assert_allclose(camera.backproject(uv, p[..., 2]), p, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 0}, "width"),
        ({"height": -480}, "height"),
        ({"height": 480.5}, "height"),
        ({"width": float("nan")}, "width"),
        ({"width": float("inf")}, "width"),
        ({"fx": 0.0}, "fx"),
        ({"fy": -480.0}, "y-up"),
        ({"cx": float("inf")}, "cx"),
        ({"cy": float("nan")}, "cy"),
        ({"model": "omni"}, "unknown model 'omni'"),
        ({"distortion": (0.1,)}, "pinhole takes 0"),
        ({"model": "radtan", "distortion": (0.1, 0.2, 0.3)}, "4 or 5"),
        ({"model": "fisheye", "distortion": (0.1, 0.2, 0.3, 0.4, 0.5)}, "fisheye takes 4"),
        ({"model": "radtan", "distortion": (0.1, 0.2, 0.3, float("nan"))}, "finite"),
    ],
)
def test_bad_parameters_are_refused(change: dict, words: str) -> None:
    with pytest.raises(UserError, match=words) as caught:
        replace(PINHOLE, **change)
    assert "\n" not in str(caught.value)
