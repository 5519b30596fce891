"""The room itself: shell, window, door, mouldings, beams, curtains, radiator, spots. World frame, metres, y up."""

from __future__ import annotations

import numpy as np

from scenes.kit.fittings import radiator
from scenes.kit.shapes import (
    Mesh,
    Parts,
    box,
    lathe,
    merge,
    move,
    move_parts,
    quad,
    rotation,
    rounded_box,
    shift_uv,
    slab,
    tube,
)

FLOOR, CEILING = 0.133, 2.632
LEFT, RIGHT = -2.425, 2.512
BACK, FRONT = -1.930, 3.000
PANE_Z = 3.09
WINDOW = (-2.22, -0.04, 0.18, 2.39)  # x0, x1, y0, y1
GAP = 0.001  # kept between things that touch, so that no two faces coincide

# x, y of the lit face, z, radiance. Positions are ICL-NUIM's four spots, and four more that light the middle evenly.
SPOTS = [
    (-0.223, 2.49, -1.649, 120.0),
    (2.254, 2.49, 0.802, 120.0),
    (0.010, 2.49, 0.802, 1250.0),
    (-2.161, 2.49, 0.801, 120.0),
    (-1.25, 2.49, -0.60, 1020.0),
    (1.25, 2.49, -0.60, 1020.0),
    (-1.25, 2.49, 2.00, 1020.0),
    (1.25, 2.49, 2.00, 1020.0),
]


def shell() -> Parts:
    """Inward facing, gap-free room: floor, ceiling, four walls, the window's reveal. The pane closes it."""
    w, h, d = RIGHT - LEFT, CEILING - FLOOR, FRONT - BACK
    x0, x1, y0, y1 = WINDOW
    xs, ys = [LEFT, x0, x1, RIGHT], [FLOOR, y0, y1, CEILING]
    front = []
    for i in range(3):
        for j in range(3):
            if (i, j) != (1, 1):  # seen from inside, u runs towards -x
                du, dv = [xs[i] - xs[i + 1], 0, 0], [0, ys[j] - ys[j + 1], 0]
                front.append(quad([xs[i + 1], ys[j + 1], FRONT], du, dv, (RIGHT - xs[i + 1], CEILING - ys[j + 1])))
    deep = PANE_Z - FRONT
    reveal = [
        quad([x0, y0, FRONT], [x1 - x0, 0, 0], [0, 0, deep]),
        quad([x0, y1, PANE_Z], [x1 - x0, 0, 0], [0, 0, -deep]),
        quad([x0, y1, FRONT], [0, 0, deep], [0, y0 - y1, 0]),
        quad([x1, y1, PANE_Z], [0, 0, -deep], [0, y0 - y1, 0]),
    ]
    return [
        ("floor", quad([LEFT, FLOOR, FRONT], [w, 0, 0], [0, 0, -d])),
        ("ceiling", quad([LEFT, CEILING, BACK], [w, 0, 0], [0, 0, d])),
        ("wall_back", quad([LEFT, CEILING, BACK], [w, 0, 0], [0, -h, 0])),
        ("wall_right", quad([RIGHT, CEILING, BACK], [0, 0, d], [0, -h, 0])),
        ("wall_left", quad([LEFT, CEILING, FRONT], [0, 0, -d], [0, -h, 0])),
        ("wall_front", merge(front)),
        ("paint", merge([flip_inside(q) for q in reveal])),
    ]


def flip_inside(q: Mesh) -> Mesh:
    """The rectangle turned so that it faces the window's middle."""
    middle = np.array([(WINDOW[0] + WINDOW[1]) / 2, (WINDOW[2] + WINDOW[3]) / 2, (FRONT + PANE_Z) / 2])
    inward = float((middle - q.v.mean(0)) @ q.n[0]) > 0
    return q if inward else Mesh(q.v, -q.n, q.uv, q.f[:, ::-1])


def pane() -> Mesh:
    """The luminous window pane, facing the room; its texture covers it once."""
    x0, x1, y0, y1 = WINDOW
    q = quad([x1, y1, PANE_Z], [x0 - x1, 0, 0], [0, y0 - y1, 0])
    return Mesh(q.v, q.n, q.uv / (x1 - x0, y1 - y0), q.f)


def window() -> Parts:
    """Frame, muntins and a sill-less casing of the French window, curtain pole."""
    x0, x1, y0, y1 = WINDOW
    z0, z1 = PANE_Z - 0.055, PANE_Z - 0.006
    e, bars = GAP, []
    for a, b in ((x0 + e, x0 + 0.06), (x1 - 0.06, x1 - e), ((x0 + x1) / 2 - 0.05, (x0 + x1) / 2 + 0.05)):
        bars.append(box([a, y0 + e, z0], [b, y1 - e, z1]))
    mid = (x0 + x1) / 2
    for a, b in ((x0 + 0.06 + e, mid - 0.05 - e), (mid + 0.05 + e, x1 - 0.06 - e)):
        for c, t in ((y0 + e, 0.12), (y1 - 0.07, 0.069), (y0 + 0.62, 0.03), (y0 + 1.14, 0.03), (y0 + 1.64, 0.03)):
            bars.append(box([a, c, z0 + 0.008], [b, c + t, z1 - 0.008]))
        for c, t in ((y0 + 0.122, 0.496), (y0 + 0.652, 0.486), (y0 + 1.172, 0.466), (y0 + 1.672, 0.466)):
            bars.append(box([(a + b) / 2 - 0.015, c, z0 + 0.012], [(a + b) / 2 + 0.015, c + t, z1 - 0.012]))
    for a, b in ((x0 - 0.09, x0 - 0.004), (x1 + 0.004, x1 + 0.09)):
        bars.append(rounded_box([a, FLOOR + GAP, FRONT - 0.022], [b, y1 + 0.09, FRONT - GAP], 0.008, 2))
    bars.append(rounded_box([x0 - 0.002, y1 + 0.004, FRONT - 0.022], [x1 + 0.002, y1 + 0.09, FRONT - GAP], 0.008, 2))
    pole = tube([[x0 - 0.16, 2.53, 2.90], [-1.0, 2.53, 2.90], [0.34, 2.53, 2.90]], 0.014, 20)
    knobs = [move(lathe(_ball(0.03)), (x, 2.53, 2.90)) for x in (x0 - 0.17, 0.35)]
    handle = tube(
        [[mid, 1.2, z0 - 0.001], [mid, 1.2, z0 - 0.05], [mid + 0.01, 1.2, z0 - 0.06], [mid + 0.1, 1.2, z0 - 0.06]],
        0.009,
    )
    return [("paint", merge(bars)), ("brass", merge([pole, *knobs, handle]))]


def _ball(r: float) -> np.ndarray:
    a = np.linspace(-np.pi / 2, np.pi / 2, 15)
    profile = np.stack([r * np.cos(a), r * np.sin(a)], 1)
    profile[[0, -1], 0] = 0
    return profile


def curtains() -> Parts:
    """Two lined curtains with deep, irregular folds, gathered at the window's sides."""
    out = []
    for seed, (a, b) in enumerate(((-2.36, -1.86), (-0.36, 0.32))):
        rng = np.random.default_rng(500 + seed)
        s, t = np.linspace(0, 1, 140), np.linspace(0, 1, 44)
        u, v = np.meshgrid(s, t, indexing="ij")
        phase = rng.uniform(0, 6, 4)
        folds = 5 + 2 * seed
        wave = np.sin(
            2 * np.pi * folds * u + 0.9 * np.sin(2 * np.pi * u * 2 + phase[0]) + 0.35 * np.sin(3 * v + phase[1])
        )
        drift = 0.5 * np.sin(2 * np.pi * u * 2.3 + phase[2] + 1.2 * v)
        z = 2.895 + (0.032 + 0.012 * v) * wave + 0.012 * drift * v
        x = a + (b - a) * (u + (0.007 + 0.008 * v) * np.cos(2 * np.pi * folds * u + phase[3]) * u * (1 - u) * 4)
        y = 2.50 - (2.50 - FLOOR - 0.015) * v + 0.004 * wave * (v > 0.99)
        step = np.linalg.norm(np.diff(np.stack([x, z], -1), axis=0), axis=-1).mean(1)
        along = np.concatenate([[0], np.cumsum(step)])
        uv = np.stack(np.broadcast_arrays(along[:, None] + seed * 0.7, 2.4 * v), -1)
        out.append(slab(np.stack([x, y, z], -1), 0.002, uv))
    return [("curtain", merge(out))]


def mouldings() -> Parts:
    """Skirting, cornice (both butted) and four ceiling beams."""
    g, h, door = GAP, 0.10, DOOR
    runs = [  # skirting: lo x, z, hi x, z
        (LEFT + 0.02 + g, BACK + g, RIGHT - 0.02 - g, BACK + 0.018),
        (RIGHT - 0.018, BACK + g, RIGHT - g, FRONT - g),
        (WINDOW[1] + 0.092, FRONT - 0.018, RIGHT - 0.02 - g, FRONT - g),
        (LEFT + g, BACK + g, LEFT + 0.018, door[0] - 0.092),
        (LEFT + g, door[1] + 0.092, LEFT + 0.018, FRONT - g),
    ]
    skirting = [rounded_box([a, FLOOR + g, b], [c, FLOOR + h, d], 0.007, 2) for a, b, c, d in runs]
    k = 0.075
    cornice = [
        rounded_box([LEFT + g, CEILING - k, BACK + g], [RIGHT - g, CEILING - g, BACK + k], 0.03, 2),
        rounded_box([LEFT + g, CEILING - k, FRONT - k], [RIGHT - g, CEILING - g, FRONT - g], 0.03, 2),
        rounded_box([LEFT + g, CEILING - k, BACK + k + g], [LEFT + k, CEILING - g, FRONT - k - g], 0.03, 2),
        rounded_box([RIGHT - k, CEILING - k, BACK + k + g], [RIGHT - g, CEILING - g, FRONT - k - g], 0.03, 2),
    ]
    beams = []
    for i, z in enumerate((-1.12, -0.1, 1.35, 2.45)):
        beam = rounded_box([LEFT + k + g, CEILING - 0.13, z - 0.07], [RIGHT - k - g, CEILING - g, z + 0.07], 0.014, 4)
        beams.append(shift_uv(beam, 0.9 * i, 0.37 * i))
    return [("paint", merge(skirting + cornice)), ("beam", merge(beams))]


DOOR = (1.50, 2.36)  # z range of the leaf in the left wall


def door() -> Parts:
    """Panelled door in the left wall with casing, handle and hinges."""
    z0, z1 = DOOR
    top, x = FLOOR + 2.03, LEFT + GAP
    casing = [
        rounded_box([x, FLOOR + GAP, z0 - 0.09], [x + 0.028, top + 0.09, z0 - 0.003], 0.01, 2),
        rounded_box([x, FLOOR + GAP, z1 + 0.003], [x + 0.028, top + 0.09, z1 + 0.09], 0.01, 2),
        rounded_box([x, top + 0.003, z0 - 0.002], [x + 0.028, top + 0.09, z1 + 0.002], 0.01, 2),
    ]
    leaf = [box([x, FLOOR + 0.006, z0], [x + 0.010, top, z1])]
    x += 0.010 + GAP
    zs = [z0 + 0.002, z0 + 0.11, (z0 + z1) / 2 - 0.05, (z0 + z1) / 2 + 0.05, z1 - 0.11, z1 - 0.002]
    for a, b in ((zs[0], zs[1]), (zs[2], zs[3]), (zs[4], zs[5])):
        leaf.append(rounded_box([x, FLOOR + 0.008, a], [x + 0.012, top - 0.002, b], 0.004, 2))
    for a, b in ((zs[1] + GAP, zs[2] - GAP), (zs[3] + GAP, zs[4] - GAP)):
        for c, d in ((FLOOR + 0.008, FLOOR + 0.22), (FLOOR + 0.82, FLOOR + 0.98), (top - 0.13, top - 0.002)):
            leaf.append(rounded_box([x, c, a], [x + 0.012, d, b], 0.004, 2))
        for c, d in ((FLOOR + 0.25, FLOOR + 0.79), (FLOOR + 1.01, top - 0.16)):
            leaf.append(rounded_box([x, c, a + 0.03], [x + 0.010, d, b - 0.03], 0.008, 2))
    h, z = FLOOR + 1.0, z0 + 0.055
    x += 0.012 + GAP
    lever = tube(
        [[x, h, z], [x + 0.04, h, z], [x + 0.048, h, z + 0.01], [x + 0.05, h, z + 0.06], [x + 0.05, h, z + 0.12]], 0.008
    )
    plate = rounded_box([x, h - 0.11, z - 0.022], [x + 0.004, h + 0.06, z + 0.022], 0.0019, 2)
    return [("paint", merge(casing)), ("door", merge(leaf)), ("brass", merge([lever, plate]))]


def spots() -> tuple[Parts, list[tuple[Mesh, float]]]:
    """Cylindrical ceiling spots: housings, and per spot the luminous disc (9 cm, facing down) with its radiance."""
    housings, discs = [], []
    # No lip below the disc: millimetres from it one would glow so brightly that indirect light turns into fireflies.
    profile = [[0.0, 2.4925], [0.060, 2.4925], [0.064, 2.4965], [0.064, CEILING - GAP], [0.0, CEILING - GAP]]
    for x, y, z, power in SPOTS:
        housings.append(move(lathe(profile, 40), (x, 0, z)))
        disc = lathe([[0.045, 0.0], [0.0, 0.0]], 40)
        down = disc if disc.n[0, 1] < 0 else Mesh(disc.v, -disc.n, disc.uv, disc.f[:, ::-1])
        discs.append((move(down, (x, y, z)), power))
    return [("paint", merge(housings))], discs


def architecture() -> Parts:
    """Everything that is fixed to the building, but for the light sources."""
    heaters = move_parts(radiator(), (LEFT + 0.001, FLOOR + GAP, 0.62), rotation("y", 90))
    return [*shell(), *window(), *curtains(), *mouldings(), *door(), *heaters]
