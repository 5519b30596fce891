"""How much darker colour images are towards their corners (vignetting): from the recording itself.

found = estimate_vignetting(dataset, GeometricTracks(dataset, range(len(dataset)), Options(), no_progress))
dataset = dataset.with_color_falloff(found.strength, found.text())

It stays where it is while the scene passes by, which biases every alignment of colours towards no motion. A point that
moves from the middle of an image to its edge gets darker than others that do not, whatever gain and offset the
image has. That determines f in I = I_even / (1 + f ρ²), with ρ the distance from the image's centre over that of its
corners. This model is right to one per cent of the intensity (cos⁴ and a camera's response).

What shines changes its brightness with the viewing direction, as if by a lens: along the true path parts of a recording
differ by far more than their pairs do. So the estimate has a normal prior, and that in its standard error.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rstrack.data.dataset import Dataset
from rstrack.data.image_files import prefetched
from rstrack.images.pyramid import corner_distance2
from rstrack.tracking.first_look.rough_track import GeometricTrack
from rstrack.tracking.first_look.views import Views, looked_up, pairs_in, pixels_of, rests

# The fewest points that a pair of images may share, and pairs.
_FEWEST_POINTS, _FEWEST_PAIRS = 400, 6
# Mean and σ of the vignetting of a lens that nothing is known of: TUM's cameras have 0.09 and 0.45.
_PRIOR, _PRIOR_SIGMA = 0.15, 0.15
# σ of what all pairs of a part have wrong alike: of one camera parts gave 0.09, 0.09 and 0.02, of another, whose
# truth is 0.15, -0.24 to 0.16.
_SYSTEMATIC = 0.05
_ROUNDS, _REWEIGHTED = 5, 4


@dataclass(frozen=True)
class Vignetting:
    """strength: f, not below 0. sigma: its standard error. pairs: of images compared, 0 where only the prior tells."""

    strength: float
    sigma: float
    pairs: int

    def text(self) -> str:
        """One line for the screen."""
        percent, error = (
            100.0 * x / (1.0 + self.strength) for x in (self.strength, self.sigma / (1.0 + self.strength))
        )
        source = f"by {self.pairs} pairs of images" if self.pairs else "as lenses do"
        return (
            f"colours of the corners are {percent:.1f} % darker (± {error:.1f}, {source}): evened out; "
            f"color.falloff: {self.strength:.3f} in the camera file fixes it"
        )


@dataclass(frozen=True)
class _Pair:
    """The same points in two images: intensities (n,) and ρ² (n,) of either."""

    intensity: tuple[FloatArray, FloatArray]
    distance2: tuple[FloatArray, FloatArray]


def estimate_vignetting(
    dataset: Dataset, tracks: Iterable[GeometricTrack | None], progress: Progress = no_progress
) -> Vignetting:
    """The vignetting of a dataset's colour images, from the part that moves most of those where enough pairs overlap.

    Raises UserError: an image that cannot be read.
    """
    for track in tracks:
        pairs = [] if track is None else _compared(dataset, track, progress)
        if len(pairs) >= _FEWEST_PAIRS:
            measured, sigma = _solved(pairs)
            information, prior = sigma**-2, _PRIOR_SIGMA**-2
            mean = (information * measured + prior * _PRIOR) / (information + prior)
            return Vignetting(max(mean, 0.0), (information + prior) ** -0.5, len(pairs))
    return Vignetting(_PRIOR, _PRIOR_SIGMA, 0)


def _compared(dataset: Dataset, track: GeometricTrack, progress: Progress) -> list[_Pair]:
    camera, spline = dataset.rig.color_camera, track.spline
    distance2 = corner_distance2(camera.width, camera.height)[::2, ::2]
    views, found = Views(dataset, spline), []
    chosen = pairs_in(dataset, track.frames, track.begin, track.end)

    def decoded(pair: tuple[int, int, int]) -> tuple[int, int, int]:
        k, i, j = pair
        views.points(k), views.image(i), views.image(j)
        return pair

    for n, (k, i, j) in enumerate(prefetched(decoded, chosen), 1):
        seen, at = [], []
        for m in (i, j):
            pixels = pixels_of(dataset, spline, views.points(k), dataset.color_stamps[m : m + 1])
            seen.append(looked_up(views.image(m), pixels)[0])
            at.append(looked_up(distance2, pixels)[0])
        later = int(np.abs(dataset.stamps - dataset.color_stamps[j]).argmin())
        still = rests(dataset, spline, views.points(k), later, views.depth(later))
        good = np.isfinite([*seen, *at]).all(axis=0) & still
        if np.count_nonzero(good) >= _FEWEST_POINTS:
            found.append(_Pair((seen[0][good], seen[1][good]), (at[0][good], at[1][good])))
        progress("colour's corners", n / len(chosen), "comparing colour images")
    return found


def _solved(pairs: Sequence[_Pair]) -> tuple[float, float]:
    """Gauss-Newton for the one number, with gain and offset of every pair eliminated: it and its standard error, from
    leaving tenths of the pairs out and what all have wrong alike."""
    f = 0.0
    for _ in range(_ROUNDS):
        sums = np.array([_linearised(pair, f) for pair in pairs])
        f -= float(sums[:, 1].sum() / max(float(sums[:, 0].sum()), 1e-12))
        f = float(np.clip(f, -0.5, 2.0))
    parts = np.array_split(np.arange(len(pairs)), min(10, len(pairs)))
    without = [np.delete(sums, part, axis=0).sum(axis=0) for part in parts]
    steps = np.array([g / max(H, 1e-12) for H, g in without])
    n = len(parts)
    scatter = float(np.sqrt((n - 1) / n * ((steps - steps.mean()) ** 2).sum()))
    return f, float(np.hypot(scatter, _SYSTEMATIC))


def _linearised(pair: _Pair, f: float) -> tuple[float, float]:
    """H and g of the vignetting, from one pair's residuals b' − gain a' − offset with Student-t weights (ν = 5)."""
    (a, b), (near, far) = pair.intensity, pair.distance2
    x, y = a * (1.0 + f * near), b * (1.0 + f * far)
    basis, w = np.column_stack([x, np.ones(len(x))]), np.ones(len(x))
    for _ in range(_REWEIGHTED):
        weighted = basis * w[:, None]
        gain, offset = np.linalg.solve(weighted.T @ basis + 1e-9 * np.eye(2), weighted.T @ y)
        r = y - gain * x - offset
        sigma = max(1.4826 * float(np.median(np.abs(r))), 1e-3)
        w = 6.0 / (5.0 + (r / sigma) ** 2)
    weighted = basis * w[:, None]
    slope = b * far - gain * a * near
    slope = slope - basis @ np.linalg.solve(weighted.T @ basis + 1e-9 * np.eye(2), weighted.T @ slope)
    return float((w * slope**2).sum()) / sigma**2, float((w * slope * r).sum()) / sigma**2
