"""SO(3) and SE(3) against SciPy's matrix functions, quadrature and finite differences, near zero and π too."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from util import numeric_jacobian, random_twists

from rsgen.geometry import se3, so3

# Around zero, around the switch from series to closed form at 1, and beyond.
ANGLES = [0.0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-6, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 0.999999, 1.000001, 1.5, 2.5, 3.1]
NEAR_PI = [np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9, np.pi - 1e-13]
SHAPES = [(), (1,), (0,), (2, 3)]

finite = st.floats(-3.0, 3.0)
vectors3 = st.tuples(finite, finite, finite).map(np.array)
vectors6 = st.tuples(*[finite] * 6).map(np.array)


def wedge(xi: np.ndarray) -> np.ndarray:
    """Twists (..., 6) as 4x4 matrices of the Lie algebra, written out independently of the package."""
    x, y, z, a, b, c = np.moveaxis(xi, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -c, b, x], [c, o, -a, y], [-b, a, o, z], [o, o, o, o]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def integral_of_exp(A: np.ndarray) -> np.ndarray:
    """∫₀¹ expm(s A) ds by Gauss-Legendre quadrature, exact to rounding for |A| up to a few."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    return sum(0.5 * w * scipy.linalg.expm(0.5 * (x + 1.0) * A) for x, w in zip(nodes, weights, strict=True))


@pytest.mark.parametrize("angle", ANGLES + NEAR_PI + [np.pi, 5.0, 9.0])
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    xi = random_twists(np.random.default_rng(1), (20,), angle)
    np.testing.assert_allclose(se3.exp(xi), scipy.linalg.expm(wedge(xi)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(so3.exp(xi[:, 3:]), Rotation.from_rotvec(xi[:, 3:]).as_matrix(), rtol=0, atol=4e-15)


@pytest.mark.parametrize("angle", ANGLES + NEAR_PI)
def test_log_inverts_exp(angle: float) -> None:
    xi = random_twists(np.random.default_rng(2), (50,), angle)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, rtol=1e-14, atol=1e-14 if angle > 1e-3 else 1e-15)


@pytest.mark.parametrize("angle", [1e-12, 1e-8, 1e-4])
def test_log_keeps_relative_precision_of_small_rotations(angle: float) -> None:
    phi = random_twists(np.random.default_rng(3), (50,), angle)[:, 3:]
    error = np.linalg.norm(so3.log(so3.exp(phi)) - phi, axis=-1)
    assert error.max() < 1e-15 * angle


def test_log_is_the_matrix_logarithm() -> None:
    for xi in random_twists(np.random.default_rng(4), (5,), 2.0):
        np.testing.assert_allclose(wedge(se3.log(se3.exp(xi))), scipy.linalg.logm(se3.exp(xi)), rtol=0, atol=1e-12)


def test_log_at_exactly_pi() -> None:
    axes = np.concatenate([np.eye(3), random_twists(np.random.default_rng(5), (100,), 1.0)[:, 3:]])
    # R = 2 a aᵀ − I has no antisymmetric part at all: what a trace-based logarithm divides by is zero.
    R = 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    phi = so3.log(R)
    np.testing.assert_allclose(np.linalg.norm(phi, axis=-1), np.pi, rtol=1e-15)
    np.testing.assert_allclose(np.abs(np.sum(phi * axes, axis=-1)), np.pi, rtol=1e-14)
    np.testing.assert_allclose(so3.exp(phi), R, rtol=0, atol=1e-14)


def test_log_stays_below_pi_just_past_it() -> None:
    phi = random_twists(np.random.default_rng(6), (50,), 1.0)[:, 3:]
    back = so3.log(so3.exp(phi * (np.pi + 1e-7)))
    np.testing.assert_allclose(back, phi * (1e-7 - np.pi), rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES + NEAR_PI + [4.0, 6.0])
def test_jacobians_are_the_integral_of_the_adjoint(angle: float) -> None:
    xi = random_twists(np.random.default_rng(7), (20,), angle, distance=2.0)
    J = se3.left_jacobian(xi)
    np.testing.assert_allclose(J, integral_of_exp(se3.ad(xi)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(se3.right_jacobian(xi), integral_of_exp(-se3.ad(xi)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(so3.left_jacobian(xi[:, 3:]), J[:, 3:, 3:], rtol=0, atol=1e-15)
    np.testing.assert_allclose(so3.right_jacobian(xi[:, 3:]), se3.right_jacobian(xi)[:, 3:, 3:], rtol=0, atol=1e-15)
    # Towards 2π the inverse itself grows without bound.
    identity = np.broadcast_to(np.eye(6), J.shape)
    bound = 1e-13 if angle < 5.0 else 1e-10
    np.testing.assert_allclose(J @ se3.left_jacobian_inv(xi), identity, rtol=0, atol=bound)
    np.testing.assert_allclose(se3.right_jacobian(xi) @ se3.right_jacobian_inv(xi), identity, rtol=0, atol=bound)
    right = so3.right_jacobian(xi[:, 3:]) @ so3.right_jacobian_inv(xi[:, 3:])
    np.testing.assert_allclose(right, identity[:, 3:, 3:], rtol=0, atol=bound)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.7, 2.9])
def test_jacobians_are_derivatives(angle: float) -> None:
    xi = random_twists(np.random.default_rng(8), (), angle)
    T_inv = np.linalg.inv(se3.exp(xi))
    left = numeric_jacobian(lambda d: se3.log(se3.exp(xi + d) @ T_inv), 6)
    right = numeric_jacobian(lambda d: se3.log(T_inv @ se3.exp(xi + d)), 6)
    np.testing.assert_allclose(se3.left_jacobian(xi), left, rtol=0, atol=1e-11)
    np.testing.assert_allclose(se3.right_jacobian(xi), right, rtol=0, atol=1e-11)


@given(vectors6, vectors6)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_adjoints(a: np.ndarray, b: np.ndarray) -> None:
    T = se3.exp(a)
    np.testing.assert_allclose(wedge(se3.adjoint(T) @ b), T @ wedge(b) @ np.linalg.inv(T), rtol=0, atol=1e-11)
    np.testing.assert_allclose(wedge(se3.ad(a) @ b), wedge(a) @ wedge(b) - wedge(b) @ wedge(a), rtol=0, atol=1e-12)
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), rtol=0, atol=1e-13)


@given(vectors3, vectors3)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_hat_and_cross(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(so3.hat(a) @ b, np.cross(a, b), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(so3.cross(a, b), np.cross(a, b))
    np.testing.assert_allclose(so3.hat_squared(a), so3.hat(a) @ so3.hat(a), rtol=0, atol=1e-13)


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 1e-3))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_quaternions(q: np.ndarray) -> None:
    R = so3.from_quat(q)
    np.testing.assert_allclose(R, Rotation.from_quat(q).as_matrix(), rtol=0, atol=4e-15)
    back = so3.to_quat(R)
    unit = q / np.linalg.norm(q)
    assert back[3] >= 0.0
    assert min(np.abs(back - unit).max(), np.abs(back + unit).max()) < 4e-15


def test_quaternion_of_half_turns_and_sign() -> None:
    for axis in np.eye(3):
        q = np.array([*axis, 0.0])
        assert np.abs(so3.to_quat(so3.from_quat(q))) == pytest.approx(q, abs=1e-15)
    q = np.array([0.1, -0.5, 0.3, 0.8])
    np.testing.assert_array_equal(so3.from_quat(q), so3.from_quat(-q))


def test_orthonormalise_takes_the_nearest_rotation() -> None:
    rng = np.random.default_rng(9)
    T = se3.exp(random_twists(rng, (40,), 1.2))
    noisy = T.copy()
    noisy[:, :3, :3] += 1e-3 * rng.normal(size=(40, 3, 3))
    noisy[:, 3] += 1e-9
    fixed = se3.orthonormalise(noisy)
    for matrix, result, original in zip(noisy, fixed, T, strict=True):
        np.testing.assert_allclose(result[:3, :3], scipy.linalg.polar(matrix[:3, :3])[0], rtol=0, atol=1e-14)
        np.testing.assert_array_equal(result[:, 3], original[:, 3])
    np.testing.assert_array_equal(fixed[:, 3], np.broadcast_to([0.0, 0.0, 0.0, 1.0], (40, 4)))
    mirrored = np.diag([1.0, 1.0, -1.0, 1.0])
    assert np.linalg.det(se3.orthonormalise(mirrored)) == pytest.approx(1.0)


def test_transform_broadcasts() -> None:
    rng = np.random.default_rng(10)
    T, p = se3.exp(random_twists(rng, (5, 1), 1.0)), rng.normal(size=(5, 7, 3))
    expected = np.stack([[(T[i, 0] @ [*p[i, j], 1.0])[:3] for j in range(7)] for i in range(5)])
    np.testing.assert_allclose(se3.transform(T, p), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(se3.transform(T[0, 0], p[0]), expected[0], rtol=0, atol=1e-14)


def test_from_quat_trans() -> None:
    T = se3.from_quat_trans([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], [1.0, 2.0, 3.0])
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(T, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("shape", SHAPES)
def test_leading_axes(shape: tuple[int, ...]) -> None:
    xi = random_twists(np.random.default_rng(11), (*shape, 2), 1.0)
    # Both branches of every coefficient within one batch.
    xi[..., 0, 3:] *= 1e-3
    xi[..., 1, 3:] *= 2.0
    functions = [se3.exp, se3.left_jacobian, se3.left_jacobian_inv, se3.right_jacobian, se3.right_jacobian_inv, se3.ad]
    functions += [lambda x: se3.log(se3.exp(x)), lambda x: se3.inverse(se3.exp(x)), lambda x: se3.adjoint(se3.exp(x))]
    functions += [lambda x: so3.to_quat(so3.exp(x[..., 3:])), lambda x: se3.orthonormalise(se3.exp(x))]
    for function in functions:
        batched = function(xi)
        single = [function(x) for x in xi.reshape(-1, 6)]
        assert batched.shape[: xi.ndim - 1] == xi.shape[:-1]
        if single:
            np.testing.assert_allclose(batched.reshape(-1, *single[0].shape), single, rtol=0, atol=1e-15)


def test_interpolated_follows_a_constant_twist_before_between_and_after() -> None:
    twist = np.array([0.3, -0.2, 0.5, 0.4, 0.9, -0.3])
    times = np.array([0.1, 0.13, 0.2])
    t = np.array([0.05, 0.1, 0.12, 0.2, 0.26])
    expected = np.stack([scipy.linalg.expm(x * wedge(twist)) for x in t])
    poses = np.stack([scipy.linalg.expm(x * wedge(twist)) for x in times])
    np.testing.assert_allclose(se3.interpolated(times, poses, t), expected, atol=1e-12)
    np.testing.assert_array_equal(se3.interpolated(times[:1], poses[:1], t[:2]), poses[[0, 0]])
