"""Small things and plants: framed pictures, clock, pottery, fruit, palm, basket, rug; each about its own origin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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


def _thrown(outer: list[list[float]], wall: float, segments: int = 56) -> Mesh:
    """Hollow vessel from its outer profile (foot's rim upwards): adds the inside, `wall` thick, and the bottom."""
    o = np.array(outer)
    inner = np.stack([np.maximum(o[:, 0] - wall, 0.002), np.maximum(o[:, 1], o[0, 1] + wall)], 1)[::-1]
    inner[0, 1] = o[-1, 1]
    return lathe([[0, o[0, 1]], *o.tolist(), *inner.tolist(), [0, o[0, 1] + wall]], segments)


def vase(scale: float = 1.0) -> Mesh:
    """Bellied vase."""
    t = np.linspace(0, 1, 28)
    r = 0.05 + 0.05 * np.sin(np.pi * t**0.8) ** 1.5 - 0.02 * t + 0.02 * np.clip(t - 0.88, 0, 1) / 0.12
    return _thrown((np.stack([r, 0.30 * t], 1) * scale).tolist(), 0.005 * scale)


def bowl(radius: float) -> Mesh:
    """Shallow bowl."""
    t = np.linspace(0, 1, 18)
    return _thrown(np.stack([radius * (0.4 + 0.6 * np.sin(t * np.pi / 2)), radius * 0.5 * t**1.6], 1).tolist(), 0.006)


def mug() -> Mesh:
    """Mug with a handle."""
    body = _thrown([[0.036, 0], [0.041, 0.006], [0.042, 0.05], [0.042, 0.095]], 0.004)
    a = np.linspace(-1.35, 1.35, 14)
    handle = tube(np.stack([0.0405 + 0.03 * np.cos(a), 0.05 + 0.032 * np.sin(a), 0 * a], 1), 0.005, 10)
    return merge([body, handle])


def fruit_bowl() -> Parts:
    """Bowl of oranges and apples."""
    spots = [(0.0, 0.062, 0.055), (0.058, 0.062, -0.025), (-0.056, 0.062, -0.028), (0.0, 0.118, 0.0)]
    fruits: dict[str, list[Mesh]] = {"orange": [], "apple": []}
    for i, (x, y, z) in enumerate(spots):
        kind = ("orange", "apple")[i % 2]
        ball = superellipsoid([0.037, 0.034 if i % 2 else 0.036, 0.037], 0.95, 1.0, 32, 20)
        fruits[kind].append(move(ball, (x, y, z), rotation("x", 25 * i)))
    return [("glaze_blue", bowl(0.15)), *[(k, merge(v)) for k, v in fruits.items()]]


def palm(seed: int, wall: float, fronds: Sequence[tuple[float, float, float, float]]) -> Parts:
    """Palm in a pot on y = 0. `fronds`: (heading in degrees, length, arch 0..1, height of the crown's stem).

    No leaflet reaches the wall at x = -`wall`.
    """
    rng = np.random.default_rng(seed)
    r = np.array([0.12, 0.135, 0.16, 0.175, 0.185, 0.185])
    pot = _thrown(np.stack([r, [0, 0.02, 0.16, 0.27, 0.29, 0.33]], 1).tolist(), 0.012, 64)
    soil = lathe([[0.0, 0.27], [0.166, 0.27], [0.12, 0.292], [0.0, 0.30]], 40)
    stems, leaves = [], []
    for heading, length, arch, base in fronds:
        a = np.radians(heading)
        out = np.array([np.cos(a), 0, np.sin(a)])
        s = np.linspace(0, 1, 26)[:, None]
        root = out * 0.03 + np.array([0, 0.285, 0])
        lift = base * (1 - (1 - s) ** 1.7) - arch * length * 0.75 * np.clip(s - 0.45, 0, 1) ** 2 * 2.2
        path = root + out * length * (0.25 * s + 0.75 * s**2) * (0.55 + 0.45 * arch) + np.array([0, 1.0, 0]) * lift
        stems.append(tube(path, np.linspace(0.009, 0.002, 26), 8))
        side = np.cross([0, 1.0, 0], out)
        for i in range(8, 26):
            t = (path[min(i + 1, 25)] - path[i - 1]) / np.linalg.norm(path[min(i + 1, 25)] - path[i - 1])
            for sign in (-1, 1):
                size = length * 0.34 * np.sin(np.pi * (0.12 + 0.8 * (i - 8) / 18)) * rng.uniform(0.85, 1.1)
                direction = side * sign * rng.uniform(0.75, 0.95) + t * rng.uniform(0.55, 0.8)
                direction /= np.linalg.norm(direction)
                leaf = _leaflet(path[i], direction, max(size, 0.05), size * 0.10 + 0.008, rng.uniform(0.25, 0.5))
                if leaf.v[:, 0].min() > -wall:
                    leaves.append(leaf)
    trunk = tube([[0, 0.28, 0], [0.004, 0.40, 0.0], [0.0, 0.50, 0.004]], [0.034, 0.03, 0.018], 20)
    return [("terracotta", pot), ("soil", soil), ("bark", merge([trunk, *stems])), ("leaf", merge(leaves))]


def _leaflet(root: np.ndarray, direction: np.ndarray, length: float, width: float, droop: float) -> Mesh:
    """Curved, keeled leaf from `root` along `direction`, bending down."""
    s, q = np.meshgrid(np.linspace(0, 1, 10), np.linspace(-1, 1, 5), indexing="ij")
    side = np.cross(direction, [0, 1.0, 0])
    side /= max(np.linalg.norm(side), 1e-6)
    w = width / 2 * np.sin(np.pi * (0.06 + 0.93 * s) ** 0.75) + 0.0008
    grid = root + direction * (length * s)[..., None] + side * (w * q)[..., None]
    grid[..., 1] += -droop * length * s**2 - 0.5 * w * (1 - np.abs(q))
    uv = np.stack([s, 0.5 + 0.5 * q], -1)
    return slab(grid[:, ::-1], 0.0016, uv[:, ::-1])


def basket() -> Parts:
    """Wicker basket with bulging, woven sides."""
    t = np.linspace(0, 1, 60)
    r = 0.17 + 0.035 * np.sin(np.pi * t) + 0.004 * np.sin(2 * np.pi * 14 * t)
    body = _thrown(np.stack([r, 0.34 * t], 1).tolist(), 0.012, 64)
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
