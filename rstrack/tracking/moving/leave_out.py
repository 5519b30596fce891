"""What moves by itself, left out of a frame and of its keyframe before the last level of an alignment.

From pixels that stand in free space to the things that they belong to: NumPy and OpenCV on small grids.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import drjit as dr
import numpy as np

from rsgen.device.arrays import Engine
from rsgen.geometry.spline import Spline
from rstrack.alignment.brightness import SAME
from rstrack.alignment.free_space import Free, FreeSpace, Grid, SeenFrom, grid_of
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.alignment.weights import START_DEPTH
from rstrack.data.moving_masks import Mask
from rstrack.images.device_frame import full_size, without_pixels
from rstrack.images.pyramid import DepthImage
from rstrack.images.sampling import EDGE
from rstrack.keyframes.keyframe import Reference, strides

# How far before what was seen (m, part of the depth, σ of depth there) a pixel has to stand to be in free space.
_BEFORE_M, _BEFORE_SIGMAS = 0.02, 5.0
# Part of the grid that has to be in free space, once thin lines are taken off, for anything to move.
_LEAST = 2e-3
# Window over which residuals are averaged, and averages that a resting surface hardly has: of depth in σ, and of the
# size of intensity's, in σ.
_WINDOW, _WORST_DEPTH, _WORST_INTENSITY = 5, 1.0, 1.8
# Steps beyond what was seen that a thing is followed, and the part of what is known of it that has to stand in free
# space.
_BEYOND_STEPS, _LEAST_SHARE = 6, 0.1
# Pixels of the grid that edges are given besides.
_MARGIN = 1
# Part of what is seen that may move: where more seems to, it is the pose that is wrong.
_MOST = 0.5


def moving(seen: SeenFrom, sigma_depth: float, median_depth: float, sigma_intensity: float) -> Mask:
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


def unseen(seen: SeenFrom, sigma_depth: float, median_depth: float) -> Mask:
    """Pixels (gh, gw) of which the other image says nothing: they fall into its holes, beyond it, or behind what it
    shows."""
    _, least = _scales(seen.z, sigma_depth, median_depth)
    return np.asarray(np.isfinite(seen.z) & ~(seen.apart >= -least))


def moving_with(seen: SeenFrom, left_out: Mask, sigma_depth: float, median_depth: float) -> Mask:
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
    """Seeds with what is connected to them on one surface and is odd, or unknown.

    That is so in holes, where something may have been left out, and beyond what was seen: there they are followed for a
    few steps only.
    """
    near = cv2.dilate(seeds.astype(np.uint8), np.ones((2 * _BEYOND_STEPS + 1,) * 2, np.uint8)) > 0
    # Seeds end at edges as well: from a thing's own rim the surface behind it would be reached.
    open_ = (seeds | np.where(unknown, near | ~beyond, odd)) & ~_edges(z)
    count, labels = cv2.connectedComponents(open_.astype(np.uint8), connectivity=4)
    visible = np.bincount(labels[seeds | ~unknown], minlength=count)
    own = np.bincount(labels[seeds], minlength=count)
    kept = own >= np.maximum(1.0, _LEAST_SHARE * visible)
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


@dataclass(frozen=True)
class LeftOut:
    """depth: of the frame, without what moves; gone: pixels (gh, gw) of the keyframe's grid that the frame sees through
    or that have moved on, None where none have."""

    depth: DepthImage
    gone: Mask | None = None

    @property
    def moves(self) -> bool:
        """Whether anything does."""
        return self.depth.whole is not None or self.gone is not None


def leave_out(
    space: FreeSpace, depths: Sequence[DepthImage], ref: Reference, fresh: Sequence[Sequence[Observation]],
    state: SplineState, before: DepthImage | None = None,
) -> list[LeftOut]:  # fmt: skip
    """Let frames' observations count without what moves, as seen from where they have been aligned to so far.

    depths: the frames' images; what has been left out of them already stays so. fresh: of each frame its observations;
    those of `ref` do without what any of the frames finds gone from it, too. before: of the frame before them.
    """
    of_ref = [[o for o in own if o.ref.index == ref.index] for own in fresh]
    left = [_found(space, depth, ref, own, state, before) for depth, own in zip(depths, of_ref, strict=True)]
    gone = [one.gone for one in left if one.gone is not None]
    cleaned = without(space.device.e, ref, np.any(gone, axis=0)) if gone else ref
    for one, own in zip(left, fresh, strict=True):
        for o in own:
            if isinstance(o.image, DepthImage):
                o.image = one.depth
            elif one.depth.whole is not None:
                o.hidden_by(one.depth.hider)
            if o.ref.index == ref.index and o.ref is not cleaned:
                o.see(cleaned)
    return left


def _found(
    space: FreeSpace, depth: DepthImage, ref: Reference, own: Sequence[Observation], state: SplineState,
    before: DepthImage | None,
) -> LeftOut:  # fmt: skip
    nothing = LeftOut(depth)
    if not own or not all(o.is_linearised for o in own):
        return nothing
    color = next((o for o in own if not o.is_depth), None)
    sigma_depth = next((o.lin.next_sigma for o in own if o.is_depth), START_DEPTH)
    image, brightness = (color.image, color.nuisance(state)) if color else (None, SAME)
    assert not isinstance(image, DepthImage)
    e, scales = space.device.e, (sigma_depth, ref.median_depth)
    sigma_intensity = color.lin.next_sigma if color else np.inf

    @cache
    def differences() -> Any:
        return space.intensity(ref, image, brightness, state.spline)

    gone = _moving(space, space.before(ref, depth.occluder, state.spline), scales, sigma_intensity,
                   lambda: space.seen_from(ref, depth.occluder, differences(), state.spline))  # fmt: skip
    if gone is None:
        return nothing
    # What falls where something is gone may be that in another place.
    rest = without(e, ref, gone) if gone.any() else ref

    def look() -> SeenFrom:
        return space.seen_from(depth.occluder, rest, differences(), state.spline)

    came = _moving(space, space.before(depth.occluder, rest, state.spline), scales, sigma_intensity, look)
    if came is None:
        return nothing
    if color is None and before is not None and before.left_out is not None:
        # Without colours only its place tells, in the keyframe's holes, what was left out of the frame before. That
        # creeps over what rests beside it; with colours it costs more than it gains.
        came = came | (unseen(look(), *scales) & _as_before(space, depth, before, state.spline, scales))
    return LeftOut(
        without_pixels(e, depth, came, grid_of(depth.exposure.lens)[1]) if came.any() else depth,
        gone if gone.any() else None,
    )


def _moving(
    space: FreeSpace, near: Free, scales: tuple[float, float], sigma_intensity: float, look: Callable[[], SeenFrom]
) -> Mask | None:
    """Pixels of what moves, None where so much seems to that the pose is wrong. look: closer, where something may move.

    scales (m): as `moving` takes them.
    """
    with space.device.timer("what moves: regions"):
        if not anything(near, *scales):
            return np.zeros(near.z.shape, bool)
    seen = look()
    with space.device.timer("what moves: regions"):
        found = moving(seen, *scales, sigma_intensity)
    return None if _share(found, seen) > _MOST else found


def _as_before(
    space: FreeSpace, depth: DepthImage, other: DepthImage, spline: Spline, scales: tuple[float, float]
) -> Mask:
    """Pixels (gh, gw) of a frame that show, at about the same place, what has been left out of another one."""
    assert other.left_out is not None
    left_out = space.device.e.upload(other.left_out.astype(np.float32))
    seen = space.seen_from(depth.occluder, other.occluder, left_out, spline)
    with space.device.timer("what moves: regions"):
        return moving_with(seen, np.nan_to_num(seen.intensity) > 0.5, *scales)


def left_out_with(
    space: FreeSpace, depth: DepthImage, other: DepthImage, median_depth: float, spline: Spline
) -> DepthImage:
    """A frame's depth image without what another frame does without and shows at about the same place.

    median_depth (m): of what they show.
    """
    if other.left_out is None:
        return depth
    came = _as_before(space, depth, other, spline, (START_DEPTH, median_depth))
    if not came.any() or came.mean() > _MOST:
        return depth
    return without_pixels(space.device.e, depth, came, other.left_out_stride)


def _share(mask: Mask, seen: Free) -> float:
    known = np.isfinite(seen.z)
    return np.count_nonzero(mask & known) / max(1, int(np.count_nonzero(known)))


def without(e: Engine, ref: Reference, gone: Mask) -> Reference:
    """A keyframe without pixels (gh, gw) of its grid."""
    camera = ref.lens.camera
    keep = ~full_size(gone, grid_of(ref.lens)[1], camera.height, camera.width)
    inverse_depth = ref.inverse_depth * e.upload(keep)
    points = []
    for known, stride in zip(ref.points, strides(camera.width, camera.height), strict=bool(ref.points)):
        points.append(replace(known, z=known.z * e.upload(keep[::stride, ::stride])))
    dr.eval(inverse_depth, [p.z for p in points])
    return replace(ref, inverse_depth=inverse_depth, points=tuple(points))
