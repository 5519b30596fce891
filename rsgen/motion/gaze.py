"""What a camera on a closed walk looks at: surfaces at 1 to 3 m, with shape and detail, and no sudden turns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rsgen.motion.floor_plan import Cast

_AZIMUTHS = 48
_PITCHES_DEG = (-25.0, -15.0, -5.0)
_ELEVATIONS_DEG = np.arange(-45.0, 16.0, 10.0)
_HALF_HEIGHT_DEG = 21.0  # of the field of view, about: a Kinect's
_HALF_WIDTH_DEG = 29.0
# How welcome a surface is at a distance: too close there is no depth, too far it is coarse.
_DISTANCE_M = (0.4, 0.9, 1.2, 3.0, 4.5, 10.0)
_WORTH = (-3.0, 0.0, 1.0, 1.0, 0.3, -0.3)
_NOTHING = -5.0
_SHAPE = 0.8
_DETAIL = 2.5
_AHEAD = 0.7
_CHANCE = 0.15
_EASY_DEG = 30.0
_MOST_DEG = 60.0  # from a waypoint to the next: the targets' chord stays well before the camera
_TARGET_M = 2.0
# Planes through every so many of the rays' hits are tried; what is as near to one as this part of its distance is on
# it; and a view is flat where such a part of its rays is on one.
_PLANE_RAYS, _PLANE, _FLAT = 7, 0.02, 0.9
_GRID = np.linspace(-0.95, 0.95, 12)


def choose_targets(p_world: FloatArray, cast: Cast, calm: float, rng: np.random.Generator) -> FloatArray:
    """Points (n, 3), world, m, to look at from the camera centres (n, 3) of a closed walk, which are 60 cm apart.

    The best sum over all views of their worth, less what turning costs: calm for 30° from one to the next. Views are
    worth more if surfaces are at 1 to 3 m and face different ways, if these are many, as of furniture, rather than a
    bare room's few, and if they are ahead rather than behind: so the camera comes to look at all sides. rng adds a
    little, so that seeds differ.
    """
    worth = _views(p_world, cast)
    way = np.roll(p_world, -1, axis=0) - np.roll(p_world, 1, axis=0)
    course = np.arctan2(way[:, 2], way[:, 0])[:, None] - np.arange(_AZIMUTHS) * (math.tau / _AZIMUTHS)
    best = worth.max(axis=2) + _AHEAD * np.cos(course) + _CHANCE * rng.random(worth.shape[:2])
    azimuth = _closed_way(best, calm)
    pitch = np.radians(np.take(_PITCHES_DEG, worth[np.arange(len(worth)), azimuth].argmax(axis=1)))
    return p_world + _TARGET_M * _direction(azimuth * (math.tau / _AZIMUTHS), pitch)


@dataclass(frozen=True)
class Seen:
    """What a grid of rays through the views of cameras meets: distances (n, rays) in m, inf for nothing, and flat (n,):
    whether a view holds next to nothing but one plane, along which and about whose normal depth tells of no motion.
    """

    distance: FloatArray
    flat: BoolArray


def seen_from(T_world_cam: FloatArray, cast: Cast) -> Seen:
    """What cameras at poses (n, 4, 4) see."""
    x, y = np.meshgrid(np.tan(np.radians(_HALF_WIDTH_DEG)) * _GRID, np.tan(np.radians(_HALF_HEIGHT_DEG)) * _GRID)
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    direction = np.einsum("nij,rj->nri", T_world_cam[:, :3, :3], rays).reshape(-1, 3)
    origin = np.repeat(T_world_cam[:, :3, 3], len(rays), axis=0)
    distance, normal = cast(origin, direction)
    p_world = origin + np.where(np.isfinite(distance), distance, 0.0)[:, None] * direction
    grid = len(T_world_cam), len(rays)
    distance, p_world, normal = (a.reshape(*grid, *a.shape[1:]) for a in (distance, p_world, normal))
    # How many lie on the plane of one of them, of a few.
    few = slice(None, None, _PLANE_RAYS)
    off = np.einsum("nrk,nck->ncr", p_world, normal[:, few])
    off -= np.einsum("nck,nck->nc", p_world[:, few], normal[:, few])[..., None]
    there = np.isfinite(distance)
    on = there[:, None] & (np.abs(off) < _PLANE * np.where(there, distance, 0.0)[:, None]) & there[:, few, None]
    return Seen(distance, on.mean(axis=2).max(axis=1) > _FLAT)


def _direction(azimuth: FloatArray, elevation: FloatArray) -> FloatArray:
    """Unit directions (..., 3), world, y up."""
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), np.sin(elevation), level * np.sin(azimuth)], axis=-1)


def _views(p_world: FloatArray, cast: Cast) -> FloatArray:
    """Worth (n, azimuths, pitches) of a view from each place in each direction."""
    azimuth, elevation = np.arange(_AZIMUTHS) * (math.tau / _AZIMUTHS), np.radians(_ELEVATIONS_DEG)
    rays = _direction(*np.meshgrid(azimuth, elevation, indexing="ij")).reshape(-1, 3)
    distance, normal = cast(np.repeat(p_world, len(rays), axis=0), np.tile(rays, (len(p_world), 1)))
    shape = (len(p_world), _AZIMUTHS, len(elevation))
    worth = np.where(np.isfinite(distance), np.interp(distance, _DISTANCE_M, _WORTH), _NOTHING).reshape(shape)
    planes = distance.reshape(shape), normal.reshape(*shape, 3), rays.reshape(*shape[1:], 3)
    worth += _DETAIL * _beside_its_plane(*planes)
    towards = -np.sign(np.einsum("ij,ij->i", normal, np.tile(rays, (len(p_world), 1))))
    normal = (normal * towards[:, None]).reshape(*shape, 3)
    half = round(_HALF_WIDTH_DEG / 360.0 * _AZIMUTHS)
    views = []
    for pitch in _PITCHES_DEG:
        rows = np.abs(_ELEVATIONS_DEG - pitch) <= _HALF_HEIGHT_DEG
        seen, facing = worth[..., rows].mean(axis=2), normal[:, :, rows].mean(axis=2)
        sides = [(np.roll(seen, k, axis=1), np.roll(facing, k, axis=1)) for k in range(-half, half + 1)]
        alike = np.linalg.norm(np.mean([side[1] for side in sides], axis=0), axis=-1)
        views.append(np.mean([side[0] for side in sides], axis=0) + _SHAPE * (1.0 - alike))
    return np.stack(views, axis=-1)


def _beside_its_plane(distance: FloatArray, normal: FloatArray, rays: FloatArray) -> FloatArray:
    """(n, azimuths, elevations): the part of what the next two rays meet that is off the plane of what a ray meets."""
    met = np.where(np.isfinite(distance), distance, 0.0)
    off = np.zeros(distance.shape)
    for axis in (0, 1):
        beyond = np.roll(met, -1, axis=axis + 1)[..., None] * np.roll(rays, -1, axis=axis) - met[..., None] * rays
        away = np.abs(np.einsum("naek,naek->nae", normal, beyond)) > _PLANE * met
        if axis == 1:
            away[:, :, -1] = False  # there is no ray above the highest
        off += 0.5 * (away & (met > 0))
    return off


def _closed_way(worth: FloatArray, calm: float) -> FloatArray:
    """Azimuths (n,) of most worth (n, azimuths) in all, less what it costs to turn from each to the next, in a ring."""
    turn = np.abs((np.arange(_AZIMUTHS)[:, None] - np.arange(_AZIMUTHS) + _AZIMUTHS // 2) % _AZIMUTHS - _AZIMUTHS // 2)
    degrees = turn * (360.0 / _AZIMUTHS)
    cost = np.where(degrees <= _MOST_DEG, calm * (degrees / _EASY_DEG) ** 2, np.inf)
    # Dynamic programming for all first azimuths at once: sums[first, last].
    sums = np.where(np.eye(_AZIMUTHS, dtype=bool), worth[0], -np.inf)
    before = []
    for here in worth[1:]:
        through = sums[:, :, None] - cost
        before.append(through.argmax(axis=1))
        sums = through.max(axis=1) + here
    first, last = np.unravel_index(np.argmax(sums - cost.T), sums.shape)
    way = [last]
    for step in before[::-1]:
        way.append(step[first, way[-1]])
    return np.array(way[::-1])
