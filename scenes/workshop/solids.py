"""Solids that machines and steelwork are made of: bars, rods, wheels, profiles; axes named, metres, y up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scenes.kit.shapes import Mesh, box, lathe, merge, move, rotation, superellipsoid, tube

GAP = 0.001  # kept between things that touch, so that no two faces coincide
Point = tuple[float, float, float]
Profile = Sequence[Sequence[float]] | NDArray[np.float64]
_TURNS = {"x": rotation("z", -90), "y": np.eye(3), "z": rotation("x", 90)}


def rod(axis: str, start: Point, length: float, radius: float, segments: int = 24) -> Mesh:
    """Closed cylinder from `start` along an axis."""
    return turned(axis, start, [[0, 0], [radius, 0], [radius, length], [0, length]], segments)


def turned(axis: str, start: Point, profile: Profile, segments: int = 24) -> Mesh:
    """Solid of revolution: `profile` (k, 2) = (radius, distance from `start` along the axis), walked upwards."""
    return move(lathe(np.asarray(profile, float), segments), start, _TURNS[axis])


def ball(centre: Point, radius: float) -> Mesh:
    """Knob of a lever."""
    return move(superellipsoid([radius] * 3, nu=16, nv=10), centre)


def beam(start: ArrayLike, end: ArrayLike, width: float, height: float) -> Mesh:
    """Square-edged bar between two points, `width` across and `height` along its upper side's normal."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    along = (b - a) / np.linalg.norm(b - a)
    up = np.array([0.0, 1.0, 0.0]) if abs(along[1]) < 0.999 else np.array([1.0, 0.0, 0.0])
    across = np.cross(along, up)
    across /= np.linalg.norm(across)
    turn = np.stack([along, np.cross(across, along), across], axis=1)
    length = float(np.linalg.norm(b - a))
    return move(box([0, -height / 2, -width / 2], [length, height / 2, width / 2]), a, turn)


def i_beam(axis: str, lo: Point, hi: Point, plate: float = 0.014) -> Mesh:
    """Rolled I profile that fills the box lo..hi along `axis`; a post has its flanges towards ±z, a girder on top."""
    a, b = np.asarray(lo, float), np.asarray(hi, float)
    flange, across = (2, 0) if axis == "y" else (1, 2 if axis == "x" else 0)
    pieces = []
    for low in (a[flange], b[flange] - plate):
        p, q = a.copy(), b.copy()
        p[flange], q[flange] = low, low + plate
        pieces.append(box(p, q))
    p, q = a.copy(), b.copy()
    middle = (a[across] + b[across]) / 2
    p[across], q[across] = middle - 0.6 * plate, middle + 0.6 * plate
    p[flange], q[flange] = p[flange] + plate + GAP / 4, q[flange] - plate - GAP / 4
    return merge([*pieces, box(p, q)])


def ring(axis: str, centre: Point, radius: float, thickness: float, segments: int = 36) -> Mesh:
    """Torus about an axis through `centre`."""
    a = np.linspace(0, 2 * np.pi, 11)[::-1]
    profile = np.stack([radius + thickness * np.cos(a), thickness * np.sin(a)], 1)
    return turned(axis, centre, profile[::-1], segments)


def handwheel(axis: str, centre: Point, radius: float, sign: float = 1.0) -> tuple[Mesh, Mesh]:
    """(rim, hub and spokes; grip) of a crank wheel in the plane across `axis`, the grip towards `sign`."""
    turn = _TURNS[axis] @ (np.eye(3) if sign > 0 else rotation("x", 180))
    wheel = [ring("y", (0, 0, 0), radius, 0.1 * radius), rod("y", (0, -0.35 * radius, 0), 0.6 * radius, 0.2 * radius)]
    for k in range(3):
        a = 2 * np.pi * k / 3
        way = np.array([np.cos(a), 0.0, np.sin(a)])
        wheel.append(tube([0.15 * radius * way, 0.95 * radius * way], 0.07 * radius, 8))
    shape = np.array([[0, 0], [0.08, 0], [0.13, 0.35], [0.09, 0.66], [0, 0.7]]) * radius
    grip = turned("y", (0.97 * radius, 0.1 * radius, 0), shape, 12)
    return move(merge(wheel), centre, turn), move(grip, centre, turn)


def buttons(centre: Point, pitch: float, count: int) -> list[tuple[str, Mesh]]:
    """A row of push buttons along x on a panel that faces +z at `centre`: green, red, black in turn."""
    names = ("button_green", "button_red", "rubber")
    left = centre[0] - pitch * (count - 1) / 2
    return [(names[k % 3], rod("z", (left + k * pitch, *centre[1:]), 0.012, 0.26 * pitch, 16)) for k in range(count)]
