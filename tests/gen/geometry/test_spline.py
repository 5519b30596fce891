"""The SE(3) spline against SciPy's BSpline, constant twists, finite differences and its own identities."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline
from util import numeric_jacobian, random_spline, random_twists

from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline

AXIS = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])


def sample_times(spline: Spline, count: int = 50, seed: int = 0) -> np.ndarray:
    """Times over the whole spline, both ends and every knot included, at least 1e-2 dt inside for differences."""
    knots = spline.t0 + spline.dt * np.arange(len(spline.control_points) - 2)
    return np.concatenate([np.random.default_rng(seed).uniform(spline.t_begin, spline.t_end, count), knots])


def scipy_spline(values: np.ndarray, t0: float, dt: float) -> BSpline:
    knots = t0 + dt * (np.arange(len(values) + 4) - 3)
    return BSpline(knots, values, 3)


def difference(function, t: np.ndarray, h: float) -> np.ndarray:
    """Fourth-order derivative by time of an array function."""
    return (8.0 * (function(t + h) - function(t - h)) - (function(t + 2.0 * h) - function(t - 2.0 * h))) / (12.0 * h)


def test_pure_translation_is_the_ordinary_spline() -> None:
    points = np.random.default_rng(1).normal(size=(10, 3))
    T = np.broadcast_to(np.eye(4), (10, 4, 4)).copy()
    T[:, :3, :3] = so3.exp(0.7 * AXIS)
    T[:, :3, 3] = points
    spline, expected = Spline(T, t0=-0.4, dt=0.1), scipy_spline(points, -0.4, 0.1)
    t = sample_times(spline)
    pose = spline.pose(t)
    np.testing.assert_allclose(pose[:, :3, 3], expected(t), rtol=0, atol=1e-13)
    np.testing.assert_allclose(pose[:, :3, :3], np.broadcast_to(T[0, :3, :3], (len(t), 3, 3)), rtol=0, atol=1e-14)
    world_velocity = (pose[:, :3, :3] @ spline.velocity(t)[:, :3, None])[..., 0]
    np.testing.assert_allclose(world_velocity, expected.derivative(1)(t), rtol=0, atol=1e-11)
    np.testing.assert_allclose(spline.world_acceleration(t), expected.derivative(2)(t), rtol=0, atol=1e-10)
    np.testing.assert_allclose(spline.velocity(t)[:, 3:], 0.0, rtol=0, atol=1e-12)


def test_rotation_about_a_fixed_axis_is_the_ordinary_spline() -> None:
    angles = np.cumsum(np.random.default_rng(2).uniform(-1.5, 1.5, size=12))
    T = np.broadcast_to(np.eye(4), (12, 4, 4)).copy()
    T[:, :3, :3] = so3.exp(angles[:, None] * AXIS)
    spline, expected = Spline(T, t0=2.0, dt=0.2), scipy_spline(angles, 2.0, 0.2)
    t = sample_times(spline)
    np.testing.assert_allclose(spline.pose(t)[:, :3, :3], so3.exp(expected(t)[:, None] * AXIS), rtol=0, atol=1e-12)
    np.testing.assert_allclose(spline.velocity(t)[:, 3:], expected.derivative(1)(t)[:, None] * AXIS, atol=1e-11)
    np.testing.assert_allclose(spline.acceleration(t)[:, 3:], expected.derivative(2)(t)[:, None] * AXIS, atol=1e-10)


def test_constant_twist_is_reproduced_exactly() -> None:
    xi, start = random_twists(np.random.default_rng(3), (), 0.3, 0.2), se3.exp([1.0, 2.0, 3.0, 0.4, 0.5, 0.6])
    index = np.arange(8.0)
    spline = Spline(start @ se3.exp(index[:, None] * xi), t0=0.0, dt=0.05)
    t = sample_times(spline)
    # Control point i is reached at t0 + (i - 1) dt.
    np.testing.assert_allclose(spline.pose(t), start @ se3.exp((t / 0.05 + 1.0)[:, None] * xi), rtol=0, atol=1e-13)
    np.testing.assert_allclose(spline.velocity(t), np.broadcast_to(xi / 0.05, (len(t), 6)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(spline.acceleration(t), 0.0, rtol=0, atol=1e-10)


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 0.6, 1.3])
def test_velocity_and_acceleration_are_derivatives(angle: float) -> None:
    spline = random_spline(4, angle=angle, dt=1.0)
    # Third derivatives jump at the knots: stay clear of them.
    t = spline.t0 + np.arange(6)[:, None] + np.linspace(0.05, 0.95, 7)
    T_inv = se3.inverse(spline.pose(t))
    pose_rate = difference(lambda x: se3.log(T_inv @ spline.pose(x)), t, 1e-3)
    np.testing.assert_allclose(spline.velocity(t), pose_rate, rtol=0, atol=1e-10)
    np.testing.assert_allclose(spline.acceleration(t), difference(spline.velocity, t, 1e-3), rtol=0, atol=1e-10)
    world_velocity = lambda x: (spline.pose(x)[..., :3, :3] @ spline.velocity(x)[..., :3, None])[..., 0]  # noqa: E731
    np.testing.assert_allclose(spline.world_acceleration(t), difference(world_velocity, t, 1e-3), rtol=0, atol=1e-10)
    np.testing.assert_array_equal(spline.pose_and_velocity(t)[0], spline.pose(t))


def test_twice_continuously_differentiable_at_knots() -> None:
    spline = random_spline(5)
    knots, h = spline.t0 + spline.dt * np.arange(1, 6), 1e-12
    for function in (spline.pose, spline.velocity, spline.acceleration):
        scale = np.abs(function(knots)).max()
        np.testing.assert_allclose(function(knots - h), function(knots + h), rtol=0, atol=1e-8 * scale)


def moved(spline: Spline, index: int, increment: np.ndarray, side: str) -> Spline:
    points = spline.control_points.copy()
    points[index] = se3.exp(increment) @ points[index] if side == "left" else points[index] @ se3.exp(increment)
    return Spline(points, spline.t0, spline.dt)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("angle", [1e-7, 0.1, 0.6, 1.4])
def test_pose_jacobian(side: str, angle: float) -> None:
    spline = random_spline(6, angle=angle)
    t = spline.t0 + spline.dt * np.array([0.0, 0.3, 1.5, 2.999, 5.7, 6.0])
    T_inv = se3.inverse(spline.pose(t))
    first, J = spline.pose_jacobian(t, side=side)
    np.testing.assert_array_equal(first, [0, 0, 1, 2, 5, 5])
    dense = np.zeros((len(t), len(spline.control_points), 6, 6))
    for k, i in enumerate(first):
        dense[k, i : i + 4] = J[k]

    def increment(index: int, d: np.ndarray) -> np.ndarray:
        T = moved(spline, index, d, side).pose(t)
        return se3.log(T @ T_inv if side == "left" else T_inv @ T)

    for index in range(len(spline.control_points)):
        numeric = numeric_jacobian(lambda d, index=index: increment(index, d), 6)
        np.testing.assert_allclose(dense[:, index], numeric, rtol=0, atol=2e-10)


def test_jacobian_identities() -> None:
    spline = random_spline(7, points=12)
    t = sample_times(spline)
    first, left = spline.pose_jacobian(t)
    _, right = spline.pose_jacobian(t, side="right")
    np.testing.assert_allclose(left.sum(axis=1), np.broadcast_to(np.eye(6), (len(t), 6, 6)), rtol=0, atol=1e-13)
    points = spline.control_points[first[:, None] + np.arange(4)]
    turned = se3.adjoint(spline.pose(t))[:, None] @ right @ se3.adjoint(se3.inverse(points))
    np.testing.assert_allclose(left, turned, rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [(), (1,), (0,), (2, 3)])
def test_leading_axes(shape: tuple[int, ...]) -> None:
    spline = random_spline(8)
    t = np.random.default_rng(9).uniform(spline.t_begin, spline.t_end, shape)
    for function in (spline.pose, spline.velocity, spline.acceleration, spline.world_acceleration):
        single = [function(x) for x in t.ravel()]
        assert function(t).shape[: t.ndim] == shape
        if single:
            np.testing.assert_allclose(function(t).reshape(-1, *single[0].shape), single, rtol=0, atol=1e-11)
    first, J = spline.pose_jacobian(t)
    assert first.shape == shape and J.shape == (*shape, 4, 6, 6)


def test_large_batches_are_cut_into_blocks_unnoticed() -> None:
    spline = random_spline(14)
    t = np.random.default_rng(15).uniform(spline.t_begin, spline.t_end, (3, 5000))
    blocks = spline.pose(t)
    assert blocks.shape == (3, 5000, 4, 4)
    np.testing.assert_array_equal(blocks, spline.pose_and_velocity(t)[0])


def test_times_outside_are_refused() -> None:
    spline = random_spline(10)
    for t in (spline.t_begin - 1e-6, spline.t_end + 1e-6, np.nan, np.inf, [spline.t_begin, 99.0]):
        with pytest.raises(UserError, match="outside"):
            spline.pose(t)
    # Rounding does not make an end invalid, with stamps since 1970 neither.
    spline.pose([spline.t_begin - 1e-13, spline.t_end + 1e-13])
    late = Spline(spline.control_points, t0=1.7e9 + 0.1, dt=0.05)
    late.pose([late.t_begin - 4e-7, late.t_end + 4e-7])
    with pytest.raises(UserError, match="outside"):
        late.pose(late.t_end + 1e-4)


@pytest.mark.parametrize(
    ("points", "t0", "dt", "words"),
    [
        (np.zeros((3, 4, 4)), 0.0, 0.1, "shape"),
        (np.broadcast_to(np.eye(4), (3, 4, 4)), 0.0, 0.1, "m >= 4"),
        (np.broadcast_to(np.eye(3), (5, 3, 3)), 0.0, 0.1, "shape"),
        (np.broadcast_to(np.eye(4), (5, 4, 4)), 0.0, 0.0, "positive"),
        (np.broadcast_to(np.eye(4), (5, 4, 4)), np.nan, 0.1, "finite"),
        (np.where(np.arange(80).reshape(5, 4, 4) == 35, np.nan, np.eye(4)), 0.0, 0.1, "control point 2 is not finite"),
        (np.broadcast_to(1.01 * np.eye(4), (5, 4, 4)), 0.0, 0.1, "control point 0 is not a rigid motion"),
        (np.broadcast_to(np.diag([1.0, 1.0, -1.0, 1.0]), (5, 4, 4)), 0.0, 0.1, "rigid"),
    ],
)
def test_bad_control_points_are_refused(points: np.ndarray, t0: float, dt: float, words: str) -> None:
    with pytest.raises(UserError, match=words):
        Spline(points, t0, dt)


def test_control_points_are_a_private_copy() -> None:
    points = random_spline(11).control_points.copy()
    spline = Spline(points, 0.0, 0.1)
    before = spline.pose(0.2)
    points[:] = np.nan
    np.testing.assert_array_equal(spline.pose(0.2), before)
    with pytest.raises(ValueError, match="read-only"):
        spline.control_points[0, 0, 0] = 2.0


def test_saved_and_loaded_bit_for_bit(tmp_path: Path) -> None:
    spline = random_spline(12)
    spline.save(tmp_path / "spline.npz")
    loaded = Spline.load(tmp_path / "spline.npz")
    np.testing.assert_array_equal(loaded.control_points, spline.control_points)
    assert (loaded.t0, loaded.dt) == (spline.t0, spline.dt)
    spline.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "spline.npz").read_bytes()


@pytest.mark.parametrize(
    "damage", ["missing", "empty", "text", "truncated", "flipped", "keys", "pickle", "npy", "folder"]
)
def test_damaged_file_is_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "spline.npz"
    random_spline(13).save(path)
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "folder":
        path.unlink()
        path.mkdir()
    elif damage == "keys":
        np.savez(path, control_points=np.eye(4))
    elif damage == "pickle":
        np.savez(path, control_points=np.array([{}], dtype=object), t0=0.0, dt=1.0)
    elif damage == "npy":
        with path.open("wb") as file:
            np.save(file, np.eye(4))
    else:
        flipped = data[:300] + bytes(255 - b for b in data[300:400]) + data[400:]
        path.write_bytes({"empty": b"", "text": b"hello\n", "truncated": data[:-200], "flipped": flipped}[damage])
    with pytest.raises(UserError, match="spline") as caught:
        Spline.load(path)
    assert "\n" not in str(caught.value)


def test_the_end_of_a_spline_is_that_spline_there() -> None:
    whole = random_spline(np.random.default_rng(6), 20)
    end = whole.tail(9)
    assert end.first == 9 and len(end.control_points) == 11 and end.t_end == whole.t_end
    assert end.t_begin == whole.t0 + 9 * whole.dt
    t = np.linspace(end.t_begin, end.t_end, 50)
    for name in ("pose", "velocity", "acceleration", "world_acceleration"):
        np.testing.assert_array_equal(getattr(end, name)(t), getattr(whole, name)(t))
    for side in ("left", "right"):
        for found, expected in zip(end.pose_jacobian(t, side), whole.pose_jacobian(t, side), strict=True):
            np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(end.locate(t)[0], whole.locate(t)[0])
    with pytest.raises(UserError, match="outside"):
        end.pose(end.t_begin - 0.01)
