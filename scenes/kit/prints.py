"""Printed and drawn things of public rooms: pages of type, posters, plates with words, worn paint, a view of a town.

(h, w, 3) sRGB images in 0..1, unless a function says otherwise; every one from its own seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from scipy.special import expit

from scenes.kit.textures import Colour, Image, fractal, mix, tint

INK: Colour = (0.20, 0.20, 0.23)


def atlas(cells: Sequence[Callable[[tuple[int, int]], Image]], columns: int) -> Callable[[tuple[int, int]], Image]:
    """Painter of a picture of equal cells, filled row by row; `cells` must fill all rows."""
    rows = len(cells) // columns

    def paint(shape: tuple[int, int]) -> Image:
        cell = (shape[0] // rows, shape[1] // columns)
        images = [painter(cell) for painter in cells]
        return np.concatenate([np.concatenate(images[r * columns : (r + 1) * columns], 1) for r in range(rows)], 0)

    return paint


def atlas_rect(i: int, columns: int, rows: int, margin: float = 0.01) -> tuple[float, float, float, float]:
    """(u0, v0, u1, v1) of cell `i`, `margin` of a cell inside it."""
    c, r = i % columns, i // columns % rows
    return (c + margin) / columns, (r + margin) / rows, (c + 1 - margin) / columns, (r + 1 - margin) / rows


def words(image: Image, text: str, at: tuple[float, float], size: float, colour: Colour, bold: float = 0.1) -> Image:
    """The image with `text` of cap height `size` (of the image's height), its left foot at `at` (of width, height)."""
    h, w = image.shape[:2]
    mask = np.zeros((h, w), np.uint8)
    place = (int(at[0] * w), int(at[1] * h))
    scale = size * h / 21.0  # Hershey's capitals are 21 units high
    cv2.putText(mask, text, place, cv2.FONT_HERSHEY_DUPLEX, scale, 255, max(1, round(bold * size * h)), cv2.LINE_AA)
    return mix(image, colour, cv2.GaussianBlur(mask / np.float32(255), (0, 0), 0.6))


def page(shape: tuple[int, int], seed: int, paper: Colour = (0.88, 0.87, 0.84), accent: Colour = INK) -> Image:
    """A printed sheet: headline, paragraphs in strokes of unreadable type, now and then a table or a chart."""
    h, w = shape
    rng = np.random.default_rng(seed)
    out = tint(paper, (fractal(shape, seed, 200, 4, 1.0), (0.012, 0.012, 0.014)))
    mask: Image = np.zeros(shape, np.float32)
    y = 0.07
    left, right = 0.09, 0.91
    mask[int(y * h) : int((y + 0.03) * h), int(left * w) : int(rng.uniform(0.45, 0.85) * w)] = 1.0
    out = mix(out, accent, mask)
    mask[:] = 0
    y += 0.07
    line = max(0.016, 3.2 / h)
    while y < 0.92:
        kind = rng.uniform()
        if kind < 0.16 and y < 0.72:  # a chart
            base = y + 0.18
            for i, value in enumerate(rng.uniform(0.2, 1.0, 8)):
                x = left + 0.1 + 0.08 * i
                mask[int((base - 0.16 * value) * h) : int(base * h), int(x * w) : int((x + 0.05) * w)] = 0.75
            y = base + 0.04
            continue
        for _ in range(int(rng.integers(3, 8))):
            x = left
            end = right if rng.uniform() < 0.75 else rng.uniform(0.4, 0.8)
            while x < end and y < 0.93:
                long = rng.uniform(0.02, 0.09)
                mask[int(y * h) : int((y + 0.55 * line) * h), int(x * w) : int(min(x + long, end) * w)] = 0.8
                x += long + 0.016
            y += 1.45 * line
        y += 0.02
    return mix(out, INK, cv2.GaussianBlur(mask, (0, 0), 0.7))


def poster(shape: tuple[int, int], seed: int, palette: Sequence[Colour], title: str) -> Image:
    """Poster: a title over large shapes in the palette's colours, a block of small type below."""
    h, w = shape
    rng = np.random.default_rng(seed)
    out = tint(palette[0], (fractal(shape, seed, 300, 4, 1.0), (0.02, 0.02, 0.02)))
    for i in range(9):
        mask = np.zeros(shape, np.uint8)
        centre = (int(rng.uniform(0.1, 0.9) * w * 16), int(rng.uniform(0.3, 0.75) * h * 16))
        size = rng.uniform(0.05, 0.25)
        if i % 2:
            cv2.circle(mask, centre, int(size * w * 16), 255, -1, cv2.LINE_AA, 4)
        else:
            box = cv2.boxPoints(
                ((centre[0] / 16, centre[1] / 16), (size * 2.4 * w, size * w), float(rng.uniform(0, 180)))
            )
            cv2.fillPoly(mask, [np.round(box * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
        tone = 0.85 + 0.08 * fractal(shape, seed + 3 + i, 60, 3, 0.8)
        out = mix(
            out, palette[1 + i % (len(palette) - 1)], cv2.GaussianBlur(mask / np.float32(255), (0, 0), 0.8) * tone
        )
    out = words(out, title, (0.08, 0.16), 0.07, INK, 0.16)
    mask2: Image = np.zeros(shape, np.float32)
    for k in range(5):
        y = 0.86 + 0.022 * k
        mask2[int(y * h) : int((y + 0.009) * h), int(0.08 * w) : int(rng.uniform(0.5, 0.9) * w)] = 0.8
    return mix(out, INK, cv2.GaussianBlur(mask2, (0, 0), 0.7))


def plate(shape: tuple[int, int], text: str, ground: Colour, ink: Colour, seed: int, size: float = 0.4) -> Image:
    """A sign with a word or a number."""
    out = tint(ground, (fractal(shape, seed, 120, 4, 1.0), (0.015, 0.015, 0.015)))
    return words(out, text, (0.08, 0.5 + size / 2), size, ink, 0.16)


def worn(image: Image, seed: int, metre: float, scuffs: int, colour: Colour, where: tuple[float, float]) -> Image:
    """Painted surface with dents and scuffs of `colour` between two heights (parts of the image, from above)."""
    h, w = image.shape[:2]
    rng = np.random.default_rng(seed)
    mask = np.zeros((h, w), np.uint8)
    for _ in range(scuffs):
        x, y = rng.uniform(0, w), rng.uniform(where[0], where[1]) * h
        long, tilt = rng.exponential(0.05) * metre, rng.normal(0, 0.25)
        end = (int((x + long) * 16), int((y + tilt * long) * 16))
        cv2.line(
            mask, (int(x * 16), int(y * 16)), end, int(rng.uniform(60, 200)), int(rng.integers(1, 4)), cv2.LINE_AA, 4
        )
    soft = cv2.GaussianBlur(mask / np.float32(255), (0, 0), 0.9)
    return mix(image, colour, soft * (0.6 + 0.25 * fractal((h, w), seed + 1, 40, 3, 0.6)))


def town(shape: tuple[int, int], seed: int, sky: float, ground: float) -> Image:
    """Linear radiance behind a window: bright soft sky over the blocks of a town, out of focus."""
    h, w = shape
    rng = np.random.default_rng(seed)
    y = np.linspace(0, 1, h, dtype=np.float32)[:, None] * np.ones((1, w), np.float32)
    clouds = fractal(shape, seed + 1, 200, 16, 1.3, (1.0, 2.0))
    out = tint((0.93, 0.98, 1.05), (clouds, (0.09, 0.07, 0.05))) * (sky * (0.85 + 0.25 * y))[..., None]
    for row in range(3):
        x = -0.05
        while x < 1.05:
            wide, top = rng.uniform(0.06, 0.2), rng.uniform(0.28, 0.5) + 0.14 * row
            tone = np.array(((0.75, 0.66, 0.58), (0.62, 0.64, 0.68), (0.70, 0.60, 0.50))[int(rng.integers(3))])
            a, b, c = int(max(x, 0) * w), int(min(x + wide, 1) * w), int(top * h)
            if b > a:
                out[c:, a:b] = tone * ground * rng.uniform(0.7, 1.2)
                for wy in np.arange(top + 0.03, 1.0, 0.055):
                    for wx in np.arange(max(x, 0) + 0.012, min(x + wide, 1) - 0.012, 0.024):
                        out[int(wy * h) : int((wy + 0.028) * h), int(wx * w) : int((wx + 0.011) * w)] *= 0.55
            x += wide + rng.uniform(0, 0.04)
    trees = 0.86 + 0.05 * fractal((4, w), seed + 2, 120, 8, 1.2)[:1]
    green = tint((0.50, 0.62, 0.36), (fractal(shape, seed + 3, 60, 6, 1.0), (0.13, 0.14, 0.09)))
    out = mix(out, green * ground, expit((y - trees) * h / 4))
    return np.maximum(cv2.GaussianBlur(out, (0, 0), 2.0), 0.05 * ground)
