"""From per-block 6×6 systems to the control points: chain rule, motion prior, banded solve.

Unknowns are left increments δ_i in se(3): T_i ← exp(δ_i) T_i in the world frame. A block of lines at time t moves by
η = Σ J_i(t) δ_i over the four control points of its segment (DESIGN section 4), so its 6×6 system becomes 24×24.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np
import scipy.linalg

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import BlockSums


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


def line_jacobian(spline: Spline, T_world_base: FloatArray, times: FloatArray, first: int, count: int) -> FloatArray:
    """η in the base frame by the control points first..first+count: (n, 6, 6 count)."""
    return _line_jacobian(spline, T_world_base.tobytes(), times.tobytes(), first, count)


# Of a spline's last images: see `line_poses`.
_REMEMBERED = 64
_jacobians: WeakKeyDictionary[Spline, dict[bytes, tuple[IntArray, FloatArray]]] = WeakKeyDictionary()


def prepare_jacobians(spline: Spline, times: Iterable[FloatArray]) -> None:
    """Work out what `line_jacobian` of several images' times (n,) needs at once: a call costs more than the numbers."""
    known = _jacobians.setdefault(spline, {})
    new = [t for t in {t.tobytes(): t for t in times}.values() if t.tobytes() not in known]
    if not new:
        return
    first, J = spline.pose_jacobian(np.concatenate(new))
    for oldest in list(known)[: max(0, len(known) + len(new) - _REMEMBERED)]:
        del known[oldest]
    ends = np.cumsum([len(t) for t in new])[:-1]
    for t, segments, own in zip(new, np.split(first, ends), np.split(J, ends), strict=True):
        known[t.tobytes()] = segments, own


@lru_cache(maxsize=64)
def _line_jacobian(spline: Spline, T_world_base: bytes, times: bytes, first: int, count: int) -> FloatArray:
    """Remembered, because both terms and all iterations of a level ask for the same."""
    prepare_jacobians(spline, [np.frombuffer(times)])
    at, J = _jacobians[spline][times]
    J = se3.adjoint(se3.inverse(np.frombuffer(T_world_base).reshape(4, 4))) @ J
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


def eliminate(
    model: Quadratic, coupling: FloatArray, H: FloatArray, g: FloatArray, sigma: FloatArray, off: FloatArray
) -> tuple[Quadratic, FloatArray, FloatArray]:
    """The model without n further unknowns that have a prior N(mean, diag σ²), by Schur complement.

    coupling (6k, n), H (n, n), g (n,): theirs with the control points and among themselves. sigma (n,): the prior's;
    off (n,): how far from its mean they are. Returns their step (n,), too, and how they follow control points (n, 6k).
    """
    system = H + np.diag(1.0 / sigma**2)
    solved = -np.asarray(np.linalg.solve(system, np.column_stack([g + off / sigma**2, coupling.T])))
    step, follow = solved[:, 0], solved[:, 1:]
    reduced = model.H + coupling @ follow
    return Quadratic(model.first, 0.5 * (reduced + reduced.T), model.g + coupling @ step), step, follow


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
    """The step (n,) of Levenberg-Marquardt; rounding can make a system indefinite that hardly tells some motion: then
    damped more. Raises numpy.linalg.LinAlgError where no damping helps."""
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
