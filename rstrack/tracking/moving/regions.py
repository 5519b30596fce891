"""From pixels that stand in free space to the things that they belong to: NumPy and OpenCV on small grids."""

from __future__ import annotations

import cv2
import numpy as np

from rstrack.alignment.free_space import Free, Grid, Seen
from rstrack.images.device_frame import Mask
from rstrack.images.sampling import EDGE

# How far before what was seen (m, part of the depth, σ of depth there) a pixel has to stand to be in free space.
_BEFORE_M, _BEFORE_SIGMAS = 0.02, 5.0
# Part of the grid that has to be in free space, once thin lines are taken off, for anything to move.
_LEAST = 2e-3
# Window over which residuals are averaged, and averages that a resting surface hardly has: of depth in σ, and of the
# size of intensity's, in σ.
_WINDOW, _WORST_DEPTH, _WORST_INTENSITY = 5, 1.0, 1.8
# Steps beyond what was seen that a thing is followed, and the part of what can be told of it that has to stand in free
# space.
_BEYOND_STEPS, _LEAST_SHARE = 6, 0.1
# Pixels of the grid that edges are given besides.
_MARGIN = 1


def moving(seen: Seen, sigma_depth: float, median_depth: float, sigma_intensity: float) -> Mask:
    """Pixels (gh, gw) of things that have moved: in free space, or on one surface with such that are.

    sigma_depth (m): scale of depth's residuals at median_depth (m), growing with the square of depth; sigma_intensity:
    that of intensity's. Nothing where too little stands in free space to tell.
    """
    scale, least = _scales(seen.z, sigma_depth, median_depth)
    far = np.nan_to_num(seen.free) > least
    seeds = _opened(far)
    if not _is_enough(seeds):
        return np.zeros_like(seeds)
    # Behind what is seen there nothing is known.
    hidden = np.nan_to_num(seen.apart) < -least
    depth = (np.where(hidden, np.nan, seen.apart) / scale).astype(np.float32)
    odd = far | _at_odds(depth, seen.intensity, sigma_intensity)
    grown = _grown(seeds, odd, hidden | ~np.isfinite(seen.apart), hidden | seen.outside, seen.z)
    return _widened(grown)


def anything(near: Free, sigma_depth: float, median_depth: float) -> bool:
    """Whether enough stands in free space for `moving` to find something."""
    _, least = _scales(near.z, sigma_depth, median_depth)
    return _is_enough(_opened(np.nan_to_num(near.free) > least))


def _is_enough(seeds: Mask) -> bool:
    return bool(np.count_nonzero(seeds) >= _LEAST * seeds.size)


def untold(seen: Seen, sigma_depth: float, median_depth: float) -> Mask:
    """Pixels (gh, gw) of which the other image says nothing: they fall into its holes, beyond it, or behind what it
    shows."""
    _, least = _scales(seen.z, sigma_depth, median_depth)
    return np.asarray(np.isfinite(seen.z) & ~(seen.apart >= -least))


def moving_with(seen: Seen, left_out: Mask, sigma_depth: float, median_depth: float) -> Mask:
    """Pixels (gh, gw) of things that the other image shows about there and does without.

    left_out (gh, gw): pixels that fall where something has been left out of it.
    """
    _, least = _scales(seen.z, sigma_depth, median_depth)
    apart = np.nan_to_num(seen.apart)
    seeds = _opened(left_out & np.isfinite(seen.apart) & (np.abs(apart) < least))
    nowhere = np.zeros_like(seeds)
    grown = _grown(seeds, (left_out & (apart > -least)) | (np.nan_to_num(seen.free) > least), nowhere, nowhere, seen.z)
    return _widened(grown) if seeds.any() else nowhere


def _scales(z: Grid, sigma_depth: float, median_depth: float) -> tuple[Grid, Grid]:
    """σ (m) at depths z, and how far before what was seen something has to stand to be in free space."""
    z = np.nan_to_num(z)
    scale = np.maximum(sigma_depth * np.square(z / np.float32(median_depth)), 1e-6)
    return scale.astype(np.float32), np.maximum(_BEFORE_M + EDGE * z, _BEFORE_SIGMAS * scale)


def _opened(mask: Mask) -> Mask:
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0)


def _widened(grown: Mask) -> Mask:
    closed = cv2.morphologyEx(grown.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    return np.asarray(cv2.dilate(closed, np.ones((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.uint8)) > 0)


def _at_odds(depth: Grid, intensity: Grid, sigma_intensity: float) -> Mask:
    """Where depth (in σ) or intensity differs, on average over a window, by more than it does on what rests."""
    color = _mean((np.abs(intensity) / sigma_intensity).astype(np.float32))  # infinite where there is none: never odd
    return np.asarray((np.abs(_mean(depth)) > _WORST_DEPTH) | (color > _WORST_INTENSITY))


def _mean(values: Grid) -> Grid:
    """Over a window, of what is known in it; 0 where nothing is."""
    known = np.isfinite(values)
    size = (_WINDOW, _WINDOW)
    # Outliers have their say, but one alone is no thing.
    total = cv2.blur(np.where(known, np.clip(values, -4.0, 4.0), 0.0).astype(np.float32), size)
    share = cv2.blur(known.astype(np.float32), size)
    return np.asarray(total / np.maximum(share, 1e-3), np.float32)


def _grown(seeds: Mask, odd: Mask, unknown: Mask, beyond: Mask, z: Grid) -> Mask:
    """Seeds with what is connected to them on one surface and is odd, or cannot be told.

    That is so in holes, where something may have been left out, and beyond what was seen: there they are followed for a
    few steps only.
    """
    near = cv2.dilate(seeds.astype(np.uint8), np.ones((2 * _BEYOND_STEPS + 1,) * 2, np.uint8)) > 0
    # Seeds end at edges as well: from a thing's own rim the surface behind it would be reached.
    open_ = (seeds | np.where(unknown, near | ~beyond, odd)) & ~_edges(z)
    count, labels = cv2.connectedComponents(open_.astype(np.uint8), connectivity=4)
    told = np.bincount(labels[seeds | ~unknown], minlength=count)
    own = np.bincount(labels[seeds], minlength=count)
    kept = own >= np.maximum(1.0, _LEAST_SHARE * told)
    kept[0] = False
    return np.asarray(kept[labels] | seeds)


def _edges(z: Grid) -> Mask:
    """Pixels without depth, or whose neighbour right or below lies on another surface."""
    out = ~np.isfinite(z)
    z = np.nan_to_num(z)
    for axis in (0, 1):
        a, b = (z[1:], z[:-1]) if axis == 0 else (z[:, 1:], z[:, :-1])
        jump = np.abs(a - b) > EDGE * np.minimum(a, b)
        if axis == 0:
            out[:-1] |= jump
        else:
            out[:, :-1] |= jump
    return out
