"""Where everything in the workshop stands and hangs, for a seed. World frame, metres, y up."""

from __future__ import annotations

import numpy as np

from scenes.kit.pieces import Piece
from scenes.kit.shapes import Mesh, Parts, box, move_parts, rotation
from scenes.workshop import benches as be
from scenes.workshop import hall, services
from scenes.workshop import storage as st
from scenes.workshop.machines import MACHINES
from scenes.workshop.solids import GAP

BAYS_X = (-8.0, -4.0, 0.0, 4.0, 8.0)  # middles between the columns
BACK = 5.93  # |z| of the backs of what stands along the long walls
ISLANDS_X = (-7.7, -4.7, -1.7, 1.3, 4.3, 7.2)
ISLAND_Z = 3.1
ISLAND = (1.35, 0.95)  # half an island's length and width
LAMPS_X, LAMP_Z, LAMP_Y = (-8.0, -4.0, 0.0, 4.0, 8.0), 2.5, 4.16
_LONGEST_DROP = 0.5


def things(seed: int) -> list[Piece]:
    """Everything that could be carried out of the hall; `on` is "building" where it hangs on a wall or the roof."""
    rng = np.random.default_rng([seed, 2])
    return [*_islands(rng), *_along_walls(rng), *_end_wall(rng), *_on_walls(rng)]


def bays() -> list[tuple[float, float, float, float]]:
    """Outlines (x0, x1, z0, z1) that are painted round the islands."""
    out = []
    for side in (-1, 1):
        z0, z1 = sorted((side * (ISLAND_Z - ISLAND[1]), side * (ISLAND_Z + ISLAND[1])))
        out += [(x - ISLAND[0], x + ISLAND[0], z0, z1) for x in ISLANDS_X]
    return out


def lamps(seed: int) -> tuple[Parts, list[tuple[Mesh, float]]]:
    """Lamps on their cords, and their luminous discs, each with its share of the light (a few are off or weak)."""
    rng = np.random.default_rng([seed, 3])
    parts: Parts = []
    discs = []
    for x in LAMPS_X:
        for z in (-LAMP_Z, LAMP_Z):
            housing, disc = hall.hung_lamp(x, LAMP_Y, z, 0.24)
            parts += housing
            discs.append((disc, float(rng.uniform(0.75, 1.15))))
    return parts, discs


def crane(seed: int) -> Parts:
    """The crane where it was left."""
    rng = np.random.default_rng([seed, 4])
    near = [x for x in np.arange(-8.0, 8.1, 0.5).tolist() if min(abs(x - c) for c in hall.COLUMNS) > 0.0]
    x = float(rng.choice(near))
    return hall.crane(x, float(rng.uniform(-1.0, 1.0)), float(rng.uniform(0.2, _LONGEST_DROP)))


def _machine_paint(rng: np.random.Generator) -> str:
    return f"machine_{'abc'[int(rng.integers(3))]}"


def _islands(rng: np.random.Generator) -> list[Piece]:
    """Two rows of six islands: machine tools, a bench, pallets."""
    kinds = [
        "lathe", "lathe", "mill", "mill", "drill grinder", "saw pallet", "press drum", "drill drill", "bench", "lathe",
        "pallet pallet", "saw grinder",
    ]  # fmt: skip
    places = [(x, side) for side in (-1, 1) for x in ISLANDS_X]
    out = []
    for (x, side), i in zip(places, rng.permutation(len(kinds)).tolist(), strict=True):
        words = kinds[i].split()
        facing = 0 if (side < 0) == (rng.uniform() < 0.7) else 180  # most face the walkway
        front = 1.0 if facing == 0 else -1.0
        for k, word in enumerate(words):
            at = x + (0.0 if len(words) == 1 else (-0.66, 0.66)[k] + float(rng.uniform(-0.05, 0.05)))
            name = f"{word} at {x:g} {side}" + ("" if k == 0 else " beside")
            turn, shift = facing + float(rng.uniform(-3, 3)), float(rng.uniform(-0.05, 0.05))
            z = side * ISLAND_Z
            if word in MACHINES:
                z -= 0.22 * front
                parts = MACHINES[word](_machine_paint(rng))
                long = word == "lathe"
                half = 0.75 if long else 0.45
                mat = box([-half, 0.001, 0.0], [half, 0.013, 0.42])
                placed = move_parts([("mat", mat)], (at, 0, z + front * 0.56), rotation("y", facing))
                out.append(Piece(f"mat of {name}", placed))
            elif word == "bench":
                out += _bench(name, at, z, facing, rng)
                continue
            elif word == "pallet":
                parts, turn = st.loaded_pallet(rng), float(rng.choice([90, 270])) + float(rng.uniform(-3, 3))
            else:
                parts = st.drum(("drum_a", "drum_b")[int(rng.integers(2))])
            out.append(Piece(name, move_parts(parts, (at, GAP, z + shift), rotation("y", turn))))
    return out


def _bench(name: str, x: float, z: float, facing: float, rng: np.random.Generator) -> list[Piece]:
    """A workbench with its vice and what lies on it; (x, z): its middle."""
    turn = rotation("y", facing)
    left = bool(rng.integers(2))
    width = 2.0

    def put(what: str, parts: Parts, along: float, across: float, degrees: float, level: float = be.BENCH_TOP) -> Piece:
        local = move_parts(parts, (along, level + 2 * GAP, across), rotation("y", degrees))
        return Piece(f"{what} on {name}", move_parts(local, (x, 0, z), turn))

    out = [Piece(name, move_parts(be.workbench(width, "drawer", left), (x, GAP, z), turn))]
    end = 0.80 if left else -0.80
    out.append(put("vice", be.vice(_machine_paint(rng)), end, 0.18, 0.0))
    slots = np.linspace(-0.84, 0.84, 7)
    slots = slots[np.abs(slots - end) > 0.2]
    for k, along in enumerate(slots.tolist()):
        back, kind = -0.20, int(rng.integers(5))
        degrees = float(rng.uniform(-20, 20))
        if kind == 0:
            tin = be.tin(float(rng.uniform(0.04, 0.07)), float(rng.uniform(0.1, 0.18)), f"tin_{'abc'[k % 3]}")
            out.append(put(f"tin {k}", tin, along, back, degrees))
        elif kind == 1:
            paint = st.PLASTICS[int(rng.integers(3))]
            out.append(put(f"crate {k}", st.crate(0.20, 0.12, 0.22, paint), along, back, 0.2 * degrees))
        elif kind == 2:
            size = tuple(float(v) for v in rng.uniform(0.06, 0.15, 3))
            block = be.block((size[0], size[1], size[2]), ("raw_steel", "bench_wood", "rust")[int(rng.integers(3))])
            out.append(put(f"block {k}", block, along, back, degrees))
        elif kind == 3:
            carton = st.carton(0.19, float(rng.uniform(0.08, 0.2)), 0.18, int(rng.integers(16)))
            out.append(put(f"carton {k}", carton, along, back, 0.5 * degrees))
        if rng.uniform() < 0.75:
            tool = be.TOOLS[int(rng.integers(len(be.TOOLS)))](float(rng.uniform(0.8, 1.0)))
            lying = 90 + 0.5 * degrees + (0 if rng.uniform() < 0.5 else 180)
            out.append(put(f"tool {k}", tool, along, 0.14, lying))
    box_ = be.tool_box(("crate_red", "crate_blue")[int(rng.integers(2))])
    out.append(put("tool box", box_, 0.42 if left else -0.42, 0.0, float(rng.uniform(-15, 15)), 0.18 + GAP))
    return out


def _along_walls(rng: np.random.Generator) -> list[Piece]:
    """What stands in the ten bays between the columns: benches under their tool boards, racks, lockers, stock."""
    kinds = ["bench", "bench", "bench", "bench", "racks", "racks", "racks", "lockers", "bars", "pallets"]
    places = [(x, side) for side in (-1, 1) for x in BAYS_X]
    out: list[Piece] = []
    for (x, side), i in zip(places, rng.permutation(len(kinds)).tolist(), strict=True):
        out += _bay(kinds[i], x, side, rng)
    return out


def _bay(kind: str, x: float, side: int, rng: np.random.Generator) -> list[Piece]:
    """What stands in the bay about x at the wall z = side * WIDE."""
    facing, name = 0 if side < 0 else 180, f"{kind} at wall {x:g} {side}"
    flip, jitter = -1.0 if rng.uniform() < 0.5 else 1.0, float(rng.uniform(-0.06, 0.06))
    out: list[Piece] = []

    def stand(what: str, parts: Parts, along: float, half_depth: float, degrees: float = 0.0) -> None:
        where = (x + flip * along, GAP, side * (BACK - half_depth))
        out.append(Piece(f"{what} of {name}", move_parts(parts, where, rotation("y", facing + degrees))))

    if kind == "bench":
        middle = x + flip * (0.55 + jitter)
        out += _bench(name, middle, side * (BACK - 0.37), facing, rng)
        wall = (middle, 1.56, side * (hall.WIDE - GAP))
        board = be.tool_board(1.9, 0.88, rng)
        out.append(Piece(f"board of {name}", move_parts(board, wall, rotation("y", facing)), "building"))
        other = int(rng.integers(4))
        if other == 0:
            stand("locker", st.locker("locker"), -1.15, 0.24)
        elif other == 1:
            stand("drum", st.drum("drum_a"), -0.90, 0.32)
            stand("drum b", st.drum("drum_b"), -1.52, 0.33)
        elif other == 2:
            stand("rack", st.rack(0.9, "rack", rng), -1.17, 0.34)
        else:
            stand("bin", st.waste_bin("drum_b"), -0.85, 0.28)
            stand("gas cart", st.gas_cart(), -1.42, 0.36)
    elif kind == "racks":
        stand("rack a", st.rack(1.6, "rack", rng), -0.84, 0.34)
        stand("rack b", st.rack(1.6, "rack", rng), 0.84, 0.34)
    elif kind == "lockers":
        for k, along in enumerate((-1.2, -0.29, 0.62)):
            stand(f"locker {k}", st.locker("locker"), along, 0.24)
        stand("bin", st.waste_bin("drum_a"), 1.42, 0.28)
    elif kind == "bars":
        stand("bar rack", st.bar_rack(rng), -0.3 + jitter, 0.34)
        stand("gas cart", st.gas_cart(), 1.35, 0.36)
    else:
        stand("pallet a", st.loaded_pallet(rng), -0.85, 0.45, float(rng.uniform(-3, 3)))
        stand("pallet b", st.loaded_pallet(rng), 0.70, 0.45, float(rng.uniform(-3, 3)))
    return out


def _end_wall(rng: np.random.Generator) -> list[Piece]:
    """Switch cabinets, a notice board and a few things at the wall x = -LONG; pallets and drums beside the door."""
    turn, wall = rotation("y", 90), -hall.LONG
    out = [
        Piece(f"cabinet {k}", move_parts(services.cabinet(2 + k), (wall + GAP, GAP, 1.6 + 0.85 * k), turn))
        for k in range(2)
    ]
    out.append(Piece("notice board", move_parts(services.notice_board(rng), (wall, 1.65, -0.2), turn), "building"))
    out.append(Piece("wall rack", move_parts(st.rack(1.6, "rack", rng), (wall + 0.38, GAP, -2.6), turn)))
    for k, z in enumerate((-4.0, -4.75)):
        if rng.uniform() < 0.8:
            out.append(Piece(f"drum at end {k}", move_parts(st.drum(f"drum_{'ab'[k]}"), (wall + 0.42, GAP, z))))
    turn, wall = rotation("y", -90), hall.LONG
    out.append(Piece("door bin", move_parts(st.waste_bin("drum_b"), (wall - 0.36, GAP, 2.2), turn)))
    for k, (z, index) in enumerate(((2.0, 5), (2.5, 8), (4.6, 3), (4.6, 4), (-3.3, 1), (-3.8, 0))):
        high = 1.75 if k != 3 else 1.32
        out.append(Piece(f"door sign {k}", move_parts(services.sign(index, 0.40), (wall, high, z), turn), "building"))
    return out


def _on_walls(rng: np.random.Generator) -> list[Piece]:
    out = [Piece(name, parts, "building") for name, parts in services.on_columns(rng)]
    for side in (-1, 1):
        turn = rotation("y", 0 if side < 0 else 180)
        out.append(Piece(f"pipes {side}", services.pipes(side), "building"))
        for i, c in enumerate(hall.COLUMNS):
            at = (c + 0.0, 0.0, side * (hall.WIDE - GAP))
            out.append(Piece(f"switch box {side} {i}", move_parts(services.switch_box(rng), at, turn), "building"))
    return out
