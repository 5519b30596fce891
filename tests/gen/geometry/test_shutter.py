"""Shutter timing by hand; rolling-shutter projection against root bracketing, closed forms, mirrors, differences."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import brentq
from shutter_reference import line_window, rolling_shutter_jacobian
from util import numeric_jacobian, random_spline, random_twists

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter, project_rolling
from rsgen.geometry.spline import Spline

pytestmark = pytest.mark.filterwarnings("error")

SCANS = ["top-bottom", "bottom-top", "left-right", "right-left"]
PINHOLE = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
RADTAN = replace(PINHOLE, model="radtan", distortion=(0.1, -0.2, 1e-3, -2e-3, 0.05), cx=310.0, cy=250.0)
FISHEYE = replace(PINHOLE, model="fisheye", distortion=(0.01, -0.02, 0.005, -0.001), fx=300.0, fy=301.0)
T_CAM_BODY = se3.exp([-0.025, 0.003, 0.001, 0.01, -0.02, 0.03])
STAMP = 0.42


def hand_held(seed: int = 1) -> Spline:
    """About 1 m/s and 2 rad/s: five pixels of line shift within a readout for slow parts, fifty for fast ones."""
    return random_spline(seed, points=12, angle=0.1, distance=0.05)


def points_in_view(spline: Spline, camera: Camera, count: int = 60, margin: float = 40.0) -> np.ndarray:
    """World points on rays in and, by `margin` pixels, around the image as seen amid the readout; 0.5 to 5 m deep."""
    rng = np.random.default_rng(7)
    size = np.array([camera.width, camera.height])
    p_cam = camera.backproject(rng.uniform(-margin, size + margin, (count, 2)), rng.uniform(0.5, 5.0, count))
    return se3.transform(spline.pose(STAMP) @ se3.inverse(T_CAM_BODY), p_cam)


def opencv_pixel(spline: Spline, camera: Camera, t: float, p_world: np.ndarray) -> np.ndarray:
    p_cam = (T_CAM_BODY @ np.linalg.inv(spline.pose(t)) @ [*p_world, 1.0])[:3].reshape(1, 1, 3)
    if camera.model == "fisheye":
        uv = cv2.fisheye.projectPoints(p_cam, np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))[0]
    else:
        D = np.array(camera.distortion or [0.0] * 4)
        uv = cv2.projectPoints(p_cam, np.zeros(3), np.zeros(3), camera.K, D)[0]
    return uv.ravel()


def line_time(scan: str, camera: Camera, shutter: Shutter, uv: np.ndarray) -> float:
    """Mid-exposure time of a pixel, written out independently of the package."""
    u, v = uv
    w, h = camera.width, camera.height
    part = {"top-bottom": v / h, "bottom-top": (h - 1 - v) / h, "left-right": u / w, "right-left": (w - 1 - u) / w}
    return STAMP - 0.5 * shutter.exposure_s + shutter.readout_s * part[scan]


@pytest.mark.parametrize("camera", [PINHOLE, RADTAN, FISHEYE], ids=["pinhole", "radtan", "fisheye"])
@pytest.mark.parametrize("scan", SCANS)
def test_projection_against_bracketing(scan: str, camera: Camera) -> None:
    spline, shutter = hand_held(), Shutter(0.028, 0.01, scan)
    p_world = points_in_view(spline, camera)
    uv, t, valid = project_rolling(spline, T_CAM_BODY, camera, shutter, STAMP, p_world)
    lines = camera.height if scan in SCANS[:2] else camera.width
    first, last = (STAMP - 0.005 + 0.028 * line / lines for line in (-0.5, lines - 0.5))
    size, seen = np.array([camera.width, camera.height]), 0
    for p, uv_k, t_k, valid_k in zip(p_world, uv, t, valid, strict=True):
        equation = lambda x, p=p: line_time(scan, camera, shutter, opencv_pixel(spline, camera, x, p)) - x  # noqa: E731
        if not (equation(first) >= 0.0 > equation(last)):
            assert not valid_k
            continue
        root = brentq(equation, first, last, xtol=1e-15, rtol=8.9e-16)
        expected = opencv_pixel(spline, camera, root, p)
        inside = (expected >= -0.5).all() and (expected < size - 0.5).all()
        assert valid_k == inside
        if inside:
            seen += 1
            np.testing.assert_allclose(t_k, root, rtol=0, atol=1e-13)
            np.testing.assert_allclose(uv_k, expected, rtol=0, atol=1e-8)
    assert 30 <= seen < len(p_world)
    assert np.isnan(uv[~valid]).all() and np.isnan(t[~valid]).all()


@pytest.mark.parametrize("scan", SCANS)
def test_global_shutter_is_a_plain_projection(scan: str) -> None:
    spline = hand_held()
    p_world = points_in_view(spline, RADTAN)
    uv, t, valid = project_rolling(spline, T_CAM_BODY, RADTAN, Shutter(0.0, 0.01, scan), STAMP, p_world)
    expected = np.array([opencv_pixel(spline, RADTAN, STAMP - 0.005, p) for p in p_world])
    np.testing.assert_array_equal(valid, RADTAN.contains(expected))
    assert 0 < valid.sum() < len(valid)
    np.testing.assert_array_equal(t[valid], STAMP - 0.005)
    np.testing.assert_allclose(uv[valid], expected[valid], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("scan", "sign"), [("left-right", 1.0), ("right-left", -1.0), ("top-bottom", 0.0)])
def test_constant_velocity_has_a_closed_form(scan: str, sign: float) -> None:
    # Sideways at V m/s in front of a plane at depth z: u = fx (X − V t) / z + cx, v constant.
    V, z, readout = 0.8, 2.0, 0.03
    T = np.broadcast_to(np.eye(4), (30, 4, 4)).copy()
    T[:, 0, 3] = V * 0.05 * (np.arange(30) - 1.0)
    spline, shutter = Spline(T, 0.0, 0.05), Shutter(readout, 0.0, scan)
    X, Y = np.meshgrid(np.linspace(-0.8, 1.2, 15), np.linspace(-0.9, 0.9, 9))
    uv, _, valid = project_rolling(
        spline, np.eye(4), PINHOLE, shutter, STAMP, np.stack([X, Y, np.full_like(X, z)], axis=-1)
    )
    a, b = PINHOLE.fx * X / z + PINHOLE.cx, PINHOLE.fx * V / z
    v = PINHOLE.fy * Y / z + PINHOLE.cy
    if scan == "top-bottom":
        u = a - b * (STAMP + readout / 480 * v)
    else:
        first_line = STAMP if sign > 0.0 else STAMP + readout / 640 * 639
        u = (a - b * first_line) / (1.0 + sign * b * readout / 640)
    expected = np.stack([u, v], axis=-1)
    np.testing.assert_array_equal(valid, PINHOLE.contains(expected))
    assert valid.sum() > 50
    np.testing.assert_allclose(uv[valid], expected[valid], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("scan", "mirror"), [(SCANS[:2], [1.0, -1.0, 1.0, 1.0]), (SCANS[2:], [-1.0, 1.0, 1.0, 1.0])])
def test_reversed_scan_is_the_mirrored_case(scan: list[str], mirror: list[float]) -> None:
    spline, M = hand_held(2), np.diag(mirror)
    p_world = points_in_view(spline, PINHOLE)
    mirrored = Spline(M @ spline.control_points @ M, spline.t0, spline.dt)
    uv, t, valid = project_rolling(spline, T_CAM_BODY, PINHOLE, Shutter(0.028, 0.01, scan[0]), STAMP, p_world)
    uv_m, t_m, valid_m = project_rolling(
        mirrored, M @ T_CAM_BODY @ M, PINHOLE, Shutter(0.028, 0.01, scan[1]), STAMP, p_world @ M[:3, :3]
    )
    np.testing.assert_array_equal(valid, valid_m)
    centre = np.array([PINHOLE.cx, PINHOLE.cy])
    assert valid.sum() > 30
    np.testing.assert_allclose(t[valid], t_m[valid], rtol=0, atol=1e-13)
    np.testing.assert_allclose(uv[valid], centre + (uv_m[valid] - centre) * mirror[:2], rtol=0, atol=1e-8)


def test_what_is_not_seen() -> None:
    spline, shutter = hand_held(), Shutter(0.028, 0.01)
    front = points_in_view(spline, PINHOLE, margin=-60.0)
    position = (spline.pose(STAMP) @ se3.inverse(T_CAM_BODY))[:3, 3]
    odd = np.array([[np.nan, 0.0, 1.0], [np.inf, 0.0, 1.0], position, [0.0, 0.0, 0.0]])
    with np.errstate(invalid="raise", divide="raise", over="raise"):
        behind = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, STAMP, 2.0 * position - front)
        strange = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, STAMP, odd[:3])
        before = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, spline.t_begin - 1.0, front)
        after = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, spline.t_end + 1.0, front)
        seen = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, STAMP, front)
    for uv, t, valid in (behind, strange, before, after):
        assert not valid.any() and np.isnan(uv).all() and np.isnan(t).all()
    assert seen[2].all()


def test_a_point_that_appears_after_mid_readout() -> None:
    # Backing off at 2 m/s from a point on the optical axis, which row 400 sees: amid the readout it is still behind.
    T = np.broadcast_to(np.eye(4), (30, 4, 4)).copy()
    T[:, 2, 3] = -2.0 * 0.05 * (np.arange(30) - 1.0)
    spline, camera, shutter = Spline(T, 0.0, 0.05), replace(PINHOLE, cy=400.0), Shutter(0.028)
    p_world = np.array([0.0, 0.0, -0.005 - 2.0 * (STAMP + shutter.line_delay(camera) * 239.5)])
    uv, t, valid = project_rolling(spline, np.eye(4), camera, shutter, STAMP, p_world)
    assert valid
    np.testing.assert_allclose(uv, [camera.cx, 400.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(t, STAMP + 400.0 * shutter.line_delay(camera), rtol=0, atol=1e-12)


def test_a_frame_that_starts_before_the_spline_is_seen_in_part() -> None:
    still = Spline(np.broadcast_to(np.eye(4), (8, 4, 4)), t0=1.0, dt=0.05)
    p_world = PINHOLE.backproject([[100.0, 119.0], [100.0, 121.0], [100.0, 300.0]], 2.0)
    shutter = Shutter(0.048)
    # Line 120 is read when the spline starts, or ends.
    for stamp, expected in ((1.0 - 0.012, [False, True, True]), (still.t_end - 0.012, [True, False, False])):
        _, t, valid = project_rolling(still, np.eye(4), PINHOLE, shutter, stamp, p_world)
        np.testing.assert_array_equal(valid, expected)
        np.testing.assert_allclose(t[valid], stamp + 1e-4 * np.array([119.0, 121.0, 300.0])[valid], rtol=0, atol=1e-12)


def test_stamps_counted_from_1970() -> None:
    spline = hand_held()
    late = Spline(spline.control_points, 1.7e9, spline.dt)
    p_world, shutter = points_in_view(spline, PINHOLE, margin=-60.0), Shutter(0.028)
    uv, t, valid = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, STAMP, p_world)
    uv_late, t_late, valid_late = project_rolling(
        late, T_CAM_BODY, PINHOLE, shutter, 1.7e9 + (STAMP - spline.t0), p_world
    )
    assert valid.all() and valid_late.all()
    np.testing.assert_allclose(t_late - 1.7e9, t - spline.t0, rtol=0, atol=2e-6)
    np.testing.assert_allclose(uv_late, uv, rtol=0, atol=5e-3)


def test_leading_axes_and_stamps_per_point() -> None:
    spline, shutter = hand_held(), Shutter(0.028, 0.01)
    p_world = points_in_view(spline, PINHOLE, 6).reshape(2, 3, 3)
    stamps = STAMP + np.array([0.0, 0.01, 0.02])
    uv, t, valid = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, stamps, p_world)
    assert uv.shape == (2, 3, 2) and t.shape == valid.shape == (2, 3) and valid.any()
    for i, j in np.ndindex(2, 3):
        single = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, float(stamps[j]), p_world[i, j])
        assert single[0].shape == (2,) and single[1].shape == ()
        np.testing.assert_allclose(single[0], uv[i, j], rtol=0, atol=1e-8)
    many = np.tile(p_world.reshape(-1, 3), (1500, 1))
    uv_many, _, valid_many = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, STAMP, many)
    assert valid_many.reshape(1500, 6).any(axis=0).sum() > 1
    np.testing.assert_array_equal(uv_many.reshape(1500, 6, 2), np.broadcast_to(uv_many[:6], (1500, 6, 2)))
    empty = project_rolling(spline, T_CAM_BODY, PINHOLE, shutter, STAMP, np.zeros((0, 3)))
    assert [x.shape for x in empty] == [(0, 2), (0,), (0,)]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("scan", SCANS)
def test_total_derivative(scan: str, side: str) -> None:
    spline, shutter = hand_held(3), Shutter(0.028, 0.01, scan)
    p_world = points_in_view(spline, RADTAN, 8, margin=-60.0)
    _, t, valid = project_rolling(spline, T_CAM_BODY, RADTAN, shutter, STAMP, p_world)
    assert valid.all()
    first, J = rolling_shutter_jacobian(spline, T_CAM_BODY, RADTAN, shutter, t, p_world, side=side)
    dense = np.zeros((len(p_world), len(spline.control_points), 2, 6))
    for k, i in enumerate(first):
        dense[k, i : i + 4] = J[k]

    def pixels(index: int, d: np.ndarray) -> np.ndarray:
        points = spline.control_points.copy()
        points[index] = se3.exp(d) @ points[index] if side == "left" else points[index] @ se3.exp(d)
        moved = Spline(points, spline.t0, spline.dt)
        return project_rolling(moved, T_CAM_BODY, RADTAN, shutter, STAMP, p_world)[0]

    # One control point before and one after those that any of the pixels depends on.
    for index in range(first.min() - 1, first.max() + 5):
        numeric = numeric_jacobian(lambda d, index=index: pixels(index, d), 6, step=1e-4)
        np.testing.assert_allclose(dense[:, index], numeric, rtol=0, atol=1e-6 * np.abs(dense).max())


@pytest.mark.parametrize(
    ("scan", "count", "uv", "line"),
    [
        ("top-bottom", 480, (10.0, 3.4), 3.4),
        ("bottom-top", 480, (10.0, 3.4), 475.6),
        ("left-right", 640, (10.0, 3.4), 10.0),
        ("right-left", 640, (10.0, 3.4), 629.0),
    ],
)
def test_timing_by_hand(scan: str, count: int, uv: tuple[float, float], line: float) -> None:
    shutter = Shutter(0.024, 0.01, scan)
    assert shutter.line_count(PINHOLE) == count
    assert shutter.line_delay(PINHOLE) == pytest.approx(0.024 / count, rel=1e-15)
    assert shutter.line_of_pixel(uv, PINHOLE) == pytest.approx(line, abs=1e-12)
    # A frame's stamp is the end of line 0's exposure.
    lines = np.array([0.0, count / 2.0])
    np.testing.assert_allclose(shutter.line_end_time(5.0, lines, PINHOLE), [5.0, 5.012], rtol=0, atol=1e-14)
    np.testing.assert_allclose(shutter.line_mid_time(5.0, lines, PINHOLE), [4.995, 5.007], rtol=0, atol=1e-14)
    opened, closed = line_window(shutter, np.array([[5.0], [6.0]]), lines, PINHOLE)
    np.testing.assert_allclose(opened, [[4.99, 5.002], [5.99, 6.002]], rtol=0, atol=1e-14)
    np.testing.assert_allclose(closed, [[5.0, 5.012], [6.0, 6.012]], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"readout_s": -0.01}, "readout_s"),
        ({"exposure_s": float("nan")}, "exposure_s"),
        ({"readout_s": float("inf")}, "readout_s"),
        ({"scan": "diagonal"}, "unknown scan 'diagonal'"),
    ],
)
def test_bad_shutters_are_refused(arguments: dict, words: str) -> None:
    with pytest.raises(UserError, match=words):
        Shutter(**arguments)


def test_helper_makes_what_it_says() -> None:
    xi = random_twists(np.random.default_rng(0), (4,), 0.3, 2.0)
    np.testing.assert_allclose(np.linalg.norm(xi[:, :3], axis=1), 2.0)
    np.testing.assert_allclose(np.linalg.norm(xi[:, 3:], axis=1), 0.3)
