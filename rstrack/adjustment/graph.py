"""Control points and keyframes, what ties them to each other, and the sparse system that moves all of them at once.

Unknowns are left increments in the world: T_i ← exp(δ_i) T_i of control points, K_j ← exp(ξ_j) K_j of keyframes. What a
frame says of the control points against a keyframe (`KeyframeModel`) is a quadratic model whose Hessian the tracker has
made anyway. All control points and the keyframe moved as one body change nothing, so that x_i = log(E⁻¹ D_i) takes the
place of δ_i in it, where D_i and E are by what control point and keyframe have been moved (left, in the world) since
the model was made.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import splu

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.chain import KeyframeModel
from rstrack.adjustment.imu import Equations, ImuResult, ImuState, ImuTerm
from rstrack.alignment.priors import ACCELERATION, acceleration_sigmas

# Information that holds the first control point, in m⁻² and rad⁻²: the gauge.
_HELD = 1e14


@dataclass(frozen=True)
class Sighting:
    """The camera at time t (s) was found at T_ref_cam (4, 4) in a keyframe.

    information (6, 6): of increments T_ref_cam exp(ξ), [m; rad].
    """

    keyframe: int
    t: float
    T_ref_cam: FloatArray
    information: FloatArray


@dataclass(frozen=True)
class State:
    """A spline T_world_cam(t) and keyframes' T_world_base (4, 4) by their numbers; the estimate of an IMU."""

    spline: Spline
    keyframes: dict[int, FloatArray]
    imu: ImuState | None = None

    def errors(self, sightings: Sequence[Sighting]) -> FloatArray:
        """Twists (n, 6) from where sightings put the camera to where it is, in the camera's axes."""
        keyframes = np.array([self.keyframes[s.keyframe] for s in sightings])
        T = se3.inverse(keyframes) @ self.spline.pose(np.array([s.t for s in sightings]))
        return se3.log(se3.inverse(np.array([s.T_ref_cam for s in sightings])) @ T)

    def moved(self, points: FloatArray, keyframes: FloatArray, imu: FloatArray | None = None) -> State:
        """With left increments of the control points (n, 6) and of the keyframes (m, 6), in their order, and a step of
        the IMU's own blocks (k, 6)."""
        T = se3.orthonormalise(se3.exp(points) @ self.spline.control_points)
        spline = Spline(T, self.spline.t0, self.spline.dt)
        steps = se3.exp(keyframes)
        return State(
            spline,
            {k: se3.orthonormalise(steps[n] @ K) for n, (k, K) in enumerate(self.keyframes.items())},
            self.imu if self.imu is None or imu is None else self.imu.moved(imu),
        )

    def placed(self, T: FloatArray) -> State:
        """All of it moved by T (4, 4) in the world."""
        spline = Spline(se3.orthonormalise(T @ self.spline.control_points), self.spline.t0, self.spline.dt)
        imu = None if self.imu is None else self.imu.turned(T[:3, :3])
        return State(spline, {k: se3.orthonormalise(T @ K) for k, K in self.keyframes.items()}, imu)


@dataclass(frozen=True)
class Graph:
    """What is known.

    at: the state around which the models of `seen` were made. keeps_motion: accelerations are to stay what they are
    there; else to be small. imu: an IMU's readings, of which a state has a `ImuState` then.
    """

    at: State
    seen: Sequence[KeyframeModel]
    sightings: Sequence[Sighting]
    keeps_motion: bool = True
    imu: ImuTerm | None = None

    def weakened(self, spread: float) -> Graph:
        """With frames and sightings so many times as uncertain (σ)."""
        seen = [each.weakened(spread) for each in self.seen]
        sightings = [replace(each, information=each.information / spread**2) for each in self.sightings]
        return replace(self, seen=seen, sightings=sightings)

    def step(self, state: State, weights: FloatArray | None = None) -> tuple[State, FloatArray]:
        """One Gauss-Newton step from a state; weights (n,) of the sightings. Returns the increments too (n, 6)."""
        system = self._system(state, weights)
        x = system.solved()
        points, keyframes = len(state.spline.control_points), len(state.keyframes)
        return state.moved(x[:points], x[points : points + keyframes], x[points + keyframes :]), x

    def found(self, state: State) -> ImuResult | None:
        """What is known there of the IMU, if there is one."""
        if self.imu is None or state.imu is None:
            return None
        return ImuResult.of(state.imu, self.imu.recording.T_imu_depth, self._system(state, None).covariance())

    def _system(self, state: State, weights: FloatArray | None) -> _System:
        others = 0 if self.imu is None or state.imu is None else len(state.imu)
        system = _System(len(state.spline.control_points), list(state.keyframes), others)
        moved_points = state.spline.control_points @ se3.inverse(self.at.spline.control_points)
        for seen in self.seen:
            system.add_seen(seen, state, self.at, moved_points)
        if self.sightings:
            system.add_sightings(self.sightings, state, np.ones(len(self.sightings)) if weights is None else weights)
        accelerations = ACCELERATION
        if self.imu is not None and state.imu is not None:
            accelerations = self.imu.accelerations
            for sums in (*self.imu.known(state.imu, state.spline.dt), *self.imu.equations(state.spline, state.imu)):
                system.add(sums)
        before = self.at.spline.increments if self.keeps_motion else np.zeros_like(state.spline.increments)
        system.add_smoothness(state.spline, before, accelerations)
        return system


@dataclass
class _System:
    """Blocks of the upper triangle of H and of g, of `points` control points, then the keyframes, then `others`."""

    points: int
    keyframes: list[int]
    others: int = 0
    _rows: list[IntArray] = field(default_factory=list)
    _columns: list[IntArray] = field(default_factory=list)
    _blocks: list[FloatArray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._number = {k: self.points + n for n, k in enumerate(self.keyframes)}
        self.g = np.zeros((self.points + len(self.keyframes) + self.others, 6))

    def add(self, sums: Equations) -> None:
        """Equations of any blocks, of which numbers below zero count from the end."""
        numbers = sums.numbers % len(self.g)
        n, k = numbers.shape
        np.add.at(self.g, numbers, sums.g.reshape(n, k, 6))
        H = sums.H.reshape(n, k, 6, k, 6)
        for a in range(k):
            for b in range(a, k):
                self._put(numbers[:, a], numbers[:, b], H[:, a, :, b])

    def add_seen(self, seen: KeyframeModel, state: State, at: State, moved_points: FloatArray) -> None:
        """A keyframe's frames."""
        band = seen.band
        n = min(len(band), self.points - band.first)
        numbers = band.first + np.arange(n)
        own = moved_points[numbers]
        E = own[n // 2]
        if seen.keyframe is not None:
            E = state.keyframes[seen.keyframe] @ se3.inverse(at.keyframes[seen.keyframe])
        x = se3.log(se3.inverse(E) @ own)
        A = se3.left_jacobian_inv(x) @ se3.adjoint(se3.inverse(E))
        Hx, whole = np.zeros((n, 6)), np.zeros((n, 6, 6))
        if seen.gradient is not None:
            Hx += seen.gradient[:n]
        for d in range(band.blocks.shape[1]):
            rows = np.arange(n - d)
            if not len(rows):
                break
            blocks = band.blocks[: n - d, d].astype(np.float64)
            Hx[rows] += (blocks @ x[rows + d][..., None])[..., 0]
            turned = np.swapaxes(A[rows], 1, 2) @ blocks @ A[rows + d]
            whole[rows] += turned
            if d:
                Hx[rows + d] += (np.swapaxes(blocks, 1, 2) @ x[rows][..., None])[..., 0]
                whole[rows + d] += np.swapaxes(turned, 1, 2)
            self._put(numbers[rows], numbers[rows + d], turned)
        g = (np.swapaxes(A, 1, 2) @ Hx[..., None])[..., 0]
        self.g[numbers] += g
        if seen.keyframe is not None:
            k = self._number[seen.keyframe]
            self._put(numbers, np.full(n, k), -whole)
            self._put(np.array([k]), np.array([k]), whole.sum(axis=0)[None])
            self.g[k] -= g.sum(axis=0)

    def add_sightings(self, sightings: Sequence[Sighting], state: State, weights: FloatArray) -> None:
        """Some sightings (n), with weights (n,)."""
        e, times = state.errors(sightings), np.array([s.t for s in sightings])
        segments, J = state.spline.pose_jacobian(times)
        to_cam = se3.right_jacobian_inv(e) @ se3.adjoint(se3.inverse(state.spline.pose(times)))
        J = np.concatenate([to_cam[:, None] @ J, -to_cam[:, None]], axis=1)
        keyframes = np.array([self._number[s.keyframe] for s in sightings])
        numbers = np.column_stack([segments[:, None] + np.arange(4), keyframes])
        information = weights[:, None, None] * np.array([s.information for s in sightings])
        weighted = np.swapaxes(J, 2, 3) @ information[:, None]
        np.add.at(self.g, numbers, (weighted @ e[:, None, :, None])[..., 0])
        for a in range(5):
            for b in range(a, 5):
                self._put(numbers[:, a], numbers[:, b], weighted[:, a] @ J[:, b])

    def add_smoothness(self, spline: Spline, before: FloatArray, accelerations: FloatArray) -> None:
        """Small accelerations, of σ (6,) in m/s² and rad/s², beside those of increments `before` (n, 6) from control
        point to control point."""
        gains, omega = spline.left_gains, spline.increments - before
        r = omega[1:] - omega[:-1]
        # It decides where nothing else does: in gaps, and in what a wall leaves open.
        inverse = 1.0 / acceleration_sigmas(accelerations, spline.dt, len(r))[:, None, None] ** 2
        J = np.stack([gains[:-1], -gains[1:] - gains[:-1], gains[1:]], axis=1)
        n = len(r)
        weighted = np.swapaxes(J, 2, 3) * inverse
        for a in range(3):
            np.add.at(self.g, np.arange(n) + a, (weighted[:, a] @ r[..., None])[..., 0])
            for b in range(a, 3):
                self._put(np.arange(n) + a, np.arange(n) + b, weighted[:, a] @ J[:, b])

    def solved(self) -> FloatArray:
        """Increments (n, 6) of all blocks. Raises numpy.linalg.LinAlgError."""
        inverted = self._inverted()
        x = -inverted(self.g.ravel())
        if not np.isfinite(x).all():
            raise np.linalg.LinAlgError("the graph's system has no finite solution")
        return np.asarray(x.reshape(-1, 6))

    def covariance(self) -> Callable[[IntArray], FloatArray]:
        """Of unknowns by their numbers (k,): (k, k). Raises numpy.linalg.LinAlgError."""
        inverted, size = self._inverted(), self.g.size
        return lambda numbers: np.stack([inverted(np.eye(1, size, int(k) % size)[0])[numbers] for k in numbers])

    def _inverted(self) -> Callable[[FloatArray], FloatArray]:
        """Takes a vector to H⁻¹ times it."""
        size = self.g.size
        self._put(np.zeros(1, int), np.zeros(1, int), _HELD * np.eye(6)[None])
        rows, columns, blocks = (np.concatenate(a) for a in (self._rows, self._columns, self._blocks))
        inner = np.arange(6)
        i = np.broadcast_to(6 * rows[:, None, None] + inner[:, None], blocks.shape).ravel().astype(np.int32)
        j = np.broadcast_to(6 * columns[:, None, None] + inner, blocks.shape).ravel().astype(np.int32)
        # Blocks on the diagonal are whole; of the others there is the upper one only.
        values = np.where((rows == columns)[:, None, None], 0.5, 1.0) * blocks
        upper = scipy.sparse.coo_matrix((values.ravel(), (i, j)), shape=(size, size)).tocsc()
        H = scipy.sparse.csc_matrix(upper + upper.T)
        scale = 1.0 / np.sqrt(np.maximum(H.diagonal(), 1e-300))
        scaling = scipy.sparse.diags(scale)
        scaled = scipy.sparse.csc_matrix(scaling @ H @ scaling)
        symmetric = {"SymmetricMode": True}
        try:
            factors = splu(scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        except RuntimeError as error:
            raise np.linalg.LinAlgError(f"the graph's system has no solution ({error})") from None
        return lambda b: np.asarray(scale * factors.solve(scale * b))

    def _put(self, rows: IntArray, columns: IntArray, blocks: FloatArray) -> None:
        self._rows.append(np.asarray(rows))
        self._columns.append(np.asarray(columns))
        self._blocks.append(blocks)
