"""Thrown vessels, each upright on y = 0: mug, bowl, vase."""

from __future__ import annotations

import numpy as np

from scenes.kit.shapes import Mesh, lathe, merge, tube


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
