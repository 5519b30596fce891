"""A window of a recording: its own spline, and the normal equations of its images for that and the parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import BlockSums
from rstrack.alignment.brightness import SAME
from rstrack.alignment.normal_equations import Eliminated, eliminate
from rstrack.alignment.priors import ACCELERATION, acceleration_prior, acceleration_sigmas, pose_constraint
from rstrack.alignment.weights import FLOOR_DEPTH, FLOOR_INTENSITY, START_DEPTH, START_INTENSITY, scale_step
from rstrack.calibration.pairs.images import DepthSurface, ImageTiming, LinePoses, lines_of
from rstrack.calibration.pairs.optics import Optics
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.parameters import COUNT, POSES, Parameters

# σ of accelerations (m/s², rad/s²), looser than the tracker's.
_ACCELERATION = 3.0 * ACCELERATION
_GAUGE = np.full(6, 1e-6)
# Frames between those that are compared: near ones determine the clocks, far ones the extrinsics.
_APART = (1, 4, 9, 16)
# σ of gain and offset of an image against another, and the least and the most that they become.
_BRIGHTNESS, _BRIGHTNESS_BOUNDS = np.array([0.3, 0.15]), (-0.7, 2.0)


@dataclass
class WindowFrame:
    """A frame on the device: its depth, as z (m) and as a surface, and the colour image that goes with it, if any.

    levels: intensities of the pyramid's levels, NaN where they are unusable. bound: see `intensity_bound`.
    """

    depth: ImageTiming
    z: object
    surface: DepthSurface
    color: ImageTiming | None = None
    levels: tuple[object, ...] = ()
    bound: float = 1.0


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
    """Views in order of time, and the spline T_world_depth(t) that covers them all.

    sigma: of depth (m) and of intensity. brightness: gain and offset of each pair (view, reference). is_rough: every
    second distance between views is enough.
    """

    views: list[WindowFrame]
    spline: Spline
    sigma: tuple[float, float] = (START_DEPTH, START_INTENSITY)
    brightness: dict[tuple[int, int], FloatArray] = field(default_factory=dict)
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
        H, g = np.zeros((size, size)), np.zeros(size)
        optics = terms.optics(p)
        depths = lines_of([view.depth for view in self.views], self.spline, p)
        seen = iter(lines_of([view.color for view in self.views if view.color is not None], self.spline, p))
        colors = [None if view.color is None else next(seen) for view in self.views]
        weighted, counted, cost = np.zeros(2), np.zeros(2, int), 0.0
        by_depth = np.zeros_like(H), np.zeros_like(g)
        for kind, pair, sums, current, reference, T_base_world in self._pairs(terms, optics, p, level, depths, colors):
            sigma = self.sigma[kind]
            own, own_g = _system(sums, current, reference, T_base_world, sigma)
            counts = 1.0
            if kind:
                own, own_g = self._without_brightness(pair, own, own_g)
            elif depth_counts < 1.0:
                counts = depth_counts
                _add(*by_depth, own, own_g, current, reference, terms.asked.at[kind])
                own, own_g = counts * own, counts * own_g
            _add(H, g, own, own_g, current, reference, terms.asked.at[kind])
            weighted[kind] += sums.weighted
            counted[kind] += sums.count
            cost += counts * (sums.cost + sums.count * np.log(sigma))
        self._add_priors(H, g, p)
        floors = FLOOR_DEPTH, FLOOR_INTENSITY
        found = [scale_step(self.sigma[k], weighted[k], int(counted[k]), floors[k]) for k in range(2)]
        self.sigma = found[0], found[1]
        return WindowSums(H, g, cost, int(counted.sum()), overcounted(*by_depth, H) if depth_counts < 1.0 else 1.0)

    def read_by(self, terms: PairTerms) -> RecordingWindow:
        """The same images and spline, to be changed by themselves, if cameras read their lines as those of `terms`."""

        def taken(one: ImageTiming) -> ImageTiming:
            return replace(one, lens=terms.depth if one.is_depth else terms.color)

        views = [replace(v, depth=taken(v.depth), color=v.color and taken(v.color)) for v in self.views]
        return replace(self, views=views, brightness=dict(self.brightness))

    def move(self, increments: FloatArray) -> None:
        """T_i ← exp(δ_i) T_i for increments (k, 6) of all control points."""
        points = se3.orthonormalise(se3.exp(increments) @ self.spline.control_points)
        self.spline = Spline(points, self.spline.t0, self.spline.dt)

    def _pairs(
        self, terms: PairTerms, optics: Optics, p: Parameters, level: int, depths: Sequence[LinePoses],
        colors: Sequence[LinePoses | None],
    ) -> Iterator[tuple[int, tuple[int, int], BlockSums, LinePoses, LinePoses, FloatArray]]:  # fmt: skip
        """Kind (0 depth, 1 colour), pair, sums, lines of the current image and the reference's, T_base_world."""
        waiting = []
        for r, others in enumerate(partners(len(self.views), _APART[::2] if self.is_rough else _APART)):
            ref, surface = self.views[r], self.views[r].surface
            T_base_world = se3.inverse(self.spline.pose(ref.depth.mid_time(p)))
            ref_to_base, ref_from_base = depths[r].to_base(T_base_world), depths[r].from_base(T_base_world)
            ref_color = colors[r]
            color_from_base = None if ref_color is None else ref_color.from_base(T_base_world)
            for k in others:
                view = self.views[k]
                to_base = depths[k].to_base(T_base_world)
                started = terms.by_depth(view.z, surface, to_base, ref_from_base, optics, self.sigma[0])
                waiting.append((0, (k, r), started, depths[k], depths[r], T_base_world))
                color = colors[k]
                if color is None or ref_color is None or color_from_base is None:
                    continue
                started = terms.by_color(
                    (view.levels[level], ref.levels[level]), surface, ref_to_base, color.from_base(T_base_world),
                    color_from_base, optics, ref.bound, self.brightness.get((k, r), SAME), self.sigma[1], level,
                )  # fmt: skip
                waiting.append((1, (k, r), started, color, ref_color, T_base_world))
            # A few at a time: the device works ahead while their sums are chained.
            for kind, pair, started, current, reference, T in waiting:
                yield kind, pair, started(), current, reference, T
            waiting.clear()

    def _without_brightness(self, pair: tuple[int, int], H: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The system (m + 2, m + 2) without the last two unknowns, this pair's gain and offset: they take their next
        values."""
        at = self.brightness.get(pair, SAME)
        found = eliminate(H[:-2, :-2], g[:-2], H[:-2, -2:], H[-2:, -2:], g[-2:], _BRIGHTNESS, at)
        self.brightness[pair] = np.clip(at + found.step, *_BRIGHTNESS_BOUNDS)
        return found.H, found.g

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


def partners(count: int, distances: Sequence[int]) -> list[list[int]]:
    """For each of `count` views as a reference the views that are compared with it, so many frames apart.

    Every view is a reference as often as any other: the noise of a few would be in all that is compared with them. Of a
    pair the earlier and the later one take turns.
    """
    found: list[list[int]] = [[] for _ in range(count)]
    for n, apart in enumerate(distances):
        for k in range(count - apart):
            a, b = (k, k + apart) if (k + n) % 2 else (k + apart, k)
            found[a].append(b)
    return found


def _system(
    sums: BlockSums, current: LinePoses, reference: LinePoses, T_base_world: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """A pair's H and g by control points of the current image, of the reference, the parameters that move poses, those
    of lenses and depth that are asked for, and gain and offset, if any."""
    J, used = _slopes(sums, current, reference, T_base_world)
    flat = J.reshape(-1, J.shape[2])
    H = flat.T @ (sums.H[used] @ J).reshape(-1, J.shape[2]) / sigma**2
    g = flat.T @ sums.g[used].ravel() / sigma
    own = sums.columns
    if own is None:
        return H, g
    coupling = flat.T @ own.coupling[used].reshape(len(flat), len(own.g)) / sigma**2
    return np.block([[H, coupling], [coupling.T, own.H / sigma**2]]), np.concatenate([g, own.g / sigma])


def _slopes(
    sums: BlockSums, current: LinePoses, reference: LinePoses, T_base_world: FloatArray
) -> tuple[FloatArray, tuple[npt.NDArray[np.intp], ...]]:
    """Derivatives (n, 6, m) of the relative twists of those pairs of blocks that have pixels, and these pairs.

    m: control points of the current image, of the reference, parameters.
    """
    used = np.nonzero(np.abs(sums.H).sum(axis=(2, 3)))
    Ad = se3.adjoint(T_base_world)
    c, r = (Ad @ lines.by_points for lines in (current, reference))
    q = Ad @ current.by_parameters, Ad @ reference.by_parameters
    return np.concatenate([c[used[0]], -r[used[1]], q[0][used[0]] - q[1][used[1]]], axis=2), used


def _add(
    H: FloatArray, g: FloatArray, own: FloatArray, own_g: FloatArray, current: LinePoses, reference: LinePoses,
    asked: Sequence[int],
) -> None:  # fmt: skip
    """Add a pair's system, in the columns of `_system`, to that of all unknowns; asked: places of the last ones."""
    a, b, points = current.by_points.shape[2], reference.by_points.shape[2], len(g) - COUNT
    to = [np.arange(6 * current.first, 6 * current.first + a), np.arange(6 * reference.first, 6 * reference.first + b),
          points + np.array([*range(POSES), *asked], int)]  # fmt: skip
    of = [slice(0, a), slice(a, a + b), slice(a + b, len(own_g))]
    # Images close in time share control points: part by part, since an index that occurs twice is added once only.
    for i, rows in zip(to, of, strict=True):
        g[i] += own_g[rows]
        for j, columns in zip(to, of, strict=True):
            H[np.ix_(i, j)] += own[rows, columns]
