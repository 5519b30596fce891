"""The fixed pattern of a depth camera's error, estimated from the recording itself.

found = estimate_depth_pattern(dataset, GeometricTracks(dataset, range(len(dataset)), Options(), no_progress))
dataset = dataset.with_depth_pattern(found.pattern)

Two images that show a surface at different pixels disagree about it. The point at pixel v and inverse depth ρ of frame
b is moved to frame a by the rough track, where it has pixel u and inverse depth 1/z. The residual is

    r = 1/z − ρ_a(u) = noise − (∂r/∂ρ) w(v) + w(u) − J ξ,

w the pattern, a linear combination of polynomials, and ξ the track's error between the two frames. ξ is eliminated,
pair by pair; w is found by least squares with Student weights and a prior. Pixels of a pair are not independent, nor
are errors of a track from one pair to the next: the covariance is that of the scatter between sixths of the pairs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import BoolArray, FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.geometry import se3
from rstrack.alignment.weights import NU
from rstrack.data.dataset import Dataset
from rstrack.data.depth_pattern import MEAN_SQUARES, PATTERN_SIZE, pattern_basis
from rstrack.data.image_files import prefetched
from rstrack.tracking.first_look.rough_track import GeometricTrack
from rstrack.tracking.first_look.views import projected

# For the progress bar.
_STAGE = "depth's pattern"
# Every so manieth frame has its image compared, with those so many steps before it.
_EVERY, _APART = 5, (1, 2, 4, 8)
# Pixels compared in a line of an image.
_ACROSS = 80
# A plane is fitted to a part of an image, so many in a line. It is a surface where nearly all of it is measured and its
# residual is below so many times the median.
_SURFACES, _MEASURED, _FLAT = 71, 0.99, 3.0
# Inverse depth (1/m) that is compared, and how far two images may differ there before one hides the other.
_FARTHEST, _SAME = 0.2, 0.05
# The fewest pixels that a pair may share, pairs, and groups of these that scatter.
_FEWEST_PIXELS, _FEWEST_PAIRS, _GROUPS = 400, 12, 6
# σ of a coefficient (1/m), a tenth of a pixel of a Kinect's disparity, and of what a rough track is off by (m, rad).
_SIGMA, _TRACK_SIGMA = 0.003, 0.02
_ROUNDS = 6


@dataclass(frozen=True)
class FoundPattern:
    """pattern (27,): coefficients in 1/m, () if nothing shows them; covariance (27, 27); pairs: of images compared."""

    pattern: tuple[float, ...]
    covariance: FloatArray
    pairs: int

    def text(self) -> str:
        """One line for the screen."""
        if not self.pattern:
            return "no fixed pattern of depth's error found: too few images overlap"
        return (
            f"fixed pattern of depth's error estimated from {self.pairs} pairs of images: "
            f"{1e3 * self.rms:.1f} ± {1e3 * self.sigma_rms:.1f} mm at 1 m (RMS)"
        )

    @property
    def rms(self) -> float:
        """Of the pattern over the image, 1/m."""
        return float(np.sqrt(MEAN_SQUARES @ np.array(self.pattern) ** 2))

    @property
    def sigma_rms(self) -> float:
        """Of its standard error over the image, 1/m."""
        return float(np.sqrt(MEAN_SQUARES @ np.diag(self.covariance)))


def estimate_depth_pattern(
    dataset: Dataset, tracks: Iterable[GeometricTrack | None], progress: Progress = no_progress
) -> FoundPattern:
    """By as many tracks as there are. Raises UserError: an image that cannot be read."""
    pairs: list[_Pair] = []
    for track in tracks:
        if track is not None:
            pairs += _pairs(dataset, track, progress)
    if len(pairs) < _FEWEST_PAIRS:
        return FoundPattern((), np.zeros((PATTERN_SIZE, PATTERN_SIZE)), len(pairs))
    x, covariance = _solved(pairs)
    progress(_STAGE, 1.0, "")
    return FoundPattern(tuple(float(value) for value in x), covariance, len(pairs))


# -- pairs of images --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Surface:
    """Inverse depth of an image (h, w), averaged, 1/m; its slopes a pixel; where it is that of a smooth surface; poses
    T_world_depth (lines, 4, 4) of its lines."""

    rho: npt.NDArray[Any]
    slope_x: npt.NDArray[Any]
    slope_y: npt.NDArray[Any]
    smooth: BoolArray
    T_world_depth: FloatArray


@dataclass(frozen=True)
class _Pair:
    """Residuals r (n,), 1/m, and their derivatives by the pattern (n, 27) and by a twist (n, 6) of frame b, in the
    world's axes, about where its middle line was taken."""

    r: FloatArray
    by_pattern: FloatArray
    by_twist: FloatArray


def _pairs(dataset: Dataset, track: GeometricTrack, progress: Progress) -> list[_Pair]:
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    lines = np.arange(shutter.line_count(camera))
    rays = camera.unproject(camera.pixel_grid())
    surfaces: list[_Surface | None] = []
    pairs = []

    def surface(k: int) -> _Surface | None:
        times = shutter.line_mid_time(dataset.stamps[k], lines, camera)
        covered = track.begin <= times.min() and times.max() <= track.end
        return _surface(dataset.depth(k), track.spline.pose(times)) if covered else None

    frames = track.frames[::_EVERY]
    for n, new in enumerate(prefetched(surface, frames)):
        progress(_STAGE, n / len(frames), "comparing images")
        surfaces.append(new)
        if new is None:
            continue
        for before in (surfaces[-1 - apart] for apart in _APART if apart < len(surfaces)):
            pair = None if before is None else _pair(dataset, rays, before, new)
            if pair is not None:
                pairs.append(pair)
    return pairs


def _surface(z: npt.NDArray[np.float32], T_world_depth: FloatArray) -> _Surface:
    """A plane of inverse depth through the pixels about each, by least squares."""
    half = max(1, z.shape[1] // (2 * _SURFACES))
    across = 2 * half + 1
    rho = np.divide(np.float32(1.0), z, out=np.zeros_like(z), where=z > 0.0)
    size = (across, across)
    mean, square = (cv2.boxFilter(image, cv2.CV_32F, size) for image in (rho, rho * rho))
    measured = cv2.boxFilter((z > 0.0).astype(np.float32), cv2.CV_32F, size)
    along = np.arange(-half, half + 1, dtype=np.float32)
    moment = float((along**2).mean())
    even = np.full(across, 1.0 / across, np.float32)
    slope = along / (across * moment)
    slope_x, slope_y = cv2.sepFilter2D(rho, cv2.CV_32F, slope, even), cv2.sepFilter2D(rho, cv2.CV_32F, even, slope)
    rest = square - mean**2 - moment * (slope_x**2 + slope_y**2)
    known = np.zeros(z.shape, bool)
    known[half:-half, half:-half] = True
    known &= (measured > _MEASURED) & (mean > _FARTHEST)
    smooth = known & (rest <= _FLAT**2 * np.median(rest[known])) if known.any() else known
    return _Surface(mean, slope_x, slope_y, smooth, T_world_depth)


def _pair(dataset: Dataset, rays: FloatArray, a: _Surface, b: _Surface) -> _Pair | None:
    """Frame b's pixels in frame a; None where they share too few."""
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    step = max(camera.width // _ACROSS, 1)
    v, u = (grid.ravel() for grid in np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step])
    keep = b.smooth[v, u] & np.isfinite(rays[v, u]).all(axis=1)
    v, u = v[keep], u[keep]
    pixels = np.stack([u, v], axis=-1)
    ray, rho = rays[v, u], b.rho[v, u].astype(np.float64)
    T_world_b = b.T_world_depth[shutter.line_of_pixel(pixels, camera).astype(np.int64)]
    p_world = se3.transform(T_world_b, ray / rho[:, None])
    T_a_world = se3.inverse(a.T_world_depth)
    uv, p, line = projected(camera, shutter, T_a_world, p_world)
    keep = camera.contains(uv) & (p[:, 2] > 0.0)
    at_u, at_v = np.rint(np.where(keep[:, None], uv, 0.0)).astype(np.int64).T
    keep &= a.smooth[at_v, at_u]
    du, dv = uv[:, 0] - at_u, uv[:, 1] - at_v
    slope_x, slope_y = a.slope_x[at_v, at_u].astype(np.float64), a.slope_y[at_v, at_u].astype(np.float64)
    r = 1.0 / np.where(keep, p[:, 2], 1.0) - (a.rho[at_v, at_u] + slope_x * du + slope_y * dv)
    keep &= np.abs(r) < _SAME
    if keep.sum() < _FEWEST_PIXELS:
        return None
    r, p, uv, slope_x, slope_y = r[keep], p[keep], uv[keep], slope_x[keep], slope_y[keep]
    # By a shift of the point in a's camera: inverse depth's change, less that of the pixel along the slope.
    by_pixel = np.stack([slope_x, slope_y], axis=-1)
    by_point = -np.einsum("ni,nij->nj", by_pixel, camera.project_jacobian(p))
    by_point[:, 2] -= 1.0 / p[:, 2] ** 2
    R_a_world = T_a_world[line[keep], :3, :3]
    by_world = np.einsum("ni,nij->nj", by_point, R_a_world)
    along = np.einsum("nij,nj->ni", T_world_b[keep, :3, :3], ray[keep]) / rho[keep, None] ** 2
    by_rho = -(by_world * along).sum(axis=1)
    size = camera.width, camera.height
    by_pattern = by_rho[:, None] * pattern_basis(pixels[keep], *size) - pattern_basis(uv, *size)
    lever = p_world[keep] - b.T_world_depth[len(b.T_world_depth) // 2, :3, 3]
    return _Pair(r, by_pattern, np.hstack([by_world, np.cross(lever, by_world)]))


# -- least squares ----------------------------------------------------------------------------------------------------


def _solved(pairs: Sequence[_Pair]) -> tuple[FloatArray, FloatArray]:
    """The pattern (27,) and its covariance."""
    prior = np.eye(PATTERN_SIZE) / _SIGMA**2
    x, twists = np.zeros(PATTERN_SIZE), np.zeros((len(pairs), 6))
    A = prior
    for _ in range(_ROUNDS):
        parts = [_reduced(pair, x, twist) for pair, twist in zip(pairs, twists, strict=True)]
        H, g = np.array([part[0] for part in parts]), np.array([part[1] for part in parts])
        overcounts = _overcounted(H, g)
        A = H.sum(axis=0) / overcounts + prior
        step = -np.linalg.solve(A, g.sum(axis=0) / overcounts + prior @ x)
        x = x + step
        twists = twists + np.array([own + follow @ step for _, _, own, follow in parts])
    return np.asarray(x, np.float64), np.asarray(np.linalg.inv(A), np.float64)


def _reduced(pair: _Pair, x: FloatArray, twist: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Normal equations H (27, 27), g (27,) of the pattern without the twist, the twist's own step (6,), and how it
    follows (6, 27) a step of the pattern."""
    e = pair.r + pair.by_pattern @ x + pair.by_twist @ twist
    sigma = 1.4826 * np.median(np.abs(e)) + 1e-9
    weight = (NU + 1.0) / (NU + (e / sigma) ** 2) / sigma**2
    J, T = pair.by_pattern, pair.by_twist
    WJ, WT = weight[:, None] * J, weight[:, None] * T
    cross = WJ.T @ T
    of_twist = WT.T @ T + np.eye(6) / _TRACK_SIGMA**2
    gradient = WT.T @ e + twist / _TRACK_SIGMA**2
    solved = np.linalg.solve(of_twist, np.column_stack([cross.T, gradient]))
    own, follow = -solved[:, -1], -solved[:, :-1]
    return WJ.T @ J + cross @ follow, WJ.T @ e + cross @ own, own, follow


def _overcounted(H: FloatArray, g: FloatArray) -> float:
    """How many times too large H (pairs, 27, 27) is by the scatter of gradients g (pairs, 27) between groups of pairs
    about their common solution: tr(H⁻¹ M) / 27, M the gradients' covariance (White, Econometrica 1980)."""
    groups = np.array_split(np.arange(len(H)), _GROUPS)
    H_of, g_of = (np.array([values[group].sum(axis=0) for group in groups]) for values in (H, g))
    total = H_of.sum(axis=0) + 1e-9 * np.trace(H_of.sum(axis=0)) * np.eye(PATTERN_SIZE)
    rest = g_of - H_of @ np.linalg.solve(total, g_of.sum(axis=0))
    M = rest.T @ rest * _GROUPS / (_GROUPS - 1.0)
    return max(1.0, float(np.trace(np.linalg.solve(total, M))) / PATTERN_SIZE)
