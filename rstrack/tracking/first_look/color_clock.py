"""How much later than its stamps say colour was taken, against depth: from the recording itself.

found = estimate_color_offset(dataset, DepthTracks(dataset, range(len(dataset)), no_progress))
dataset = dataset.with_color_offset(found.offset_s)

A few seconds with motion are tracked by geometry alone, which leaves colour out. Points of depth images are then looked
up in pairs of colour images a few frames apart, with the poses that the track has at the colour lines' times plus an
offset; at the right offset both images show the same intensity there, up to a gain and an offset of brightness each
pair has. What tells is that the camera turns differently at the two times: steady motion tells nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rstrack.data.dataset import Dataset
from rstrack.data.rig import UNFOUND_OFFSET_S
from rstrack.tracking.first_look.depth_track import DepthTrack
from rstrack.tracking.first_look.lookup import (
    MOST_NOISE,
    disagreement,
    image_of,
    pairs_in,
    pixels_of,
    points_of,
    values_at,
)

# For the progress bar.
_STAGE, _NOTE = "colour's clock", "comparing colour images"
# Offsets looked at (s): coarse ones, then fine ones about the best.
_MOST_S, _COARSE_S, _FINE_S = 0.06, 0.01, 0.0025
# Of the points every so manieth is enough for the coarse ones.
_FEW = 4
# Fine offsets on each side of the best one through which a parabola is laid.
_NEAR = 2
# The fewest points that a pair may share.
_FEWEST = 100
# The offset is taken for determined if its standard error is below this, and it lies inside of what was looked at.
_MOST_SIGMA_S = 5e-3
# σ of what the pairs of a part have wrong alike: three parts of a recording gave 2.9 ± 0.5, 6.1 ± 0.6, 4.3 ± 1.4 ms.
_SYSTEMATIC_S = 1.5e-3


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
    dataset: Dataset, tracks: Iterable[DepthTrack | None], progress: Progress = no_progress
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


def _estimate(dataset: Dataset, track: DepthTrack | None, progress: Progress) -> ColorOffset:
    if track is None:
        return ColorOffset(0.0, np.inf, 0, "the geometry alone gives no track")
    pairs = pairs_in(dataset, track.frames, track.begin + _MOST_S, track.end - _MOST_S)
    if len(pairs) < 6:
        return ColorOffset(0.0, np.inf, len(pairs), "too few images overlap")
    coarse = np.arange(-_MOST_S, _MOST_S + 1e-9, _COARSE_S)
    costs, noise = _costs(dataset, track, pairs, coarse, _FEW, lambda done: progress(_STAGE, 0.5 * done, _NOTE))
    if len(costs) < 6:
        return ColorOffset(0.0, np.inf, len(costs), "too few images overlap")
    if np.median(noise) > MOST_NOISE:
        return ColorOffset(0.0, np.inf, len(costs), "colour does not fit the track that depth alone gives")
    best = int(np.argmin(costs.sum(axis=0)))
    if best in (0, len(coarse) - 1):
        return ColorOffset(0.0, np.inf, len(costs), f"it would be beyond {1e3 * _MOST_S:.0f} ms")
    fine = coarse[best] + np.arange(-5, 6) * _FINE_S
    finer = _costs(dataset, track, pairs, fine, 1, lambda done: progress(_STAGE, 0.5 + 0.5 * done, _NOTE))
    return _minimum(fine, finer[0])


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
    dataset: Dataset, track: DepthTrack, pairs: Sequence[tuple[int, int, int]], offsets: FloatArray, every: int,
    done: Callable[[float], None],
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Costs (k, m) of the offsets (m,) of the k pairs that share enough, and their noise (k,) over the contrast.

    every: of the points that are looked up.
    """
    points = lru_cache(maxsize=1)(lambda k: points_of(dataset, track.spline, k)[::every])

    @lru_cache(maxsize=4)
    def seen(k: int, i: int) -> FloatArray:
        return values_at(
            image_of(dataset, track, i), pixels_of(dataset, track.spline, points(k), dataset.color_stamps[i] + offsets)
        )

    found = [(np.empty((0, len(offsets))), np.empty(0))]
    for n, (k, i, j) in enumerate(pairs):
        a, b = seen(k, i), seen(k, j)
        good = np.isfinite(a).all(axis=0) & np.isfinite(b).all(axis=0)
        if np.count_nonzero(good) * every >= _FEWEST:
            cost, noise = disagreement(a[:, good], b[:, good])
            found.append((cost[None], np.array([noise])))
        done((n + 1) / len(pairs))
    return np.concatenate([costs for costs, _ in found]), np.concatenate([noise for _, noise in found])
