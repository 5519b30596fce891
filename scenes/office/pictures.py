"""Drawn pictures of the office: screens, spines of binders, pages, the whiteboard, posters; (h, w, 3) in 0..1."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import cv2
import numpy as np

from scenes.kit.prints import INK, atlas, page, poster, words
from scenes.kit.textures import Colour, Image, fractal, mix, tint

SCREENS = (4, 2)  # columns, rows of the atlas of screens
PAGES = (4, 3)  # of the atlas of pages
BINDERS = 24  # columns of the atlas of spines: binders, then books
POSTERS = (3, 1)

_BARS: list[Colour] = [(0.33, 0.52, 0.70), (0.80, 0.52, 0.30), (0.42, 0.60, 0.42), (0.70, 0.36, 0.36)]


def _code(shape: tuple[int, int], seed: int) -> Image:
    h, w = shape
    rng = np.random.default_rng(seed)
    out: Image = np.zeros((h, w, 3), np.float32)
    out[:] = (0.23, 0.25, 0.29)
    out[:, : w // 6] = (0.28, 0.30, 0.34)
    out[: h // 20] = (0.36, 0.38, 0.42)
    colours = [(0.80, 0.80, 0.78), (0.55, 0.72, 0.85), (0.85, 0.68, 0.48), (0.60, 0.78, 0.56), (0.80, 0.56, 0.74)]
    y, indent = 0.08, 0
    while y < 0.97:
        indent = int(np.clip(indent + rng.integers(-1, 2), 0, 4))
        x = 0.20 + 0.03 * indent
        if rng.uniform() > 0.15:
            for _ in range(int(rng.integers(2, 8))):
                long = rng.uniform(0.02, 0.10)
                out[int(y * h) : int((y + 0.013) * h), int(x * w) : int(min(x + long, 0.97) * w)] = colours[
                    int(rng.integers(5))
                ]
                x += long + 0.012
        out[int(y * h) : int((y + 0.011) * h), int(0.02 * w) : int(rng.uniform(0.05, 0.14) * w)] = (0.62, 0.64, 0.66)
        y += 0.027
    return cv2.GaussianBlur(out, (0, 0), 0.7)


def _table(shape: tuple[int, int], seed: int) -> Image:
    h, w = shape
    rng = np.random.default_rng(seed)
    out: Image = np.zeros((h, w, 3), np.float32)
    out[:] = (0.84, 0.85, 0.86)
    out[: h // 9] = (0.33, 0.50, 0.40)
    for y in np.linspace(0.14, 0.97, 26):
        out[int(y * h) : int(y * h) + 1] = (0.68, 0.69, 0.70)
        for x in np.linspace(0.04, 0.9, 9):
            if rng.uniform() < 0.8:
                long = rng.uniform(0.02, 0.07)
                out[int((y + 0.010) * h) : int((y + 0.022) * h), int(x * w) : int((x + long) * w)] = INK
    for x in np.linspace(0.03, 0.97, 10):
        out[h // 9 :, int(x * w) : int(x * w) + 1] = (0.68, 0.69, 0.70)
    return cv2.GaussianBlur(out, (0, 0), 0.7)


def _charts(shape: tuple[int, int], seed: int) -> Image:
    h, w = shape
    rng = np.random.default_rng(seed)
    out: Image = np.zeros((h, w, 3), np.float32)
    out[:] = (0.80, 0.82, 0.84)
    out[:, : w // 8] = (0.30, 0.36, 0.44)
    for k in range(4):
        x0, y0 = 0.17 + 0.42 * (k % 2), 0.08 + 0.47 * (k // 2)
        out[int(y0 * h) : int((y0 + 0.40) * h), int(x0 * w) : int((x0 + 0.38) * w)] = (0.90, 0.90, 0.90)
        for i, v in enumerate(rng.uniform(0.1, 1, 10)):
            x = x0 + 0.03 + 0.033 * i
            out[int((y0 + 0.36 - 0.28 * v) * h) : int((y0 + 0.36) * h), int(x * w) : int((x + 0.022) * w)] = _BARS[k]
        out[int((y0 + 0.03) * h) : int((y0 + 0.05) * h), int((x0 + 0.03) * w) : int((x0 + 0.18) * w)] = INK
    return cv2.GaussianBlur(out, (0, 0), 0.7)


def _document(shape: tuple[int, int], seed: int) -> Image:
    h, w = shape
    out: Image = np.zeros((h, w, 3), np.float32)
    out[:] = (0.55, 0.58, 0.62)
    out[: h // 10] = (0.36, 0.46, 0.60)
    for k in range(2):
        a = int((0.09 + 0.43 * k) * w)
        sheet = page((int(0.84 * h), int(0.39 * w)), seed + k, (0.90, 0.90, 0.90))
        out[int(0.14 * h) : int(0.14 * h) + sheet.shape[0], a : a + sheet.shape[1]] = sheet
    return out


def _photograph(shape: tuple[int, int], seed: int) -> Image:
    h, _ = shape
    y = np.linspace(0, 1, h, dtype=np.float32)[:, None] * np.ones((1, shape[1]), np.float32)
    out = tint((0.50, 0.64, 0.78), (fractal(shape, seed, 200, 10, 1.3, (1.0, 2.5)), (0.07, 0.06, 0.05)))
    for i, colour in enumerate([(0.42, 0.50, 0.60), (0.34, 0.46, 0.42), (0.40, 0.44, 0.28)]):
        ridge = 0.42 + 0.18 * i + 0.06 * fractal((4, shape[1]), seed + 5 + i, 300, 8, 1.5)[:1]
        paint = tint(colour, (fractal(shape, seed + 9 + i, 60, 4, 0.9, (1.0, 2.0)), (0.06, 0.06, 0.05)))
        out = mix(out, paint, (y - ridge) * h / 2)
    return out


def screens(shape: tuple[int, int], seed: int) -> Image:
    """Linear radiance of eight screens, SCREENS = (columns, rows) of equal cells: white is 1."""
    painters = (_code, _table, _document, _charts, _code, _photograph, _document, _table)
    cells: list[Callable[[tuple[int, int]], Image]] = [
        partial(painter, seed=seed + 50 * i) for i, painter in enumerate(painters)
    ]
    return np.clip(atlas(cells, SCREENS[0])(shape), 0.02, 1) ** np.float32(2.2)


def binders(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of BINDERS spines side by side: marbled or plain binders with a label, then books."""
    h, w = shape
    rng = np.random.default_rng(seed)
    palette = [
        *[(0.30, 0.31, 0.34), (0.66, 0.28, 0.25), (0.26, 0.40, 0.58), (0.36, 0.50, 0.38)],
        *[(0.80, 0.70, 0.36), (0.74, 0.74, 0.73), (0.50, 0.38, 0.56)],
    ]
    out: Image = np.zeros((h, w, 3), np.float32)
    for i, (a, b) in enumerate(pairwise(np.round(np.linspace(0, w, BINDERS + 1)).astype(int))):
        colour = np.clip(np.array(palette[int(rng.integers(len(palette)))]) + rng.normal(0, 0.03, 3), 0.22, 0.86)
        spine: Image = np.broadcast_to(colour.astype(np.float32), (h, b - a, 3)).copy()
        n = b - a
        if i < BINDERS // 2:
            spine = spine * (1 + 0.10 * np.clip(fractal((h, n), seed + i, 30, 3, 0.8), -2, 2))[..., None]
            label = page((int(0.36 * h), n - 2 * (n // 7)), seed + 40 + i)
            top = int(0.14 * h)
            spine[top : top + label.shape[0], n // 7 : n // 7 + label.shape[1]] = label
            spine = words(spine, str(2000 + int(rng.integers(26))), (0.2, 0.30), 0.035, INK, 0.2)
            y, x = np.ogrid[:h, :n]
            hole = np.hypot(y - 0.82 * h, (x - n / 2) * 1.0)
            spine = mix(spine, (0.72, 0.72, 0.72), 1 / (1 + np.exp(np.abs(hole - 0.32 * n) - 2)))
            spine = mix(spine, (0.22, 0.22, 0.23), 1 / (1 + np.exp(hole - 0.26 * n)))
        else:
            ink = np.array((0.88, 0.82, 0.62) if colour.mean() < 0.5 else (0.28, 0.25, 0.24), np.float32)
            for y0 in rng.uniform(0.03, 0.95, 3):
                spine[int(y0 * h) : int(y0 * h) + int(rng.integers(3, 16))] = ink
            y1 = 0.18
            while y1 < rng.uniform(0.5, 0.8):
                spine[int(y1 * h) : int((y1 + 0.02) * h), n // 3 : 2 * n // 3] = ink
                y1 += 0.034
        spine[int(0.955 * h) :] = colour
        out[:, a:b] = spine
    return cv2.GaussianBlur(out, (0, 0), 0.8)


def pages(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of PAGES = (columns, rows) printed sheets."""
    rng = np.random.default_rng(seed)
    papers = [(0.88, 0.87, 0.84), (0.89, 0.89, 0.88), (0.88, 0.84, 0.70), (0.78, 0.84, 0.88)]
    cells: list[Callable[[tuple[int, int]], Image]] = [
        partial(page, seed=seed + 7 * i, paper=papers[int(rng.integers(4))], accent=_BARS[i % 4])
        for i in range(PAGES[0] * PAGES[1])
    ]
    return atlas(cells, PAGES[0])(shape)


def whiteboard(shape: tuple[int, int], seed: int) -> Image:
    """Whiteboard with boxes, arrows, a curve and notes in three inks, wiped traces and a few sticky notes."""
    h, w = shape
    rng = np.random.default_rng(seed)
    out = tint((0.86, 0.87, 0.87), (fractal(shape, seed, 400, 20, 1.4, (1.0, 3.0)), (0.012, 0.012, 0.011)))
    inks: list[Colour] = [(0.22, 0.30, 0.52), (0.62, 0.24, 0.22), (0.20, 0.36, 0.26)]

    def draw(colour: Colour, strokes: list[list[tuple[float, float]]], thick: int = 3) -> None:
        nonlocal out
        mask = np.zeros(shape, np.uint8)
        for stroke in strokes:
            p = np.round(np.array(stroke) * (w, h) * 16).astype(np.int32)
            cv2.polylines(mask, [p], False, 255, thick, cv2.LINE_AA, 4)
        out = mix(out, colour, cv2.GaussianBlur(mask / np.float32(255), (0, 0), 0.8) * 0.9)

    x, boxes = 0.05, []
    for i in range(4):
        y = 0.15 + 0.08 * rng.uniform()
        boxes.append((x, y))
        j = rng.normal(0, 0.004, (5, 2))
        corners = [(x, y), (x + 0.11, y), (x + 0.11, y + 0.17), (x, y + 0.17), (x, y)]
        draw(inks[0], [[(a + d[0], b + d[1]) for (a, b), d in zip(corners, j, strict=True)]])
        out = words(out, ("pose", "rays", "light", "rows")[i], (x + 0.015, y + 0.11), 0.05, inks[i % 3], 0.12)
        x += 0.16
    draw(inks[1], [[(a + 0.115, b + 0.08), (a + 0.155, b + 0.08), (a + 0.145, b + 0.06)] for a, b in boxes[:-1]])
    draw(inks[2], [[(0.08, 0.50), (0.08, 0.90), (0.42, 0.90)]])
    s = np.linspace(0, 1, 40)
    curve = 0.88 - 0.34 * (1 - np.exp(-3 * s)) + 0.02 * np.sin(9 * s)
    draw(inks[1], [list(zip(0.08 + 0.33 * s, curve, strict=True))])
    for k, note in enumerate(("1. measure twice", "2. drift < 1 mm", "3. ask Anna", "t = t0 + r y / h")):
        out = words(out, note, (0.50, 0.56 + 0.11 * k), 0.055, inks[(k + int(rng.integers(3))) % 3], 0.11)
    smear = np.clip(fractal(shape, seed + 1, 250, 30, 1.3, (1.0, 4.0)) - 1.0, 0, 1)
    out = mix(out, (0.66, 0.68, 0.72), 0.25 * smear)
    for _ in range(6):
        a, b = int(rng.uniform(0.74, 0.93) * w), int(rng.uniform(0.08, 0.45) * h)
        n = int(0.06 * w)
        out[b : b + n, a : a + n] = ((0.88, 0.80, 0.42), (0.88, 0.62, 0.62), (0.60, 0.80, 0.62))[int(rng.integers(3))]
        for q in range(3):
            out[
                b + n // 5 + q * n // 5 : b + n // 5 + q * n // 5 + 3, a + n // 8 : a + int(n * rng.uniform(0.5, 0.9))
            ] = INK
    return cv2.GaussianBlur(out, (0, 0), 0.6)


def posters(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of POSTERS = (columns, rows) posters."""
    palettes: list[list[Colour]] = [
        [(0.86, 0.83, 0.76), (0.74, 0.40, 0.30), (0.26, 0.40, 0.50), (0.82, 0.64, 0.32)],
        [(0.40, 0.52, 0.58), (0.86, 0.82, 0.72), (0.78, 0.50, 0.36), (0.30, 0.36, 0.40)],
        [(0.82, 0.80, 0.70), (0.40, 0.52, 0.40), (0.66, 0.70, 0.42), (0.84, 0.60, 0.42)],
    ]
    titles = ("OPEN DAY", "FORUM 26", "SUMMER")
    cells: list[Callable[[tuple[int, int]], Image]] = [
        partial(poster, seed=seed + 31 * i, palette=palettes[(i + seed) % 3], title=titles[i]) for i in range(3)
    ]
    return atlas(cells, POSTERS[0])(shape)
