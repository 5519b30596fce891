"""The office's building: walls, window, door, glass partition, suspended ceiling with its lamps. Metres, y up."""

from __future__ import annotations

import numpy as np

from scenes.kit.fittings import board, door, radiator, sign, switch, window_frame
from scenes.kit.pieces import Piece
from scenes.kit.prints import atlas_rect
from scenes.kit.shapes import Mesh, Parts, atlas_uv, box, merge, move_parts, quad, rotation, rounded_box, tube
from scenes.kit.walls import GAP, Opening, Wall, ceiling, floor, frame
from scenes.office.pictures import POSTERS

FLOOR, CEILING = 0.0, 2.80
LEFT, RIGHT, BACK, FRONT = -4.0, 4.0, -3.0, 3.0
PARTITION = 1.40  # x of the glass
TILE = 0.60  # of the ceiling, from the corner at LEFT, BACK
PANELS = [(1, 2), (4, 2), (7, 2), (1, 7), (4, 7), (7, 7), (11, 2), (11, 7)]  # ceiling tiles (column, row) that shine

DOOR = Opening(4.25, 5.20, FLOOR, 2.05, 0.09)
WINDOW = Opening(3.30, 7.50, 0.95, 2.45, 0.14, luminous=True)
SMALL_WINDOW = Opening(0.55, 2.05, 0.95, 2.45, 0.14, luminous=True)
WALLS = {
    "back": Wall((LEFT, BACK), (RIGHT, BACK), FLOOR, CEILING, (DOOR,)),
    "right": Wall((RIGHT, BACK), (RIGHT, FRONT), FLOOR, CEILING),
    "front": Wall((RIGHT, FRONT), (LEFT, FRONT), FLOOR, CEILING, (SMALL_WINDOW, WINDOW)),
    "left": Wall((LEFT, FRONT), (LEFT, BACK), FLOOR, CEILING),
}
_POSTS = [BACK, -1.85, -0.75, 0.25, 1.65, FRONT]  # z of the partition's posts; the door is between the third and fourth
_DOOR_BAY = 2


def shell() -> Parts:
    """Floor, ceiling, walls with their openings, inward facing; luminous panes close the windows."""
    parts: Parts = [
        ("floor", floor((LEFT, BACK), (RIGHT, FRONT), FLOOR)),
        ("ceiling", ceiling((LEFT, BACK), (RIGHT, FRONT), CEILING)),
    ]
    for name, wall in WALLS.items():
        parts.append(("wall_accent" if name == "right" else "wall", wall.surface()))
        parts += wall.reveals()
    return parts


def panes() -> list[Mesh]:
    """The windows' luminous panes."""
    return [WALLS["front"].pane(o) for o in (WINDOW, SMALL_WINDOW)]


def fixtures(rng: np.random.Generator) -> list[Piece]:
    """What is fixed to walls and ceiling; `rng` draws how far the blinds are down and where pictures hang."""
    back, front, right, left = (WALLS[k] for k in ("back", "front", "right", "left"))
    pieces = [Piece(f"skirting {k}", w.skirting("skirting", 0.07, 0.012, 0.056)) for k, w in WALLS.items()]
    pieces.append(Piece("door", back.hang(door(DOOR, "door", "frame", "metal"), (0, 0), 0.0)))
    for name, o, bars in (("window", WINDOW, 3), ("small window", SMALL_WINDOW, 1)):
        pieces.append(Piece(name, front.hang(window_frame(o, bars, "paint"), (0, 0), 0.0)))
        pieces.append(Piece(f"{name} blind", front.hang(_blind(o, float(rng.uniform(0.0, 0.55))), (0, 0))))
    for x in (3.95, 5.40, 6.85):
        pieces.append(Piece("radiator", front.hang(_named(radiator()), (x, FLOOR + GAP), 0.015)))
    pieces.append(Piece("radiator", front.hang(_named(radiator()), (1.30, FLOOR + GAP), 0.015)))
    pieces.append(Piece("switch", back.hang(switch("paint"), (4.08, 1.10))))
    pieces.append(Piece("whiteboard", back.hang(_whiteboard(), (float(rng.uniform(1.95, 2.6)), 1.50))))
    order = rng.permutation(3)
    for i, (wall, x, y) in enumerate(
        ((right, float(rng.uniform(0.8, 1.2)), 1.55), (left, 0.55, 1.60), (right, 5.2, 1.5))
    ):
        rect = atlas_rect(int(order[i]), *POSTERS)
        pieces.append(Piece("poster", wall.hang(sign(0.60, 0.85, "poster", rect, "frame"), (x, y))))
    return [*pieces, *partition()]


def _named(parts: Parts) -> Parts:
    return [("paint" if name == "paint" else "black", mesh) for name, mesh in parts]


def _blind(o: Opening, drop: float) -> Parts:
    """Roller blind before the window's lintel, `drop` metres of its cloth let down in the reveal."""
    y = o.y1 + 0.05
    case = rounded_box([o.x0 - 0.05, y - 0.045, 0.0], [o.x1 + 0.05, y + 0.045, 0.08], 0.012, 3, edge=2)
    parts: Parts = [("paint", case)]
    if drop > 0.02:
        cloth = box([o.x0 - 0.03, y - 0.046 - drop, 0.035], [o.x1 + 0.03, y - 0.046, 0.0365])
        bar = tube([[o.x0 - 0.03, y - 0.052 - drop, 0.0358], [o.x1 + 0.03, y - 0.052 - drop, 0.0358]], 0.005, 10)
        parts += [("blind", cloth), ("paint", bar)]
    return parts


def _whiteboard() -> Parts:
    w, h = 2.0, 1.2
    parts = board(w, h, "board", "metal", "steel")
    face = quad([-w / 2 + 0.027, h / 2 - 0.027, 0.0130], [w - 0.054, 0, 0], [0, 0.054 - h, 0])
    pens = [
        rounded_box([x, -h / 2 + GAP, 0.03], [x + 0.12, -h / 2 + 0.016, 0.045], 0.006, 3, edge=2)
        for x in (-0.3, 0.0, 0.22)
    ]
    pens[0] = rounded_box([-0.42, -h / 2 + GAP, 0.022], [-0.29, -h / 2 + 0.032, 0.062], 0.006, 3, edge=2)
    return [*parts, ("whiteboard", atlas_uv(face, (0, 0, 1, 1))), ("pen", merge(pens))]


def partition() -> list[Piece]:
    """Panes of glass in a powder-coated frame from wall to wall, a glass door in it, dots of film at eye level."""
    x0, x1 = PARTITION - 0.03, PARTITION + 0.03
    top = CEILING - 0.002
    bars, panes, film = [], [], []
    zs = [BACK + 0.014, *_POSTS[1:-1], FRONT - 0.014]
    bars.append(box([x0, top - 0.05, zs[0]], [x1, top, zs[-1]]))
    for i, z in enumerate(zs):
        a, b = (z, z + 0.05) if i == 0 else (z - 0.05, z) if i == len(zs) - 1 else (z - 0.025, z + 0.025)
        bars.append(box([x0, FLOOR + GAP, a], [x1, top - 0.05 - GAP, b]))
    for i in range(len(zs) - 1):
        a = zs[i] + (0.05 if i == 0 else 0.025) + GAP
        b = zs[i + 1] - (0.05 if i == len(zs) - 2 else 0.025) - GAP
        low = FLOOR + GAP
        if i == _DOOR_BAY:
            bars.append(box([x0 + 0.005, 2.10, a], [x1 - 0.005, 2.15, b]))
            rim = frame(0.004, b - a - 0.004, FLOOR + 0.008, 2.096, 0.07, -0.018, 0.018)
            leaf = move_parts([("frame", rim)], (PARTITION, 0, b), rotation("y", 90))
            handle = [
                tube([[PARTITION + s * 0.055, 0.9, b - 0.11], [PARTITION + s * 0.055, 1.3, b - 0.11]], 0.011, 14)
                for s in (-1, 1)
            ] + [
                tube(
                    [
                        [PARTITION + s * 0.019, y, b - 0.045],
                        [PARTITION + s * 0.045, y, b - 0.075],
                        [PARTITION + s * 0.055, y, b - 0.098],
                    ],
                    0.006,
                    8,
                )
                for s in (-1, 1)
                for y in (0.95, 1.25)
            ]
            bars += [leaf[0][1]]
            panes.append(_pane(a + 0.075, b - 0.075, 0.079, 2.025))
            panes.append(_pane(a, b, 2.151, top - 0.052))
        else:
            bars.append(box([x0 + 0.005, low, a], [x1 - 0.005, 0.07, b]))
            panes.append(_pane(a, b, 0.071, top - 0.052))
            handle = []
        for y in (1.02, 1.10, 1.46, 1.54):
            for z in np.arange(a + 0.14, b - 0.17, 0.10):
                film.append(box([PARTITION - 0.0022, y, z], [PARTITION - 0.0012, y + 0.05, z + 0.05]))
        if handle:
            bars_metal = merge(handle)
    return [
        Piece(
            "partition", [("frame", merge(bars)), ("metal", bars_metal), ("film", merge(film)), ("glass", merge(panes))]
        )
    ]


def _pane(z0: float, z1: float, y0: float, y1: float) -> Mesh:
    return quad([PARTITION, y1, z1], [0, 0, z0 - z1], [0, y0 - y1, 0])


def panel(column: int, row: int) -> tuple[Parts, Mesh]:
    """A ceiling lamp in the place of a tile: its housing, and its shining face, which nothing reaches below."""
    x, z = LEFT + TILE * column, BACK + TILE * row
    y = CEILING - 0.014
    housing = box([x + 0.004, y, z + 0.004], [x + TILE - 0.004, CEILING - GAP, z + TILE - 0.004])
    face = ceiling((x + 0.016, z + 0.016), (x + TILE - 0.016, z + TILE - 0.016), y - GAP)
    return [("paint", housing)], face
