"""The corridor's building: walls, doors, lamps, and the stairwell at its end. Metres, y up."""

from __future__ import annotations

from scenes.corridor.stairs import LANDING, SIDE, balustrade, flight, nosings, wall_rail
from scenes.kit.fittings import door, window_frame
from scenes.kit.pieces import Piece
from scenes.kit.shapes import Mesh, Parts, box, merge, tube
from scenes.kit.walls import GAP, Opening, Wall, ceiling, floor

FLOOR, CEILING, WELL = 0.0, 3.0, 4.7  # heights of the floor and of the ceilings of corridor and stairwell
LENGTH, PORTAL, HALF = 18.2, 14.0, 1.2  # x of the end wall and of the stairwell's beginning; half the width
DADO = 1.2  # height of the oil paint
NORTH_DOORS = (2.0, 5.5, 9.0, 12.3)  # x of the doors' middles
SOUTH_DOORS = (3.75, 7.25, 10.75)
LAMPS = [
    (1.4, CEILING),
    (3.8, CEILING),
    (6.2, CEILING),
    (8.6, CEILING),
    (11.0, CEILING),
    (13.1, CEILING),
    (15.0, WELL),
    (17.0, WELL),
]
_PILASTER = 0.10


def _doors(middles: list[float], width: float = 0.9) -> tuple[Opening, ...]:
    return tuple(Opening(x - width / 2, x + width / 2, FLOOR, 2.05, 0.10) for x in middles)


UPPER_DOOR = Opening(3.18, 4.05, LANDING, LANDING + 2.05, 0.10)
END_DOOR = Opening(1.56, 2.30, FLOOR, 2.05, 0.10)
WINDOW = Opening(0.15, 1.30, LANDING + 0.95, LANDING + 2.55, 0.16, luminous=True)
WALLS = {
    "north": Wall((0.0, -HALF), (PORTAL, -HALF), FLOOR, CEILING, _doors(list(NORTH_DOORS))),
    "well north": Wall((PORTAL, -HALF), (LENGTH, -HALF), FLOOR, WELL, (UPPER_DOOR,)),
    "end": Wall((LENGTH, -HALF), (LENGTH, HALF), FLOOR, WELL, (END_DOOR, WINDOW)),
    "well south": Wall((LENGTH, HALF), (PORTAL, HALF), FLOOR, WELL),
    "south": Wall((PORTAL, HALF), (0.0, HALF), FLOOR, CEILING, _doors([PORTAL - x for x in SOUTH_DOORS])),
    "west": Wall((0.0, HALF), (0.0, -HALF), FLOOR, CEILING, (Opening(0.7, 1.7, FLOOR, 2.05, 0.10),)),
    "lintel": Wall((PORTAL, HALF), (PORTAL, -HALF), CEILING, WELL),
}
_TWO_TONED = ("north", "south", "west")


def shell() -> Parts:
    """Floor, ceilings, walls with their openings and the flight of stairs, inward facing; a pane closes the window."""
    parts: Parts = [
        ("floor", floor((0.0, -HALF), (LENGTH, HALF), FLOOR)),
        (
            "ceiling",
            merge([ceiling((0.0, -HALF), (PORTAL, HALF), CEILING), ceiling((PORTAL, -HALF), (LENGTH, HALF), WELL)]),
        ),
        *flight(LENGTH, -HALF),
    ]
    for name, wall in WALLS.items():
        if name in _TWO_TONED:
            parts += [("dado", wall.surface(high=DADO)), ("wall", wall.surface(low=DADO))]
        else:
            parts.append(("wall", wall.surface()))
        parts += wall.reveals()
    return parts


def pane() -> Mesh:
    """The window's luminous pane."""
    return WALLS["end"].pane(WINDOW)


def fixtures() -> list[Piece]:
    """What belongs to the building: doors, skirting, portal, window frame, stairs' rails, pipes."""
    p = _PILASTER
    boards = {
        "north": (None, PORTAL - p - GAP),
        "south": (p + GAP, None),
        "west": (None, None),
        "well south": (None, LENGTH - PORTAL - p - GAP),
    }
    pieces = [
        Piece(f"skirting {k}", WALLS[k].skirting("skirting", 0.10, 0.014, 0.056, *ab)) for k, ab in boards.items()
    ]
    for name in ("north", "south", "west"):
        for i, o in enumerate(WALLS[name].openings):
            made = door(o, "door", "frame", "metal", "left" if i % 2 else "right", glazed=name == "west")
            pieces.append(Piece(f"door {name} {i}", WALLS[name].hang(made, (0, 0), 0.0)))
    pieces.append(Piece("door end", WALLS["end"].hang(door(END_DOOR, "door", "frame", "metal", "right"), (0, 0), 0.0)))
    upper = door(UPPER_DOOR, "door", "frame", "metal", "right")
    pieces.append(Piece("door landing", WALLS["well north"].hang(upper, (0, 0), 0.0)))
    pieces.append(Piece("window", WALLS["end"].hang(window_frame(WINDOW, 1, "paint"), (0, 0), 0.0)))
    low = 2.74
    pieces.append(
        Piece("portal", [
            ("frame", merge([
                box([PORTAL - p, FLOOR + GAP, -HALF + GAP], [PORTAL + p, low, -HALF + p]),
                box([PORTAL - p, FLOOR + GAP, HALF - p], [PORTAL + p, low, HALF - GAP]),
                box([PORTAL - p, low + GAP, -HALF + GAP], [PORTAL + p, CEILING - GAP, HALF - GAP]),
            ]))
        ])
    )  # fmt: skip
    return [*pieces, nosings(-HALF), balustrade(LENGTH), wall_rail(WALLS["well north"], PORTAL), _pipes()]


def _pipes() -> Piece:
    """Two pipes below the ceiling along the north wall, and their clips."""
    y, z = 2.84, -HALF + 0.11
    end = PORTAL - _PILASTER - 0.003
    pipes = [
        tube([[0.003, y, z + 0.09 * k], [end / 2, y, z + 0.09 * k], [end, y, z + 0.09 * k]], 0.03 - 0.008 * k, 16)
        for k in (0, 1)
    ]
    clips = [
        box([x - 0.012, y + 0.0305, z - 0.02], [x + 0.012, CEILING - GAP, z + 0.11])
        for x in (0.4, 2.8, 5.2, 7.6, 10.0, 12.4)
    ]
    bands = [
        box([x - 0.010, y + 0.0225, z + 0.075], [x + 0.010, y + 0.030, z + 0.105])
        for x in (0.4, 2.8, 5.2, 7.6, 10.0, 12.4)
    ]
    return Piece("pipes", [("pipe", merge(pipes)), ("steel", merge([*clips, *bands]))])


def lamp(x: float, y: float) -> tuple[Parts, Mesh]:
    """A long lamp below the ceiling at height `y`: housing, and shining face, which nothing reaches below."""
    low = y - 0.062
    z = 0.0 if y == CEILING else (SIDE - HALF) / 2
    housing = box([x - 0.62, low, z - 0.11], [x + 0.62, y - GAP, z + 0.11])
    face = ceiling((x - 0.60, z - 0.09), (x + 0.60, z + 0.09), low - GAP)
    return [("paint", housing)], face
