"""Cumulative cubic B-spline on SE(3): pose, body velocity and acceleration, and pose Jacobians by control point.

Equations (4) and (5) of Kerl, Stückler, Cremers, ICCV 2015: on segment l, with u = (t − t_l) / dt and control points
T_0..T_3 = control_points[l..l+3],  T(t) = T_0 A_1 A_2 A_3,  A_j = exp(b_j(u) Ω_j),  Ω_j = log(T_{j−1}⁻¹ T_j).
Derivatives after Sommer et al., CVPR 2020, and Tirado & Civera, arXiv 2201.10602.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.so3 import cross, powers
from rsgen.inputs import read_arrays

Side = Literal["left", "right"]

# b_1..b_3 as polynomials in u, constant term first.
_BASIS = np.array([[5.0, 3.0, -3.0, 1.0], [1.0, 3.0, 3.0, -2.0], [0.0, 0.0, 0.0, 1.0]]).T / 6.0
BY_U = np.diag([1.0, 2.0, 3.0], 1)
"""Derives polynomials in u, constant term first."""
BASES = _BASIS, BY_U @ _BASIS, BY_U @ BY_U @ _BASIS
"""b_1..b_3 and their first and second derivatives by u, (4, 3) each: powers of u times these."""
# Times evaluated at once: intermediate results then stay in the cache, which halves the time of large batches.
_BLOCK = 4096


@dataclass(frozen=True, eq=False)
class Spline:
    """Trajectory T_world_body(t) from control points (m, 4, 4), m ≥ 4, at uniform knots `dt` seconds apart.

    Segment l covers [t0 + l dt, t0 + (l + 1) dt) and depends on control points l..l+3 only; the last segment includes
    its end. Neighbouring control points must be less than π apart in rotation. Rotations are taken as they are, not
    orthonormalised. Of a long spline that grows only the end may be held: `first` is the number of the first control
    point that is; segments are counted from t0 all the same. Raises UserError for wrong shapes, non-finite numbers and
    matrices that are not rigid motions.
    """

    control_points: FloatArray
    t0: float
    dt: float
    first: int = 0

    def __post_init__(self) -> None:
        points = np.array(self.control_points, dtype=np.float64)
        points.setflags(write=False)
        object.__setattr__(self, "control_points", points)
        object.__setattr__(self, "t0", float(self.t0))
        object.__setattr__(self, "dt", float(self.dt))
        if points.ndim != 3 or points.shape[1:] != (4, 4) or len(points) < 4:
            raise UserError(f"spline: control points have shape {points.shape}; expected (m, 4, 4) with m >= 4")
        if not (np.isfinite(self.t0) and np.isfinite(self.dt) and self.dt > 0.0):
            raise UserError(f"spline: t0 = {self.t0} and dt = {self.dt} must be finite, dt positive")
        bad = ~np.isfinite(points).all(axis=(1, 2))
        if bad.any():
            raise UserError(f"spline: control point {int(np.argmax(bad))} is not finite; refit the trajectory")
        bad = ~se3.is_rigid(points)
        if bad.any():
            raise UserError(
                f"spline: control point {int(np.argmax(bad))} is not a rigid motion; pass it through se3.orthonormalise"
            )

    def tail(self, first: int) -> Spline:
        """The spline from control point number `first` on, with what has been derived from it."""
        at = first - self.first
        return self.with_derived(first, self.control_points[at:].copy(), self.increments[at:], self.left_gains[at:])

    def with_derived(self, first: int, points: FloatArray, increments: FloatArray, left_gains: FloatArray) -> Spline:
        """One with the same knots, of which all is known and nothing need be checked."""
        twin = object.__new__(Spline)
        points.setflags(write=False)
        known = {"control_points": points, "t0": self.t0, "dt": self.dt, "first": first}
        for name, value in (known | {"increments": increments, "left_gains": left_gains}).items():
            object.__setattr__(twin, name, value)
        return twin

    @property
    def t_begin(self) -> float:
        """First valid time in seconds."""
        return self.t0 + self.first * self.dt

    @property
    def t_end(self) -> float:
        """Last valid time in seconds."""
        return self.t0 + (self.first + len(self.control_points) - 3) * self.dt

    @cached_property
    def increments(self) -> FloatArray:
        """Twists (m − 1, 6) between neighbouring control points: log(T_i⁻¹ T_{i+1})."""
        return se3.log(se3.inverse(self.control_points[:-1]) @ self.control_points[1:])

    def locate(self, t: npt.ArrayLike) -> tuple[IntArray, FloatArray]:
        """Segment (...,) and position on it u (...,) in [0, 1] of times (...,) in seconds; UserError outside."""
        t = np.asarray(t, dtype=np.float64)
        s = (t - self.t0) / self.dt
        last = self.first + len(self.control_points) - 4
        # Rounding of the times themselves must not push a first or last stamp out of the spline.
        slack = 1e-9 + 4.0 * np.finfo(np.float64).eps * max(abs(self.t_begin), abs(self.t_end)) / self.dt
        outside = ~((s >= self.first - slack) & (s <= last + 1 + slack))
        if outside.any():
            raise UserError(
                f"spline: time {float(t[outside].flat[0])!r} s is outside [{self.t_begin!r}, {self.t_end!r}] s; "
                "use a longer trajectory or fewer frames"
            )
        segment = np.clip(np.floor(s), self.first, last).astype(np.int64)
        return segment, np.asarray(s - segment)

    def _held(self, t: npt.ArrayLike) -> tuple[IntArray, FloatArray]:
        """`locate` among the control points that are held."""
        segment, u = self.locate(t)
        return (segment - self.first if self.first else segment), u

    def pose(self, t: npt.ArrayLike) -> FloatArray:
        """T_world_body (..., 4, 4) at times (...,) in seconds: equation (4) with the basis of (5)."""
        t = np.asarray(t, dtype=np.float64)
        if t.size > _BLOCK:
            out = np.empty((t.size, 4, 4))
            for i in range(0, t.size, _BLOCK):
                out[i : i + _BLOCK] = self.pose(t.ravel()[i : i + _BLOCK])
            return out.reshape(*t.shape, 4, 4)
        segment, u = self._held(t)
        T = self.control_points[segment]
        for A in self._factors(segment, powers(u, 4) @ BASES[0]):
            T = T @ A
        return T

    def pose_and_velocity(self, t: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """`pose` (..., 4, 4) and `velocity` (..., 6) at once, for the price of one and a half."""
        segment, u = self._held(t)
        db = powers(u, 4) @ BASES[1] / self.dt
        T, w = self.control_points[segment], np.zeros((*u.shape, 6))
        for j, A in enumerate(self._factors(segment, powers(u, 4) @ BASES[0])):
            T = T @ A
            # Ad(A⁻¹) [v; ω] = [Rᵀ (v − t × ω); Rᵀ ω]: rows times R, without the 6x6.
            R, t_ = A[..., :3, :3], A[..., :3, 3]
            v, omega = w[..., :3] - cross(t_, w[..., 3:]), w[..., 3:]
            turned = np.stack([v, omega], axis=-2) @ R
            w = turned.reshape(w.shape) + db[..., j : j + 1] * self.increments[segment + j]
        return T, w

    def velocity(self, t: npt.ArrayLike) -> FloatArray:
        """Body velocity (..., 6) = [v; ω] at times (...,): m/s and rad/s, in body coordinates."""
        return self.pose_and_velocity(t)[1]

    def acceleration(self, t: npt.ArrayLike) -> FloatArray:
        """Time derivative (..., 6) = [v̇; ω̇] of `velocity`: m/s² and rad/s², components in body coordinates."""
        return self._motion(t)[1]

    def world_acceleration(self, t: npt.ArrayLike) -> FloatArray:
        """Second time derivative (..., 3) of the body's position in the world, in m/s²: R (v̇ + ω × v)."""
        w, dw = self._motion(t)
        body = dw[..., :3] + cross(w[..., 3:], w[..., :3])
        return np.asarray((self.pose(t)[..., :3, :3] @ body[..., None])[..., 0])

    def pose_jacobian(self, t: npt.ArrayLike, side: Side = "left") -> tuple[IntArray, FloatArray]:
        """Derivative of the pose by its four control points.

        Returns the index of the first of them (...,) and J (..., 4, 6, 6). side "left": T_i ← exp(δ_i) T_i moves
        T(t) ← exp(η) T(t) with η = Σ J_i δ_i (and Σ J_i = I); side "right": the same with increments on the right.
        """
        segment, u = self._held(t)
        b = powers(u, 4) @ BASES[0]
        blocks = self._left_blocks(segment, b) if side == "left" else self._right_blocks(segment, b)
        return segment + self.first, np.stack(blocks, axis=-3)

    def arrays(self) -> dict[str, FloatArray]:
        """What a file of it holds, by name, as `load` reads it."""
        return {"control_points": self.control_points, "t0": np.array(self.t_begin), "dt": np.array(self.dt)}

    def save(self, path: str | Path) -> None:
        """Write control_points, t0 and dt to an .npz file (float64, so that `load` returns the very same spline)."""
        with Path(path).open("wb") as file:
            np.savez(file, allow_pickle=False, **self.arrays())

    @classmethod
    def load(cls, path: str | Path) -> Spline:
        """Read what `save` wrote. Raises UserError for a missing, damaged or foreign file."""
        try:
            data = read_arrays(Path(path), ("control_points", "t0", "dt"))
            return cls(data["control_points"], float(data["t0"]), float(data["dt"]))
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
        except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UserError(f"{path}: not a readable spline ({reason}); write it anew with rsgen") from error

    def _parts(self, segment: IntArray, b: FloatArray) -> FloatArray:
        """b_j Ω_j (3, ..., 6): all at once, since a call costs more than the numbers do."""
        return np.moveaxis(b, -1, 0)[..., None] * self.increments[np.stack([segment, segment + 1, segment + 2])]

    def _factors(self, segment: IntArray, b: FloatArray) -> FloatArray:
        """A_1..A_3 (3, ..., 4, 4)."""
        return se3.exp(self._parts(segment, b))

    def _motion(self, t: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        segment, u = self._held(t)
        b = powers(u, 4) @ BASES[0]
        db = powers(u, 4) @ BASES[1] / self.dt
        ddb = powers(u, 4) @ BASES[2] / self.dt**2
        w, dw = np.zeros((*u.shape, 6)), np.zeros((*u.shape, 6))
        for j, A in enumerate(self._factors(segment, b)):
            omega = self.increments[segment + j]
            to_next = se3.adjoint(se3.inverse(A))
            w = (to_next @ w[..., None])[..., 0] + db[..., j : j + 1] * omega
            bracket = (se3.ad(w) @ omega[..., None])[..., 0]
            dw = (to_next @ dw[..., None])[..., 0] + db[..., j : j + 1] * bracket + ddb[..., j : j + 1] * omega
        return w, dw

    @cached_property
    def left_gains(self) -> FloatArray:
        """Derivative Jl⁻¹(Ω_j) Ad(T_{j−1}⁻¹) (m − 1, 6, 6) of `increments` by a left increment of T_j; − of T_{j−1}."""
        return se3.left_jacobian_inv(self.increments) @ se3.adjoint(se3.inverse(self.control_points[:-1]))

    def _left_blocks(self, segment: IntArray, b: FloatArray) -> list[FloatArray]:
        T = self.control_points[segment]
        F = [np.broadcast_to(np.eye(6), (*segment.shape, 6, 6))]
        J = se3.left_jacobian(self._parts(segment, b))
        for j, A in enumerate(self._factors(segment, b)):
            F.append(b[..., j, None, None] * (se3.adjoint(T) @ J[j] @ self.left_gains[segment + j]))
            T = T @ A
        return [F[0] - F[1], F[1] - F[2], F[2] - F[3], F[3]]

    def _right_blocks(self, segment: IntArray, b: FloatArray) -> list[FloatArray]:
        P = np.broadcast_to(np.eye(6), (*segment.shape, 6, 6))
        A = self._factors(segment, b)
        D, E = [P] * 3, [P] * 3
        for j in (2, 1, 0):
            bj, omega = b[..., j : j + 1], self.increments[segment + j]
            D[j] = bj[..., None] * (P @ se3.right_jacobian(bj * omega) @ se3.right_jacobian_inv(omega))
            E[j] = D[j] @ se3.adjoint(se3.exp(-omega))
            P = P @ se3.adjoint(se3.inverse(A[j]))
        return [P - E[0], D[0] - E[1], D[1] - E[2], D[2]]
