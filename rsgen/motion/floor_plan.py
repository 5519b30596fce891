"""Where a camera can be carried about in a scene: floors, and the free places at eye height that walls surround."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from scipy import ndimage

from rsgen.array_types import BoolArray, FloatArray

Cast = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From points (n, 3) along unit directions (n, 3): distances (n,), m, inf for none, and triangles' normals (n, 3)."""

HEADROOM_M = 1.6
"""Over a floor there is at least so much air."""

BOB_M = 0.08
"""So much does the camera rise above its mean height, and sink below it."""

HIGHEST_M = 60.0
"""What has walls and is higher is a room in another unit than metres."""

_EYE_M = 1.45  # a camera held before the chest of somebody who stands
_SLACK_M = 0.06
_COLUMNS = 48
_MOST_STOREYS = 24  # surfaces above each other that are looked through for floors
_LEVEL_M = 0.1  # floors are told apart so finely
_CELLS = 1_500_000
_CELL_M = 0.03
_PROBE_M = 0.2
_PROBES = 20_000
_AZIMUTHS = 24
_WALLED = 0.7  # of the horizontal rays, those that hit a wall where the camera is indoors
_FAR_M = 30.0  # a wall that is farther off is none
_LOW_M = 0.55  # one can hold a camera over a sofa or a low table, not over a cupboard
_SUNK_M = 0.2


@dataclass(frozen=True)
class Floor:
    """A height on which one can stand.

    y: world, m. area_m2: as far as columns of rays tell. gap_m: median height of the air above it, inf under the sky.
    """

    y: float
    area_m2: float
    gap_m: float


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Square cells over x and z at one height of the camera.

    corner: (2,) world x, z of the centre of cell [0, 0]. eye_y: the camera's mean height, world, m. room_m: (nx, nz)
    distance in the plane to the nearest surface at about that height, m. inside: (nx, nz) walls around, floor below.
    solid: whether these walls show their backs: what they enclose is a body rather than a room.
    """

    corner: FloatArray
    cell_m: float
    eye_y: float
    floor: Floor
    room_m: FloatArray
    inside: BoolArray
    solid: bool

    def largest(self, room_m: float) -> BoolArray:
        """Cells (nx, nz) of the largest connected region inside whose cells have room_m about them."""
        labels, count = ndimage.label((self.room_m >= room_m) & self.inside)
        if not count:
            return np.zeros(self.inside.shape, bool)
        return np.asarray(labels == 1 + np.argmax(np.bincount(labels.ravel())[1:]))

    def area_m2(self, cells: BoolArray) -> float:
        """Area of a region of cells, m²."""
        return float(cells.sum()) * self.cell_m**2


def find_floors(cast: Cast, low: FloatArray, high: FloatArray) -> list[Floor]:
    """Floors of a scene within the box of corners low and high (3,), world, m, the largest first.

    Columns of rays go down through everything; what has HEADROOM_M of air above it may be a floor.
    """
    size = high - low
    p = _columns(low, high, high[1] + 1.0)
    skin, above = 1e-4 * max(1.0, float(size.max())), np.full(len(p), np.inf)
    heights, gaps = [], []
    for _ in range(_MOST_STOREYS):
        distance, _ = cast(p, np.tile([0.0, -1.0, 0.0], (len(p), 1)))
        met = np.isfinite(distance)
        p, above = p[met] - distance[met, None] * [0.0, 1.0, 0.0], above[met]
        if not len(p):
            break
        heights.append(p[:, 1])
        gaps.append(above - p[:, 1])
        above, p = p[:, 1], p - skin * np.array([0.0, 1.0, 0.0])
    y, gap = np.concatenate([*heights, np.zeros(0)]), np.concatenate([*gaps, np.zeros(0)])
    y, gap = y[gap >= HEADROOM_M], gap[gap >= HEADROOM_M]
    floors = []
    column_m2 = float(size[0] * size[2]) / _COLUMNS**2
    while len(y):
        level = np.maximum((y - low[1]) / _LEVEL_M, 0.0).astype(np.int64)
        most = low[1] + (np.bincount(level).argmax() + 0.5) * _LEVEL_M
        here = np.abs(y - most) <= 1.5 * _LEVEL_M
        floors.append(Floor(float(np.median(y[here])), float(here.sum()) * column_m2, float(np.median(gap[here]))))
        y, gap = y[~here], gap[~here]
    return sorted(floors, key=lambda floor: -floor.area_m2)


def floor_plan(triangles: FloatArray, cast: Cast, floor: Floor, clearance_m: float) -> FloorPlan:
    """The plan over a floor of a scene of triangles (m, 3, 3), world, m, at the height at which a camera is held."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    far = _FAR_M if high[1] - low[1] <= HIGHEST_M else math.inf
    eye_y = floor.y + min(_EYE_M, floor.gap_m - clearance_m - BOB_M - _SLACK_M)
    cell = max(_CELL_M, math.sqrt(float((high[0] - low[0]) * (high[2] - low[2])) / _CELLS))
    shape = tuple(math.ceil((high[k] - low[k]) / cell) + 5 for k in (0, 2))
    corner = np.array([low[0], low[2]]) - 2.0 * cell
    reach = clearance_m + BOB_M
    taken = _occupied(triangles, (eye_y - reach, eye_y + reach), corner, cell, shape)
    # A cell is taken where a surface passes its centre within half a diagonal.
    room_m = np.maximum(ndimage.distance_transform_edt(~taken) - 0.75, 0.0) * cell
    stride = max(1, round(_PROBE_M / cell), math.ceil(math.sqrt(room_m.size / _PROBES)))
    cells = np.stack(np.meshgrid(*(np.arange(0, n, stride) for n in shape), indexing="ij"), axis=-1)
    probes = np.insert(corner + cells.reshape(-1, 2) * cell, 1, eye_y, axis=1)
    walled, backs, ground = _around(probes, cast, far)
    inside = walled & (ground >= floor.y - _SUNK_M) & (ground <= floor.y + _LOW_M)
    solid = bool(inside.any() and np.median(backs[inside]) > 0.5)
    grid = inside.reshape(cells.shape[:2])
    i, j = (np.minimum((np.arange(shape[k]) + stride // 2) // stride, grid.shape[k] - 1) for k in (0, 1))
    return FloorPlan(corner, cell, eye_y, floor, room_m, grid[np.ix_(i, j)], solid)


def share_without_floor(cast: Cast, low: FloatArray, high: FloatArray) -> float:
    """Share in [0, 1] of the places halfway up the box of corners low and high (3,), m, with walls but no floor."""
    walled, _, ground = _around(_columns(low, high, 0.5 * (low[1] + high[1])), cast, math.inf)
    return float((walled & np.isneginf(ground)).mean())


def _columns(low: FloatArray, high: FloatArray, y: float) -> FloatArray:
    """Points (_COLUMNS², 3) at the height y, evenly over x and z of the box of corners low and high (3,)."""
    x, z = (low[k] + (np.arange(_COLUMNS) + 0.5) / _COLUMNS * (high[k] - low[k]) for k in (0, 2))
    return np.insert(np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2), 1, y, axis=1)


def _around(p_world: FloatArray, cast: Cast, far: float) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Of places (n, 3): whether most horizontal rays hit a wall within far, the share of backs, the height below."""
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * (math.tau / _AZIMUTHS)
    around = np.tile(np.stack([np.cos(azimuth), np.zeros(_AZIMUTHS), np.sin(azimuth)], axis=1), (len(p_world), 1))
    distance, normal = cast(np.repeat(p_world, _AZIMUTHS, axis=0), around)
    walled = (distance.reshape(-1, _AZIMUTHS) < far).mean(axis=1) >= _WALLED
    backs = (np.einsum("ij,ij->i", normal, around) > 0).reshape(-1, _AZIMUTHS).mean(axis=1)
    below, _ = cast(p_world, np.tile([0.0, -1.0, 0.0], (len(p_world), 1)))
    return walled, backs, p_world[:, 1] - below


def _occupied(
    triangles: FloatArray, slab: tuple[float, float], corner: FloatArray, cell: float, shape: tuple[int, ...]
) -> BoolArray:
    """Cells that hold a part of a triangle between the two heights of the slab."""
    near = (triangles[..., 1].max(axis=1) >= slab[0]) & (triangles[..., 1].min(axis=1) <= slab[1])
    taken = np.zeros(shape, np.uint8)
    if not near.any():
        return taken.astype(bool)
    v, f = triangles[near].reshape(-1, 3), np.arange(3 * near.sum()).reshape(-1, 3)
    for height, normal in zip(slab, ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0)), strict=True):
        v, f, _ = trimesh.intersections.slice_faces_plane(v, f, normal, (0.0, height, 0.0))
    corners = np.round((v[f][..., [0, 2]] - corner) / cell).astype(np.int32)
    small = (np.ptp(corners, axis=1) <= 1).all(axis=1)
    taken[tuple(corners[small].reshape(-1, 2).T)] = 1
    for polygon in corners[~small][..., ::-1]:  # OpenCV counts columns first
        cv2.fillConvexPoly(taken, polygon, 1)
    return taken.astype(bool)
