"""Projection on the device against rsgen.geometry's float64: camera models, rolling shutter, derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from rstrack_util import ENGINE, SCANS, T_COLOR_DEPTH, hand_held
from shutter_reference import rolling_shutter_jacobian
from util import numeric_jacobian

from rsgen.device.lens import Lens
from rsgen.device.projection import (
    TO_BASE,
    Projection,
    RollingProjection,
    cross,
    gather,
    move,
    project,
    project_rolling,
)
from rsgen.geometry import se3, shutter
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.geometry.spline import Spline
from rstrack.images.line_poses import Exposure, from_base_table

CAMERAS = {
    "pinhole": Camera(640, 480, 525.0, 520.0, 319.5, 241.0),
    "radtan": Camera(640, 480, 525.0, 520.0, 310.0, 241.0, "radtan", (-0.28, 0.11, 0.001, -0.002)),
    "radtan k3": Camera(640, 480, 525.0, 520.0, 310.0, 241.0, "radtan", (0.26, -0.95, -0.005, 0.003, 1.16)),
    "folding": Camera(640, 480, 525.0, 520.0, 310.0, 241.0, "radtan", (-0.4, 0.0, 0.0, 0.0)),
    "no distortion": Camera(640, 480, 525.0, 520.0, 310.0, 241.0, "radtan", (0.0, 0.0, 0.0, 0.0)),
    "rational": Camera(
        640, 480, 525.0, 520.0, 310.0, 241.0, "rational", (0.3, 0.1, 0.004, -0.003, 0.02, 0.5, 0.1, 0.01)
    ),
    "folding rational": Camera(640, 480, 525.0, 520.0, 310.0, 241.0, "rational", (-0.2, 0, 1e-3, 0, 0, 0.3, 0, 0)),
    "fisheye": Camera(640, 480, 320.0, 322.0, 310.0, 241.0, "fisheye", (0.03, -0.01, 0.004, -0.001)),
    "double sphere": Camera(640, 480, 313.2, 313.2, 319.5, 239.5, "double_sphere", (-0.18, 0.59)),
    "double sphere that ends": Camera(640, 480, 320.0, 322.0, 310.0, 241.0, "double_sphere", (-0.6, 0.7)),
    "folding fisheye": Camera(640, 480, 320.0, 322.0, 310.0, 241.0, "fisheye", (-0.15, -0.05, 0.0, 0.0)),
}
STAMP = 0.45


def device(points: np.ndarray) -> tuple:
    """Points (n, 3) as three device arrays."""
    return tuple(ENGINE.upload(c) for c in points.T)


def host(*arrays: object) -> np.ndarray:
    """Device arrays of n numbers as (n, k) in float64; constants are repeated."""
    columns = [np.atleast_1d(np.asarray(a.numpy() if hasattr(a, "numpy") else a, float)) for a in arrays]
    return np.stack(np.broadcast_arrays(*columns), axis=-1)


def points_for(camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Points in single precision: in and around the image, on the axis, near the domain's edge, behind the camera."""
    direction = rng.normal(size=(300, 2))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    edge = min(camera.max_radius, 4.0)
    # Right at the edge single precision decides either way.
    radius = np.concatenate([rng.uniform(0.0, 0.9, 140), [0.0, 1e-7, 1e-4], edge * rng.uniform(0.97, 0.9999, 57)])
    outside = edge * rng.uniform(1.0001, 1.5, 100)
    xy = direction * np.concatenate([radius, outside])[:, None]
    z = rng.uniform(0.2, 6.0, 300)
    front = np.concatenate([xy, np.ones((300, 1))], axis=1) * z[:, None]
    behind = rng.uniform(-2, 2, (40, 3)) * (1.0, 1.0, -1.0) - (0.0, 0.0, 2.01)
    special = [[0.0, 0.0, 0.0], [0.3, 0.2, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, np.nan]]
    return np.concatenate([front, behind, special]).astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("name", CAMERAS)
def test_projection_and_its_derivatives_equal_those_of_the_camera(name: str) -> None:
    camera, rng = CAMERAS[name], np.random.default_rng(1)
    p = points_for(camera, rng)
    at = project(camera, device(p))
    uv, defined = camera.project(p)
    valid = host(at.valid)[:, 0].astype(bool)
    # A point that is not a number passes where nothing compares its radius; the pixel is not a number then.
    number = np.isfinite(p).all(axis=1)
    np.testing.assert_array_equal(valid[number], defined[number])
    assert np.isnan(host(at.x, at.y)[valid & ~number]).any(axis=1).all()
    on = valid & number
    assert 150 < on.sum() < 400
    scale = 640.0 + np.abs(uv[on]).max(axis=1, keepdims=True)
    assert np.abs((host(at.x, at.y)[on] - uv[on]) / scale).max() < 1e-6
    J = camera.project_jacobian(p[on])
    size = np.abs(J).max(axis=(1, 2))[:, None]
    a, v = rng.normal(size=(len(p), 2)), rng.normal(size=(len(p), 3))
    pulled = host(*at.vjp(*(ENGINE.upload(c) for c in a.T)))[on]
    pushed = host(*at.jvp(device(v)))[on]
    assert np.abs((pulled - np.einsum("ni,nij->nj", a[on], J)) / size).max() < 2e-5
    assert np.abs((pushed - np.einsum("nij,nj->ni", J, v[on])) / size).max() < 2e-5


def test_points_nearer_than_five_centimetres_are_not_seen() -> None:
    p = np.array([[0.0, 0.0, 0.0501], [0.0, 0.0, 0.0499], [0.01, 0.0, 1e-8]])
    for camera in CAMERAS.values():
        assert host(project(camera, device(p)).valid)[:, 0].tolist() == [1.0, 0.0, 0.0]


def test_push_is_the_transpose_of_pull() -> None:
    rng = np.random.default_rng(2)
    p, a, v = rng.normal(size=(50, 3)) * 0.3 + (0, 0, 2), rng.normal(size=(50, 2)), rng.normal(size=(50, 3))
    at = project(CAMERAS["radtan k3"], device(p))
    pulled, pushed = host(*at.vjp(*(ENGINE.upload(c) for c in a.T))), host(*at.jvp(device(v)))
    np.testing.assert_allclose((pulled * v).sum(axis=1), (a * pushed).sum(axis=1), rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize(("count", "first", "stride"), [(12, 0, 12), (18, 0, 18), (6, 12, 18), (6, 0, 6), (3, 1, 7)])
def test_packets_hold_the_floats_that_are_asked_for(count: int, first: int, stride: int) -> None:
    rows = np.random.default_rng(count).normal(size=(9, stride)).astype(np.float32)
    entry = np.array([8, 0, 3, 3, 5, 1], np.uint32)
    got = gather(ENGINE.upload(rows), ENGINE.UInt(entry), count, first, stride)
    want = rows[entry, first : first + count]
    np.testing.assert_array_equal(np.stack([value.numpy() for value in got], axis=-1), want)


def test_move_cross_and_gather() -> None:
    rng = np.random.default_rng(3)
    T = se3.exp(rng.normal(size=(7, 6)))
    p, q = rng.normal(size=(2, 7, 3))
    table = ENGINE.upload(np.concatenate([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]], axis=1))
    entry = ENGINE.UInt(np.arange(7, dtype=np.uint32))
    M = gather(table, entry, TO_BASE, stride=TO_BASE)
    np.testing.assert_allclose(host(*move(M, device(p))), se3.transform(T, p), atol=1e-6)
    np.testing.assert_allclose(host(*cross(device(p), device(q))), np.cross(p, q), atol=1e-6)
    np.testing.assert_allclose(host(*gather(table, entry, 3, 9, TO_BASE)), T[:, :3, 3], atol=1e-6)


# -- rolling shutter -----------------------------------------------------------------------------------------------


def exposure(camera: Camera, scan: Scan, readout_s: float = 0.028) -> Exposure:
    return Exposure(Lens(camera, Shutter(readout_s, 0.004, scan)), STAMP, T_COLOR_DEPTH)


def scene(spline: Spline, image: Exposure, n: int, seed: int = 5) -> np.ndarray:
    """Points (n, 3) of the world in the image's view and somewhat beyond it."""
    rng, camera = np.random.default_rng(seed), image.lens.camera
    uv = rng.uniform(-0.02, 1.02, (n, 2)) * (camera.width, camera.height)
    q = camera.backproject(uv, rng.uniform(0.6, 5.0, n))
    T = spline.pose(image.mid_time) @ se3.inverse(image.T_cam_body)
    return se3.transform(T, q[np.isfinite(q).all(axis=1)])


def look(spline: Spline, image: Exposure, T_world_base: np.ndarray, p_world: np.ndarray) -> RollingProjection:
    p_base = se3.transform(se3.inverse(T_world_base), p_world)
    table = ENGINE.upload(from_base_table(spline, T_world_base, image))
    return project_rolling(image.lens, table, device(p_base), ENGINE.UInt, ENGINE.Int)


@pytest.mark.parametrize("name", ["pinhole", "radtan", "fisheye"])
@pytest.mark.parametrize("scan", SCANS)
def test_rolling_shutter_equals_newtons_method_in_float64(name: str, scan: Scan) -> None:
    image = exposure(CAMERAS[name], scan)
    for seed in range(3):
        spline = hand_held(seed)
        p = scene(spline, image, 3000, seed)
        seen = look(spline, image, spline.pose(0.40), p)
        camera, curtain = image.lens.camera, image.lens.shutter
        uv, t, valid = shutter.project_rolling(spline, T_COLOR_DEPTH, camera, curtain, STAMP, p)
        assert 0.8 * len(p) < valid.sum() < len(p)
        assert host(seen.valid)[valid].all()
        error = np.abs(host(seen.x, seen.y)[valid] - uv[valid]).max(axis=1)
        assert error.max() < 1e-3 and np.median(error) < 1e-4
        # 10 ms of 0.5 m/s and 1 rad/s: a global shutter would see another pixel.
        q = se3.transform(T_COLOR_DEPTH @ se3.inverse(spline.pose(t[valid])), p[valid])
        still = camera.project(se3.transform(T_COLOR_DEPTH @ se3.inverse(spline.pose(image.mid_time)), p[valid]))[0]
        assert np.percentile(np.abs(still - uv[valid]), 90) > 0.5
        np.testing.assert_allclose(host(seen.z)[valid, 0], q[:, 2], rtol=2e-6)
        line = curtain.line_of_pixel(uv[valid], camera)
        np.testing.assert_allclose(host(seen.line)[valid, 0], line, atol=1e-3)
        # The first step, from the middle line, finds a line nearby.
        assert np.abs(host(seen.row)[valid, 0] - line).max() < 4.0


@pytest.mark.parametrize("name", ["pinhole", "radtan", "fisheye"])
@pytest.mark.parametrize("scan", SCANS)
def test_chain_is_the_total_derivative(name: str, scan: Scan) -> None:
    image = exposure(CAMERAS[name], scan)
    spline, rng = hand_held(7), np.random.default_rng(8)
    camera, curtain = image.lens.camera, image.lens.shutter
    p = scene(spline, image, 400)
    uv, t, valid = shutter.project_rolling(spline, T_COLOR_DEPTH, camera, curtain, STAMP, p)
    p, t, uv = p[valid], t[valid], uv[valid]
    T_world_base = spline.pose(0.40)
    seen = look(spline, image, T_world_base, p)
    # All control points moved alike move the world the other way: x(exp(δ) T, p) = x(T, exp(−δ) p).
    _, J = rolling_shutter_jacobian(spline, T_COLOR_DEPTH, camera, curtain, t, p)
    by_world = -J.sum(axis=1)[..., :3]
    by_base = by_world @ T_world_base[:3, :3]
    a = rng.normal(size=(len(p), 2))
    got = host(*seen.chain(ENGINE.upload(a[:, 0]), ENGINE.upload(a[:, 1]), ENGINE.Float(0.0)))
    want = np.einsum("ni,nij->nj", a, by_base)
    size = np.abs(by_base).max(axis=(1, 2))[:, None]
    # The nearest line's pose and velocity stand for those of the line itself.
    assert np.abs((got - want) / size).max() < 3e-4
    T_cam_world = T_COLOR_DEPTH @ se3.inverse(spline.pose(t))
    still = camera.project_jacobian(se3.transform(T_cam_world, p)) @ (T_cam_world @ T_world_base)[:, :3, :3]
    without = np.einsum("ni,nij->nj", a, still)
    assert np.percentile(np.abs((without - want) / size), 90) > 3e-3


@pytest.mark.parametrize("scan", ["top-bottom", "right-left"])
def test_chain_of_depth(scan: Scan) -> None:
    image = exposure(CAMERAS["radtan"], scan)
    spline = hand_held(9)
    camera, curtain = image.lens.camera, image.lens.shutter
    p = scene(spline, image, 60)
    T_world_base = spline.pose(0.40)
    p_base = se3.transform(se3.inverse(T_world_base), p)

    def depth(shift: np.ndarray) -> np.ndarray:
        moved = se3.transform(T_world_base, p_base + shift)
        _, t, _ = shutter.project_rolling(spline, T_COLOR_DEPTH, camera, curtain, STAMP, moved)
        return se3.transform(T_COLOR_DEPTH @ se3.inverse(spline.pose(np.nan_to_num(t, nan=STAMP))), moved)[:, 2]

    inside = shutter.project_rolling(spline, T_COLOR_DEPTH, camera, curtain, STAMP, p)[2]
    inside &= camera.contains(shutter.project_rolling(spline, T_COLOR_DEPTH, camera, curtain, STAMP, p)[0] * 1.02 - 5)
    want = numeric_jacobian(depth, 3, 1e-4)[inside]
    zero = ENGINE.Float(0.0)
    got = host(*look(spline, image, T_world_base, p).chain(zero, zero, ENGINE.Float(1.0)))[inside]
    assert inside.sum() > 30
    np.testing.assert_allclose(got, want, atol=1e-4)


def test_a_global_shutter_is_a_projection_with_one_pose() -> None:
    spline, camera = hand_held(4), CAMERAS["radtan"]
    image = Exposure(Lens(camera, Shutter(0.0, 0.006)), STAMP, T_COLOR_DEPTH)
    assert image.lens.lines == 1 and image.times() == pytest.approx([STAMP - 0.003])
    p, T_world_base = scene(spline, image, 500), spline.pose(0.40)
    seen = look(spline, image, T_world_base, p)
    uv, _, valid = shutter.project_rolling(spline, T_COLOR_DEPTH, camera, image.lens.shutter, STAMP, p)
    assert np.abs(host(seen.x, seen.y)[valid] - uv[valid]).max() < 5e-4
    T_cam_base = T_COLOR_DEPTH @ se3.inverse(spline.pose(STAMP - 0.003)) @ T_world_base
    q = se3.transform(T_COLOR_DEPTH @ se3.inverse(spline.pose(STAMP - 0.003)), p[valid])
    want = camera.project_jacobian(q)[:, 1] @ T_cam_base[:3, :3]
    got = host(*seen.chain(ENGINE.Float(0.0), ENGINE.Float(1.0), ENGINE.Float(0.0)))[valid]
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-3)


def test_points_that_cannot_be_seen_are_refused_quietly() -> None:
    spline, image = hand_held(4), exposure(CAMERAS["radtan"], "top-bottom")
    T_world_cam = spline.pose(image.mid_time) @ se3.inverse(T_COLOR_DEPTH)
    q = np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [5.0, 0.0, 0.5], [0.0, 0.0, 0.02], [np.nan, 0.0, 1.0]])
    seen = look(spline, image, spline.pose(0.40), se3.transform(T_world_cam, q))
    assert host(seen.valid)[:4, 0].tolist() == [0.0] * 4
    row = host(seen.row)[:, 0]
    assert ((row >= 0) & (row < 480)).all()


def test_a_picture_that_outruns_the_shutter_is_refused() -> None:
    # 60 rad/s about x: the picture moves by several lines per line delay.
    T = se3.exp(np.arange(20)[:, None] * [0.0, 0.0, 0.0, 1.5, 0.0, 0.0])
    spline = Spline(T, 0.3, 0.025)
    image = exposure(CAMERAS["pinhole"], "top-bottom")
    ahead = se3.transform(spline.pose(image.mid_time) @ se3.inverse(T_COLOR_DEPTH), np.array([[0.0, 0.0, 2.0]]))
    table = ENGINE.upload(from_base_table(spline, np.eye(4), image))
    assert not host(project_rolling(image.lens, table, device(ahead), ENGINE.UInt, ENGINE.Int).valid).any()


def test_projection_of_a_pinhole_has_constant_slopes() -> None:
    at: Projection = project(CAMERAS["pinhole"], device(np.array([[0.2, 0.1, 2.0]])))
    assert host(*at.vjp(1.0, 0.0)).tolist() == [pytest.approx([262.5, 0.0, -26.25])]
