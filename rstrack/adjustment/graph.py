"""Control points and keyframes, what ties them to each other, and the sparse system that moves all of them at once.

Unknowns are left increments in the world: T_i ← exp(δ_i) T_i of control points, K_j ← exp(ξ_j) K_j of keyframes. What a
frame says of the control points against a keyframe (`KeyframeModel`) is a quadratic model whose Hessian the tracker has
made anyway. All control points and the keyframe moved as one body change nothing, so that x_i = log(E⁻¹ D_i) takes the
place of δ_i in it, where D_i and E are by what control point and keyframe have been moved (left, in the world) since
the model was made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.chain import KeyframeModel
from rstrack.adjustment.imu import Equations, ImuResult, ImuState, ImuTerm
from rstrack.adjustment.system import BlockSystem, Layout
from rstrack.alignment.priors import ACCELERATION, acceleration_sigmas


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
    # That of the last system: only numbers change from step to step.
    _layouts: list[Layout] = field(default_factory=list, init=False, repr=False, compare=False)

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
        system = _System(len(state.spline.control_points), list(state.keyframes), others, self._layouts)
        system.add_seen(self._stacked, state, self.at)
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

    @cached_property
    def _stacked(self) -> _Stacked:
        return _Stacked.of(self.seen, self.at)


@dataclass(frozen=True)
class _Stacked:
    """All keyframes' models one after the other: a row for each control point that one has, r in all.

    numbers (r,): of the control points. model (r,): whose row it is. keyframes (p,): of the p models, by their place
    among the state's, −1 without one; middles (p,): rows of their middles. gradient (r, 6): where they were made.
    pairs: for each d rows (k,), and the blocks (k, 6, 6) of their control points and those of the rows d later.
    """

    numbers: IntArray
    model: IntArray
    keyframes: IntArray
    middles: IntArray
    gradient: FloatArray
    pairs: list[tuple[IntArray, FloatArray]]

    @classmethod
    def of(cls, seen: Sequence[KeyframeModel], at: State) -> _Stacked:
        points, place = len(at.spline.control_points), {k: n for n, k in enumerate(at.keyframes)}
        seen = [each for each in seen if min(len(each.band), points - each.band.first) > 0]
        counts = [min(len(each.band), points - each.band.first) for each in seen]
        begins = np.cumsum([0, *counts])
        numbers = [each.band.first + np.arange(n) for each, n in zip(seen, counts, strict=True)]
        gradient = np.zeros((begins[-1], 6))
        parts: list[list[tuple[IntArray, FloatArray]]] = []
        for each, begin, n in zip(seen, begins, counts, strict=False):
            if each.gradient is not None:
                gradient[begin : begin + n] = each.gradient[:n]
            width = min(n, each.band.blocks.shape[1])
            parts += [[] for _ in range(width - len(parts))]
            for d in range(width):
                parts[d].append((begin + np.arange(n - d), each.band.blocks[: n - d, d].astype(np.float64)))
        return cls(
            np.concatenate([*numbers, np.zeros(0, int)]),
            np.repeat(np.arange(len(seen)), counts),
            np.array([-1 if each.keyframe is None else place[each.keyframe] for each in seen], int),
            begins[:-1] + np.array(counts, int) // 2,
            gradient,
            [(np.concatenate([rows for rows, _ in of_d]), np.concatenate([H for _, H in of_d])) for of_d in parts],
        )


class _System(BlockSystem):
    """Of `points` control points, then the keyframes, then `others`."""

    def __init__(self, points: int, keyframes: list[int], others: int, layouts: list[Layout]) -> None:
        super().__init__(points + len(keyframes) + others, layouts)
        self.points = points
        self._number = {k: points + n for n, k in enumerate(keyframes)}

    def add(self, sums: Equations) -> None:
        """Equations of any blocks, of which numbers below zero count from the end."""
        numbers = sums.numbers % len(self.g)
        n, k = numbers.shape
        np.add.at(self.g, numbers, sums.g.reshape(n, k, 6))
        H = sums.H.reshape(n, k, 6, k, 6)
        for a in range(k):
            for b in range(a, k):
                self.put(numbers[:, a], numbers[:, b], H[:, a, :, b])

    def add_seen(self, seen: _Stacked, state: State, at: State) -> None:
        """All keyframes' frames."""
        if not len(seen.numbers):
            return
        numbers, model = seen.numbers, seen.model
        own = state.spline.control_points[numbers] @ se3.inverse(at.spline.control_points[numbers])
        E = own[seen.middles]
        is_with = seen.keyframes >= 0
        K, K_at = (np.array(list(each.keyframes.values())).reshape(-1, 4, 4) for each in (state, at))
        moved = seen.keyframes[is_with]
        E[is_with] = K[moved] @ se3.inverse(K_at[moved])
        E_inv = se3.inverse(E)
        x = se3.log(E_inv[model] @ own)
        A = se3.left_jacobian_inv(x) @ se3.adjoint(E_inv)[model]
        At = np.swapaxes(A, 1, 2)
        Hx, whole = seen.gradient.copy(), np.zeros((len(numbers), 6, 6))
        for d, (rows, blocks) in enumerate(seen.pairs):
            Hx[rows] += (blocks @ x[rows + d][..., None])[..., 0]
            turned = At[rows] @ blocks @ A[rows + d]
            whole[rows] += turned
            if d:
                Hx[rows + d] += (np.swapaxes(blocks, 1, 2) @ x[rows][..., None])[..., 0]
                whole[rows + d] += np.swapaxes(turned, 1, 2)
            self.put(numbers[rows], numbers[rows + d], turned)
        g = (At @ Hx[..., None])[..., 0]
        np.add.at(self.g, numbers, g)
        with_keyframe = np.flatnonzero(is_with[model])
        k = self.points + seen.keyframes[model[with_keyframe]]
        self.put(numbers[with_keyframe], k, -whole[with_keyframe])
        self.put(k, k, whole[with_keyframe])
        np.add.at(self.g, k, -g[with_keyframe])

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
                self.put(numbers[:, a], numbers[:, b], weighted[:, a] @ J[:, b])

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
                self.put(np.arange(n) + a, np.arange(n) + b, weighted[:, a] @ J[:, b])
