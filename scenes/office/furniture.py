"""The office's furniture: desks, chairs, shelves, cabinets, tables; each about its own origin, standing on y = 0."""

from __future__ import annotations

from functools import cache

import numpy as np

from scenes.kit.prints import atlas_rect
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
    shift_uv,
    slab,
    superellipsoid,
    tube,
)
from scenes.kit.walls import GAP
from scenes.office.pictures import BINDERS

DESK = (1.60, 0.80, 0.73)  # width, depth, height of its top
TABLE = (1.00, 2.40, 0.73)  # of the meeting room: along x, along z, height
SHELF = (0.90, 0.34, 1.86)
SHELF_BOARDS = (0.07, 0.44, 0.80, 1.16, 1.52)  # upper faces of the boards


def desk(shift: float) -> Parts:
    """Desk about the origin, its user at +z: top on two steel frames, cable tray; `shift` slides the top's grain."""
    w, d, h = DESK
    top = rounded_box([-w / 2, h - 0.026, -d / 2], [w / 2, h, d / 2], 0.004, 3, edge=2)
    y = h - 0.026 - GAP
    steel = []
    for s in (-1, 1):
        x = s * (w / 2 - 0.10)
        steel += [
            box([x - 0.03, 0.0, -d / 2 + 0.06], [x + 0.03, 0.034, d / 2 - 0.06]),
            box([x - 0.025, y - 0.04, -d / 2 + 0.08], [x + 0.025, y, d / 2 - 0.08]),
            box([x - 0.03, 0.034 + GAP, -0.05], [x + 0.03, y - 0.041, 0.05]),
        ]
    inner = w / 2 - 0.13 - GAP
    steel.append(box([-inner, y - 0.04, -0.06], [inner, y - 0.008, -0.02]))
    tray = box([-0.5, y - 0.13, -d / 2 + 0.05], [0.5, y - 0.012, -d / 2 + 0.17])
    hooks = [box([x - 0.015, y - 0.011, -d / 2 + 0.09], [x + 0.015, y, -d / 2 + 0.13]) for x in (-0.4, 0.4)]
    return [("laminate", shift_uv(top, shift, 0.7 * shift)), ("steel", merge([*steel, tray, *hooks]))]


@cache
def pedestal() -> Parts:
    """Drawer unit on a plinth, its front at +z, about the middle of its foot: 0.42 wide, 0.56 deep, 0.58 high."""
    w, d, h = 0.21, 0.28, 0.58
    body = box([-w, 0.04 + GAP, -d], [w, h, d - 0.02])
    plinth = box([-w + 0.02, 0.0, -d + 0.02], [w - 0.02, 0.04, d - 0.05])
    fronts, grips = [], []
    for a, b in ((0.05, 0.32), (0.325, 0.445), (0.45, 0.57)):
        fronts.append(rounded_box([-w + 0.002, a, d - 0.019], [w - 0.002, b, d - 0.001], 0.003, 2, edge=1))
        grips.append(tube([[-0.06, b - 0.04, d + 0.012], [0, b - 0.04, d + 0.015], [0.06, b - 0.04, d + 0.012]], 0.005))
        grips += [tube([[x, b - 0.04, d], [x, b - 0.04, d + 0.008]], 0.004, 8) for x in (-0.055, 0.055)]
    return [("cabinet", merge([body, *fronts])), ("steel", merge([plinth, *grips]))]


def office_chair(turn: float) -> Parts:
    """Swivel chair about its column: star base with castors, seat turned by `turn` degrees (0: sitter faces -z)."""
    base, castors = [], []
    for k in range(5):
        a = 2 * np.pi * k / 5 + 0.3
        out = np.array([np.cos(a), 0.0, np.sin(a)])
        base.append(
            tube(
                [out * 0.032 + [0, 0.105, 0], out * 0.16 + [0, 0.095, 0], out * 0.30 + [0, 0.074, 0]],
                [0.022, 0.019, 0.013],
            )
        )
        castors.append(
            move(
                superellipsoid([0.028, 0.028, 0.02], 0.6, 1.0, 20, 12),
                out * 0.30 + [0, 0.0285, 0],
                rotation("y", -np.degrees(a)),
            )
        )
        base.append(tube([out * 0.30 + [0, 0.058, 0], out * 0.30 + [0, 0.0725, 0]], 0.008, 8))
    hub = lathe([[0, 0.085], [0.031, 0.085], [0.031, 0.16], [0.02, 0.17], [0.02, 0.40], [0, 0.40]], 24)
    plate = box([-0.12, 0.401, -0.12], [0.12, 0.425, 0.12])
    seat = rounded_box([-0.25, 0.427, -0.24], [0.25, 0.50, 0.25], 0.035, 10, 0.008)
    s, t = np.meshgrid(np.linspace(-1, 1, 15), np.linspace(0, 1, 15), indexing="ij")
    width = 0.22 * (1 - 0.10 * (2 * t - 1) ** 2)
    grid = np.stack([s * width, 0.60 + 0.46 * t, 0.30 - 0.05 * s**2 + 0.05 * (t - 0.35) ** 2 * 2], -1)
    back = slab(grid, 0.045, np.stack([s * 0.22, -0.46 * t], -1))
    stem = tube([[0, 0.413, 0.122], [0, 0.42, 0.22], [0, 0.47, 0.33], [0, 0.62, 0.348], [0, 0.78, 0.345]], 0.016)
    arms, pads = [], []
    for q in (-1, 1):
        arms.append(
            tube(
                [[q * 0.122, 0.413, 0.0], [q * 0.25, 0.413, 0.0], [q * 0.285, 0.45, 0.0], [q * 0.285, 0.645, 0.0]],
                0.013,
            )
        )
        pads.append(rounded_box([q * 0.285 - 0.04, 0.646, -0.13], [q * 0.285 + 0.04, 0.675, 0.12], 0.012, 4, edge=2))
    upper: Parts = [("chair", merge([seat, back])), ("black", merge([plate, stem, *arms, *pads]))]
    r = rotation("y", turn)
    return [("black", merge([*base, *castors])), ("chrome", hub), *[(n, move(m, r=r)) for n, m in upper]]


@cache
def visitor_chair() -> Parts:
    """Four-legged meeting chair about the middle of its seat, sitter faces -z."""
    seat = rounded_box([-0.225, 0.43, -0.22], [0.225, 0.475, 0.21], 0.02, 8, 0.004)
    s, t = np.meshgrid(np.linspace(-1, 1, 13), np.linspace(0, 1, 11), indexing="ij")
    grid = np.stack([s * 0.215, 0.56 + 0.29 * t, 0.225 + 0.05 * t - 0.04 * s**2], -1)
    back = slab(grid, 0.022, np.stack([s * 0.2, -0.3 * t], -1))
    legs = []
    for q in (-1, 1):
        legs.append(tube([[q * 0.20, 0.004, -0.21], [q * 0.19, 0.25, -0.195], [q * 0.18, 0.428, -0.18]], 0.011))
        legs.append(tube([[q * 0.20, 0.004, 0.25], [q * 0.19, 0.25, 0.22], [q * 0.18, 0.428, 0.19]], 0.011))
        legs.append(
            tube(
                [[q * 0.1, 0.44, 0.212], [q * 0.1, 0.50, 0.243], [q * 0.1, 0.62, 0.249], [q * 0.1, 0.70, 0.262]], 0.009
            )
        )
    return [("chair", merge([seat, back])), ("steel", merge(legs))]


def meeting_table() -> Parts:
    """Meeting table about the origin: boat-shaped top on two slab legs."""
    w, d, h = TABLE
    t, k = np.meshgrid(np.linspace(-1, 1, 25), np.linspace(-1, 1, 9), indexing="ij")
    half = w / 2 * (1 - 0.14 * t**2)
    grid = np.stack([half * k, np.full_like(t, h - 0.014), t * d / 2], -1)
    top = slab(grid, 0.028, np.stack([t * d / 2, k * w / 2], -1))
    legs = [rounded_box([-0.28, 0.001, z - 0.03], [0.28, h - 0.029, z + 0.03], 0.006, 3, edge=2) for z in (-0.75, 0.75)]
    return [("table_wood", top), ("steel", merge(legs))]


@cache
def shelf() -> Parts:
    """Open bookcase about x = 0, back at z = 0: plinth, five boards (see SHELF_BOARDS), top, sides, back panel."""
    w, d, h = SHELF
    t = 0.02
    meshes = [
        box([-w / 2, 0, 0.002], [-w / 2 + t, h, d]),
        box([w / 2 - t, 0, 0.002], [w / 2, h, d]),
        box([-w / 2 + t + GAP, 0.05, 0.0025], [w / 2 - t - GAP, h - 0.022, 0.008]),
        box([-w / 2 + t + GAP, h - t, 0.0025], [w / 2 - t - GAP, h - 0.001, d - 0.002]),
        box([-w / 2 + t + GAP, 0.0, 0.06], [w / 2 - t - GAP, 0.049, d - 0.03]),
    ]
    for y in SHELF_BOARDS:
        meshes.append(box([-w / 2 + t + GAP, y - t, 0.009], [w / 2 - t - GAP, y, d - 0.003]))
    return [("shelf", merge([shift_uv(m, 0.31 * i, 0.17 * i) for i, m in enumerate(meshes)]))]


def binders(x0: float, x1: float, rng: np.random.Generator) -> Parts:
    """Binders and books upright on y = 0 from x0 to x1, spines at z close to 0.3; the last third may be bare."""
    spines, bodies = [], []
    x, end = x0, x1 - rng.uniform(0.0, 0.35) * (x1 - x0)
    while True:
        kind = rng.uniform()
        w, h, d = (
            (0.075, 0.315, 0.285) if kind < 0.5 else (0.048, 0.315, 0.285) if kind < 0.65 else
            (rng.uniform(0.018, 0.045), rng.uniform(0.20, 0.29), rng.uniform(0.16, 0.22))
        )  # fmt: skip
        if x + w > end:
            break
        z1 = 0.328 - (rng.uniform(0, 0.02) if kind < 0.65 else rng.uniform(0.03, 0.06))
        cover = box([x, GAP, z1 - d], [x + w - 0.0015, h, z1])
        face = quad([x + 0.002, h - 0.003, z1 + 0.0006], [w - 0.0055, 0, 0], [0, 0.008 - h, 0])
        cell = int(rng.integers(BINDERS // 2)) if kind < 0.65 else BINDERS // 2 + int(rng.integers(BINDERS // 2))
        rect = atlas_rect(cell, BINDERS, 1, 0.02)
        spines.append(atlas_uv(face, rect))
        middle = ((rect[0] + rect[2]) / 2, 0.97)
        bodies.append(atlas_uv(cover, (middle[0] - 0.002, 0.965, middle[0] + 0.002, 0.975)))
        x += w
    return [("binder", merge([*spines, *bodies]))] if spines else []


def divider(width: float) -> Parts:
    """Fabric screen between two desks, about the middle of its foot on the desks' tops, which it straddles."""
    panel = rounded_box([-width / 2, 0.006, -0.013], [width / 2, 0.40, 0.013], 0.008, 8, edge=2)
    feet = [
        box([x - 0.03, GAP, s * 0.014 - (0.04 if s < 0 else 0)], [x + 0.03, 0.005, s * 0.014 + (0.04 if s > 0 else 0)])
        for x in (-width / 2 + 0.2, width / 2 - 0.2)
        for s in (-1, 1)
    ]
    return [("divider", panel), ("steel", merge(feet))]
