"""Procedural, band-limited textures of the room's surfaces, as (h, w, 3) sRGB images in 0..1, with fixed seeds.

All of them tile. Noise is made in the Fourier domain, so that no wavelength below about 2.5 texels is left to alias.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

Image = NDArray[Any]  # float32 in practice
Colour = tuple[float, float, float]


def fractal(
    shape: tuple[int, int],
    seed: int,
    longest: float,
    shortest: float,
    slope: float = 1.0,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> Image:
    """Periodic noise (h, w), mean 0, deviation 1: amplitude ~ wavelength**slope between two wavelengths in texels.

    `stretch` = (down, across) lengthens its features along an axis: (1, 30) is the grain of wood.
    """
    h, w = shape
    white = np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)
    fy = np.abs(np.fft.fftfreq(h).astype(np.float32))[:, None] * stretch[0]
    fx = np.fft.rfftfreq(w).astype(np.float32)[None] * stretch[1]
    f = np.sqrt(fy**2 + fx**2) + 1e-9
    gain = f ** -(slope + 0.0) * np.exp(-((f * shortest * 0.6) ** 4)) * (1 - np.exp(-((f * longest) ** 2)))
    gain[0, 0] = 0
    out = fft.irfft2(fft.rfft2(white, workers=1) * gain, s=shape, workers=1).astype(np.float32)
    return (out - out.mean()) / out.std()


def tint(base: Colour, *layers: tuple[Image, Colour]) -> Image:
    """`base` plus noise layers (h, w), each times its own colour change."""
    h, w = layers[0][0].shape
    out = np.broadcast_to(np.array(base, np.float32), (h, w, 3)).copy()
    for noise, change in layers:
        out += noise[..., None] * np.array(change, np.float32)
    return out


def mix(a: Image, b: Image | Colour, t: Image) -> Image:
    """Blend from `a` to `b` by `t` (h, w) in 0..1."""
    return a + (np.asarray(b, np.float32) - a) * np.clip(t, 0, 1)[..., None]


def plaster(shape: tuple[int, int], seed: int, base: Colour, contrast: float = 1.0) -> Image:
    """Lime plaster: clouds of tone, trowel strokes, fine grain, a few darker pits."""
    clouds = fractal(shape, seed, 900, 60, 1.6)
    trowel = fractal(shape, seed + 1, 160, 6, 1.1, (1.0, 2.2)) + fractal(shape, seed + 2, 160, 6, 1.1, (2.4, 1.0))
    grain = fractal(shape, seed + 3, 14, 2.6, 0.4)
    pits = np.clip(fractal(shape, seed + 4, 30, 4, 1.0) - 2.1, 0, 1.2)
    c = contrast
    b = np.array(base)
    warm = tuple(b * (0.055, 0.06, 0.075) * c)
    return tint(
        base, (clouds, warm), (trowel, tuple(b * 0.042 * c)), (grain, tuple(b * 0.026 * c)), (pits, tuple(-b * 0.2))
    )


def wood(shape: tuple[int, int], seed: int, light: Colour, dark: Colour, ring: float = 26.0) -> Image:
    """Grain along u: warped growth rings, fibres and pores; `ring` is their mean distance in texels."""
    h, w = shape
    warp = fractal(shape, seed, 700, 30, 1.8, (1.0, 9.0))
    rows = np.arange(h, dtype=np.float32)[:, None]
    turns = max(round(h / ring), 1)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (rows * turns / h) + 3.2 * warp)
    fibre = fractal(shape, seed + 1, 40, 2.6, 0.6, (1.0, 25.0))
    pores = np.clip(fractal(shape, seed + 2, 10, 2.6, 0.3, (1.0, 14.0)) - 1.3, 0, 1.5)
    t = 0.42 * rings**2 + 0.16 * warp + 0.13 * fibre + 0.25 * pores + 0.22
    base = np.broadcast_to(np.array(light, np.float32), (h, w, 3))
    return mix(base, dark, t)


def planks(shape: tuple[int, int], seed: int, metre: float, width: float = 0.137) -> Image:
    """Oak floor of long boards along u with staggered joints, a tone and a piece of grain of its own for each."""
    h, w = shape
    rng = np.random.default_rng(seed)
    grain = wood(shape, seed + 1, (0.80, 0.66, 0.49), (0.55, 0.39, 0.26), 18.0)
    n = round(h / (width * metre))
    edges = np.round(np.linspace(0, h, n + 1)).astype(int)
    out = np.empty((h, w, 3), np.float32)
    seam: Image = np.zeros(shape, np.float32)
    for a, b in pairwise(edges):  # a few dozen boards
        cuts = np.sort((rng.uniform(0, w) + np.cumsum(rng.uniform(0.7, 1.9, 3)) * metre) % w).astype(int)
        for c0, c1 in zip(cuts, [*cuts[1:], cuts[0] + w], strict=True):
            columns = np.arange(c0, c1) % w
            rows = np.arange(b - a) + int(rng.integers(0, h))
            tone = rng.normal(1.0, 0.13) * np.array([1.0, 1 + rng.normal(0, 0.02), 1 + rng.normal(0, 0.05)])
            piece = grain[rows[:, None] % h, (columns + int(rng.integers(0, w))) % w]
            out[a:b, columns] = piece * tone.astype(np.float32)
            seam[a:b, np.array([c0, c0 + 1]) % w] = 1
        seam[[a, (a + 1) % h], :] = 1
    seam = cv2.GaussianBlur(seam, (0, 0), 0.9)
    return mix(out, (0.20, 0.13, 0.08), 0.75 * seam)


def fabric(shape: tuple[int, int], seed: int, warp: Colour, weft: Colour, thread: float = 7.0) -> Image:
    """Coarse two-colour weave, slubbed threads, worn clouds; `thread` is the thread distance in texels."""
    h, w = shape
    nx, ny = max(round(w / thread), 1), max(round(h / thread), 1)
    jitter = fractal(shape, seed, 300, 30, 1.2)
    x = np.arange(w, dtype=np.float32)[None] * nx / w + 0.25 * jitter
    y = np.arange(h, dtype=np.float32)[:, None] * ny / h + 0.25 * jitter
    weave = 0.5 + 0.5 * np.sin(np.pi * x * 2) * np.sin(np.pi * y * 2)
    slub = fractal(shape, seed + 1, 30, 2.8, 0.5, (1, 12)) + fractal(shape, seed + 2, 30, 2.8, 0.5, (12, 1))
    clouds = fractal(shape, seed + 3, 600, 20, 1.4)
    base = np.broadcast_to(np.array(warp, np.float32), (h, w, 3))
    out = mix(base, weft, weave * 0.8 + 0.14 * slub)
    return out * (1 + 0.055 * clouds + 0.05 * fractal(shape, seed + 4, 60, 5, 0.8))[..., None]


def brick(shape: tuple[int, int], seed: int, metre: float) -> Image:
    """Whitewashed brick: every brick its own tone and roughness, mortar, limewash worn through in patches."""
    h, w = shape
    rng = np.random.default_rng(seed)
    rows, cols = round(h / (0.0833 * metre)), round(w / (0.26 * metre))
    wob = fractal(shape, seed + 1, 120, 12, 1.2)
    y = (np.arange(h, dtype=np.float32)[:, None] + 1.1 * wob) * rows / h
    row = np.floor(y).astype(int)
    shift = rng.uniform(0.35, 0.65, rows + 2).astype(np.float32)
    x = (np.arange(w, dtype=np.float32)[None] + 1.1 * np.roll(wob, 97, 1)) * cols / w + shift[row % rows] * (row % 2)
    col = np.floor(x).astype(int) % cols
    tones = rng.normal(0, 1, (rows, cols, 3)).astype(np.float32)
    tone = tones[row % rows, col]
    fy, fx = (np.abs(y % 1 - 0.5) * 83.3, np.abs(x % 1 - 0.5) * 260)  # millimetres from the brick's middle
    edge = np.maximum(fy - 36, fx - 124) + 0.8 * np.roll(wob, 31, 0)
    mortar = 1 / (1 + np.exp(-edge * 1.1))
    clay = tint((0.62, 0.40, 0.31), (tone[..., 0], (0.075, 0.055, 0.045)), (tone[..., 1], (0.02, -0.005, -0.02)))
    clay += fractal(shape, seed + 2, 60, 2.8, 0.7)[..., None] * np.array((0.05, 0.04, 0.035), np.float32)
    lime = (
        fractal(shape, seed + 3, 500, 20, 1.3) * 0.22
        + fractal(shape, seed + 4, 40, 3, 0.8) * 0.17
        + tone[..., 2] * 0.12
    )
    face = mix(clay, (0.86, 0.83, 0.78), 0.52 + lime)
    joint = tint((0.70, 0.67, 0.62), (fractal(shape, seed + 5, 30, 2.8, 0.5), (0.06, 0.06, 0.06)))
    return mix(face, joint, mortar * 0.95) * (1 - 0.22 * np.exp(-((edge - 1.0) ** 2) / 6))[..., None]


def wallpaper(shape: tuple[int, int], seed: int, metre: float) -> Image:
    """Hand-printed wallpaper: wandering stems with leaves and blossoms, no two alike, on a mottled ground."""
    h, w = shape
    rng = np.random.default_rng(seed)
    ground = tint(
        (0.70, 0.74, 0.69),
        (fractal(shape, seed + 1, 900, 50, 1.5), (0.03, 0.028, 0.025)),
        (fractal(shape, seed + 2, 60, 3, 0.7), (0.024, 0.024, 0.024)),
        (fractal(shape, seed + 3, 12, 2.8, 0.3, (12, 1)), (0.014, 0.014, 0.012)),
    )
    over = 4  # drawn at 1/16 texel precision through cv2's shift, antialiased
    ink = np.zeros((h, w, 3), np.uint8)
    mask = np.zeros((h, w), np.uint8)
    greens = [(0.36, 0.47, 0.40), (0.45, 0.55, 0.43), (0.28, 0.40, 0.38), (0.56, 0.60, 0.42)]
    blooms = [(0.80, 0.56, 0.48), (0.87, 0.77, 0.58), (0.72, 0.45, 0.46), (0.90, 0.86, 0.80)]

    def fill(points: NDArray[np.float64], colour: Sequence[float] | NDArray[np.float64]) -> None:
        p = np.round(points * 2**over).astype(np.int32)
        for s in (-w, 0, w):
            q = p + np.array([s * 2**over, 0], np.int32)
            if q[:, 0].max() >= 0 and q[:, 0].min() < w * 2**over:
                cv2.fillPoly(ink, [q], [int(255 * c) for c in colour], cv2.LINE_8, over)
                cv2.fillPoly(mask, [q], 255, cv2.LINE_AA, over)

    k = np.linspace(0, 1, 14)
    outline = np.concatenate(
        [np.stack([k, np.sin(np.pi * k**0.8)], 1), np.stack([k, -np.sin(np.pi * k**0.8)], 1)[::-1]]
    )
    for x0 in np.arange(0, w, 0.30 * metre):
        n = int(h / (0.03 * metre)) + 4
        y = h - np.arange(n) * 0.03 * metre
        x = (
            x0
            + 0.1 * metre * np.cumsum(rng.normal(0, 0.18, n))
            + 0.05 * metre * np.sin(y / (0.17 * metre) + rng.uniform(0, 6))
        )
        stem = np.concatenate([np.stack([x - 2, y], 1), np.stack([x + 2, y], 1)[::-1]])
        fill(stem, (0.42, 0.46, 0.38))
        for i in range(0, n, 2):
            side = 1 if (i // 2) % 2 else -1
            angle = -np.pi / 2 + side * rng.uniform(0.5, 1.3)
            length, flat = rng.uniform(0.07, 0.13) * metre, rng.uniform(0.15, 0.24)
            r = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            shade = np.array(greens[rng.integers(4)]) * rng.uniform(0.9, 1.12)
            fill(outline * (1, flat) * length @ r.T + (x[i], y[i]), shade)
            fill(outline * (0.9, 0.022) * length @ r.T + (x[i], y[i]), shade * 1.25)
            if rng.uniform() < 0.2:
                colour, size = np.array(blooms[rng.integers(4)]), rng.uniform(0.016, 0.03) * metre
                centre = np.array([x[i] - side * 0.055 * metre, y[i]])
                turn = rng.uniform(0, 6)
                for petal in np.arange(6) * np.pi / 3 + turn:
                    r = np.array([[np.cos(petal), -np.sin(petal)], [np.sin(petal), np.cos(petal)]])
                    fill(outline * (1.3, 0.42) * size @ r.T + centre, colour * rng.uniform(0.88, 1.08))
                fill(outline * (0.7, 0.33) * size + centre - (0.35 * size, 0), (0.55, 0.40, 0.22))
    worn = 0.78 + 0.10 * fractal(shape, seed + 4, 60, 3, 0.8)
    alpha = cv2.GaussianBlur(mask.astype(np.float32) / 255, (0, 0), 0.8) * worn
    return mix(ground, cv2.GaussianBlur(ink.astype(np.float32) / 255, (0, 0), 0.8), alpha)


def leaf(shape: tuple[int, int], seed: int) -> Image:
    """Leaf along u: midrib, side veins, mottled green."""
    h, w = shape
    v = np.linspace(-1, 1, h, dtype=np.float32)[:, None]
    u = np.linspace(0, 1, w, dtype=np.float32)[None]
    veins = np.cos(2 * np.pi * (u * 26 - np.abs(v) * 5)) ** 8 * 0.5
    rib = np.exp(-((v / 0.06) ** 2))
    base = tint(
        (0.36, 0.53, 0.27),
        (fractal(shape, seed, 300, 10, 1.2), (0.05, 0.06, 0.03)),
        (fractal(shape, seed + 1, 20, 3, 0.5), (0.03, 0.035, 0.02)),
    )
    return mix(base, (0.62, 0.72, 0.42), np.maximum(veins, rib) * 0.8 * np.ones_like(base[..., 0]))
