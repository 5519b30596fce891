"""What is fixed to a building: doors, radiators, windows' frames, switches, signs, extinguishers; modelled on a wall.

In a wall's frame (scenes.kit.walls): x to the right, y up, z out of the wall, unless a function says otherwise.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from scenes.kit.shapes import (
    Parts,
    atlas_uv,
    box,
    lathe,
    merge,
    move,
    quad,
    rotation,
    rounded_box,
    superellipsoid,
    tube,
)
from scenes.kit.walls import GAP, Opening, frame

Rect = tuple[float, float, float, float]  # u0, v0, u1, v1 of a picture


@cache
def radiator(length: float = 0.95, height: float = 0.52, columns: int = 17) -> Parts:
    """Column radiator about x = 0, back at z = 0, feet on y = 0."""
    xs = np.linspace(-length / 2 + 0.03, length / 2 - 0.03, columns)
    fins = [rounded_box([x - 0.0225, 0.09, 0.035], [x + 0.0225, height, 0.105], 0.02, 4) for x in xs]
    feet = [box([x - 0.015, 0.0, 0.05], [x + 0.015, 0.089, 0.09]) for x in (xs[1], xs[-2])]
    pipe = tube([[xs[-1] + 0.024, 0.14, 0.07], [length / 2 + 0.05, 0.14, 0.07], [length / 2 + 0.05, 0.0, 0.07]], 0.011)
    knob = move(lathe([[0, 0], [0.022, 0], [0.024, 0.04], [0.018, 0.055], [0, 0.055]]), (length / 2 + 0.05, 0.15, 0.07))
    return [("paint", merge([*fins, *feet, pipe])), ("black", knob)]


def door(o: Opening, leaf: str, casing: str, metal: str, hinge: str = "left", glazed: bool = False) -> Parts:
    """Flush door in the opening `o`, whose foot is the floor: steel casing, leaf, lever handle, hinges, rose.

    Materials: `leaf`, `casing`, `metal` (handle). `glazed`: a dark slit of glass in the leaf.
    """
    y0, x0, x1, y1 = o.y0 + GAP, o.x0, o.x1, o.y1
    out, w = 0.015, 0.055  # the casing's projection and width
    sides = [
        rounded_box([x0 - w, y0, GAP], [x0 - GAP, y1 + w, out], 0.003, 2, edge=2),
        rounded_box([x1 + GAP, y0, GAP], [x1 + w, y1 + w, out], 0.003, 2, edge=2),
        rounded_box([x0, y1 + GAP, GAP], [x1, y1 + w, out], 0.003, 2, edge=2),
    ]
    rebate = frame(x0 + GAP, x1 - GAP, y0, y1 - GAP, 0.018, -o.depth + GAP, -0.004, sill=False)
    z0, z1 = -o.depth + 2 * GAP, -o.depth + 0.042
    a, b = x0 + 0.021, x1 - 0.021
    panel = rounded_box([a, y0 + 0.005, z0], [b, y1 - 0.022, z1], 0.002, 2, edge=1)
    side = -1.0 if hinge == "left" else 1.0
    handle_x = b - 0.065 if side < 0 else a + 0.065
    h = o.y0 + 1.03
    z = z1 + GAP
    lever = tube(
        [
            [handle_x, h, z + 0.0065],
            [handle_x, h, z + 0.045],
            [handle_x + side * 0.008, h, z + 0.053],
            [handle_x + side * 0.03, h, z + 0.055],
            [handle_x + side * 0.13, h, z + 0.055],
        ],
        0.0095,
    )
    plate = rounded_box([handle_x - 0.02, h - 0.14, z], [handle_x + 0.02, h + 0.05, z + 0.006], 0.002, 2, edge=1)
    edge = a + 0.012 if side < 0 else b - 0.012
    hinges = [
        tube([[edge, o.y0 + y - 0.045, z + 0.008], [edge, o.y0 + y + 0.045, z + 0.008]], 0.0075, 10)
        for y in (0.25, 1.75)
    ]
    parts: Parts = [(casing, merge([*sides, rebate])), (leaf, panel), (metal, merge([lever, plate, *hinges]))]
    if glazed:
        c, d = (b - 0.26, b - 0.14) if side < 0 else (a + 0.14, a + 0.26)
        parts.append((casing, frame(c, d, o.y0 + 1.15, o.y0 + 1.85, 0.012, z1 + GAP, z1 + 0.008)))
        slit = box([c + 0.013, o.y0 + 1.163, z1 + GAP], [d - 0.013, o.y0 + 1.837, z1 + 0.004])
        parts.append(("dark_glass", slit))
    return parts


def window_frame(o: Opening, bars: int, material: str) -> Parts:
    """Frame of the window in `o` with `bars` mullions, just in front of its pane, and a sill board below."""
    z0, z1 = -o.depth + 0.006, -o.depth + 0.056
    meshes = [frame(o.x0 + GAP, o.x1 - GAP, o.y0 + GAP, o.y1 - GAP, 0.05, z0, z1)]
    for x in np.linspace(o.x0, o.x1, bars + 2)[1:-1]:
        meshes.append(box([x - 0.03, o.y0 + 0.052, z0 + 0.004], [x + 0.03, o.y1 - 0.052, z1 - 0.004]))
    board = rounded_box([o.x0 - 0.04, o.y0 - 0.026, GAP], [o.x1 + 0.04, o.y0 - GAP, 0.09], 0.006, 2, edge=2)
    return [(material, merge([*meshes, board]))]


def switch(material: str) -> Parts:
    """Light switch about the origin."""
    plate = rounded_box([-0.04, -0.04, 0], [0.04, 0.04, 0.009], 0.003, 2, edge=1)
    rocker = rounded_box([-0.027, -0.027, 0.0095], [0.027, 0.027, 0.0135], 0.002, 2, edge=1)
    return [(material, merge([plate, rocker]))]


def sign(width: float, height: float, material: str, rect: Rect, body: str) -> Parts:
    """Flat plate about the origin with a picture on its front, a part `rect` of the atlas `material`."""
    w, h = width / 2, height / 2
    plate = box([-w, -h, 0], [w, h, 0.006])
    face = quad([-w + 0.003, h - 0.003, 0.0068], [width - 0.006, 0, 0], [0, 0.006 - height, 0])
    return [(body, plate), (material, atlas_uv(face, rect))]


def board(width: float, height: float, surface: str, rim: str, tray: str = "") -> Parts:
    """Notice board or whiteboard about the origin, its rim 25 mm wide; `tray`: material of a ledge below, if any."""
    w, h, b = width / 2, height / 2, 0.025
    parts: Parts = [
        (rim, frame(-w, w, -h, h, b, 0.0, 0.02)),
        (surface, box([-w + b + GAP, -h + b + GAP, 0.002], [w - b - GAP, h - b - GAP, 0.012])),
    ]
    if tray:
        parts.append((tray, rounded_box([-w * 0.5, -h - 0.018, 0.0], [w * 0.5, -h - GAP, 0.07], 0.004, 2, edge=1)))
    return parts


def extinguisher(red: str, black: str, metal: str) -> Parts:
    """Powder extinguisher hanging about x = 0 on a bracket; its foot at y = 0."""
    z = 0.10
    profile: list[list[float]] = [
        [0, 0],
        [0.07, 0],
        [0.078, 0.012],
        [0.078, 0.40],
        [0.07, 0.44],
        [0.045, 0.468],
        [0.02, 0.48],
        [0, 0.48],
    ]
    body = move(lathe(profile, 36), (0, 0, z))
    valve = move(lathe([[0, 0], [0.021, 0], [0.021, 0.05], [0, 0.05]], 20), (0, 0.481, z))
    levers = [
        box([-0.012, 0.533, z - 0.02], [0.012, 0.541, z + 0.11]),
        box([-0.012, 0.553, z - 0.02], [0.012, 0.560, z + 0.10]),
        box([-0.010, 0.532 + 2 * GAP, z - 0.03], [0.010, 0.556, z - 0.021]),
    ]
    s = np.linspace(0, 1, 14)
    hose = tube(
        np.stack([0.022 + 0.085 * np.sin(np.pi * s * 0.75), 0.505 - 0.33 * s**1.4, z + 0.01 + 0.03 * s], 1), 0.009, 10
    )
    bracket = box([-0.03, 0.22, 0.0], [0.03, 0.46, z - 0.0795])
    return [(red, body), (black, merge([valve, levers[0], levers[1], levers[2], hose])), (metal, bracket)]


def bin_(material: str, height: float = 0.32, radius: float = 0.14) -> Parts:
    """Waste bin about the origin, standing on y = 0."""
    r = radius
    profile: list[list[float]] = [
        [0, 0],
        [0.8 * r, 0],
        [r, height],
        [r - 0.006, height],
        [0.8 * r - 0.006, 0.006],
        [0, 0.006],
    ]
    return [(material, lathe(profile, 40))]


def rail(path: list[list[float]], radius: float, wood: str, metal: str, out: float, posts: list[int]) -> Parts:
    """Handrail along the points `path` of a wall's frame, `out` of the wall, held at the points `posts`."""
    p = np.asarray(path, float) + np.array([0.0, 0.0, out])
    brackets = []
    for i in posts:
        x, y, _ = p[i]
        foot = lathe([[0, 0], [0.03, 0], [0.03, 0.006], [0, 0.006]], 24)
        brackets.append(move(foot, (x, y - 0.07, 0.0), rotation("x", 90)))
        brackets.append(
            tube(
                [[x, y - 0.07, 0.007], [x, y - 0.07, out - 0.01], [x, y - 0.06, out], [x, y - radius - GAP, out]], 0.007
            )
        )
    ends = [move(superellipsoid([radius * 0.98] * 3, 1, 1, 16, 10), q) for q in (p[0], p[-1])]
    return [(wood, merge([tube(p, radius, 20), *ends])), (metal, merge(brackets))]


def cabinet(width: float, depth: float, height: float, rows: int, columns: int) -> Parts:
    """Steel cabinet about x = 0, back at z = 0, its doors or drawers on a grid."""
    w = width / 2
    body = box([-w, 0.05 + GAP, 0.002], [w, height, depth - 0.02])
    plinth = box([-w + 0.02, 0.0, 0.03], [w - 0.02, 0.05, depth - 0.05])
    fronts, grips = [], []
    ys = np.linspace(0.055, height - 0.004, rows + 1)
    xs = np.linspace(-w + 0.003, w - 0.003, columns + 1)
    for i in range(rows):
        for j in range(columns):
            lo, hi = [xs[j] + 0.001, ys[i], depth - 0.019], [xs[j + 1] - 0.001, ys[i + 1] - 0.003, depth]
            fronts.append(rounded_box(lo, hi, 0.003, 2, edge=1))
            x, y = (xs[j] + xs[j + 1]) / 2, ys[i + 1] - 0.05
            grips.append(
                rounded_box([x - 0.06, y - 0.008, depth + GAP], [x + 0.06, y + 0.008, depth + 0.014], 0.004, 2, edge=2)
            )
    return [("cabinet", merge([body, *fronts])), ("steel", merge([plinth, *grips]))]
