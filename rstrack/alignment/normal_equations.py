"""Normal equations of the step, equation (12): per-block 6×6 systems chained to the control points, and solved.

Unknowns are left increments δ_i in se(3): T_i ← exp(δ_i) T_i in the world frame. A block of lines at time t moves by
η = Σ J_i(t) δ_i over the four control points of its segment (docs/method.md), so its 6×6 system becomes 24×24.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.linalg

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import BlockSums
from rstrack.images.line_poses import SplineCache


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
        return replace(self, g=self.g + self.H @ step) if step.any() else self


_jacobians: SplineCache[bytes, tuple[IntArray, FloatArray]] = SplineCache()


def prepare_jacobians(spline: Spline, times: Iterable[FloatArray]) -> None:
    """Work out what `line_jacobian` of several images' times (n,) needs at once."""

    def work_out(new: list[bytes]) -> Iterator[tuple[IntArray, FloatArray]]:
        given = [np.frombuffer(t) for t in new]
        first, J = spline.pose_jacobian(np.concatenate(given))
        ends = np.cumsum([len(t) for t in given])[:-1]
        return zip(np.split(first, ends), np.split(J, ends), strict=True)

    _jacobians.add(spline, (t.tobytes() for t in times), work_out)


def line_jacobian(spline: Spline, T_world_base: FloatArray, times: FloatArray, first: int, count: int) -> FloatArray:
    """η in the base frame by the control points first..first+count: (n, 6, 6 count)."""
    return _line_jacobian(spline, T_world_base.tobytes(), times.tobytes(), first, count)


@lru_cache(maxsize=64)
def _line_jacobian(spline: Spline, T_world_base: bytes, times: bytes, first: int, count: int) -> FloatArray:
    """Remembered, because both terms and all iterations of a level ask for the same."""
    prepare_jacobians(spline, [np.frombuffer(times)])
    at, J = _jacobians.of(spline)[times]
    J = se3.adjoint(se3.inverse(np.frombuffer(T_world_base).reshape(4, 4))) @ J
    return by_points(at, J, first, count)


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
        segments, _ = spline.locate(every)
        first, count = int(segments.min()), int(segments.max() - segments.min()) + 4
        current = line_jacobian(spline, T_world_base, times, first, count)
        reference = None if ref_times is None else line_jacobian(spline, T_world_base, ref_times, first, count)
        return cls(first, current, reference)


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


def eliminate(
    H: FloatArray, g: FloatArray, coupling: FloatArray, own: FloatArray, own_g: FloatArray, sigma: FloatArray,
    off: FloatArray,
) -> Eliminated:  # fmt: skip
    """Take n nuisance unknowns with a prior N(mean, diag σ²), such as an image's brightness, out of H (m, m), g (m,).

    coupling (m, n), own (n, n), own_g (n,): theirs with the others and among themselves. sigma (n,): the prior's; off
    (n,): how far from its mean they are.
    """
    system = own + np.diag(1.0 / sigma**2)
    solved = -np.asarray(np.linalg.solve(system, np.column_stack([own_g + off / sigma**2, coupling.T])))
    step, follow = solved[:, 0], solved[:, 1:]
    reduced = H + coupling @ follow
    return Eliminated(0.5 * (reduced + reduced.T), g + coupling @ step, step, follow)


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


def solve(H: FloatArray, g: FloatArray, bandwidth: int = 24) -> FloatArray:
    """−H⁻¹ g by banded Cholesky. Raises numpy.linalg.LinAlgError where H is not positive definite or not finite."""
    size = len(g)
    bandwidth = min(bandwidth, size)
    # Jacobi scaling: metres, radians and barely touched control points differ by many orders of magnitude.
    # A diagonal that rounding made zero or negative overflows.
    with np.errstate(over="ignore", invalid="ignore"):
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        scaled, right = H * scale[:, None] * scale, scale * g
    if not (np.isfinite(scaled).all() and np.isfinite(right).all()):
        raise np.linalg.LinAlgError("the normal equations are not finite")
    band = np.zeros((bandwidth, size))
    for k in range(bandwidth):
        band[k, : size - k] = np.diagonal(scaled, -k)
    return -scale * np.asarray(scipy.linalg.solveh_banded(band, right, lower=True))


def solve_damped(H: FloatArray, g: FloatArray, bandwidth: int, damping: float = 0.0) -> FloatArray:
    """The step (n,) of Levenberg-Marquardt, damped more where rounding makes the system indefinite, as it does where a
    motion is hardly observed. Raises numpy.linalg.LinAlgError where no damping helps."""
    for _ in range(8):
        damped = H.copy()
        damped[np.diag_indices_from(H)] *= 1.0 + damping
        try:
            step = solve(damped, g, bandwidth)
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
