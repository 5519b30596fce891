"""A window of a recording: its own spline, and the normal equations of its images for that and the parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment import brightness
from rstrack.alignment.normal_equations import Eliminated, eliminate
from rstrack.alignment.priors import ACCELERATION, acceleration_prior, acceleration_sigmas, pose_constraint
from rstrack.alignment.weights import FLOOR_DEPTH, FLOOR_INTENSITY, START_DEPTH, START_INTENSITY, scale_step
from rstrack.calibration.pairs.images import ImageTiming, LinePoses, WindowImages, lines_of
from rstrack.calibration.pairs.terms import PairSums, PairTerms
from rstrack.calibration.parameters import COUNT, Parameters
from rstrack.compiled import compiled

# σ of accelerations (m/s², rad/s²), looser than the tracker's.
_ACCELERATION = 3.0 * ACCELERATION
_GAUGE = np.full(6, 1e-6)
# Frames between those that are compared: near ones determine the clocks, far ones the extrinsics.
_APART = (1, 4, 9, 16)
# The least and the most that gain and offset of an image against another become.
_BRIGHTNESS_BOUNDS = (-0.7, 2.0)


@dataclass(frozen=True)
class WindowFrame:
    """When a frame's depth was taken, and the colour image that goes with it, if it has one."""

    depth: ImageTiming
    color: ImageTiming
    has_color: bool


@dataclass(frozen=True)
class WindowSums:
    """Normal equations of a window at some spline and parameters: H, g over [control points, parameters].

    cost: negative log-likelihood but for its constant; pixels: that were compared. depth_overcounts: see `overcounted`;
    1 where all of depth's pixels count.
    """

    H: FloatArray
    g: FloatArray
    cost: float
    pixels: int
    depth_overcounts: float = 1.0

    @cached_property
    def reduced(self) -> Eliminated:
        """Of the parameters (31,) alone: the control points are what the images then make of them."""
        x = len(self.g) - COUNT
        nothing = np.full(x, np.inf), np.zeros(x)
        return eliminate(self.H[x:, x:], self.g[x:], self.H[x:, :x], self.H[:x, :x], self.g[:x], *nothing)

    def points_step(self, step: FloatArray) -> FloatArray:
        """Increments (k, 6) of the control points that go with a step (31,) of the parameters."""
        return (self.reduced.step + self.reduced.follow @ step).reshape(-1, 6)


@dataclass
class RecordingWindow:
    """Views in order of time, their images, and the spline T_world_depth(t) that covers them all.

    sigma: of depth (m) and of intensity. brightness (views, views, 2): gain and offset of each view against each
    reference. is_rough: every second distance between views is enough.
    """

    views: list[WindowFrame]
    images: WindowImages
    spline: Spline
    brightness: FloatArray
    sigma: tuple[float, float] = (START_DEPTH, START_INTENSITY)
    is_rough: bool = False

    @property
    def is_new(self) -> bool:
        """Whether the scales of its errors have not been estimated yet."""
        return self.sigma == (START_DEPTH, START_INTENSITY)

    def sums(self, terms: PairTerms, p: Parameters, level: int, depth_counts: float = 1.0) -> WindowSums:
        """Around the current spline; re-estimates σ and brightness on the way.

        depth_counts: part of depth's pixels that count, as the others only repeat them.
        """
        return self.launched(terms, p, level, depth_counts)()

    def launched(
        self, terms: PairTerms, p: Parameters, level: int, depth_counts: float = 1.0
    ) -> Callable[[], WindowSums]:  # fmt: skip
        """The same, once it is called; the device works on it meanwhile. The spline must stay as it is until then."""
        base, lever = self.base(p)
        optics, pairs = terms.optics(p), partners(len(self.views), _APART[::2] if self.is_rough else _APART)
        depths = lines_of([view.depth for view in self.views], self.spline, p, base)
        started = [terms.by_depth(self.images, pairs, depths, optics, self.sigma[0], lever)]
        colors = lines_of([view.color for view in self.views], self.spline, p, base)
        lines = depths, colors
        has_color = np.array([view.has_color for view in self.views])
        seen = pairs[has_color[pairs].all(axis=1)]
        if len(seen):
            given = self.images, level, seen, lines, optics, self.brightness
            started.append(terms.by_color(*given, self.sigma[1], lever))
        return lambda: self._added(started, lines, seen, terms, p, depth_counts)

    def _added(
        self, started: Sequence[Callable[[], PairSums]], lines: tuple[LinePoses, LinePoses], seen: IntArray,
        terms: PairTerms, p: Parameters, depth_counts: float,
    ) -> WindowSums:  # fmt: skip
        """What `started` has summed, of depth and of the pairs `seen` (n, 2) of colour, in one system."""
        size = 6 * len(self.spline.control_points) + COUNT
        H, g, cost, found = np.zeros((size, size)), np.zeros(size), 0.0, list(self.sigma)
        sums = [sums_of() for sums_of in started]
        for kind, one in enumerate(sums):
            sigma, floor = self.sigma[kind], (FLOOR_DEPTH, FLOOR_INTENSITY)[kind]
            rest = add_system(H, g, one, lines[kind], terms.asked.at[kind], sigma)
            if kind:
                at = seen[:, 0], seen[:, 1]
                self.brightness[at] = without_brightness(H, g, *rest, self.brightness[at])
            else:
                by_depth_alone = H.copy(), g.copy()
                H *= depth_counts
                g *= depth_counts
            cost += (1.0 if kind else depth_counts) * (one.blocks.cost + one.blocks.count * np.log(sigma))
            found[kind] = scale_step(sigma, one.blocks.weighted, one.blocks.count, floor)
        self._add_priors(H, g, p)
        self.sigma = found[0], found[1]
        repeated = overcounted(*by_depth_alone, H) if depth_counts < 1.0 else 1.0
        return WindowSums(H, g, cost, sum(one.blocks.count for one in sums), repeated)

    def base(self, p: Parameters) -> tuple[FloatArray, float]:
        """T_base_world of the frame that all is compared in, that of the view in the middle, and how far (m) what any
        view sees is from there, about."""
        T_base_world = se3.inverse(self.spline.pose(self.views[len(self.views) // 2].depth.mid_time(p)))
        t = np.clip([view.depth.mid_time(p) for view in self.views], self.spline.t_begin, self.spline.t_end)
        away = np.linalg.norm((T_base_world @ self.spline.pose(t))[:, :3, 3], axis=1)
        return T_base_world, float((away + self.images.median_depth).max())

    def read_by(self, terms: PairTerms) -> RecordingWindow:
        """The same images and spline, to be changed by themselves, if cameras read their lines as those of `terms`."""

        def read(view: WindowFrame) -> WindowFrame:
            depth, color = replace(view.depth, lens=terms.depth), replace(view.color, lens=terms.color)
            return replace(view, depth=depth, color=color)

        return replace(self, views=[read(view) for view in self.views], brightness=self.brightness.copy())

    def move(self, increments: FloatArray) -> None:
        """T_i ← exp(δ_i) T_i for increments (k, 6) of all control points."""
        points = se3.orthonormalise(se3.exp(increments) @ self.spline.control_points)
        self.spline = Spline(points, self.spline.t0, self.spline.dt)

    def _add_priors(self, H: FloatArray, g: FloatArray, p: Parameters) -> None:
        count = len(self.spline.control_points)
        sigma = acceleration_sigmas(_ACCELERATION, self.spline.dt, count - 2)
        t = self.views[len(self.views) // 2].depth.mid_time(p)
        for model, _ in (
            acceleration_prior(self.spline, 0, count, sigma),
            pose_constraint(self.spline, t, self.spline.pose(t), _GAUGE),
        ):
            at = slice(6 * model.first, 6 * model.last)
            H[at, at] += model.H
            g[at] += model.g


def overcounted(H: FloatArray, g: FloatArray, information: FloatArray) -> float:
    """How many times too much a term counts by its H and g (see `WindowSums`), around control points known otherwise.

    gᵀ H⁺ g is in the mean the rank of H times that, and what these points are off by: tr(H C), C their covariance by
    their `information` (like H). All of the control points alone. 1 where its pixels are independent.
    """
    x = len(g) - COUNT
    own = H[:x, :x]
    inverse = np.linalg.pinv(own, rcond=1e-6, hermitian=True)
    off = float(np.trace(np.linalg.solve(information[:x, :x], own)))
    return (float(g[:x] @ inverse @ g[:x]) - off) / max(1.0, float(np.trace(inverse @ own)))


def partners(count: int, distances: Sequence[int]) -> IntArray:
    """Pairs (n, 2) of `count` views, a view and the reference that it is compared with, so many frames apart.

    Every view is a reference as often as any other: the noise of a few would be in all that is compared with them. Of a
    pair the earlier and the later one take turns.
    """
    found = [
        (k + apart, k) if (k + n) % 2 else (k, k + apart)
        for n, apart in enumerate(distances) for k in range(count - apart)
    ]  # fmt: skip
    return np.array(found, int).reshape(-1, 2)


def add_system(
    H: FloatArray, g: FloatArray, sums: PairSums, lines: LinePoses, asked: Sequence[int], sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Add pairs to the normal equations H, g over [control points, parameters]; sigma: of r.

    lines: of the images. asked: places among the parameters of the first of the further columns. Of those that are left
    over, such as gain and offset: coupling (p, size, k), H (p, k, k) and g (p, k).
    """
    x, size, n = len(g) - COUNT, len(g), sums.coupling.shape[2]
    slopes = lines.slopes.reshape(-1, *lines.slopes.shape[2:])
    column = np.empty((len(slopes), slopes.shape[2]), np.int64)
    points = column.shape[1] - len(lines.moved)
    column[:, :points] = 6 * lines.first.reshape(-1, 1) + np.arange(points)
    column[:, points:] = x + np.array(lines.moved)
    blocks, of = sums.blocks, (sums.begin, sums.current, sums.reference)
    given = blocks.H[:, 0] / sigma**2, blocks.g[:, 0] / sigma, sums.coupling / sigma**2
    half, gradient, shared, apart = _chained(*given, *of, slopes, column, points, n - len(asked), size)
    own_H, own_g = sums.own_H / sigma**2, sums.own_g / sigma
    k = len(asked)
    at = x + np.array(asked, int)
    H += half + half.T
    H[:, at] += shared[:, :k]
    H[at] += shared[:, :k].T
    H[np.ix_(at, at)] += own_H[:, :k, :k].sum(axis=0)
    g += gradient
    g[at] += own_g[:, :k].sum(axis=0)
    apart[:, at] += own_H[:, :k, k:]
    return apart, own_H[:, k:, k:], own_g[:, k:]


def without_brightness(
    H: FloatArray, g: FloatArray, coupling: FloatArray, own: FloatArray, own_g: FloatArray, at: FloatArray
) -> FloatArray:
    """Take gains and offsets of p pairs, `at` (p, 2), out of H (m, m) and g (m,), and return their next values.

    coupling (p, m, 2), own (p, 2, 2), own_g (p, 2): see `normal_equations.eliminate`, which takes them out one by one.
    """
    system, right = own + np.diag(brightness.SIGMA**-2.0), own_g + at * brightness.SIGMA**-2.0
    solved = np.linalg.solve(system, np.concatenate([right[..., None], coupling.swapaxes(1, 2)], axis=2))
    flat = coupling.swapaxes(0, 1).reshape(len(g), -1)
    H -= flat @ solved[..., 1:].reshape(-1, len(g))
    g -= flat @ solved[..., 0].ravel()
    return np.clip(at - solved[..., 0], *_BRIGHTNESS_BOUNDS)


@compiled
def _chained(
    H: Any, g: Any, coupling: Any, begin: Any, current: Any, reference: Any, slopes: Any, column: Any, points: Any,
    apart: Any, size: Any,
) -> Any:  # fmt: skip
    """With J (r, 6, m) the slopes of r blocks by unknowns `column` (r, m), of which the first `points` stand side by
    side, and each pair of blocks moving by J of the current one less J of the reference: half (size, size) of the
    system, which is that and its transpose; the gradient (size,); the coupling (size, n) of all pairs, and that
    (p, size, apart) of each pair with the last of the columns."""
    pairs, (rows, _, m), n = len(begin) - 1, slopes.shape, coupling.shape[2]
    own_H, own_g, own_c = np.zeros((rows, 6, 6)), np.zeros((rows, 6)), np.zeros((rows, 6, n))
    half, gradient, shared = np.zeros((size, size)), np.zeros(size), np.zeros((size, n))
    each, moved = np.zeros((pairs, size, apart)), np.zeros((6, size))
    for q in range(pairs):
        u = begin[q]
        while u < begin[q + 1]:
            c, low, high = current[u], size, 0
            # All references' blocks that one current block is compared with, at once.
            while u < begin[q + 1] and current[u] == c:
                r = reference[u]
                own_H[c] += H[u]
                own_H[r] += H[u]
                own_g[c] += g[u]
                own_g[r] -= g[u]
                own_c[c] += coupling[u]
                own_c[r] -= coupling[u]
                low, high = min(low, column[r, 0]), max(high, column[r, 0] + points)
                for i in range(6):
                    for j in range(6):
                        h = H[u, i, j]
                        for a in range(m):
                            moved[i, column[r, a]] += h * slopes[r, j, a]
                    for k in range(apart):
                        h = coupling[u, i, n - apart + k]
                        for a in range(m):
                            each[q, column[c, a], k] += h * slopes[c, i, a]
                            each[q, column[r, a], k] -= h * slopes[r, i, a]
                u += 1
            for i in range(6):
                for a in range(m):
                    s, row = slopes[c, i, a], column[c, a]
                    for t in range(low, high):
                        half[row, t] -= s * moved[i, t]
                    for b in range(points, m):
                        half[row, column[c, b]] -= s * moved[i, column[c, b]]
            moved[:] = 0.0
    for r in range(rows):
        for i in range(6):
            for a in range(m):
                s, row = slopes[r, i, a], column[r, a]
                gradient[row] += s * own_g[r, i]
                for k in range(n):
                    shared[row, k] += s * own_c[r, i, k]
                for j in range(6):
                    h = 0.5 * s * own_H[r, i, j]
                    for b in range(m):
                        half[row, column[r, b]] += h * slopes[r, j, b]
    return half, gradient, shared, each
