"""What stands where in the office of a seed: desks with all that is on them, shelves, the meeting table, the plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenes.kit.fittings import cabinet
from scenes.kit.pieces import Piece, draw, stand
from scenes.kit.plants import palm
from scenes.kit.shapes import Mesh, Parts, move, move_parts, rotation
from scenes.kit.walls import GAP
from scenes.office import equipment as eq
from scenes.office import furniture as fu
from scenes.office.pictures import SCREENS
from scenes.office.room import BACK, FLOOR, FRONT, WALLS

ON_FLOOR = FLOOR + GAP
_TOP = ON_FLOOR + fu.DESK[2] + GAP


@dataclass(frozen=True)
class Arrangement:
    """The office's movables, and the shining faces of its screens."""

    pieces: list[Piece]
    screens: list[Mesh]


@dataclass(frozen=True)
class Place:
    """A desk's place: (x, z) of its middle, `turn` in degrees (0: its user sits at +z)."""

    x: float
    z: float
    turn: float


# Two desks face each other, with a screen between, in an island; or desks in rows along a wall.
_ISLAND = fu.DESK[1] / 2 + 0.02


def _islands(rng: np.random.Generator) -> tuple[list[Place], list[Place]]:
    """Desks and dividers of one of three plans."""
    d = _ISLAND
    plan = int(rng.integers(3))
    if plan == 0:  # one island of four in the middle
        x, z = -1.35 + rng.uniform(-0.15, 0.15), 0.35 + rng.uniform(-0.1, 0.15)
        desks = [Place(x + s, z + q, t) for s in (-0.805, 0.805) for q, t in ((d, 0), (-d, 180))]
        return desks, [Place(x + s, z, 0) for s in (-0.805, 0.805)]
    if plan == 1:  # the same turned by a quarter
        x, z = -1.1 + rng.uniform(-0.1, 0.1), 0.1 + rng.uniform(-0.1, 0.1)
        desks = [Place(x + q, z + s, t) for s in (-0.805, 0.805) for q, t in ((d, 90), (-d, -90))]
        return desks, [Place(x, z + s, 90) for s in (-0.805, 0.805)]
    x, z = -0.9 + rng.uniform(-0.1, 0.1), -0.05 + rng.uniform(-0.05, 0.05)  # an island of two, two along the window
    desks = [Place(x, z + d, 0), Place(x, z - d, 180)]
    desks += [Place(q, FRONT - 0.17 - fu.DESK[1] / 2, 180) for q in (-2.75, -0.1)]
    return desks, [Place(x, z, 0)]


def arrange(seed: int) -> Arrangement:
    """Everything that could be carried out of the office of this seed."""
    rng = draw(seed, "arrangement")
    pieces: list[Piece] = []
    screens: list[Mesh] = []
    desks, dividers = _islands(rng)
    for place in desks:
        _workplace(place, rng, pieces, screens)
    for i, place in enumerate(dividers):
        pieces.append(stand(f"divider {i}", fu.divider(1.4), place.x, _TOP, place.z, place.turn))
    _shelves(rng, pieces)
    _meeting(rng, pieces, screens)
    angles = np.arange(9) * 40.0 + rng.uniform(0, 40)
    fronds = [
        (float(a), float(rng.uniform(0.40, 0.55)), float(rng.uniform(0.7, 0.95)), float(rng.uniform(0.3, 0.9)))
        for a in angles
    ]
    plant = palm(int(rng.integers(1000)), 9.0, fronds)
    pieces.append(stand("plant", plant, 0.72, ON_FLOOR, FRONT - 0.86 if len(dividers) != 1 else BACK + 1.25))
    return Arrangement(pieces, screens)


def _workplace(place: Place, rng: np.random.Generator, pieces: list[Piece], screens: list[Mesh]) -> None:
    """A desk, its chair and drawers, and what is on it."""
    k = len([p for p in pieces if p.name.startswith("desk")])
    turn = rotation("y", place.turn)

    def put(name: str, parts: Parts, x: float, y: float, z: float, own: float = 0.0) -> np.ndarray:
        local = rotation("y", own)
        at = turn @ np.array([x, 0.0, z]) + (place.x, y, place.z)
        pieces.append(Piece(f"{name} {k}", move_parts(parts, at, turn @ local)))
        return turn @ local

    def show(made: tuple[Parts, Mesh], name: str, x: float, z: float, own: float) -> None:
        parts, screen = made
        r = put(name, parts, x, _TOP, z, own)
        at = turn @ np.array([x, 0.0, z]) + (place.x, _TOP, place.z)
        screens.append(move(screen, at, r))

    side = float(rng.choice([-1.0, 1.0]))
    put("desk", fu.desk(0.37 * k), 0, ON_FLOOR, 0)
    put("pedestal", fu.pedestal(), -side * 0.44, ON_FLOOR, 0.10)
    put(
        "chair",
        fu.office_chair(float(rng.uniform(-35, 35))),
        side * 0.06,
        ON_FLOOR,
        float(rng.uniform(0.62, 0.74)),
        float(rng.uniform(0, 72)),
    )
    count = SCREENS[0] * SCREENS[1]
    if rng.uniform() < 0.5:
        for s in (-1, 1):
            show(eq.monitor(int(rng.integers(count))), "monitor", s * 0.30, -0.13, -s * 9)
        free = 0.68
    else:
        show(eq.monitor(int(rng.integers(count))), "monitor", 0.0, -0.13, float(rng.uniform(-8, 8)))
        free = 0.42
    put("keyboard", eq.keyboard(), 0.0, _TOP, 0.16, float(rng.uniform(-6, 6)))
    put("mouse", eq.mouse(), side * 0.39, _TOP, 0.17, float(rng.uniform(-8, 8)))
    put("papers", eq.papers(rng, int(rng.integers(2, 6))), -side * 0.50, _TOP, 0.20, float(rng.uniform(-14, 14)))
    if free < 0.6:
        put("telephone", eq.telephone(), side * 0.56, _TOP, -0.10, side * -15)
        put("files", eq.papers(rng, 4), -side * 0.56, _TOP, -0.16, float(rng.uniform(-6, 6)))
    put("mug", eq.coffee(float(rng.uniform(0, 360))), side * 0.62, _TOP, 0.12 + float(rng.uniform(0, 0.08)))
    put("pens", eq.pencils(rng), -side * 0.27, _TOP, 0.02)


def _shelves(rng: np.random.Generator, pieces: list[Piece]) -> None:
    """Three bookcases and a cabinet with the printer along the left wall."""
    wall = WALLS["left"]
    order = rng.permutation(4)
    x = 1.45
    for i in order:
        wide = fu.SHELF[0] if i < 3 else 0.80
        middle = x + wide / 2
        if i < 3:
            pieces.append(Piece(f"shelf {i}", wall.hang(fu.shelf(), (middle, ON_FLOOR), 0.015)))
            for j, y in enumerate(fu.SHELF_BOARDS):
                row = fu.binders(-fu.SHELF[0] / 2 + 0.03, fu.SHELF[0] / 2 - 0.03, rng)
                if row:
                    pieces.append(Piece(f"binders {i} {j}", wall.hang(row, (middle, ON_FLOOR + y), 0.015)))
            if rng.uniform() < 0.7:
                carton = move_parts(eq.box_file(0.34, 0.26, 0.26), (0, 0, 0.165))
                pieces.append(
                    Piece(
                        f"carton {i}",
                        wall.hang(
                            carton, (middle + float(rng.uniform(-0.2, 0.2)), ON_FLOOR + fu.SHELF[2] + GAP), 0.015
                        ),
                    )
                )
        else:
            pieces.append(Piece("cabinet", wall.hang(cabinet(0.80, 0.45, 0.78, 1, 2), (middle, ON_FLOOR), 0.015)))
            pieces.append(
                Piece(
                    "printer", wall.hang(move_parts(eq.printer(), (0, 0, 0.22)), (middle, ON_FLOOR + 0.78 + GAP), 0.015)
                )
            )
        x += wide + 0.03
    filing = cabinet(0.46, 0.60, 1.32, 4, 1)
    pieces.append(Piece("filing cabinet", WALLS["back"].hang(filing, (0.60, ON_FLOOR), 0.015)))


def _meeting(rng: np.random.Generator, pieces: list[Piece], screens: list[Mesh]) -> None:
    """The meeting room: table, chairs, a laptop, papers, mugs, a screen on the wall, a low cabinet."""
    x, z = 2.70, 0.05
    pieces.append(stand("table", fu.meeting_table(), x, ON_FLOOR, z))
    seats = [(s, q) for s in (-1, 1) for q in (-0.8, 0.0, 0.8)]
    for i, (s, q) in enumerate(seats):
        out = 0.56 + float(rng.uniform(0, 0.12))
        pieces.append(
            stand(
                f"visitor chair {i}",
                fu.visitor_chair(),
                x + s * out,
                ON_FLOOR,
                z + q,
                s * 90 + float(rng.uniform(-12, 12)),
            )
        )
    top = ON_FLOOR + fu.TABLE[2] + GAP
    used = rng.permutation(6)[:4]
    for n, i in enumerate(used):
        s, q = seats[int(i)]
        at, turn = (x + s * 0.24, z + q), s * 90 + float(rng.uniform(-12, 12))
        if n == 0:
            parts, screen = eq.laptop(int(rng.integers(SCREENS[0] * SCREENS[1])))
            pieces.append(stand("laptop", parts, at[0], top, at[1], turn))
            screens.append(move(screen, (at[0], top, at[1]), rotation("y", turn)))
        else:
            pieces.append(stand(f"papers m{n}", eq.papers(rng, int(rng.integers(1, 4))), at[0], top, at[1], turn))
        pieces.append(stand(f"mug m{n}", eq.coffee(float(rng.uniform(0, 360))), x + s * 0.20, top, z + q + 0.27))
    parts, screen = eq.television(int(rng.integers(SCREENS[0] * SCREENS[1])))
    wall = WALLS["right"]
    pieces.append(Piece("television", wall.hang(parts, (3.05, 1.55))))
    screens.append(wall.hang([("", screen)], (3.05, 1.55))[0][1])
    pieces.append(Piece("low cabinet", WALLS["back"].hang(cabinet(1.20, 0.42, 0.74, 1, 3), (6.9, ON_FLOOR), 0.015)))
    carton = move_parts(eq.box_file(0.36, 0.24, 0.28), (0, 0, 0.22))
    pieces.append(Piece("carton m", WALLS["back"].hang(carton, (6.65, ON_FLOOR + 0.74 + GAP), 0.015)))
