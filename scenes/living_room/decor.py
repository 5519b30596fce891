"""Small things: framed pictures, clock, fruit, basket, rug; each about its own origin."""

from __future__ import annotations

import numpy as np

from scenes.kit.plants import bowl, thrown
from scenes.kit.shapes import (
    Mesh,
    Parts,
    atlas_uv,
    box,
    lathe,
    merge,
    move,
    quad,
    rotation,
    rounded_box,
    slab,
    superellipsoid,
    tube,
)
from scenes.living_room.pictures import painting_rect
from scenes.living_room.room import GAP

RUG = 0.012  # thickness


def picture(index: int, width: float, height: float, frame: str = "walnut") -> Parts:
    """Framed picture about the origin, hanging on the plane z = 0, facing +z."""
    b, t = 0.028, 0.022
    w, h = width / 2, height / 2
    bars = [
        rounded_box([-w, h - b, 0.001], [w, h, t], 0.006, 2, edge=2),
        rounded_box([-w, -h, 0.001], [w, -h + b, t], 0.006, 2, edge=2),
        rounded_box([-w, -h + b + GAP, 0.001], [-w + b, h - b - GAP, t], 0.006, 2, edge=2),
        rounded_box([w - b, -h + b + GAP, 0.001], [w, h - b - GAP, t], 0.006, 2, edge=2),
    ]
    e = b + GAP
    canvas = box([-w + e, -h + e, 0.002], [w - e, h - e, 0.009])
    face = quad([-w + e, h - e, 0.010], [2 * (w - e), 0, 0], [0, -2 * (h - e), 0])
    return [(frame, merge(bars)), ("paint", canvas), ("picture", atlas_uv(face, painting_rect(index)))]


def wall_clock(radius: float) -> Parts:
    """Round clock on the plane z = 0: rim, face, hands at ten past ten."""
    rim = lathe(
        [
            [0, 0.001],
            [radius, 0.001],
            [radius, 0.03],
            [radius - 0.008, 0.036],
            [radius - 0.02, 0.03],
            [radius - 0.02, 0.016],
            [0, 0.016],
        ],
        72,
    )
    r = radius - 0.021
    face = quad([-r, r, 0.019], [2 * r, 0, 0], [0, -2 * r, 0])
    k = np.linspace(0, 2 * np.pi, 73)[:-1]
    disc = np.stack([r * np.cos(k), r * np.sin(k), 0 * k + 0.019], 1)
    uv = 0.5 + 0.5 * np.stack([np.cos(k), -np.sin(k)], 1)
    f = np.stack([0 * k[1:-1], np.arange(1, 71), np.arange(2, 72)], 1).astype(int)
    face = Mesh(disc, np.tile([0.0, 0, 1], (72, 1)), uv, f)
    hands = [
        move(box([-0.006, -0.02, 0.022 + 0.003 * i], [0.006, size, 0.024 + 0.003 * i]), r=rotation("z", angle))
        for i, (size, angle) in enumerate(((radius * 0.45, 55), (radius * 0.68, -62)))
    ]
    return [("walnut", move(rim, r=rotation("x", 90))), ("clock", face), ("black", merge(hands))]


def fruit_bowl() -> Parts:
    """Bowl of oranges and apples."""
    spots = [(0.0, 0.062, 0.055), (0.058, 0.062, -0.025), (-0.056, 0.062, -0.028), (0.0, 0.118, 0.0)]
    fruits: dict[str, list[Mesh]] = {"orange": [], "apple": []}
    for i, (x, y, z) in enumerate(spots):
        kind = ("orange", "apple")[i % 2]
        ball = superellipsoid([0.037, 0.034 if i % 2 else 0.036, 0.037], 0.95, 1.0, 32, 20)
        fruits[kind].append(move(ball, (x, y, z), rotation("x", 25 * i)))
    return [("glaze_blue", bowl(0.15)), *[(k, merge(v)) for k, v in fruits.items()]]


def basket() -> Parts:
    """Wicker basket with bulging, woven sides."""
    t = np.linspace(0, 1, 60)
    r = 0.17 + 0.035 * np.sin(np.pi * t) + 0.004 * np.sin(2 * np.pi * 14 * t)
    body = thrown(np.stack([r, 0.34 * t], 1).tolist(), 0.012, 64)
    a = np.linspace(0, np.pi, 20)
    handles = [
        tube(np.stack([0.05 * np.cos(a), 0.335 + 0.045 * np.sin(a), 0 * a + z], 1), 0.007, 10) for z in (-0.162, 0.162)
    ]
    return [("wicker", merge([body, *handles]))]


def rug(width: float, depth: float) -> Parts:
    """Rug about the origin on y = 0, slightly wavy, with fringes along its short sides."""
    rng = np.random.default_rng(77)
    x, z = np.meshgrid(np.linspace(-width / 2, width / 2, 60), np.linspace(-depth / 2, depth / 2, 90), indexing="ij")
    y = RUG / 2 + 0.0006 * np.sin(5 * x) * np.sin(4 * z + 1)
    uv = np.stack([z / depth + 0.5, x / width + 0.5], -1)
    pile = slab(np.stack([x, y, z], -1)[:, ::-1], RUG - 0.003, uv[:, ::-1])
    knots = []
    for s in (-1, 1):
        for fx in np.arange(-width / 2 + 0.01, width / 2, 0.016):
            bend = rng.normal(0, 0.008, 2)
            knots.append(
                tube(
                    [
                        [fx, 0.005, s * (depth / 2 + 0.002)],
                        [fx + bend[0], 0.005, s * (depth / 2 + 0.03)],
                        [fx + bend[1], 0.0035, s * (depth / 2 + 0.065)],
                    ],
                    0.0028,
                    6,
                )
            )
    return [("rug", pile), ("curtain", merge(knots))]
