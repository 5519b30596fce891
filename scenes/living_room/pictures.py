"""Drawn pictures of the room: paintings, book spines, clock face, rug, window view, as (h, w, 3) images in 0..1."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from scenes.kit.textures import Colour, Image, fractal, mix, tint

PAINTINGS = (4, 2)  # columns, rows of the atlas of paintings
BOOKS = 48  # columns of the atlas of spines


def _landscape(shape: tuple[int, int], seed: int, sky: Colour, hills: list[Colour]) -> Image:
    h, w = shape
    y = np.linspace(0, 1, h, dtype=np.float32)[:, None] * np.ones((1, w), np.float32)
    cloud = fractal(shape, seed, 300, 8, 1.3, (1.0, 2.5))
    out = mix(tint(sky, (cloud, (0.07, 0.06, 0.04))), (0.95, 0.86, 0.70), y * 0.8)
    for i, colour in enumerate(hills):
        ridge = 0.38 + 0.56 * i / len(hills) + 0.055 * fractal((4, w), seed + 10 + i, 400, 8, 1.5)[:1]
        paint = tint(colour, (fractal(shape, seed + 20 + i, 90, 4, 0.9, (1.0, 3.0)), (0.08, 0.08, 0.06)))
        out = mix(out, paint, (y - ridge) * h / 2)
    return out


def _abstract(shape: tuple[int, int], seed: int, palette: list[Colour]) -> Image:
    h, w = shape
    rng = np.random.default_rng(seed)
    out = tint(palette[0], (fractal(shape, seed, 300, 3, 1.0), (0.04, 0.04, 0.04)))
    for i in range(16):
        mask = np.zeros(shape, np.uint8)
        centre = (int(rng.uniform(0, w) * 16), int(rng.uniform(0, h) * 16))
        axes = (int(rng.uniform(0.06, 0.3) * w * 16), int(rng.uniform(0.05, 0.28) * w * 16))
        if i % 3:
            cv2.ellipse(mask, centre, axes, float(rng.uniform(0, 180)), 0, 360, 255, -1, cv2.LINE_AA, 4)
        else:
            box = cv2.boxPoints(((centre[0] / 16, centre[1] / 16), (axes[0] / 8, axes[1] / 16), rng.uniform(0, 180)))
            cv2.fillPoly(mask, [np.round(box * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
        brush = 0.82 + 0.15 * fractal(shape, seed + 30 + i, 60, 3, 0.8, (1.0, 6.0))
        out = mix(
            out, palette[1 + i % (len(palette) - 1)], cv2.GaussianBlur(mask / np.float32(255), (0, 0), 1.0) * brush
        )
    return out


def _botanical(shape: tuple[int, int], seed: int, ink: Colour) -> Image:
    h, w = shape
    rng = np.random.default_rng(seed)
    paper = tint((0.88, 0.84, 0.75), (fractal(shape, seed, 200, 3, 0.9), (0.03, 0.03, 0.035)))
    mask = np.zeros(shape, np.uint8)
    for stem in range(5):
        s = np.linspace(0, 1, 30)
        x = w * (0.5 + (stem - 2) * 0.17 * s**1.5)
        y = h * (0.92 - s * rng.uniform(0.55, 0.8))
        cv2.polylines(mask, [np.round(np.stack([x, y], 1) * 16).astype(np.int32)], False, 255, 3, cv2.LINE_AA, 4)
        for i in range(6, 30, 3):
            angle = rng.uniform(-70, -20) if i % 2 else rng.uniform(200, 250)
            size = (int(w * 0.05 * 16), int(w * 0.017 * 16))
            tip = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))]) * w * 0.05
            centre = (int((x[i] + tip[0]) * 16), int((y[i] + tip[1]) * 16))
            cv2.ellipse(mask, centre, size, angle, 0, 360, 255, -1, cv2.LINE_AA, 4)
    tone = cv2.GaussianBlur(mask / np.float32(255), (0, 0), 1.0) * (0.8 + 0.13 * fractal(shape, seed + 2, 40, 3, 0.8))
    return mix(paper, ink, tone)


def paintings(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of eight paintings, PAINTINGS = (columns, rows) of equal cells."""
    cols, rows = PAINTINGS
    cell = (shape[0] // rows, shape[1] // cols)
    blues = [(0.45, 0.55, 0.62), (0.36, 0.46, 0.45), (0.47, 0.50, 0.33), (0.60, 0.52, 0.33)]
    warm = [(0.62, 0.50, 0.50), (0.66, 0.42, 0.34), (0.50, 0.32, 0.27), (0.36, 0.28, 0.28)]
    modern = [(0.86, 0.81, 0.72), (0.75, 0.42, 0.30), (0.25, 0.38, 0.45), (0.85, 0.65, 0.32), (0.36, 0.33, 0.32)]
    sage = [(0.80, 0.80, 0.74), (0.42, 0.52, 0.45), (0.62, 0.42, 0.35), (0.30, 0.35, 0.34), (0.86, 0.72, 0.55)]
    cells = [
        _landscape(cell, seed, (0.60, 0.71, 0.80), blues),
        _abstract(cell, seed + 100, modern),
        _botanical(cell, seed + 200, (0.25, 0.37, 0.28)),
        _landscape(cell, seed + 300, (0.80, 0.66, 0.55), warm),
        _abstract(cell, seed + 400, sage),
        _botanical(cell, seed + 500, (0.45, 0.27, 0.22)),
        _landscape(cell, seed + 600, (0.72, 0.76, 0.74), [*warm[:2], *blues[1:]]),
        _abstract(cell, seed + 700, [sage[0], *modern[1:]]),
    ]
    return np.concatenate([np.concatenate(cells[r * cols : (r + 1) * cols], 1) for r in range(rows)], 0)


def painting_rect(i: int) -> tuple[float, float, float, float]:
    """(u0, v0, u1, v1) of painting `i`, a little inside its cell."""
    cols, rows = PAINTINGS
    u, v = i % cols / cols, i // cols % rows / rows
    return u + 0.004, v + 0.008, u + 1 / cols - 0.004, v + 1 / rows - 0.008


def books(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of BOOKS spines side by side: cloth or paper, bands, a title in strokes of unreadable type."""
    h, w = shape
    rng = np.random.default_rng(seed)
    palette = np.array(
        [
            *[(0.60, 0.27, 0.22), (0.24, 0.37, 0.45), (0.77, 0.68, 0.50), (0.33, 0.44, 0.34), (0.83, 0.79, 0.71)],
            *[(0.70, 0.48, 0.28), (0.40, 0.30, 0.36), (0.52, 0.60, 0.62), (0.82, 0.60, 0.34), (0.35, 0.33, 0.34)],
        ]
    )
    out: Image = np.empty((h, w, 3), np.float32)
    edges = np.round(np.linspace(0, w, BOOKS + 1)).astype(int)
    for a, b in pairwise(edges):
        colour = np.clip(palette[rng.integers(len(palette))] + rng.normal(0, 0.035, 3), 0.2, 0.9)
        spine = np.broadcast_to(colour.astype(np.float32), (h, b - a, 3)).copy()
        ink = np.array((0.90, 0.83, 0.62) if colour.mean() < 0.55 else (0.30, 0.24, 0.20), np.float32)
        for y in rng.uniform(0.03, 0.95, 3):
            spine[int(y * h) : int(y * h) + int(rng.integers(3, 22))] = ink
        y, end = int(rng.uniform(0.12, 0.25) * h), rng.uniform(0.5, 0.85) * h
        while y < end:
            n = int(rng.integers(8, 22))
            spine[y : y + n, (b - a) // 3 : 2 * (b - a) // 3 + 1] = ink
            y += n + int(rng.integers(5, 10))
        shade = 1 - 0.25 * np.abs(np.linspace(-1, 1, b - a, dtype=np.float32)) ** 4
        out[:, a:b] = spine * shade[None, :, None]
    out = cv2.GaussianBlur(out, (0, 0), 1.1)
    return out * (1 + 0.05 * fractal(shape, seed + 1, 80, 3, 0.7))[..., None]


def book_rect(i: int) -> tuple[float, float, float, float]:
    """(u0, v0, u1, v1) of spine `i`."""
    u = i % BOOKS / BOOKS
    return u + 0.001, 0.01, u + 1 / BOOKS - 0.001, 0.99


def clock(shape: tuple[int, int], seed: int) -> Image:
    """Clock face: twelve marks, sixty minutes (the hands are shapes of their own)."""
    h, w = shape
    out = tint((0.89, 0.86, 0.78), (fractal(shape, seed, 120, 3, 1.0), (0.03, 0.03, 0.035)))
    y, x = np.meshgrid(np.linspace(-1, 1, h, dtype=np.float32), np.linspace(-1, 1, w, dtype=np.float32), indexing="ij")
    r, a = np.hypot(x, y), np.arctan2(x, -y) / (2 * np.pi)
    hour, minute = (np.abs((a * n + 0.5) % 1 - 0.5) * 2 * np.pi * r / n for n in (12, 60))
    soft = 2.0 / h
    marks = (1 / (1 + np.exp((hour - 0.022) / soft))) * ((r > 0.66) & (r < 0.88))
    marks = np.maximum(marks, (1 / (1 + np.exp((minute - 0.007) / soft))) * ((r > 0.82) & (r < 0.88)))
    return mix(out, (0.20, 0.18, 0.17), cv2.GaussianBlur(marks.astype(np.float32), (0, 0), 1.0))


def rug(shape: tuple[int, int], seed: int) -> Image:
    """Oriental rug: border bands, a medallion and scattered figures, symmetrical by design but woven unevenly."""
    h, w = shape
    y, x = np.meshgrid(np.linspace(-1, 1, h, dtype=np.float32), np.linspace(-1, 1, w, dtype=np.float32), indexing="ij")
    aspect = w / h
    wob = 0.006 * fractal(shape, seed, 200, 12, 1.2)
    red, navy, cream, gold = (0.62, 0.27, 0.22), (0.22, 0.29, 0.40), (0.85, 0.78, 0.65), (0.76, 0.56, 0.32)
    edge = np.minimum((1 - np.abs(x)) * aspect, 1 - np.abs(y)) + wob

    def soft(d: Image) -> Image:
        return 1 / (1 + np.exp(-np.clip(d * h / 2.5, -40, 40)))

    out = mix(np.broadcast_to(np.array(red, np.float32), (h, w, 3)), navy, soft(edge - 0.30) * 0 + soft(0.30 - edge))
    along = np.where((1 - np.abs(x)) * aspect < 1 - np.abs(y), y, x * aspect)
    rosette = np.hypot((along * 6.5) % 1 - 0.5, (edge - 0.17) * 6.5)
    out = mix(out, gold, soft((0.40 - rosette) * 0.15))
    out = mix(out, red, soft((0.22 - rosette) * 0.15))
    out = mix(out, cream, soft((0.09 - rosette) * 0.15))
    for at, colour in ((0.05, cream), (0.29, cream), (0.33, gold), (0.02, gold)):
        out = mix(out, colour, soft(0.010 - np.abs(edge - at)))
    rng = np.random.default_rng(seed)
    r, a = np.hypot(x * aspect, y), np.arctan2(y, x * aspect)
    star = r * (1 + 0.10 * np.cos(8 * a)) + wob
    for radius, colour in (
        (0.50, navy),
        (0.46, gold),
        (0.44, navy),
        (0.33, cream),
        (0.30, red),
        (0.16, gold),
        (0.12, navy),
    ):
        out = mix(out, colour, soft(radius - star))
    for i in range(90):
        cx, cy, size = rng.uniform(-aspect, aspect), rng.uniform(-1, 1), rng.uniform(0.022, 0.05)
        if np.hypot(cx, cy) > 0.6 and min(aspect - abs(cx), 1 - abs(cy)) > 0.42:
            d = np.hypot(x * aspect - cx, y - cy) * (
                1 + 0.35 * np.cos((4 + i % 3) * np.arctan2(y - cy, x * aspect - cx))
            )
            out = mix(out, (navy, cream, gold)[i % 3], soft(size - d))
    knots = fractal(shape, seed + 1, 12, 2.8, 0.3, (1.0, 3.0))
    bands = fractal(shape, seed + 2, 300, 8, 0.9, (1.0, 8.0))
    return out * (1 + 0.06 * knots + 0.05 * bands)[..., None]


def garden(shape: tuple[int, int], seed: int, sky: float, ground: float) -> Image:
    """Linear radiance behind the window: bright soft sky over out-of-focus trees and lawn."""
    h, w = shape
    y = np.linspace(0, 1, h, dtype=np.float32)[:, None] * np.ones((1, w), np.float32)
    horizon = 0.40 + 0.07 * fractal((4, w), seed, 200, 20, 1.4)[:1]
    clouds = fractal(shape, seed + 1, 200, 16, 1.3, (1.0, 2.0))
    top = tint((0.92, 0.97, 1.06), (clouds, (0.09, 0.07, 0.05))) * (sky * (0.9 + 0.25 * y))[..., None]
    green = tint((0.62, 0.75, 0.42), (fractal(shape, seed + 2, 90, 9, 1.0), (0.14, 0.15, 0.10)))
    out = mix(top, green * ground, 1 / (1 + np.exp(-(y - horizon) * h / 5)))
    return np.maximum(cv2.GaussianBlur(out, (0, 0), 3.0), 0.05 * ground)
