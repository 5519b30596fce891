"""Leave out of a frame, and of its keyframe, what moves by itself: before the last level of an alignment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import drjit as dr
import numpy as np

from rsgen.device.arrays import Engine
from rsgen.geometry.spline import Spline
from rstrack.alignment.brightness import SAME
from rstrack.alignment.free_space import Free, FreeSpace, Seen, grid_of
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.alignment.weights import START_DEPTH
from rstrack.images.device_frame import full_size, without_pixels
from rstrack.images.pyramid import DepthImage
from rstrack.keyframes.keyframe import Reference, strides
from rstrack.tracking.moving.regions import Mask, anything, moving, moving_with, untold

# Part of what is seen that may move: where more seems to, it is the pose that is wrong.
_MOST = 0.5


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
    image, brightness = (color.image, color.brightness(state)) if color else (None, SAME)
    assert not isinstance(image, DepthImage)
    e, scales = space.device.e, (sigma_depth, ref.median_depth)
    sigma_intensity = color.lin.next_sigma if color else np.inf

    @cache
    def differences() -> Any:
        return space.intensity(ref, image, brightness, state.spline)

    gone = _moving(space, space.before_frame(ref, depth.occluder, state.spline), scales, sigma_intensity,
                   lambda: space.keyframe_in_frame(ref, depth.occluder, differences(), state.spline))  # fmt: skip
    if gone is None:
        return nothing
    # What falls where something is gone may be that in another place.
    rest = without(e, ref, gone) if gone.any() else ref

    def look() -> Seen:
        return space.frame_in_keyframe(depth.occluder, rest, differences(), state.spline)

    came = _moving(space, space.before_keyframe(depth.occluder, rest, state.spline), scales, sigma_intensity, look)
    if came is None:
        return nothing
    if color is None and before is not None and before.left_out is not None:
        # Without colours only its place tells, in the keyframe's holes, what was left out of the frame before. That
        # creeps over what rests beside it; with colours it costs more than it gains.
        came = came | (untold(look(), *scales) & _as_before(space, depth, before, state.spline, scales))
    return LeftOut(
        without_pixels(e, depth, came, grid_of(depth.exposure.lens)[1]) if came.any() else depth,
        gone if gone.any() else None,
    )


def _moving(
    space: FreeSpace, near: Free, scales: tuple[float, float], sigma_intensity: float, look: Callable[[], Seen]
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
    seen = space.frame_in_frame(depth.occluder, other.occluder, other.left_out.astype(np.float32), spline)
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
