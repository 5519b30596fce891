"""What hangs and stands in the corridor of a seed: boards with notices, radiators, lockers, bench, signs."""

from __future__ import annotations

import numpy as np

from scenes.corridor import room
from scenes.corridor.pictures import EXIT, FIRE, FLOOR_1, FLOOR_2, NOTICES, PLATES
from scenes.corridor.stairs import LANDING
from scenes.kit.fittings import bin_, board, cabinet, extinguisher, radiator, sign, switch
from scenes.kit.pieces import Piece, draw, stand
from scenes.kit.prints import atlas_rect
from scenes.kit.shapes import Mesh, Parts, atlas_uv, box, merge, move_parts, quad, rotation, superellipsoid
from scenes.kit.walls import GAP

_PINS = ("red", "black")


def arrange(seed: int) -> list[Piece]:
    """Everything that could be unscrewed or carried away from the corridor of this seed."""
    rng = draw(seed, "arrangement")
    north, south = room.WALLS["north"], room.WALLS["south"]
    pieces: list[Piece] = []
    plates = [(north, o) for o in north.openings] + [(south, o) for o in south.openings]
    for k, (wall, o) in enumerate(plates):
        rect = atlas_rect(k, *PLATES)
        pieces.append(Piece(f"plate {k}", wall.hang(sign(0.20, 0.10, "plate", rect, "steel"), (o.x1 + 0.20, 1.55))))
    for k, x in enumerate((3.75, 7.25, 10.7)):
        wide = float(rng.choice([1.2, 1.5, 1.8]))
        at = (x + float(rng.uniform(-0.12, 0.12)), 1.55)
        pieces.append(Piece(f"board north {k}", north.hang(_notice_board(wide, 1.0, rng), at)))
    x0 = room.PORTAL
    for k, x in enumerate((2.0, 5.5, 9.0)):
        made = [("paint" if name == "paint" else "black", mesh) for name, mesh in radiator(1.1, 0.60, 20)]
        pieces.append(Piece(f"radiator {k}", south.hang(made, (x0 - x, room.FLOOR + GAP), 0.016)))
        if rng.uniform() < 0.75:
            at = (x0 - x + float(rng.uniform(-0.1, 0.1)), 1.62)
            pieces.append(Piece(f"board south {k}", south.hang(_notice_board(1.2, 0.9, rng), at)))
    if rng.uniform() < 0.5:
        pieces.append(
            Piece("lockers", south.hang(cabinet(1.20, 0.42, 1.80, 2, 4), (x0 - 12.6, room.FLOOR + GAP), 0.016))
        )
        pieces.append(Piece("bench", _bench(room.HALF - 0.03, 0.72)))
    else:
        pieces.append(Piece("bench", _bench(room.HALF - 0.03, 12.6)))
        pieces.append(Piece("board south 3", south.hang(_notice_board(1.5, 0.9, rng), (x0 - 12.6, 1.62))))
    pieces.append(stand("bin", bin_("steel"), 6.30 + float(rng.uniform(-0.1, 0.1)), room.FLOOR + GAP, room.HALF - 0.19))
    pieces.append(Piece("extinguisher", north.hang(extinguisher("red", "black", "steel"), (13.45, 0.75))))
    pieces.append(
        Piece("fire sign", north.hang(sign(0.24, 0.12, "plate", atlas_rect(FIRE, *PLATES), "steel"), (13.45, 1.75)))
    )
    face = move_parts(sign(0.40, 0.20, "plate", atlas_rect(EXIT, *PLATES), "steel"), r=rotation("y", -90))
    pieces.append(Piece("exit sign", move_parts(face, (room.PORTAL - 0.10 - GAP, 2.87, 0.0))))
    level = sign(0.5, 0.25, "plate", atlas_rect(FLOOR_1, *PLATES), "steel")
    pieces.append(Piece("level sign", room.WALLS["well south"].hang(level, (2.3, 1.9))))
    level = sign(0.44, 0.22, "plate", atlas_rect(FLOOR_2, *PLATES), "steel")
    pieces.append(Piece("landing sign", room.WALLS["end"].hang(level, (1.85, LANDING + 1.5))))
    pieces.append(Piece("well board", room.WALLS["well south"].hang(_notice_board(1.2, 0.9, rng), (0.95, 1.55))))
    for k, (wall, x) in enumerate(((north, 2.75), (south, x0 - 11.45))):
        pieces.append(Piece(f"switch {k}", wall.hang(switch("paint"), (x + 0.11, 1.10))))
    return pieces


def _bench(back: float, x: float) -> Parts:
    """Bench of slats on two trestles, its back edge at z = `back`, about x."""
    y = room.FLOOR + GAP
    slats = [
        box([x - 0.6, y + 0.42, back - 0.09 * (k + 1)], [x + 0.6, y + 0.445, back - 0.09 * k - 0.012]) for k in range(4)
    ]
    legs = []
    for q in (x - 0.45, x + 0.45):
        legs += [
            box([q - 0.02, y + 0.385, back - 0.35], [q + 0.02, y + 0.419, back - 0.012]),
            box([q - 0.02, y, back - 0.34], [q + 0.02, y + 0.384, back - 0.30]),
            box([q - 0.02, y, back - 0.06], [q + 0.02, y + 0.384, back - 0.02]),
        ]
    return [("bench", merge(slats)), ("steel", merge(legs))]


def _notice_board(width: float, height: float, rng: np.random.Generator) -> Parts:
    """Cork board with notices pinned in rows, a little askew, some places bare."""
    parts = board(width, height, "cork", "bench")
    sheets = []
    pins: dict[str, list[Mesh]] = {name: [] for name in _PINS}
    columns, rows = int((width - 0.1) / 0.27), 2
    for i in range(columns):
        for j in range(rows):
            if rng.uniform() < 0.18:
                continue
            w, h = (0.21, 0.297) if rng.uniform() < 0.8 else (0.148, 0.21)
            x = -width / 2 + 0.05 + (i + 0.5) * (width - 0.1) / columns + float(rng.uniform(-0.012, 0.012))
            y = (0.5 - j) * (height - 0.12) / rows + float(rng.uniform(-0.02, 0.02))
            cell = atlas_rect(int(rng.integers(NOTICES[0] * NOTICES[1])), *NOTICES)
            face = atlas_uv(quad([-w / 2, h / 2, 0.0], [w, 0, 0], [0, -h, 0]), cell)
            turned: Parts = move_parts([("notice", face)], (x, y, 0.0142), rotation("z", float(rng.normal(0, 2.0))))
            sheets.append(turned[0][1])
            pin = move_parts([("", superellipsoid([0.006, 0.006, 0.004], 1, 1, 12, 8))], (x, y + h / 2 - 0.015, 0.0185))
            pins[_PINS[int(rng.integers(2))]].append(pin[0][1])
    return [*parts, ("notice", merge(sheets)), *((name, merge(m)) for name, m in pins.items() if m)]
