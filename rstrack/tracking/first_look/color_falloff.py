"""How much darker colour images are towards their corners (vignetting): from the recording itself.

found = estimate_color_falloff(dataset)
dataset = dataset.with_color_falloff(found.falloff, found.text())

It stays where it is while the scene passes by, which draws every alignment of colours towards no motion at all. A point
that moves from the middle of an image to its edge gets darker than others that do not, whatever gain and offset the
image has: so the falloff f in I = I_even / (1 + f ρ²) is told, with ρ the distance from the image's centre over that of
its corners. Near enough to what lenses do (cos⁴ and a camera's response) to one per cent of the intensity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rstrack.data.dataset import Dataset
from rstrack.images.pyramid import corner_distance2
from rstrack.options import Options
from rstrack.tracking.first_look.color_pairs import (
    Colors,
    geometric_track,
    image_of,
    looked_up,
    moving_parts,
    pairs_in,
    points_of,
    rests,
)

# For the progress bar.
_STAGE = "colour's corners"
# Fewer frames are not looked at; parts of a recording that are, at most; and the standard error that is enough.
_FEWEST_FRAMES, _PARTS, _ENOUGH = 30, 2, 7e-3
# What all pairs have wrong alike: renderings of cameras without any were told 0.002 to 0.005.
_SYSTEMATIC = 4e-3
# The fewest points that a pair of images may share, and pairs.
_FEWEST_POINTS, _FEWEST_PAIRS = 400, 6
# A falloff is believed beyond so many standard errors, beyond what interpolation makes of a camera without, and up to
# what no camera has.
_SIGMAS, _LEAST, _MOST = 4.0, 0.02, 2.0
_ROUNDS, _REWEIGHTED = 5, 4
# Tracks along which pairs are compared, until one is enough, with what falloff until then: before a wall depth alone
# slides, and with it colours that are taken for even.
_TRACKS: tuple[tuple[Colors, float], ...] = (("moving", 0.0), ("always", 0.0), ("always", 0.15), ("always", 0.3))


@dataclass(frozen=True)
class ColorFalloff:
    """falloff: f, 0 if there is none to speak of. sigma: its standard error, from leaving tenths of the pairs out and
    what they have wrong alike. pairs: of images compared.
    """

    falloff: float
    sigma: float
    pairs: int

    def text(self) -> str:
        """One line for the screen; empty where colours are taken as they are."""
        if not self.falloff:
            return ""
        percent = 100.0 * (1.0 - 1.0 / (1.0 + self.falloff))
        return (
            f"colours of the corners are {abs(percent):.1f} % {'darker' if percent > 0.0 else 'brighter'} "
            f"(± {100.0 * self.sigma:.1f}, by {self.pairs} pairs of images): evened out; "
            f"color.falloff: {self.falloff:.3f} in the camera file fixes it"
        )


@dataclass(frozen=True)
class _Pair:
    """The same points in two images: intensities (n,) and ρ² (n,) of either."""

    intensity: tuple[FloatArray, FloatArray]
    distance2: tuple[FloatArray, FloatArray]


def estimate_color_falloff(
    dataset: Dataset, frames: range | None = None, options: Options | None = None, progress: Progress = no_progress
) -> ColorFalloff:
    """The falloff of a dataset's colour images. frames: those to look at, default all.

    Raises UserError: an image that cannot be read.
    """
    frames = range(len(dataset)) if frames is None else frames
    pairs: list[_Pair] = []
    found = ColorFalloff(0.0, np.inf, 0)
    if len(frames) < _FEWEST_FRAMES:
        return found
    for part in moving_parts(dataset, frames)[:_PARTS]:
        before, tried = pairs, found
        for colors, guess in _TRACKS:
            own = _compared(dataset.with_color_falloff(guess), part, options or Options(), progress, colors)
            if len(before) + len(own) >= _FEWEST_PAIRS:
                tried = _solved(before + own)
            if tried.sigma < found.sigma:
                pairs, found = before + own, tried
            if found.sigma < _ENOUGH:
                break
        if found.sigma < _ENOUGH:
            break
    is_believed = max(_LEAST, _SIGMAS * found.sigma) < abs(found.falloff) < _MOST
    return found if is_believed else ColorFalloff(0.0, found.sigma, found.pairs)


def _compared(dataset: Dataset, part: range, options: Options, progress: Progress, colors: Colors) -> list[_Pair]:
    spline, begin, end = geometric_track(dataset, part, options, progress, _STAGE, colors)
    if spline is None:
        return []
    camera = dataset.rig.color_camera
    distance2 = corner_distance2(camera.width, camera.height)[::2, ::2]
    points = lru_cache(maxsize=2)(lambda k: points_of(dataset, spline, k))
    images = lru_cache(maxsize=16)(lambda i: image_of(dataset.images.color(i)))
    found = []
    chosen = pairs_in(dataset, part, begin, end)
    for n, (k, i, j) in enumerate(chosen):
        seen, at = [], []
        for m in (i, j):
            stamp = dataset.color_stamps[m : m + 1]
            seen.append(looked_up(dataset, spline, images(m), points(k), stamp)[0])
            at.append(looked_up(dataset, spline, distance2, points(k), stamp)[0])
        later = int(np.abs(dataset.stamps - dataset.color_stamps[j]).argmin())
        good = np.isfinite([*seen, *at]).all(axis=0) & rests(dataset, spline, points(k), later)
        if np.count_nonzero(good) >= _FEWEST_POINTS:
            found.append(_Pair((seen[0][good], seen[1][good]), (at[0][good], at[1][good])))
        progress(_STAGE, 0.7 + 0.3 * (n + 1) / len(chosen), "comparing colour images")
    return found


def _solved(pairs: Sequence[_Pair]) -> ColorFalloff:
    """Gauss-Newton for the one falloff, with gain and offset of every pair eliminated."""
    f = 0.0
    for _ in range(_ROUNDS):
        sums = np.array([_linearised(pair, f) for pair in pairs])
        f -= float(sums[:, 1].sum() / max(float(sums[:, 0].sum()), 1e-12))
        f = float(np.clip(f, -0.5, _MOST))
    parts = np.array_split(np.arange(len(pairs)), min(10, len(pairs)))
    without = [np.delete(sums, part, axis=0).sum(axis=0) for part in parts]
    steps = np.array([g / max(H, 1e-12) for H, g in without])
    n = len(parts)
    scatter = float(np.sqrt((n - 1) / n * ((steps - steps.mean()) ** 2).sum()))
    return ColorFalloff(f, float(np.hypot(scatter, _SYSTEMATIC)), len(pairs))


def _linearised(pair: _Pair, f: float) -> tuple[float, float]:
    """H and g of the falloff, from one pair's residuals b' − gain a' − offset with Student-t weights (ν = 5)."""
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
