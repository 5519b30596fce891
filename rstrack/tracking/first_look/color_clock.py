"""How much later than its stamps say colour was taken, against depth: from the recording itself.

found = estimate_color_offset(dataset, GeometricTracks(dataset, range(len(dataset)), Options(), no_progress))
dataset = dataset.with_color_offset(found.offset_s)

A few seconds with motion are tracked by geometry alone, which leaves colour out. Points of depth images are then looked
up in pairs of colour images a few frames apart, with the poses that the track has at the colour lines' times plus an
offset; at the right offset both images show the same intensity there, up to a gain and an offset of brightness each
pair has. What tells is that the camera turns differently at the two times: steady motion tells nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rstrack.data.dataset import Dataset
from rstrack.data.image_files import prefetched
from rstrack.data.rig import UNFOUND_OFFSET_S
from rstrack.tracking.first_look.rough_track import GeometricTrack
from rstrack.tracking.first_look.views import Views, looked_up, pairs_in, pixels_of

# For the progress bar.
_STAGE = "colour's clock"
# Offsets looked at (s): coarse ones, then fine ones about the best.
_MOST_S, _COARSE_S, _FINE_S = 0.06, 0.01, 0.0025
# Fine offsets on each side of the best one through which a parabola is laid.
_NEAR = 2
# The fewest points that a pair may share.
_FEWEST = 400
# The offset is taken for determined if its standard error is below this, and it lies inside of what was looked at.
_MOST_SIGMA_S = 5e-3
# σ of what the pairs of a part have wrong alike: three parts of a recording gave 2.9 ± 0.5, 6.1 ± 0.6, 4.3 ± 1.4 ms.
_SYSTEMATIC_S = 1.5e-3
# Noise of colour images against each other, over their contrast, above which the track is not to be believed.
_MOST_NOISE = 0.25


@dataclass(frozen=True)
class ColorOffset:
    """offset_s: to be added to colour's stamps, 0 if not determined. sigma_s: its standard error, as far as the pairs
    of images differ (what the track has wrong in all of them is not in it). pairs: of images compared. reason: why it
    is not determined, empty if it is.
    """

    offset_s: float
    sigma_s: float
    pairs: int
    reason: str = ""

    @property
    def sigma_in_all_s(self) -> float:
        """Its standard error with what the pairs of a part have wrong alike; where it is not determined, that of a
        clock of which nothing is known."""
        return UNFOUND_OFFSET_S if self.reason else math.hypot(self.sigma_s, _SYSTEMATIC_S)

    def text(self) -> str:
        """One line for the screen."""
        if self.reason:
            return f"no offset of colour against depth found ({self.reason}): used as stamped"
        return (
            f"that offset was found from {self.pairs} pairs of images, to {1e3 * self.sigma_s:.1f} ms; "
            "color.offset_s in the camera file fixes it"
        )


def estimate_color_offset(
    dataset: Dataset, tracks: Iterable[GeometricTrack | None], progress: Progress = no_progress
) -> ColorOffset:
    """Seconds to add to a dataset's colour stamps: by one part after the other, until the pairs of one differ by less
    than parts do, and by the one whose pairs differ least. Raises UserError: an image that cannot be read.
    """
    tried = []
    for track in tracks:
        tried.append(_estimate(dataset, track, progress))
        if not tried[-1].reason and tried[-1].sigma_s < _SYSTEMATIC_S:
            break
    return min(tried, key=lambda found: (bool(found.reason), found.sigma_s))


def _estimate(dataset: Dataset, track: GeometricTrack | None, progress: Progress) -> ColorOffset:
    if track is None:
        return ColorOffset(0.0, np.inf, 0, "the geometry alone gives no track")
    pairs = pairs_in(dataset, track.frames, track.begin + _MOST_S, track.end - _MOST_S)
    if len(pairs) < 6:
        return ColorOffset(0.0, np.inf, len(pairs), "too few images overlap")
    coarse = np.arange(-_MOST_S, _MOST_S + 1e-9, _COARSE_S)
    views = Views(dataset, track.spline)
    costs, noise = _costs(dataset, track, views, pairs, coarse, progress)
    if len(costs) < 6:
        return ColorOffset(0.0, np.inf, len(costs), "too few images overlap")
    if np.median(noise) > _MOST_NOISE:
        return ColorOffset(0.0, np.inf, len(costs), "colour does not fit the track that depth alone gives")
    best = int(np.argmin(costs.sum(axis=0)))
    if best in (0, len(coarse) - 1):
        return ColorOffset(0.0, np.inf, len(costs), f"it would be beyond {1e3 * _MOST_S:.0f} ms")
    fine = coarse[best] + np.arange(-5, 6) * _FINE_S
    return _minimum(fine, _costs(dataset, track, views, pairs, fine, progress)[0])


def _minimum(offsets: FloatArray, costs: FloatArray) -> ColorOffset:
    """Minimum over offsets (m,) of the summed costs (pairs, m), its error from leaving tenths of the pairs out."""
    if not len(costs):
        return ColorOffset(0.0, np.inf, 0, "too few images overlap")
    best = int(np.argmin(costs.sum(axis=0)))
    near = slice(max(best - _NEAR, 0), best + _NEAR + 1)
    offsets, costs = offsets[near], costs[:, near]
    offset, bend = _parabola(offsets, costs.sum(axis=0))
    parts = np.array_split(np.arange(len(costs)), min(10, len(costs)))
    without = [_parabola(offsets, np.delete(costs, part, axis=0).sum(axis=0)) for part in parts]
    n = len(parts)
    sigma = float(np.sqrt((n - 1) / n * np.sum((np.array([o for o, _ in without]) - offset) ** 2)))
    if bend <= 0.0 or any(b <= 0.0 for _, b in without):
        return ColorOffset(0.0, np.inf, len(costs), "the camera moves too evenly")
    if not sigma < _MOST_SIGMA_S or not offsets[0] < offset < offsets[-1]:
        return ColorOffset(0.0, sigma, len(costs), "the camera moves too little or too evenly")
    return ColorOffset(offset, sigma, len(costs))


def _parabola(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Where a parabola through y (m,) at x (m,) is least, and its bend; NaN and 0 or less where it has no minimum."""
    middle = x.mean()
    a, b, _ = np.polyfit(x - middle, y, 2)
    return (float(middle - 0.5 * b / a) if a > 0.0 else float("nan")), float(a)


# --- how well images agree -------------------------------------------------------------------------------------------


def _costs(
    dataset: Dataset, track: GeometricTrack, views: Views, pairs: Sequence[tuple[int, int, int]], offsets: FloatArray,
    progress: Progress,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Costs (k, m) of the offsets (m,) of the k pairs that share enough, and their noise (k,) over the contrast."""

    @lru_cache(maxsize=3)
    def at_offsets(k: int, i: int) -> FloatArray:
        pixels = pixels_of(dataset, track.spline, views.points(k), dataset.color_stamps[i] + offsets)
        return looked_up(views.image(i), pixels)

    def seen(pair: tuple[int, int, int]) -> tuple[FloatArray, FloatArray]:
        """Intensities (m, n) of the same points in both images."""
        k, i, j = pair
        return at_offsets(k, i), at_offsets(k, j)

    found = [(np.empty((0, len(offsets))), np.empty(0))]
    for n, (one, other) in enumerate(prefetched(seen, pairs), 1):
        good = np.isfinite(one).all(axis=0) & np.isfinite(other).all(axis=0)
        if np.count_nonzero(good) >= _FEWEST:
            cost, noise = _disagreement(one[:, good], other[:, good])
            found.append((cost[None], np.array([noise])))
        progress(_STAGE, n / len(pairs), "comparing colour images")
    return np.concatenate([costs for costs, _ in found]), np.concatenate([noise for _, noise in found])


def _disagreement(a: FloatArray, b: FloatArray) -> tuple[FloatArray, float]:
    """Student-t cost (m,) of intensities b (m, n) against gain · a + offset, fitted to each of the m; and its σ over
    that of b.

    One σ for all, from where they agree best: the costs are log-likelihoods up to a constant, for n independent points.
    """
    errors = np.array([_residuals(x, y) for x, y in zip(a, b, strict=True)])
    sigma = max(float(np.min(1.4826 * np.median(np.abs(errors), axis=1))), 1e-3)
    contrast = max(1.4826 * float(np.median(np.abs(b - np.median(b)))), 1e-3)
    return np.asarray(3.0 * np.log1p((errors / sigma) ** 2 / 5.0).sum(axis=1)), sigma / contrast


def _residuals(x: FloatArray, y: FloatArray) -> FloatArray:
    """y − gain · x − offset (n,), fitted with Student-t weights (ν = 5); closed form in every round."""
    w = np.ones(len(x))
    for _ in range(4):
        mean_x, mean_y = np.average(x, weights=w), np.average(y, weights=w)
        spread = np.average((x - mean_x) ** 2, weights=w)
        gain = np.average((x - mean_x) * (y - mean_y), weights=w) / max(float(spread), 1e-12)
        r = y - mean_y - gain * (x - mean_x)
        sigma = max(1.4826 * float(np.median(np.abs(r))), 1e-3)
        w = 6.0 / (5.0 + (r / sigma) ** 2)
    return r
