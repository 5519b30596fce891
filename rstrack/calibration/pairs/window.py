"""A window of a recording: its own spline, and the normal equations of its images for that and the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import Eliminated, eliminate
from rstrack.alignment.priors import ACCELERATION, acceleration_prior, acceleration_sigmas, pose_constraint
from rstrack.alignment.weights import FLOOR_DEPTH, FLOOR_INTENSITY, START_DEPTH, START_INTENSITY, scale_step
from rstrack.calibration.pairs.chain import add_system, without_brightness
from rstrack.calibration.pairs.images import ImageTiming, WindowImages, lines_of
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.parameters import COUNT, Parameters

# σ of accelerations (m/s², rad/s²), looser than the tracker's.
_ACCELERATION = 3.0 * ACCELERATION
_GAUGE = np.full(6, 1e-6)
# Frames between those that are compared: near ones determine the clocks, far ones the extrinsics.
_APART = (1, 4, 9, 16)


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
        size = 6 * len(self.spline.control_points) + COUNT
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
