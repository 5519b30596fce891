"""A fixed-lag smoother over the newest control points and an IMU's numbers, from all images and samples so far.

Each image's normal equations and each sample are added once. Control points that nothing new depends on are
marginalised, not fixed: a spline held where it was estimated would make biases look far better known than they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.spline_state import SplineState
from rstrack.inertial.estimate import GRAVITY, SIZE, STRENGTH, ImuEstimate
from rstrack.inertial.factor import ImuQuadratic, without

# Information of a control point that nothing observes (σ 100 m, rad): systems are never singular.
_NOTHING = 1e-4
# Increments of control points (m, rad) that leave the samples' derivatives as they were.
_SAME = 1e-2


@dataclass
class Smoother:
    """½ xᵀ H x + gᵀ x over control points `first`... and the IMU's numbers, as increments since the control points had
    received `at` (k, 6) and around `estimate` (12,)."""

    first: int
    H: FloatArray
    g: FloatArray
    at: FloatArray
    estimate: FloatArray

    @classmethod
    def start(cls, estimate: ImuEstimate) -> Smoother:
        """Without any control points."""
        return cls(0, estimate.information.copy(), np.zeros(SIZE), np.zeros((0, 6)), estimate.mean)

    @property
    def last(self) -> int:
        """One past the last control point."""
        return self.first + len(self.at)

    def reach(self, state: SplineState, first: int, last: int) -> float:
        """Be around a state, and hold its control points up to `last`; from `first` on, if there are none yet.

        Returns how much more it costs there.
        """
        cost = 0.0
        if not len(self.at):
            self.first = first
        if len(self.at):
            step = (state.received(self.first, self.last) - self.at).ravel()
            change = self.H[:, :-SIZE] @ step
            cost = float(step @ self.g[:-SIZE] + 0.5 * step @ change[:-SIZE])
            self.g = self.g + change
        missing = 6 * max(0, last - self.last)
        if missing:
            c, size = len(self.g) - SIZE, len(self.g) + missing
            H, g = np.diag(np.full(size, _NOTHING)), np.zeros(size)
            g[:c], g[c + missing :] = self.g[:c], self.g[c:]
            H[:c, :c], H[c + missing :, c + missing :] = self.H[:c, :c], self.H[c:, c:]
            H[:c, c + missing :], H[c + missing :, :c] = self.H[:c, c:], self.H[c:, :c]
            self.H, self.g = H, g
        self.at = state.received(self.first, max(last, self.last))
        return cost

    def copy(self) -> Smoother:
        """One to which can be added without adding to this one."""
        return Smoother(self.first, self.H.copy(), self.g.copy(), self.at, self.estimate)

    def without_imu(self, strength: float) -> tuple[Quadratic, float]:
        """Over the control points alone, the IMU's numbers, gravity of a known strength (m/s²), being best at every
        step; and how much less that costs here than the estimate does."""
        u, size = np.zeros(SIZE), float(np.linalg.norm(self.estimate[GRAVITY]))
        u[GRAVITY] = self.estimate[GRAVITY] / max(1e-9, size)
        more, points = (np.outer(u, u) / STRENGTH**2, u * (size - strength) / STRENGTH**2), len(self.g) - SIZE
        H, g, _, gained = without(self.H, self.g, slice(points, None), slice(points), more)
        return Quadratic(self.first, H, g), gained

    def around(self, estimate: FloatArray) -> None:
        """Be around another estimate (12,)."""
        self.g = self.g + self.H[:, -SIZE:] @ (estimate - self.estimate)
        self.estimate = estimate.copy()

    def add(self, model: Quadratic | ImuQuadratic) -> None:
        """What is around the same state (and estimate). Control points before the first are taken to be fixed."""
        tail = SIZE if isinstance(model, ImuQuadratic) else 0
        count = (len(model.g) - tail) // 6
        low, high = max(model.first, self.first), min(model.first + count, self.last)
        if low >= high:
            return
        # Block by block: slices are added faster than arrays of indices.
        to, own = (slice(6 * (low - first), 6 * (high - first)) for first in (self.first, model.first))
        blocks = [(to, own)]
        if tail:
            blocks.append((slice(len(self.g) - tail, None), slice(6 * count, None)))
        for to, own in blocks:
            self.g[to] += model.g[own]
            for to_other, own_other in blocks:
                self.H[to, to_other] += model.H[own, own_other]

    def diffuse(self, variance: FloatArray) -> None:
        """The estimate's numbers walk on: variances (12,) of their steps."""
        walks = np.flatnonzero(variance > 0.0)
        ways = np.zeros((len(self.g), len(walks)))
        ways[len(self.g) - SIZE + walks, np.arange(len(walks))] = 1.0
        self._loosen(ways, np.diag(variance[walks]))

    def shift(self, covariance: FloatArray) -> None:
        """What is held comes to lie elsewhere in the world, as one body, with gravity: by a left increment with
        covariance (6, 6), as where images are aligned to another keyframe from now on.

        Where a difference of two keyframes' is less than nothing in some motion, nothing is loosened there.
        """
        sizes, axes = np.linalg.eigh(covariance)
        covariance = (axes * np.maximum(0.0, sizes)) @ axes.T
        x, y, z = self.estimate[GRAVITY]
        ways = np.concatenate([np.tile(np.eye(6), (len(self.at), 1)), np.zeros((SIZE, 6))])
        ways[6 * len(self.at) :][GRAVITY, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # φ × g
        self._loosen(ways, covariance)

    def _loosen(self, ways: FloatArray, covariance: FloatArray) -> None:
        """Noise of a covariance (m, m) along ways (n, m): (H⁻¹ + M Q Mᵀ)⁻¹ = H − H M (I + Q Mᵀ H M)⁻¹ Q Mᵀ H, the mean
        staying where it is."""
        rows = ways.T @ self.H
        gains = np.linalg.solve(np.eye(len(covariance)) + covariance @ rows @ ways, covariance @ rows)
        self.g = self.g - gains.T @ (ways.T @ self.g)
        H = self.H - rows.T @ gains
        self.H = 0.5 * (H + H.T)

    def marginalise(self, first: int) -> None:
        """Marginalise the control points before number `first`."""
        count = 6 * min(max(0, first - self.first), len(self.at))
        if not count:
            return
        self.H, self.g, _, _ = without(self.H, self.g, slice(count), slice(count, None))
        self.at, self.first = self.at[count // 6 :], self.first + count // 6

    def marginal(self) -> ImuEstimate:
        """The estimate."""
        only = Smoother(self.first, self.H, self.g, self.at, self.estimate)
        only.marginalise(self.last)
        return ImuEstimate(self.estimate - np.linalg.solve(only.H, only.g), only.H)


class ReusedPrior:
    """A `rstrack.alignment.priors.Prior` whose normal equations are used again while the spline hardly moves.

    summed: its model around the state as it is now, and the cost there. first, end: the control points that it depends
    on, and how many there were of all.
    """

    def __init__(self, state: SplineState, first: int, summed: Callable[[], tuple[Quadratic, float]]) -> None:
        self.state, self.first, self.end = state, first, state.end
        self._summed = summed
        self._known: tuple[Quadratic, float] | None = None
        self._at: FloatArray = np.zeros((0, 6))

    def __call__(self, spline: Spline) -> tuple[Quadratic, float]:
        if self._known is not None:
            model, cost = self._known
            moved = self.state.received(model.first, model.last) - self._at
            if np.abs(moved).max() < _SAME:
                step = moved.ravel()
                turned = model.H @ step
                there = Quadratic(model.first, model.H, model.g + turned)
                return there, cost + float(step @ (model.g + 0.5 * turned))
        self._known = self._summed()
        model, _ = self._known
        self._at = self.state.received(model.first, model.last)
        return self._known
