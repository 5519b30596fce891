"""The staircase at the corridor's end: one flight to a landing, its balustrade and handrails. Metres, y up."""

from __future__ import annotations

import numpy as np

from scenes.kit.fittings import rail
from scenes.kit.pieces import Piece
from scenes.kit.shapes import Mesh, box, merge, move, quad, superellipsoid, tube
from scenes.kit.walls import GAP, Wall

RISE, GOING, STEPS = 0.17, 0.28, 10  # ten risers, nine treads and the landing
FOOT = 14.40  # x of the first riser
HEAD = FOOT + GOING * (STEPS - 1)  # of the last
LANDING = RISE * STEPS  # its height
SIDE = 0.25  # z of the flight's open side
_RAIL = 0.92  # above the nosings


def flight(end: float, z0: float) -> list[tuple[str, Mesh]]:
    """Masonry from the wall at z0 to SIDE: risers, treads, landing up to x = `end`, the wall below the open side."""
    stone, side = [], []
    deep = SIDE - z0
    for i in range(STEPS):
        x, y = FOOT + GOING * i, RISE * i
        stone.append(quad([x, y + RISE, z0], [0, 0, deep], [0, -RISE, 0], (0.37 * i, 0.2 * i)))
        x1 = x + GOING if i < STEPS - 1 else end
        stone.append(quad([x, y + RISE, z0], [x1 - x, 0, 0], [0, 0, deep], (0.41 * i, 0.13 * i)))
        side.append(quad([x, y + RISE, SIDE], [x1 - x, 0, 0], [0, -y - RISE, 0], (x, 1.8 - y - RISE)))
    return [("terrazzo", merge(stone)), ("stair_side", merge(side))]


def nosings(z0: float) -> Piece:
    """Dark strips on the edges of the treads."""
    strips = []
    for i in range(STEPS):
        x, y = FOOT + GOING * i, RISE * (i + 1)
        strips.append(box([x + 0.004, y + 0.0005, z0 + 0.03], [x + 0.05, y + 0.004, SIDE - 0.03]))
    return Piece("nosings", [("nosing", merge(strips))])


def balustrade(end: float) -> Piece:
    """Posts on every tread along the open side, a rail of steel at half height, a wooden one on top."""
    z = SIDE - 0.07
    tread = [(FOOT + GOING * (i + 0.5), RISE * (i + 1)) for i in range(STEPS - 1)]
    level = [(x, LANDING) for x in np.arange(HEAD + 0.16, end - 0.1, 0.18)]
    slope = RISE / GOING

    def line(x: float, up: float) -> float:  # height of a rail `up` above the nosings, level on the landing
        return min(RISE + (x - FOOT) * slope, LANDING) + up

    steel = []
    for x, y in [*tread, *level]:
        steel.append(tube([[x, y + 0.008, z], [x, line(x, _RAIL) - 0.024, z]], 0.009, 10))
        steel.append(box([x - 0.03, y + GAP, z - 0.03], [x + 0.03, y + 0.007, z + 0.03]))
    newel = FOOT + 0.02 + 0.03
    xs = [newel, *np.linspace(FOOT + 0.3, HEAD - 0.06, 5), HEAD + 0.02, HEAD + 0.12, end - 0.06]
    top = np.array([[x, line(x, _RAIL), z] for x in xs])
    middle = [[x, line(x, 0.45), z + 0.017] for x in xs]
    steel.append(tube(middle, 0.0075, 10))
    wood = [tube(top, 0.023, 20), *(move(superellipsoid([0.0228] * 3, 1, 1, 16, 10), q) for q in (top[0], top[-1]))]
    return Piece("balustrade", [("steel", merge(steel)), ("rail", merge(wood))])


def wall_rail(wall: Wall, start: float) -> Piece:
    """Handrail on the wall beside the flight; `start`: x of the wall's left end."""
    slope = RISE / GOING
    xs = np.linspace(FOOT - 0.1 - start, HEAD + 0.05 - start, 9)
    path = [[float(x), float(RISE + (x + start - FOOT) * slope + _RAIL), 0.0] for x in xs]
    return Piece("handrail", wall.hang(rail(path, 0.021, "rail", "steel", 0.075, [1, 4, 7]), (0, 0)))
