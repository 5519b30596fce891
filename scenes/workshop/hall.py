"""The hall itself: shell, windows, doors, floor markings, columns, trusses, crane. World frame, metres, y up.

x runs along the hall, z across it; the floor is y = 0, the eaves are at 5 m, the ridge over z = 0 at 6 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from scenes.kit.shapes import Mesh, Parts, box, merge, move, quad, rounded_box, smooth, tube
from scenes.workshop.solids import GAP, beam, i_beam, rod, turned

LONG, WIDE = 10.0, 6.0  # half the hall's length and width
EAVES, RIDGE = 5.0, 6.0
DADO = 1.6  # so high walls are painted dark
WINDOWS = tuple((x + 0.42, x + 3.58, 3.55, 4.70) for x in (-10.0, -6.0, -2.0, 2.0, 6.0))  # x0, x1, y0, y1
DEEP = 0.16  # of the windows' reveals
COLUMNS = (-6.0, -2.0, 2.0, 6.0)
COLUMN_Z = (5.64, 5.88)  # inner and outer face
RAIL_Z = (5.28, 5.46)
RAIL_TOP = 3.30
DOOR = (-2.6, 1.0, 3.7)  # roller door in the wall x = LONG: z0, z1, height
EXIT = (3.1, 4.1, 2.1)  # the small door beside it
Rect = tuple[float, float, float, float]


def roof_height(z: float) -> float:
    """Height of the roof's inside over z, m."""
    return RIDGE - (RIDGE - EAVES) * abs(z) / WIDE


def patchwork(ground: Rect, patches: Sequence[tuple[str, Rect]], name: str) -> list[tuple[str, Rect]]:
    """The rectangle `ground` = (a0, a1, b0, b1) cut into cells along all edges; each with the last patch's name there.

    A cell under a patch called '' is left out: a hole. No edge of a cell ends within another's.
    """
    a = np.unique(np.round([*ground[:2], *(v for _, r in patches for v in r[:2])], 6)).tolist()
    b = np.unique(np.round([*ground[2:], *(v for _, r in patches for v in r[2:])], 6)).tolist()
    cells = []
    for a0, a1 in pairwise(a):
        for b0, b1 in pairwise(b):
            x, y = (a0 + a1) / 2, (b0 + b1) / 2
            over = [n for n, (p0, p1, q0, q1) in patches if p0 < x < p1 and q0 < y < q1]
            if (own := over[-1] if over else name) != "":
                cells.append((own, (a0, a1, b0, b1)))
    return cells


def floor(bays: Sequence[Rect]) -> Parts:
    """Concrete with painted lines: a walkway along the hall, outlines of `bays` (x0, x1, z0, z1), hazard stripes."""
    line, patches = 0.08, []
    for z in (-1.25, 1.25 - line):
        patches.append(("floor_line", (-9.2, 8.6, z, z + line)))
    for x0, x1, z0, z1 in bays:
        for r in ((x0, x1, z0, z0 + line), (x0, x1, z1 - line, z1), (x0, x0 + line, z0, z1), (x1 - line, x1, z0, z1)):
            patches.append(("floor_line", r))
    patches.append(("floor_hazard", (9.0, 9.6, DOOR[0] + 0.3, DOOR[1] - 0.3)))
    out = []
    for name, (x0, x1, z0, z1) in patchwork((-LONG, LONG, -WIDE, WIDE), patches, "floor"):
        out.append((name, quad([x0, 0, z0], [x1 - x0, 0, 0], [0, 0, z1 - z0], (x0 + LONG, z0 + WIDE))))
    return out


def _long_wall(side: int) -> Parts:
    """A long wall at z = side * WIDE with its window holes and their reveals, facing the hall."""
    holes = [("", w) for w in WINDOWS]
    out: Parts = []
    dado = [("wall_lower", (-LONG, LONG, 0.0, DADO))]
    for name, (x0, x1, y0, y1) in patchwork((-LONG, LONG, 0.0, EAVES), [*dado, *holes], "wall_upper"):
        if side < 0:
            q = quad([x0, y1, -WIDE], [x1 - x0, 0, 0], [0, y0 - y1, 0], (x0 + LONG, EAVES - y1))
        else:
            q = quad([x1, y1, WIDE], [x0 - x1, 0, 0], [0, y0 - y1, 0], (LONG - x1, EAVES - y1))
        out.append((name, q))
    z0, deep = side * WIDE, side * DEEP
    for x0, x1, y0, y1 in WINDOWS:
        centre = np.array([(x0 + x1) / 2, (y0 + y1) / 2, z0])
        for q in (
            quad([x0, y0, z0], [x1 - x0, 0, 0], [0, 0, deep]),
            quad([x0, y1, z0], [x1 - x0, 0, 0], [0, 0, deep]),
            quad([x0, y0, z0], [0, y1 - y0, 0], [0, 0, deep]),
            quad([x1, y0, z0], [0, y1 - y0, 0], [0, 0, deep]),
        ):
            out.append(("window_paint", facing(q, centre)))
    return out


def facing(q: Mesh, towards: np.ndarray) -> Mesh:
    """The flat rectangle turned so that its front is seen from a point."""
    return q if float((towards - q.v.mean(0)) @ q.n[0]) > 0 else Mesh(q.v, -q.n, q.uv, q.f[:, ::-1])


def shell() -> Parts:
    """Walls, gables and roof, all facing inwards; the floor and the panes close them."""
    out = [*_long_wall(-1), *_long_wall(1)]
    for side in (-1, 1):
        x = side * LONG
        a, u = -side * WIDE, (0.0, 0.0, 2.0 * side * WIDE)
        out.append(("wall_lower", _upright(x, a, u, 0.0, DADO)))
        out.append(("wall_upper", _upright(x, a, u, DADO, EAVES)))
        n = np.tile([-float(side), 0.0, 0.0], (3, 1))
        v = np.array([[x, EAVES, a], [x, EAVES, -a], [x, RIDGE, 0.0]])
        uv = np.stack([np.abs(v[:, 2] - a), RIDGE - v[:, 1] + 3.0], 1)
        gable = Mesh(v, n, uv, np.array([[0, 1, 2]]))
        turn = np.cross(v[1] - v[0], v[2] - v[0]) @ n[0] > 0
        out.append(("wall_upper", gable if turn else Mesh(v, n, uv, gable.f[:, ::-1])))
        slope = quad([-LONG, EAVES, side * WIDE], [2 * LONG, 0, 0], [0, RIDGE - EAVES, -side * WIDE])
        out.append(("roof", facing(slope, np.array([0.0, 2.0, 0.0]))))
    return out


def _upright(x: float, a: float, u: tuple[float, float, float], y0: float, y1: float) -> Mesh:
    q = quad([x, y1, a], u, [0, y0 - y1, 0], (0.0, EAVES - y1))
    return facing(q, np.array([0.0, 2.0, 0.0]))


def panes(side: int) -> Mesh:
    """The luminous panes of one long wall, facing the hall; one picture runs along all of them."""
    quads = []
    for x0, x1, y0, y1 in WINDOWS:
        z = side * (WIDE + DEEP)
        q = quad([x0, y1, z], [x1 - x0, 0, 0], [0, y0 - y1, 0])
        u = (q.v[:, 0] + LONG) / (2 * LONG)
        q = Mesh(q.v, q.n, np.stack([u if side < 0 else 1 - u, (y1 - q.v[:, 1]) / (y1 - y0)], 1), q.f)
        quads.append(facing(q, np.array([0.0, 2.0, 0.0])))
    return merge(quads)


def window_bars() -> Parts:
    """Steel frames and glazing bars before the panes, and sills."""
    bars = []
    for side in (-1, 1):
        for x0, x1, y0, y1 in WINDOWS:
            near, far = sorted((side * (WIDE + DEEP - 0.05), side * (WIDE + DEEP - 0.012)))
            e = GAP
            bars.append(box([x0 + e, y0 + e, near], [x1 - e, y0 + 0.05, far]))
            bars.append(box([x0 + e, y1 - 0.05, near], [x1 - e, y1 - e, far]))
            inner = (y0 + 0.05 + e, y1 - 0.05 - e)
            for x in np.linspace(x0 + 0.025, x1 - 0.025, 7).tolist():
                half = 0.024 if abs(x - (x0 + x1) / 2) > 1.5 else 0.016
                bars.append(box([x - half, inner[0], near], [x + half, inner[1], far]))
            sill = sorted((side * (WIDE - 0.05), side * (WIDE - GAP)))
            bars.append(box([x0 - 0.05, y0 - 0.04, sill[0]], [x1 + 0.05, y0 - GAP, sill[1]]))
    return [("window_paint", merge(bars))]


def doors() -> Parts:
    """The roller door with its guides and drum case, and the small door beside it, all on the wall x = LONG."""
    z0, z1, high = DOOR
    t = np.linspace(0, 2 * np.pi, 7)[:-1]
    rows, height = 37, 0.1
    profile = []
    for k in range(rows):  # one slat: a shallow S
        profile += [[0.018 * (0.5 - 0.5 * np.cos(a)), (k + a / (2 * np.pi)) * height] for a in t]
    p = np.array([*profile, [0.0, rows * height]])
    slats = []
    width = z1 - z0 - 0.02
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    x = LONG - 0.035 - p[:, 0]
    v = np.stack([np.repeat(x, 2), np.repeat(p[:, 1] + 0.002, 2), np.tile([z0 + 0.01, z0 + 0.01 + width], len(p))], 1)
    uv = np.stack([np.tile([0.0, width], len(p)), -np.repeat(along, 2)], 1)
    i = 2 * np.arange(len(p) - 1)
    f = np.concatenate([np.stack([i, i + 1, i + 3], 1), np.stack([i, i + 3, i + 2], 1)])

    sheet = smooth(v, uv, f)
    if sheet.n[:, 0].mean() > 0:
        sheet = smooth(v, uv, f[:, ::-1])
    slats.append(sheet)
    slats.append(box([LONG - 0.034, 0.002, z0 + 0.01], [LONG - 0.012, high, z1 - 0.01]))
    guides = [box([LONG - 0.09, GAP, z - 0.05], [LONG - GAP, high, z + 0.05]) for z in (z0 - 0.045, z1 + 0.045)]
    case = rounded_box([LONG - 0.42, high + GAP, z0 - 0.12], [LONG - GAP, high + 0.42, z1 + 0.12], 0.03, 4, edge=3)
    a, b, top = EXIT
    leaf = box([LONG - 0.06, 0.012, a + 0.061], [LONG - 0.02, top - 0.061, b - 0.061])
    frame = [box([LONG - 0.08, GAP, z], [LONG - GAP, top, z + 0.06]) for z in (a, b - 0.06)]
    frame.append(box([LONG - 0.08, top - 0.06, a + 0.061], [LONG - GAP, top, b - 0.061]))
    handle = tube([[LONG - 0.061, 1.05, b - 0.14], [LONG - 0.12, 1.05, b - 0.14], [LONG - 0.12, 1.05, b - 0.27]], 0.011)
    panel = box([LONG - 0.014, 1.2, z1 + 0.35], [LONG - GAP, 1.5, z1 + 0.53])
    return [
        ("roller", merge(slats)), ("frame", merge([*guides, case])), ("door", leaf), ("frame", merge(frame)),
        ("bright", handle), ("panel", panel), *_push_buttons(z1 + 0.44),
    ]  # fmt: skip


def _push_buttons(z: float) -> Parts:
    names = ("button_green", "rubber", "button_red")
    return [(n, rod("x", (LONG - 0.026, 1.43 - 0.08 * k, z), 0.0115, 0.022, 16)) for k, n in enumerate(names)]


def steelwork() -> Parts:
    """Columns on both sides, a truss over each pair of them, and the purlins under the roof."""
    steel = []
    inner, outer = COLUMN_Z
    for x in COLUMNS:
        for side in (-1, 1):
            z0, z1 = sorted((side * inner, side * outer))
            steel.append(i_beam("y", (x - 0.10, 0.021, z0), (x + 0.10, 4.36, z1)))
            steel.append(box([x - 0.16, GAP, z0 - 0.05], [x + 0.16, 0.02, z1 + 0.05]))
            steel += [
                rod("y", (x + a, 0.0205, z), 0.03, 0.012, 12) for a in (-0.13, 0.13) for z in (z0 - 0.02, z1 + 0.02)
            ]
        steel += _truss(x)
    purlins = []
    for z in (-5.4, -4.2, -3.0, -1.8, -0.6, 0.6, 1.8, 3.0, 4.2, 5.4):
        y = roof_height(abs(z) + 0.04) - 0.004
        purlins.append(box([-LONG + GAP, y - 0.13, z - 0.035], [LONG - GAP, y, z + 0.035]))
    return [("steel", merge(steel)), ("purlin", merge(purlins))]


def _truss(x: float) -> list[Mesh]:
    """Bottom chord, two top chords, posts and diagonals at one x."""
    low = 4.43
    pieces = [box([x - 0.06, low - 0.06, -5.88], [x + 0.06, low + 0.06, 5.88])]

    def chord(z: float) -> float:
        return roof_height(z) - 0.22

    for s in (-1, 1):
        pieces.append(beam((x, chord(0.02), 0.02 * s), (x, chord(5.86), 5.86 * s), 0.12, 0.10))
        knots = [0.0, 1.2, 2.4, 3.6, 4.8]
        for k, z in enumerate(knots):
            if z > 0.0 or s > 0:
                pieces.append(beam((x, low + 0.061, z * s), (x, chord(z) - 0.062, z * s), 0.05, 0.05))
            if k + 1 < len(knots):
                foot = (x, low + 0.09, (knots[k + 1] - 0.05) * s)
                pieces.append(beam((x, chord(z) - 0.10, (z + 0.05) * s), foot, 0.045, 0.045))
    return pieces


def crane(x: float, z: float, drop: float) -> Parts:
    """Runway girders on brackets, and a bridge crane at x with its hoist at z and the hook `drop` m below it."""
    steel, yellow = [], []
    inner = COLUMN_Z[0]
    for side in (-1, 1):
        z0, z1 = sorted((side * RAIL_Z[0], side * RAIL_Z[1]))
        steel.append(i_beam("x", (-LONG + 0.02, RAIL_TOP - 0.26, z0), (LONG - 0.02, RAIL_TOP - 0.04, z1)))
        middle = (z0 + z1) / 2
        steel.append(box([-LONG + 0.02, RAIL_TOP - 0.039, middle - 0.025], [LONG - 0.02, RAIL_TOP, middle + 0.025]))
        for c in COLUMNS:
            b0, b1 = sorted((side * (RAIL_Z[0] - 0.02), side * (inner - GAP)))
            steel.append(box([c - 0.07, RAIL_TOP - 0.42, b0], [c + 0.07, RAIL_TOP - 0.261, b1]))
            foot = (c, RAIL_TOP - 0.75, side * (inner - 0.03))
            steel.append(beam(foot, (c, RAIL_TOP - 0.43, side * (RAIL_Z[0] + 0.06)), 0.08, 0.04))
        for end in (-LONG + 0.25, LONG - 0.25):
            steel.append(box([end - 0.06, RAIL_TOP + GAP, middle - 0.06], [end + 0.06, RAIL_TOP + 0.16, middle + 0.06]))
        yellow.append(box([x - 0.75, RAIL_TOP + 0.03, middle - 0.11], [x + 0.75, RAIL_TOP + 0.25, middle + 0.11]))
        wheels = [rod("z", (x + w, RAIL_TOP + 0.06, middle - 0.03), 0.06, 0.058, 24) for w in (-0.6, 0.6)]
        steel += wheels
    reach = (RAIL_Z[0] + RAIL_Z[1]) / 2 + 0.10
    yellow.append(i_beam("z", (x - 0.13, RAIL_TOP + 0.251, -reach), (x + 0.13, RAIL_TOP + 0.60, reach), 0.02))
    under = RAIL_TOP + 0.25
    hoist = [
        rounded_box([x - 0.20, under - 0.38, z - 0.30], [x + 0.20, under - 0.06, z + 0.30], 0.03, 4, edge=3),
        box([x - 0.12, under - 0.0595, z - 0.20], [x + 0.12, under - 0.002, z + 0.20]),
    ]
    top = under - 0.381
    ropes = [rod("y", (x, top - drop, z + s), drop, 0.006, 8) for s in (-0.05, 0.05)]
    block = rounded_box(
        [x - 0.06, top - drop - 0.20, z - 0.09], [x + 0.06, top - drop - GAP, z + 0.09], 0.02, 3, edge=2
    )
    a = np.linspace(np.radians(90), np.radians(-170), 16)
    y = top - drop - 0.33
    hook = tube(
        [[x, top - drop - 0.201, z], *np.stack([0 * a + x, y + 0.06 * np.sin(a), z + 0.06 * np.cos(a)], 1).tolist()],
        np.linspace(0.02, 0.012, 17), 12,
    )  # fmt: skip
    return [
        ("steel", merge(steel)), ("crane", merge([*yellow, block])), ("trim", merge(hoist)),
        ("cast", merge([*ropes, hook])),
    ]  # fmt: skip


def lamp(radius: float) -> tuple[Parts, Mesh]:
    """High-bay lamp about the origin: housing above y = 0 with its cord's gland, and the luminous disc, facing down."""
    r = radius
    profile = [
        [0, 0.004],
        [r, 0.004],
        [r + 0.02, 0.012],
        [r + 0.02, 0.03],
        [0.55 * r, 0.16],
        [0.09, 0.20],
        [0.09, 0.36],
        [0, 0.36],
    ]
    disc = turned("y", (0, 0, 0), [[r, 0.0], [0.0, 0.0]], 40)
    down = disc if disc.n[0, 1] < 0 else Mesh(disc.v, -disc.n, disc.uv, disc.f[:, ::-1])
    return [("lamp_housing", turned("y", (0, 0, 0), profile, 40))], down


def hung_lamp(x: float, y: float, z: float, radius: float) -> tuple[Parts, Mesh]:
    """A lamp at (x, y, z) on a cord from the roof."""
    housing, disc = lamp(radius)
    top = roof_height(z) - 0.003
    cord = rod("y", (x, y + 0.361, z), top - y - 0.361, 0.008, 8)
    return [(n, move(m, (x, y, z))) for n, m in housing] + [("cable", cord)], move(disc, (x, y, z))
