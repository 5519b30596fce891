"""What a workshop keeps things in: racks, crates, pallets, drums, lockers, bar stock; about the origin, on y = 0."""

from __future__ import annotations

import numpy as np

from scenes.kit.shapes import Mesh, Parts, atlas_uv, box, merge, move_parts, rounded_box, shift_uv, tube
from scenes.workshop.drawings import label_rect
from scenes.workshop.solids import GAP, beam, ring, rod, turned

RACK_LEVELS = (0.12, 0.72, 1.26, 1.80)
BOARD = 0.03
PLASTICS = ("crate_red", "crate_blue", "crate_grey")


def crate(width: float, height: float, depth: float, paint: str) -> Parts:
    """Open storage crate with a rim and a label in front (+z)."""
    w, d, t = width / 2, depth / 2, 0.006
    walls = [
        box([-w, 0.0, -d], [w, t, d]),
        box([-w, t + GAP / 4, -d], [-w + t, height, d]),
        box([w - t, t + GAP / 4, -d], [w, height, d]),
        box([-w + t + GAP / 4, t + GAP / 4, -d], [w - t - GAP / 4, height, -d + t]),
        box([-w + t + GAP / 4, t + GAP / 4, d - t], [w - t - GAP / 4, height, d]),
    ]
    e = 0.012
    rim = [
        box([-w - e, height - 0.03, d + GAP / 2], [w + e, height - 0.004, d + e]),
        box([-w - e, height - 0.03, -d - e], [w + e, height - 0.004, -d - GAP / 2]),
        box([-w - e, height - 0.03, -d], [-w - GAP / 2, height - 0.004, d]),
        box([w + GAP / 2, height - 0.03, -d], [w + e, height - 0.004, d]),
    ]
    return [(paint, merge([*walls, *rim]))]


def carton(width: float, height: float, depth: float, index: int) -> Parts:
    """Closed cardboard box with tape over its top and a printed label in front."""
    w, d = width / 2, depth / 2
    label = box([-0.3 * width, 0.25 * height, d + GAP / 4], [0.3 * width, 0.75 * height, d + GAP])
    tape = box([-w, height + GAP / 4, -0.03], [w, height + GAP, 0.03])
    card = shift_uv(box([-w, 0, -d], [w, height, d]), 0.37 * index, 0.23 * index)
    return [("card", card), ("label", atlas_uv(label, label_rect(index))), ("tape", tape)]


def _filled(width: float, height: float, depth: float, rng: np.random.Generator) -> Parts:
    """A crate with stock in it: rods, blocks or coils."""
    paint = PLASTICS[int(rng.integers(3))]
    parts = crate(width, height, depth, paint)
    kind = int(rng.integers(3))
    inside = width / 2 - 0.03
    if kind == 0:
        rods = [
            rod("z", (float(x), 0.008 + 0.014, -depth / 2 + 0.012), depth - 0.03, 0.013, 12)
            for x in np.arange(-inside, inside, 0.029)
        ]
        parts.append(("bright", merge(rods)))
    elif kind == 1:
        edges = np.arange(-inside, inside - 0.05, 0.075)
        blocks = [
            box([x, 0.007, -0.3 * depth], [x + 0.06, float(rng.uniform(0.5, 1.1)) * height, 0.3 * depth])
            for x in edges.tolist()
        ]
        parts.append(("raw_steel", merge(blocks)))
    else:
        r = min(inside, depth / 2 - 0.03) - 0.012
        parts.append(("cable", merge([ring("y", (0, 0.02 + 0.024 * k, 0), r, 0.0115, 28) for k in range(3)])))
    return parts


def rack(width: float, paint: str, rng: np.random.Generator) -> Parts:
    """Shelving of four levels, 0.6 m deep and 2.35 m high, its shelves filled with crates, cartons and tins."""
    w, d, top = width / 2, 0.30, 2.35
    posts = [box([s * w - 0.02, 0, t * d - 0.02], [s * w + 0.02, top, t * d + 0.02]) for s in (-1, 1) for t in (-1, 1)]
    boards = [box([-w + 0.021, y, -d], [w - 0.021, y + BOARD, d]) for y in RACK_LEVELS]
    braces = [
        beam((s * w, 0.2, -d + 0.0215), (s * w, 1.1, d - 0.0215), 0.004, 0.03)
        for s in (-1, 1)
    ]  # fmt: skip
    lips = [
        box([-w + 0.021, y - 0.05, t * (d + 0.0045) - 0.003], [w - 0.021, y - GAP, t * (d + 0.0045) + 0.003])
        for y in RACK_LEVELS
        for t in (-1, 1)
    ]
    parts: Parts = [(paint, merge([*posts, *braces])), ("rack_board", merge(boards)), ("rack_lip", merge(lips))]
    for level, y in enumerate(RACK_LEVELS):
        x = -w + 0.05
        while True:
            step = float(rng.choice([0.33, 0.42, 0.50]))
            if x + step > w - 0.04:
                break
            high = float(rng.uniform(0.17, 0.38))
            at = (x + step / 2, y + BOARD + GAP, float(rng.uniform(-0.01, 0.03)))
            kind = int(rng.integers(5))
            if kind <= 1:
                parts += move_parts(_filled(step - 0.05, min(high, 0.24), 0.46, rng), at)
            elif kind <= 3:
                parts += move_parts(carton(step - 0.06, high, 0.42, int(rng.integers(16))), at)
            else:
                for k in range(3):
                    name = ("tin_a", "tin_b", "tin_c")[(k + level) % 3]
                    tin = turned("y", (0, 0, 0), [[0, 0], [0.05, 0], [0.05, 0.15], [0.043, 0.16], [0, 0.16]], 28)
                    parts += move_parts([(name, tin)], (x + 0.07 + 0.105 * k, at[1], 0.12 - 0.11 * (k % 2)))
            x += step
    return parts


def locker(paint: str) -> Parts:
    """Double steel locker of 0.9 x 0.45 x 1.85 m with vents and handles, doors towards +z."""
    body = rounded_box([-0.45, 0.0, -0.225], [0.45, 1.85, 0.205], 0.008, 4, edge=2)
    doors, vents = [], []
    for s in (-1, 1):
        lo, hi = sorted((0.005 * s, 0.435 * s))
        doors.append(rounded_box([lo, 0.08, 0.206], [hi, 1.82, 0.224], 0.004, 3, edge=2))
        for k in range(6):
            y = 1.58 + 0.03 * k
            vents.append(box([lo + 0.12, y, 0.2245], [hi - 0.12, y + 0.008, 0.228]))
    handles = [box([s * 0.05 - 0.008, 0.90, 0.2245], [s * 0.05 + 0.008, 1.04, 0.245]) for s in (-1, 1)]
    return [(paint, body), ("trim", merge(doors)), ("cast", merge(vents)), ("bright", merge(handles))]


def pallet() -> Parts:
    """Euro pallet of 1.2 x 0.144 x 0.8 m on y = 0."""
    boards = []
    for z in (-0.35, 0.0, 0.35):
        half = 0.0725 if z == 0.0 else 0.05
        boards.append(box([-0.6, 0.0, z - half], [0.6, 0.022, z + half]))
        for x in (-0.5275, 0.0, 0.5275):
            boards.append(box([x - 0.0725, 0.0222, z - half], [x + 0.0725, 0.0998, z + half]))
    for x in (-0.5275, 0.0, 0.5275):
        boards.append(box([x - 0.0725, 0.1, -0.4], [x + 0.0725, 0.1218, 0.4]))
    for z, half in ((-0.3275, 0.0725), (-0.165, 0.05), (0.0, 0.0725), (0.165, 0.05), (0.3275, 0.0725)):
        boards.append(box([-0.6, 0.122, z - half], [0.6, 0.144, z + half]))
    return [("pallet", merge([shift_uv(b, 0.31 * k, 0.17 * k) for k, b in enumerate(boards)]))]


PALLET_TOP = 0.144


def loaded_pallet(rng: np.random.Generator) -> Parts:
    """A pallet with cartons, crates, sections of steel, or empty under two more pallets."""
    parts, y = pallet(), PALLET_TOP + GAP
    kind = int(rng.integers(4))
    if kind == 0:
        for layer in range(int(rng.integers(2, 4))):
            for x in (-0.4, 0.0, 0.4):
                for z in (-0.19, 0.19):
                    box_ = carton(0.385, 0.28, 0.365, int(rng.integers(16)))
                    parts += move_parts(box_, (x, y + 0.282 * layer, z))
    elif kind == 1:
        for x in (-0.3, 0.3):
            for z in (-0.2, 0.2):
                if rng.uniform() < 0.85:
                    parts += move_parts(_filled(0.54, 0.26, 0.34, rng), (x, y, z))
    elif kind == 2:
        battens = [box([x - 0.04, y, -0.36], [x + 0.04, y + 0.06, 0.36]) for x in (-0.45, 0.45)]
        parts.append(("pallet", merge(battens)))
        bars = []
        for k, z in enumerate(np.arange(-0.32, 0.30, 0.075).tolist()):
            half = 0.030 + 0.006 * (k % 2)
            bars.append(box([-0.58 + 0.02 * (k % 3), y + 0.061, z - half], [0.57, y + 0.061 + 2 * half, z + half]))
        parts.append(("raw_steel", merge(bars)))
    else:
        for layer in range(1, int(rng.integers(3, 7))):
            parts += move_parts(pallet(), (0.008 * (layer % 2), layer * (PALLET_TOP + GAP), 0.006 * (layer % 3)))
    return parts


def drum(paint: str) -> Parts:
    """Steel drum of 200 litres, 0.88 m."""
    r = 0.286
    profile = [[0, 0.01], [r - 0.012, 0.01], [r - 0.01, 0], [r, 0], [r, 0.28]]
    for y in (0.29, 0.58):
        profile += [[r, y], [r + 0.012, y + 0.012], [r, y + 0.024]]
    profile += [[r, 0.88], [r - 0.01, 0.88], [r - 0.012, 0.862], [0, 0.862]]
    bung = rod("y", (0.18, 0.8625, 0.05), 0.018, 0.035, 20)
    return [(paint, turned("y", (0, 0, 0), profile, 48)), ("cast", bung)]


def gas_cart() -> Parts:
    """Trolley with an oxygen and an acetylene bottle, regulators and hoses."""
    parts: Parts = []
    for x, name, high in ((-0.13, "gas_blue", 1.30), (0.13, "gas_maroon", 1.12)):
        t = np.linspace(0, np.pi / 2, 7)
        dome = np.stack([0.035 + 0.08 * np.cos(t), high + 0.11 * np.sin(t)], 1).tolist()
        profile = [[0, 0], [0.115, 0], *dome, [0.028, high + 0.17], [0, high + 0.17]]
        parts.append((name, turned("y", (x, 0.061, 0), profile, 36)))
        valve = [rod("y", (x, high + 0.232, 0), 0.05, 0.012, 12), rod("z", (x, high + 0.255, 0.013), 0.07, 0.012, 12)]
        gauge = [rod("z", (x + s * 0.045, high + 0.262, 0.05), 0.025, 0.028, 20) for s in (-1, 1)]
        parts += [("bright", merge(valve)), ("stone", merge(gauge))]
        hose = tube(
            [[x, high + 0.25, 0.084], [x, high, 0.17], [1.5 * x, 0.7, 0.22], [1.2 * x, 0.3, 0.2], [0.0, 0.1, 0.23]],
            0.008,
            8,
        )
        parts.append((("hose_blue", "hose_red")[x > 0], hose))
    frame = [
        box([-0.28, 0.03, -0.16], [0.28, 0.06, 0.26]),
        tube([[-0.2, 0.061, -0.15], [-0.2, 1.1, -0.15], [-0.2, 1.2, -0.26]], 0.014, 12),
        tube([[0.2, 0.061, -0.15], [0.2, 1.1, -0.15], [0.2, 1.2, -0.26]], 0.014, 12),
        rod("x", (-0.185, 0.7, -0.15), 0.37, 0.012, 12),
        box([-0.27, 0.8, 0.117], [0.27, 0.83, 0.121]),
    ]
    wheels = [rod("x", (x, 0.11, -0.19), 0.05, 0.11, 32) for x in (-0.34, 0.29)]
    feet = [rod("y", (x, 0.0, 0.22), 0.0295, 0.02, 12) for x in (-0.22, 0.22)]
    return [*parts, ("frame", merge(frame)), ("rubber", merge([*wheels, *feet]))]


def bar_rack(rng: np.random.Generator) -> Parts:
    """Cantilever rack of 1.9 m with tubes, bars and angles of steel on five pairs of arms towards +z."""
    frame = []
    for x in (-0.7, 0.7):
        frame.append(box([x - 0.05, 0.0, -0.30], [x + 0.05, 0.06, 0.30]))
        frame.append(box([x - 0.05, 0.061, -0.30], [x + 0.05, 1.90, -0.20]))
        frame += [box([x - 0.03, 0.35 + 0.36 * k, -0.199], [x + 0.03, 0.39 + 0.36 * k, 0.22]) for k in range(5)]
    frame.append(box([-0.649, 1.2, -0.27], [0.649, 1.28, -0.25]))
    stock: list[Mesh] = []
    red: list[Mesh] = []
    for k in range(5):
        z = -0.17
        while z < 0.17:
            r = float(rng.uniform(0.012, 0.030))
            start, end = -1.1 + float(rng.uniform(0, 0.25)), 1.1 - float(rng.uniform(0, 0.25))
            level = 0.39 + 0.36 * k + GAP
            if rng.uniform() < 0.6:
                piece = rod("x", (start, level + r, z + r), end - start, r, 14)
            else:
                piece = box([start, level, z], [end, level + 1.4 * r, z + 2 * r])
            (stock if rng.uniform() < 0.7 else red).append(piece)
            z += 2 * r + float(rng.uniform(0.004, 0.03))
    parts: Parts = [("frame", merge(frame)), ("raw_steel", merge(stock))]
    return [*parts, ("rust", merge(red))] if red else parts


def waste_bin(paint: str) -> Parts:
    """Round waste bin of 0.65 m, open."""
    outer = [[0.0, 0.0], [0.20, 0.0], [0.23, 0.62], [0.24, 0.63], [0.24, 0.65], [0.225, 0.65]]
    return [(paint, turned("y", (0, 0, 0), [*outer, [0.19, 0.02], [0.0, 0.02]], 40))]
