"""A fixed-lag smoother over the newest control points and a belief: what all images and samples so far say.

Each image's normal equations and each sample are added once. Control points that nothing new depends on are
marginalised, not fixed: a spline held where it was estimated would make biases look far better known than they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.spline_state import SplineState
from rstrack.inertial.belief import GRAVITY, SIZE, STRENGTH, Belief
from rstrack.inertial.residuals import Joint

# Information of a control point that nothing tells (σ 100 m, rad): systems are never singular.
_NOTHING = 1e-4


@dataclass
class Smoother:
    """½ xᵀ H x + gᵀ x over control points `first`... and a belief's numbers, as increments since the control points had
    received `at` (k, 6) and around `belief` (12,)."""

    first: int
    H: FloatArray
    g: FloatArray
    at: FloatArray
    belief: FloatArray

    @classmethod
    def start(cls, belief: Belief) -> Smoother:
        """Without any control points."""
        return cls(0, belief.information.copy(), np.zeros(SIZE), np.zeros((0, 6)), belief.mean)

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
        return Smoother(self.first, self.H.copy(), self.g.copy(), self.at, self.belief)

    def without_belief(self, strength: float) -> tuple[Quadratic, float]:
        """Over the control points alone, the belief, gravity of a known strength (m/s²), being best at every step; and
        how much less that costs here than what is believed."""
        z, c = slice(len(self.g) - SIZE, None), slice(0, len(self.g) - SIZE)
        u, size = np.zeros(SIZE), float(np.linalg.norm(self.belief[GRAVITY]))
        u[GRAVITY] = self.belief[GRAVITY] / max(1e-9, size)
        gradient = self.g[z] + u * (size - strength) / STRENGTH**2
        information = self.H[z, z] + np.outer(u, u) / STRENGTH**2
        solved = np.linalg.solve(information, np.column_stack([self.H[z, c], gradient]))
        H = self.H[c, c] - self.H[c, z] @ solved[:, :-1]
        g = self.g[c] - self.H[c, z] @ solved[:, -1]
        return Quadratic(self.first, 0.5 * (H + H.T), g), 0.5 * float(gradient @ solved[:, -1])

    def around(self, belief: FloatArray) -> None:
        """Be around another belief (12,)."""
        self.g = self.g + self.H[:, -SIZE:] @ (belief - self.belief)
        self.belief = belief.copy()

    def add(self, model: Quadratic | Joint) -> None:
        """What is around the same state (and belief). Control points before the first are taken to be fixed."""
        tail = SIZE if isinstance(model, Joint) else 0
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
        """The belief's numbers walk on: variances (12,) of their steps."""
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
        x, y, z = self.belief[GRAVITY]
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

    def forget(self, first: int) -> None:
        """Marginalise the control points before number `first`."""
        count = 6 * min(max(0, first - self.first), len(self.at))
        if not count:
            return
        solved = np.linalg.solve(self.H[:count, :count], np.column_stack([self.H[:count, count:], self.g[:count]]))
        H = self.H[count:, count:] - self.H[count:, :count] @ solved[:, :-1]
        self.g = self.g[count:] - self.H[count:, :count] @ solved[:, -1]
        self.H, self.at = 0.5 * (H + H.T), self.at[count // 6 :]
        self.first += count // 6

    def marginal(self) -> Belief:
        """What is believed."""
        only = Smoother(self.first, self.H, self.g, self.at, self.belief)
        only.forget(self.last)
        return Belief(self.belief - np.linalg.solve(only.H, only.g), only.H)
