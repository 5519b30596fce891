"""The spline at the rows of an image, compiled: NumPy's calls take far longer than these few numbers do.

Twins of `Spline`'s methods, for one time after the other; the tests compare them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import BASES, Spline
from rstrack.compiled import compiled
from rstrack.images.fast_se3 import (
    EXP,
    added,
    corner,
    cross,
    exp,
    hat,
    inverse_jacobian,
    log,
    matrix,
    nearest_rotation,
    plus,
    polynomial,
    product,
    series,
    store,
    transposed,
    turned,
)

_VALUE, _RATE = (np.ascontiguousarray(basis.T) for basis in BASES[:2])


@compiled
def _increment(increments: Any, at: Any, b: Any) -> Any:
    x = increments[at]
    return (b * x[0], b * x[1], b * x[2]), (b * x[3], b * x[4], b * x[5])


@compiled
def _segment(t: Any, t0: Any, dt: Any, first: Any, last: Any) -> Any:
    s = (t - t0) / dt
    number = min(max(math.floor(s), first), last)
    return number, s - number


@compiled
def _motion_at(points: Any, increments: Any, at: Any, u: Any, dt: Any) -> Any:
    """Pose R, t and body velocity v, ω in the middle of the control points number at..at+3 held."""
    R, t = matrix(points[at])
    v, w = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for j in range(3):
        A, a = exp(*_increment(increments, at + j, series(_VALUE[j], u)))
        t, R, back = plus(t, turned(R, a), 1.0), product(R, A), transposed(A)
        dv, dw = _increment(increments, at + j, series(_RATE[j], u) / dt)
        v = plus(turned(back, plus(v, cross(a, w), -1.0)), dv, 1.0)
        w = plus(turned(back, w), dw, 1.0)
    return R, t, v, w


@compiled
def _motions(points: Any, increments: Any, first: Any, t0: Any, dt: Any, times: Any) -> Any:
    T, twist = np.zeros((len(times), 4, 4)), np.empty((len(times), 6))
    last = first + len(points) - 4
    for n in range(len(times)):
        number, u = _segment(times[n], t0, dt, first, last)
        R, t, v, w = _motion_at(points, increments, number - first, u, dt)
        store(R, t, T[n])
        T[n, 3, 3] = 1.0
        for i in range(3):
            twist[n, i], twist[n, 3 + i] = v[i], w[i]
    return T, twist


@compiled
def _add_block(out: Any, column: Any, D: Any, C: Any, sign: Any) -> None:
    for i in range(3):
        for j in range(3):
            out[i, column + j] += sign * D[3 * i + j]
            out[3 + i, column + 3 + j] += sign * D[3 * i + j]
            out[i, column + 3 + j] += sign * C[3 * i + j]


@compiled
def _jacobians(
    points: Any, increments: Any, gains: Any, first: Any, t0: Any, dt: Any, T_base_world: Any, times: Any, begin: Any,
    count: Any,
) -> Any:  # fmt: skip
    out = np.zeros((len(times), 6, 6 * count))
    last = first + len(points) - 4
    R_base, t_base = matrix(T_base_world)
    for n in range(len(times)):
        number, u = _segment(times[n], t0, dt, first, last)
        at, column = number - first, 6 * (number - begin)
        R, t = matrix(points[at])
        R, t = product(R_base, R), plus(turned(R_base, t), t_base, 1.0)
        _add_block(out[n], column, R_base, product(hat(t_base), R_base), 1.0)
        for j in range(3):
            b = series(_VALUE[j], u)
            rho, phi = _increment(increments, at + j, b)
            # b Ad(T) Jl(b Ω) times the derivative of Ω by the control points on both sides.
            theta2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
            A, a = exp(rho, phi)
            if theta2 <= 1.0:
                J = polynomial(phi, series(EXP[1], theta2), series(EXP[2], theta2))
            else:
                x = math.sqrt(theta2)
                J = polynomial(phi, 2.0 * (math.sin(0.5 * x) / x) ** 2, (x - math.sin(x)) / x**3)
            D, C = product(R, J), added(product(product(hat(t), R), J), product(R, corner(rho, phi)), 1.0)
            gain = gains[at + j]
            G = (
                gain[0, 0],
                gain[0, 1],
                gain[0, 2],
                gain[1, 0],
                gain[1, 1],
                gain[1, 2],
                gain[2, 0],
                gain[2, 1],
                gain[2, 2],
            )
            E = (
                gain[0, 3],
                gain[0, 4],
                gain[0, 5],
                gain[1, 3],
                gain[1, 4],
                gain[1, 5],
                gain[2, 3],
                gain[2, 4],
                gain[2, 5],
            )
            D, C = product(D, G), added(product(D, E), product(C, G), 1.0)
            _add_block(out[n], column + 6 * j, D, C, -b)
            _add_block(out[n], column + 6 * (j + 1), D, C, b)
            t, R = plus(t, turned(R, a), 1.0), product(R, A)
    return out


@compiled
def _derived(points: Any) -> Any:
    """`Spline.increments` and `Spline.left_gains` of control points (m, 4, 4)."""
    pairs = len(points) - 1
    increments, gains = np.empty((pairs, 6)), np.zeros((pairs, 6, 6))
    for n in range(pairs):
        R, t = matrix(points[n])
        S, s = matrix(points[n + 1])
        back = transposed(R)
        rho, phi = log(product(back, S), turned(back, plus(s, t, -1.0)))
        for i in range(3):
            increments[n, i], increments[n, 3 + i] = rho[i], phi[i]
        K = inverse_jacobian(phi)
        # Jl⁻¹ = [[K, −K Q K], [0, K]], Ad(T⁻¹) = [[Rᵀ, −Rᵀ t^], [0, Rᵀ]].
        D = product(K, back)
        KQ = product(K, corner(rho, phi))
        C = added(product(D, hat(t)), product(KQ, D), 1.0)
        _add_block(gains[n], 0, D, C, 1.0)
        for i in range(3):
            for j in range(3):
                gains[n, i, 3 + j] = -C[3 * i + j]
    return increments, gains


@compiled
def _moved(points: Any, steps: Any) -> Any:
    out = np.zeros_like(points)
    for n in range(len(points)):
        R, t = matrix(points[n])
        x = steps[n]
        A, a = exp((x[0], x[1], x[2]), (x[3], x[4], x[5]))
        store(nearest_rotation(product(A, R)), plus(turned(A, t), a, 1.0), out[n])
        out[n, 3, 3] = 1.0
    return out


@compiled
def _rows(
    points: Any, increments: Any, first: Any, t0: Any, dt: Any, middle: Any, since: Any, count: Any, T_left: Any,
    T_right: Any, is_inverse: Any, delay: Any,
) -> Any:  # fmt: skip
    R_left, t_left = matrix(T_left)
    R_right, t_right = matrix(T_right)
    T, twist = _motions(points, increments, first, t0, dt, middle)
    nodes, per_node = since.shape
    out = np.empty((count, 18 if is_inverse else 12))
    power = np.zeros((3, 18))
    for n in range(nodes):
        R, t = matrix(T[n])
        own = twist[n]
        v, w = (own[0], own[1], own[2]), (own[3], own[4], own[5])
        # Central differences; a node's twist and the next one's are as far apart as their times.
        before, after = max(n - 1, 0), min(n + 1, nodes - 1)
        apart = middle[after] - middle[before]
        per_s = 1.0 / apart if apart != 0.0 else 0.0
        change = (twist[after] - twist[before]) * per_s
        dv, dw = (change[0], change[1], change[2]), (change[3], change[4], change[5])
        if is_inverse:
            back = transposed(R)
            A, a, B, b = R_left, t_left, product(back, R_right), turned(back, plus(t_right, t, -1.0))
            sign = -1.0
        else:
            A, a, B, b = product(R_left, R), plus(turned(R_left, t), t_left, 1.0), R_right, t_right
            sign = 1.0
        # A exp(±(twist s + ½ rate s²)) B to second order in the seconds s after the middle.
        rate, change_of_rate = hat(w), hat(dw)
        once, once_t = product(rate, B), plus(turned(rate, b), v, 1.0)
        twice = added(product(rate, once), product(change_of_rate, B), sign)
        twice_t = plus(turned(rate, once_t), plus(turned(change_of_rate, b), dv, 1.0), sign)
        _store_power(power[0], product(A, B), plus(turned(A, b), a, 1.0), 1.0)
        _store_power(power[1], product(A, once), turned(A, once_t), sign)
        _store_power(power[2], product(A, twice), turned(A, twice_t), 0.5)
        if is_inverse:
            _store_twist(power[0], A, a, v, w, delay)
            _store_twist(power[1], A, a, dv, dw, delay)
        for k in range(per_node):
            row = n * per_node + k
            if row < count:
                s = since[n, k]
                for i in range(out.shape[1]):
                    out[row, i] = power[0, i] + s * (power[1, i] + s * power[2, i])
    return out


@compiled
def _store_power(out: Any, R: Any, t: Any, factor: Any) -> None:
    for i in range(9):
        out[i] = factor * R[i]
    for i in range(3):
        out[9 + i] = factor * t[i]


@compiled
def _store_twist(out: Any, A: Any, a: Any, v: Any, w: Any, factor: Any) -> None:
    """factor · Ad [v; ω] with the pose A, a."""
    spin = turned(A, w)
    speed = plus(turned(A, v), cross(a, spin), 1.0)
    for i in range(3):
        out[12 + i], out[15 + i] = factor * speed[i], factor * spin[i]


def motions(spline: Spline, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`Spline.pose_and_velocity` at times (n,), s: T_world_body (n, 4, 4), body twists (n, 6). UserError outside."""
    _check(spline, times)
    return _motions(spline.control_points, spline.increments, spline.first, spline.t0, spline.dt, times)


def motion(spline: Spline, t: float) -> tuple[FloatArray, FloatArray]:
    """`motions` at one time: T_world_body (4, 4), body twist (6,)."""
    T, twist = motions(spline, np.array([t]))
    return T[0], twist[0]


def twist_between(T_world_a: FloatArray, T_world_b: FloatArray) -> FloatArray:
    """log(T_world_a⁻¹ T_world_b), (6,), of poses (4, 4) less than half a turn apart."""
    increments, _ = _derived(np.stack([T_world_a, T_world_b]))
    return np.asarray(increments[0])


def jacobians(spline: Spline, T_base_world: FloatArray, times: FloatArray, first: int, count: int) -> FloatArray:
    """`Spline.pose_jacobian` at times (n,), s, in the base frame: (n, 6, 6 count) by the control points
    first..first+count.

    All four control points of every time must be among them. Raises UserError for times outside.
    """
    _check(spline, times)
    known = spline.control_points, spline.increments, spline.left_gains, spline.first, spline.t0, spline.dt
    return _jacobians(*known, T_base_world, times, first, count)


def rows(
    spline: Spline, middle: FloatArray, since: FloatArray, count: int, T_left: FloatArray, T_right: FloatArray,
    is_inverse: bool, delay: float = 0.0,
) -> FloatArray:  # fmt: skip
    """T_left T_world_body T_right of `count` rows, or with its inverse in the middle: rotation row-major, translation.

    middle (n,): times of blocks of rows, s; since (n, m): of each block's rows after that. A row is at
    T exp(twist s + ½ rate s²), to second order in s: exact to nanometres over the quarter of a millisecond to a block's
    edge. (A constant twist is wrong by a micrometre at 35 m/s², and its velocity moves what project_rolling finds by
    1e-3 px.) Returns (count, 12); of inverses (count, 18), with the twist of T_left's frame in `delay` seconds. Raises
    UserError for times outside the spline.
    """
    _check(spline, middle)
    known = spline.control_points, spline.increments, spline.first, spline.t0, spline.dt
    return _rows(*known, middle, since, count, T_left, T_right, is_inverse, delay)


def changed(spline: Spline, first: int, points: FloatArray) -> Spline:
    """The spline with control points `points` (n, 4, 4) from number `first` on; they may go beyond the end.

    Derives anew only what the change touches, however long the spline is; points are trusted to be rigid.
    """
    first -= spline.first
    last = first + len(points)
    every = np.concatenate([spline.control_points[:first], points, spline.control_points[last:]])
    begin, end = max(0, first - 1), min(last, len(every) - 1)
    fresh = _derived(every[begin : end + 1])
    derived = [
        np.concatenate([old[:begin], new, old[end:]])
        for old, new in zip((spline.increments, spline.left_gains), fresh, strict=True)
    ]
    return spline.with_derived(spline.first, every, *derived)


def moved(points: FloatArray, increments: FloatArray) -> FloatArray:
    """exp(δ_i) T_i of poses (n, 4, 4) and increments (n, 6), with proper rotations whatever the rounding."""
    return _moved(points, increments)


def _check(spline: Spline, times: FloatArray) -> None:
    if not (spline.t_begin <= times.min() and times.max() <= spline.t_end):
        spline.locate(times)  # which raises, but for rounding
