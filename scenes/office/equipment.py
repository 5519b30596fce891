"""What is on the desks: screens, keyboards, papers, mugs, telephones; each about its own origin on y = 0."""

from __future__ import annotations

from functools import cache

import numpy as np

from scenes.kit.plants import mug
from scenes.kit.prints import atlas_rect
from scenes.kit.shapes import (
    Mesh,
    Parts,
    atlas_uv,
    box,
    lathe,
    merge,
    move,
    move_parts,
    quad,
    rotation,
    rounded_box,
    superellipsoid,
    tube,
)
from scenes.kit.walls import GAP
from scenes.office.pictures import PAGES, SCREENS

MONITOR = (0.56, 0.335)  # width and height of its case


def _screen(width: float, height: float, y: float, z: float, picture: int) -> Mesh:
    """The shining face of a screen, facing +z, its middle at (0, y, z)."""
    face = quad([-width / 2, y + height / 2, z], [width, 0, 0], [0, -height, 0])
    return atlas_uv(face, atlas_rect(picture, *SCREENS, 0.0))


def monitor(picture: int) -> tuple[Parts, Mesh]:
    """Monitor on its stand, facing +z; and its screen, showing cell `picture` of the atlas of screens."""
    w, h = MONITOR
    y = 0.115 + h / 2
    case = rounded_box([-w / 2, y - h / 2, -0.012], [w / 2, y + h / 2, 0.012], 0.006, 4, edge=2)
    back = rounded_box([-w / 3, y - h / 3, -0.040], [w / 3, y + h / 3, -0.0125], 0.01, 3, edge=2)
    foot = rounded_box([-0.12, 0.0, -0.13], [0.12, 0.012, 0.05], 0.005, 4, edge=2)
    neck = rounded_box([-0.03, 0.0125, -0.062], [0.03, y + 0.04, -0.0405], 0.006, 3, edge=2)
    return [("plastic", merge([case, back])), ("steel", merge([foot, neck]))], _screen(
        w - 0.022, h - 0.022, y, 0.0128, picture
    )


def television(picture: int) -> tuple[Parts, Mesh]:
    """Wall screen on the plane z = 0, facing +z, about its middle; and its shining face."""
    case = rounded_box([-0.62, -0.36, 0.03], [0.62, 0.36, 0.065], 0.006, 4, edge=2)
    mount = box([-0.2, -0.2, 0.0], [0.2, 0.2, 0.0295])
    return [("plastic", case), ("steel", mount)], _screen(1.20, 0.68, 0.0, 0.0658, picture)


@cache
def keyboard() -> Parts:
    """Keyboard with its keys, the user at +z."""
    body = rounded_box([-0.22, 0.0, -0.065], [0.22, 0.014, 0.065], 0.004, 3, edge=1)
    keys = []
    for row in range(5):
        z = -0.052 + row * 0.0215
        x = -0.212
        for k in range(16):
            wide = 0.095 if row == 4 and k == 4 else 0.0195
            if x + wide <= 0.2125:
                keys.append(box([x, 0.0150, z], [x + wide, 0.0195, z + 0.0185]))
            x += wide + 0.0035
    return [("plastic", body), ("key", merge(keys))]


@cache
def mouse() -> Parts:
    """Mouse on a mat."""
    mat = rounded_box([-0.11, 0.0, -0.09], [0.11, 0.003, 0.09], 0.0012, 2, edge=1)
    body = move(superellipsoid([0.031, 0.0185, 0.056], 0.8, 0.8, 32, 20), (0.01, 0.0217, 0.0))
    return [("mat", mat), ("plastic", body)]


def papers(rng: np.random.Generator, sheets: int) -> Parts:
    """A pile of printed sheets, each a little turned; the lower ones are thicker stacks."""
    parts: Parts = []
    y = 0.0
    for i in range(sheets):
        t = float(rng.uniform(0.002, 0.012)) if i < sheets - 1 else 0.0012
        body = box([-0.105, 0.0, -0.1485], [0.105, t, 0.1485])
        face = quad([-0.104, t + 0.0004, -0.1475], [0.208, 0, 0], [0, 0, 0.295])
        sheet: Parts = [
            ("paper", body),
            ("page", atlas_uv(face, atlas_rect(int(rng.integers(PAGES[0] * PAGES[1])), *PAGES))),
        ]
        at = (float(rng.normal(0, 0.012)), y, float(rng.normal(0, 0.012)))
        parts += move_parts(sheet, at, rotation("y", float(rng.normal(0, 9))))
        y += t + 0.0009
    return parts


@cache
def telephone() -> Parts:
    """Desk telephone, the user at +z."""
    base = rounded_box([-0.09, 0.0, -0.10], [0.09, 0.035, 0.10], 0.01, 4, edge=2)
    handset = merge([
        rounded_box([-0.085, 0.052, -0.09], [-0.04, 0.07, 0.09], 0.009, 4, edge=2),
        rounded_box([-0.085, 0.036, -0.09], [-0.04, 0.051, -0.05], 0.006, 3, edge=1),
        rounded_box([-0.085, 0.036, 0.05], [-0.04, 0.051, 0.09], 0.006, 3, edge=1),
    ])  # fmt: skip
    keys = [
        box([-0.02 + 0.03 * i, 0.0355, -0.02 + 0.024 * j], [0.0 + 0.03 * i, 0.040, -0.004 + 0.024 * j])
        for i in range(3)
        for j in range(4)
    ]
    display = box([-0.02, 0.0355, -0.08], [0.06, 0.039, -0.035])
    return [("plastic", merge([base, handset])), ("key", merge(keys)), ("dark_glass", display)]


def pencils(rng: np.random.Generator) -> Parts:
    """Pen pot with a few pens."""
    pot = lathe([[0, 0], [0.036, 0], [0.038, 0.10], [0.0355, 0.10], [0.0335, 0.003], [0, 0.003]], 32)
    pens = []
    for k in range(5):
        a = 2 * np.pi * k / 5 + rng.uniform(0, 0.3)
        foot, top = (
            np.array([0.017 * np.cos(a), 0.0085, 0.017 * np.sin(a)]),
            np.array([0.030 * np.cos(a), 0.15, 0.030 * np.sin(a)]),
        )
        pens.append(tube([foot, (foot + top) / 2, top], 0.004, 8))
    return [("steel", pot), ("pen", merge([move(m) for m in pens]))]


def laptop(picture: int) -> tuple[Parts, Mesh]:
    """Open laptop, the user at +z; and its screen."""
    base = rounded_box([-0.16, 0.0, -0.11], [0.16, 0.016, 0.11], 0.004, 4, edge=1)
    keys = [
        box([-0.14 + 0.0235 * i, 0.0170, -0.075 + 0.021 * j], [-0.119 + 0.0235 * i, 0.0190, -0.0565 + 0.021 * j])
        for i in range(12)
        for j in range(4)
    ]
    r = rotation("x", -16)
    at = (0, 0.017, -0.106)
    lid = move(rounded_box([-0.16, 0.002, -0.009], [0.16, 0.218, -0.001], 0.003, 4, edge=1), at, r)
    screen = move(_screen(0.296, 0.19, 0.112, -0.0002, picture), at, r)
    return [("steel", merge([base, lid])), ("key", merge(keys))], screen


def coffee(turn: float) -> Parts:
    """A mug."""
    return [("glaze", move(mug(), r=rotation("y", turn)))]


def printer() -> Parts:
    """Laser printer with paper in its tray, its front at +z."""
    body = rounded_box([-0.21, 0.0, -0.2], [0.21, 0.25, 0.2], 0.02, 6, edge=3)
    top = rounded_box([-0.19, 0.2505, -0.18], [0.19, 0.285, 0.1], 0.01, 4, edge=2)
    panel = rounded_box([-0.18, 0.2505, 0.115], [0.18, 0.266, 0.185], 0.005, 2, edge=1)
    slot = box([-0.16, 0.12, 0.2005], [0.16, 0.15, 0.206])
    tray = rounded_box([-0.19, 0.03, 0.2005], [0.19, 0.10, 0.212], 0.004, 2, edge=1)
    return [("cabinet", merge([body, top, tray])), ("black", merge([panel, slot]))]


def box_file(width: float, height: float, depth: float) -> Parts:
    """Cardboard box with a lid."""
    w, d = width / 2, depth / 2
    body = box([-w, 0, -d], [w, height - 0.06, d])
    lid = box([-w - 0.004, height - 0.06 + GAP, -d - 0.004], [w + 0.004, height, d + 0.004])
    return [("carton", merge([body, lid]))]
