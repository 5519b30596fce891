"""Vessels and plants, each upright on y = 0."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scenes.kit.shapes import Mesh, Parts, lathe, merge, slab, tube


def thrown(outer: list[list[float]], wall: float, segments: int = 56) -> Mesh:
    """Hollow vessel from its outer profile (foot's rim upwards): adds the inside, `wall` thick, and the bottom."""
    o = np.array(outer)
    inner = np.stack([np.maximum(o[:, 0] - wall, 0.002), np.maximum(o[:, 1], o[0, 1] + wall)], 1)[::-1]
    inner[0, 1] = o[-1, 1]
    return lathe([[0, o[0, 1]], *o.tolist(), *inner.tolist(), [0, o[0, 1] + wall]], segments)


def vase(scale: float = 1.0) -> Mesh:
    """Bellied vase."""
    t = np.linspace(0, 1, 28)
    r = 0.05 + 0.05 * np.sin(np.pi * t**0.8) ** 1.5 - 0.02 * t + 0.02 * np.clip(t - 0.88, 0, 1) / 0.12
    return thrown((np.stack([r, 0.30 * t], 1) * scale).tolist(), 0.005 * scale)


def bowl(radius: float) -> Mesh:
    """Shallow bowl."""
    t = np.linspace(0, 1, 18)
    return thrown(np.stack([radius * (0.4 + 0.6 * np.sin(t * np.pi / 2)), radius * 0.5 * t**1.6], 1).tolist(), 0.006)


def mug() -> Mesh:
    """Mug with a handle."""
    body = thrown([[0.036, 0], [0.041, 0.006], [0.042, 0.05], [0.042, 0.095]], 0.004)
    a = np.linspace(-1.35, 1.35, 14)
    handle = tube(np.stack([0.0405 + 0.03 * np.cos(a), 0.05 + 0.032 * np.sin(a), 0 * a], 1), 0.005, 10)
    return merge([body, handle])


def palm(seed: int, wall: float, fronds: Sequence[tuple[float, float, float, float]]) -> Parts:
    """Palm in a pot on y = 0. `fronds`: (heading in degrees, length, arch 0..1, height of the crown's stem).

    No leaflet reaches the wall at x = -`wall`.
    """
    rng = np.random.default_rng(seed)
    r = np.array([0.12, 0.135, 0.16, 0.175, 0.185, 0.185])
    pot = thrown(np.stack([r, [0, 0.02, 0.16, 0.27, 0.29, 0.33]], 1).tolist(), 0.012, 64)
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
