"""Where everything in the room stands and hangs. World frame, metres, y up."""

from __future__ import annotations

import numpy as np

from scenes.kit.pieces import Piece
from scenes.kit.plants import bowl, mug, palm, vase
from scenes.kit.shapes import Mesh, Parts, move, move_parts, rotation
from scenes.living_room import furniture as fu
from scenes.living_room.decor import RUG, basket, fruit_bowl, picture, rug, wall_clock
from scenes.living_room.room import BACK, FLOOR, FRONT, GAP, LEFT, RIGHT

ON_FLOOR = FLOOR + GAP


def furnishing() -> tuple[list[Piece], list[Mesh]]:
    """Everything that could be carried out of the room, placed; and the glowing lamp shades."""
    y, r = ON_FLOOR, rotation
    on_rug = FLOOR + RUG + 2 * GAP
    back, right, front = r("y", 0), r("y", -90), r("y", 180)
    pieces: list[Piece] = []

    def put(name: str, parts: Parts, x: float, height: float, z: float, turn: np.ndarray = back) -> None:
        pieces.append(Piece(name, move_parts(parts, (x, height, z), turn)))

    put(
        "sofa",
        fu.sofa("sofa_a", 2.50, 1.03, [("pillow_a", 0.75, 0.42), ("pillow_b", 0.45, 0.40)], backs=2),
        -0.35,
        y,
        BACK + 0.02,
    )
    put("folded blanket", fu.folded_blanket(0.42, 0.34), -1.10, y + 0.516, BACK + 0.62, r("y", 12))
    put(
        "sofa",
        fu.sofa("sofa_b", 2.25, 1.03, [("pillow_c", -0.72, 0.40), ("pillow_a", 0.66, 0.43), ("pillow_b", 0.35, 0.40)]),
        RIGHT - 0.04,
        y,
        0.62,
        right,
    )
    put("throw blanket", fu.throw_blanket(0.5), -0.35 + 1.25 - 0.105, y, BACK + 0.36)
    put("rug", rug(1.95, 2.75), -0.10, y, 0.68)
    put("low table", fu.low_table(0.70, 1.15, 0.54 - on_rug), 0.50, on_rug, 0.72)
    put("armchair", fu.armchair(), 0.35, y, 2.42, r("y", 158))
    put("bookshelf", fu.bookshelf(0.98, 0.30, 1.86), 1.78, y, BACK + 0.03)
    put("sideboard", fu.sideboard(1.40, 0.42, 0.74), 1.05, y, FRONT - 0.03, front)
    put("round table", fu.round_table(0.24, 0.52), 2.12, y, 2.06)
    for i, (x0, x1, level) in enumerate(
        ((-0.45, 0.44, 0), (-0.45, 0.1, 1), (-0.45, 0.43, 2), (-0.14, 0.45, 3), (-0.45, 0.2, 4))
    ):
        put(
            "book row", fu.book_row(x0, x1, 0.27, 800 + i, 0.285), 1.78, y + fu.SHELF_BOARDS[level] + 0.025, BACK + 0.03
        )
    shelf_y = [y + b + 0.025 for b in fu.SHELF_BOARDS]
    put("vase", [("glaze_blue", vase(0.8))], 2.06, shelf_y[1], BACK + 0.19)
    put("bowl", [("glaze_white", bowl(0.11))], 1.50, shelf_y[3], BACK + 0.19)
    put("vase", [("glaze_white", vase(0.9))], 2.10, shelf_y[4], BACK + 0.18)
    put(
        "book pile",
        fu.book_pile([(0.03, 0.24, 0.18), (0.02, 0.22, 0.17), (0.035, 0.2, 0.15)], 41),
        1.62,
        y + 1.893,
        BACK + 0.18,
    )
    top = 0.54 + GAP
    put("fruit bowl", fruit_bowl(), 0.50, top, 0.62)
    put(
        "book pile",
        fu.book_pile([(0.028, 0.29, 0.21), (0.022, 0.26, 0.2), (0.03, 0.22, 0.16)], 42),
        0.42,
        top,
        1.08,
        r("y", 70),
    )
    put("mug", [("glaze_white", mug())], 0.68, top, 0.90, r("y", 40))
    put("mug", [("glaze_blue", mug())], 0.30, top, 0.30, r("y", 200))
    put("vase", [("glaze_white", vase(0.7))], 0.62, top, 0.27)
    put(
        "book pile",
        fu.book_pile([(0.02, 0.28, 0.2), (0.024, 0.25, 0.19), (0.02, 0.25, 0.19), (0.03, 0.2, 0.14)], 43),
        0.5,
        on_rug + 0.141,
        0.9,
    )
    board = y + 0.742
    put("vase", [("glaze_blue", vase(1.15))], 1.55, board, 2.76)
    put("book pile", fu.book_pile([(0.03, 0.27, 0.2), (0.02, 0.24, 0.18)], 44), 0.70, board, 2.78)
    put("bowl", [("glaze_white", bowl(0.13))], 1.10, board, 2.78)
    put("book pile", fu.book_pile([(0.025, 0.22, 0.16), (0.02, 0.2, 0.14)], 45), 2.16, y + 0.522, 2.12)
    put("mug", [("glaze_white", mug())], 2.02, y + 0.522, 1.98, r("y", 120))
    put("basket", basket(), -2.10, y, 2.66)
    put("basket", basket(), 0.05, y, 2.72)
    put("palm", palm(9, -2.13 - LEFT - 0.02, PALM_FRONDS), -2.13, y, -0.55)
    hang(pieces)
    shades = []
    for x, z in ((2.035, 2.608), (-2.089, -1.513)):
        stand, shade = fu.foot_lamp(1.56 - y)
        put("foot lamp", stand, x, y, z)
        shades.append(move(shade, (x, y, z)))
    return pieces, shades


PALM_FRONDS = [  # kept below and beside kt3's path, which passes 0.4 m from the crown
    (0, 0.50, 0.95, 0.30),
    (60, 0.55, 0.9, 0.42),
    (105, 0.62, 0.8, 0.60),
    (140, 0.36, 0.7, 0.62),
    (-60, 0.52, 0.9, 0.42),
    (-100, 0.60, 0.8, 0.70),
    (-125, 0.34, 0.5, 1.10),
    (-80, 0.34, 0.6, 0.66),
    (-35, 0.50, 0.9, 0.34),
    (30, 0.52, 0.9, 0.36),
]


def hang(pieces: list[Piece]) -> None:
    """Adds what hangs on the walls."""
    walls = {  # turn, and a function from (position along the wall, height) to a point
        "back": (rotation("y", 0), lambda s, h: (s, h, BACK + GAP)),
        "front": (rotation("y", 180), lambda s, h: (s, h, FRONT - GAP)),
        "left": (rotation("y", 90), lambda s, h: (LEFT + GAP, h, s)),
        "right": (rotation("y", -90), lambda s, h: (RIGHT - GAP, h, s)),
    }
    pictures = [
        ("back", -0.95, 1.72, 0, 0.85, 0.62, "walnut"),
        ("back", -0.16, 1.80, 2, 0.42, 0.55, "oak"),
        ("back", 0.42, 1.66, 4, 0.50, 0.50, "walnut"),
        ("back", 0.92, 1.86, 5, 0.34, 0.44, "oak"),
        ("back", -1.78, 1.55, 1, 0.40, 0.52, "oak"),
        ("right", 0.25, 1.72, 3, 0.95, 0.66, "walnut"),
        ("right", 1.10, 1.82, 2, 0.40, 0.52, "oak"),
        ("right", 1.66, 1.55, 1, 0.46, 0.60, "walnut"),
        ("right", -0.62, 1.78, 5, 0.42, 0.56, "oak"),
        ("left", 0.62, 1.62, 6, 0.80, 0.56, "oak"),
        ("left", -1.30, 1.70, 7, 0.50, 0.64, "walnut"),
        ("left", -0.50, 1.92, 4, 0.44, 0.44, "oak"),
        ("front", 1.12, 1.55, 7, 0.95, 0.70, "oak"),
        ("front", 1.85, 1.75, 5, 0.32, 0.42, "walnut"),
    ]
    for wall, s, h, index, width, height, frame in pictures:
        turn, at = walls[wall]
        pieces.append(Piece("picture", move_parts(picture(index, width, height, frame), at(s, h), turn)))
    turn, at = walls["right"]
    pieces.append(Piece("wall clock", move_parts(wall_clock(0.17), at(2.25, 1.80), turn)))
