"""Normal equations of the step, equation (12): per-block 6×6 systems chained to the control points, and solved.

Unknowns are left increments δ_i in se(3): T_i ← exp(δ_i) T_i in the world frame. A block of lines at time t moves by
η = Σ J_i(t) δ_i over the four control points of its segment (docs/method.md), so its 6×6 system becomes 24×24.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.linalg

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import BlockSums
from rstrack.compiled import compiled
from rstrack.images.fast_spline import jacobians


@dataclass(frozen=True)
class Quadratic:
    """½ δᵀ H δ + gᵀ δ over control points first, first + 1, ...: H (6k, 6k), g (6k,)."""

    first: int
    H: FloatArray
    g: FloatArray

    @property
    def last(self) -> int:
        """One past the last control point."""
        return self.first + len(self.g) // 6

    def scaled(self, factor: float) -> Quadratic:
        """The model times a factor."""
        return self if factor == 1.0 else Quadratic(self.first, factor * self.H, factor * self.g)

    def moved(self, increments: FloatArray) -> Quadratic:
        """The same model around a state that has been moved by increments (k, 6) of its control points."""
        step = increments.ravel()
        return Quadratic(self.first, self.H, self.g + self.H @ step) if step.any() else self


@lru_cache(maxsize=64)
def _line_jacobian(spline: Spline, T_base_world: bytes, times: bytes, first: int, count: int) -> FloatArray:
    """Remembered, because both terms and all iterations of a level ask for the same."""
    return jacobians(spline, np.frombuffer(T_base_world).reshape(4, 4), np.frombuffer(times), first, count)


def by_points(at: IntArray, J: FloatArray, first: int, count: int) -> FloatArray:
    """Derivatives (n, 6, 6 count) by control points first..first+count of what four of them move, from `at` (n,) on, by
    J (n, 4, 6, 6)."""
    out = np.zeros((len(at), 6, count, 6))
    rows = np.arange(len(at))
    for i in range(4):
        out[rows, :, at - first + i] = J[:, i]
    return out.reshape(len(at), 6, 6 * count)


@dataclass(frozen=True)
class Slopes:
    """η of an image's blocks of lines and of a rolling reference's, by control points from `first` on: (n, 6, 6k)."""

    first: int
    current: FloatArray
    reference: FloatArray | None

    @classmethod
    def of(cls, spline: Spline, T_world_base: FloatArray, times: FloatArray, ref_times: FloatArray | None) -> Slopes:
        """Blocks at `times` (n,) and, of a rolling reference, at `ref_times`."""
        every = times if ref_times is None else np.concatenate([times, ref_times])
        segments, _ = spline.locate([every.min(), every.max()])
        first, count = int(segments[0]), int(segments[1] - segments[0]) + 4
        T_base_world = se3.inverse(T_world_base).tobytes()
        current = _line_jacobian(spline, T_base_world, times.tobytes(), first, count)
        if ref_times is None:
            return cls(first, current, None)
        return cls(first, current, _line_jacobian(spline, T_base_world, ref_times.tobytes(), first, count))


def chain(sums: BlockSums, slopes: Slopes, coupling: FloatArray | None = None) -> tuple[Quadratic, FloatArray]:
    """`sums` of blocks by the control points.

    coupling (nc, nr, 6, m): of the blocks' twists with unknowns of the image. Returns the quadratic model and the
    coupling (6k, m) of the control points.
    """
    first, size = slopes.first, slopes.current.shape[-1]
    if slopes.reference is None:
        J, H, g = slopes.current, sums.H[:, 0], sums.g[:, 0]
    else:
        used = np.flatnonzero(np.abs(sums.H).sum(axis=(2, 3)).ravel())
        c, r = np.divmod(used, len(slopes.reference))
        J = slopes.current[c] - slopes.reference[r]
        H, g = sums.H[c, r], sums.g[c, r]
    HJ = H @ J
    flat = J.reshape(-1, size).T
    dense = flat @ HJ.reshape(-1, size)
    if coupling is None:
        return Quadratic(first, 0.5 * (dense + dense.T), flat @ g.ravel()), np.zeros((size, 0))
    blocks = coupling[:, 0] if slopes.reference is None else coupling[c, r]
    return Quadratic(first, 0.5 * (dense + dense.T), flat @ g.ravel()), flat @ blocks.reshape(-1, blocks.shape[-1])


@dataclass(frozen=True)
class Eliminated:
    """Normal equations H (m, m), g (m,) without n further unknowns (Schur complement).

    step (n,): of these where the others stay; follow (n, m): what they move by with the others.
    """

    H: FloatArray
    g: FloatArray
    step: FloatArray
    follow: FloatArray

    def after(self, at: FloatArray, increments: FloatArray) -> FloatArray:
        """Those (n,) that were eliminated `at` (n,), after increments (m,) of the others."""
        found: FloatArray = at + self.step + self.follow @ increments
        return found


def eliminate(
    H: FloatArray, g: FloatArray, coupling: FloatArray, own: FloatArray, own_g: FloatArray, sigma: FloatArray,
    off: FloatArray,
) -> Eliminated:  # fmt: skip
    """Take n nuisance unknowns with a prior N(mean, diag σ²), such as an image's brightness, out of H (m, m), g (m,).

    coupling (m, n), own (n, n), own_g (n,): theirs with the others and among themselves. sigma (n,): the prior's; off
    (n,): how far from its mean they are.
    """
    return Eliminated(*_eliminated(H, g, coupling, own, own_g, sigma, off))


@compiled
def _eliminated(H: Any, g: Any, coupling: Any, own: Any, own_g: Any, sigma: Any, off: Any) -> Any:
    m, n = coupling.shape
    system, right = own.copy(), np.empty((n, m + 1))
    for i in range(n):
        system[i, i] += 1.0 / sigma[i] ** 2
        right[i, 0] = own_g[i] + off[i] / sigma[i] ** 2
        right[i, 1:] = coupling[:, i]
    solved = -np.linalg.solve(system, right)
    step, follow = solved[:, 0].copy(), solved[:, 1:].copy()
    reduced, slope = H.copy(), g.copy()
    for i in range(m):
        for k in range(n):
            slope[i] += coupling[i, k] * step[k]
            for j in range(m):
                # Half of either order, so that it is symmetric.
                reduced[i, j] += 0.5 * (coupling[i, k] * follow[k, j] + coupling[j, k] * follow[k, i])
    return reduced, slope, step, follow


def block_diagonal(block: FloatArray, count: int) -> FloatArray:
    """A block (n, n) so many times along the diagonal of a matrix: np.kron takes five times as long."""
    n = len(block)
    out = np.zeros((n * count, n * count))
    for k in range(0, n * count, n):
        out[k : k + n, k : k + n] = block
    return out


def assemble(models: Iterable[Quadratic], first: int, last: int) -> tuple[FloatArray, FloatArray]:
    """Sum of quadratic models restricted to the free control points first..last; the others are held fixed."""
    size = 6 * (last - first)
    H, g = np.zeros((size, size)), np.zeros(size)
    for model in models:
        low, high = max(model.first, first), min(model.last, last)
        if low >= high:
            continue
        own = slice(6 * (low - model.first), 6 * (high - model.first))
        to = slice(6 * (low - first), 6 * (high - first))
        H[to, to] += model.H[own, own]
        g[to] += model.g[own]
    return H, g


def solve(H: FloatArray, g: FloatArray, bandwidth: int = 24, damping: float = 0.0) -> FloatArray:
    """−H⁻¹ g by banded Cholesky, with the diagonal of H (n, n) larger by a part `damping`. Raises
    numpy.linalg.LinAlgError where H is not positive definite or not finite."""
    size = len(g)
    # Jacobi scaling: metres, radians and barely touched control points differ by many orders of magnitude.
    # A diagonal that rounding made zero or negative overflows.
    with np.errstate(over="ignore", invalid="ignore"):
        scale = 1.0 / np.sqrt(np.maximum(H.ravel()[:: size + 1] * (1.0 + damping), 1e-300))
        scaled, right = H * scale[:, None] * scale, scale * g
        scaled.ravel()[:: size + 1] *= 1.0 + damping
    if not (np.isfinite(scaled).all() and np.isfinite(right).all()):
        raise np.linalg.LinAlgError("the normal equations are not finite")
    _, x, failed = scipy.linalg.lapack.dpbsv(
        scaled.ravel()[_below_diagonal(size, min(bandwidth, size))], right, lower=1
    )
    if failed:
        raise np.linalg.LinAlgError("the normal equations are not positive definite")
    return np.asarray(-scale * x)


@lru_cache(maxsize=64)
def _below_diagonal(size: int, bandwidth: int) -> IntArray:
    """Where a matrix (size, size) has its diagonal and those below (bandwidth, size), as LAPACK has them; the first
    element where a diagonal has ended, which is not read."""
    row, column = np.arange(bandwidth)[:, None] + np.arange(size), np.arange(size)
    return np.where(row < size, row * size + column, 0)


def solve_damped(H: FloatArray, g: FloatArray, bandwidth: int, damping: float = 0.0) -> FloatArray:
    """The step (n,) of Levenberg-Marquardt, damped more where rounding makes the system indefinite, as it does where a
    motion is hardly observed. Raises numpy.linalg.LinAlgError where no damping helps."""
    for _ in range(8):
        try:
            step = solve(H, g, bandwidth, damping)
        except np.linalg.LinAlgError:
            step = np.full_like(g, np.nan)
        if np.isfinite(step).all():
            return step
        damping = max(1e-9, 100.0 * damping)
    raise np.linalg.LinAlgError("the normal equations have no finite solution")


# Steps that are remembered, and how many times as far as the plain step one goes at most.
_MEMORY, _FURTHEST = 3, 4.0
# A step this part of the one before, or less, shows that Gauss-Newton needs no help.
_FAST = 0.3


class AndersonMixing:
    """Longer steps where Gauss-Newton's are too short, from the last iterations of one optimisation.

    The Hessian of Gauss and Newton takes gradients of noise for gradients of the scene: on a real recording it is 1.6
    times too large for colour, several times in motions that are hardly seen, and steps then shrink by a tenth at a
    time. Anderson's mixing (J. ACM 1965; Walker and Ni, SIAM J. Numer. Anal. 2011) takes them for a fixed-point
    iteration and extrapolates from the last few.
    """

    def __init__(self) -> None:
        self._at: deque[FloatArray] = deque(maxlen=_MEMORY)
        self._steps: deque[FloatArray] = deque(maxlen=_MEMORY)

    def reset(self) -> None:
        """Begin anew, as where a step has been taken back."""
        self._at.clear()
        self._steps.clear()

    def extrapolated(self, at: FloatArray, step: FloatArray, H: FloatArray) -> FloatArray:
        """The step to take at increments `at` (6n,), where Gauss-Newton's with the Hessian H (6n, 6n) is `step` (6n,).

        Of all mixtures of the last iterations it begins from the one whose mixed step is least, measured by H.
        """
        # Copies: the optimiser moves its increments in place.
        self._at.append(at.copy())
        self._steps.append(step.copy())
        if len(self._steps) < 2:
            return step
        length, before = step @ H @ step, self._steps[-2] @ H @ self._steps[-2]
        if length < _FAST**2 * before:
            return step
        moves, changes = np.diff(np.array(self._at), axis=0).T, np.diff(np.array(self._steps), axis=0).T
        share = np.linalg.lstsq(changes.T @ H @ changes, changes.T @ (H @ step), rcond=1e-6)[0]
        further = step - (moves + changes) @ share
        longer = np.sqrt(max(float(further @ H @ further), 0.0) / max(float(length), 1e-300))
        return further if longer <= _FURTHEST else np.asarray(further * (_FURTHEST / longer))
