"""Drawing on 8-bit sheets for the table's prints: shapes, type, small pictures of a cover; sizes in pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from scenes.kit.textures import Colour, Image, fractal

Canvas = NDArray[np.uint8]

INK, PAPER = (0.24, 0.22, 0.23), (0.88, 0.86, 0.79)
_PHRASE = (
    "the light of a lamp over old wood and the slow turn of a row that was read too late so each line has its own "
    "time and place where the garden path bends by the river stone bridge under seven poplar trees in a wind from west"
)


def canvas(shape: tuple[int, int], colour: Colour) -> Canvas:
    """(h, w, 3) 8-bit sheet of one colour."""
    return np.tile(np.round(np.array(colour) * 255).astype(np.uint8), (*shape, 1))


def _rgb(colour: Colour) -> tuple[float, ...]:
    return tuple(round(255 * c) for c in colour)


def fill(sheet: Canvas, points: NDArray[np.float64], colour: Colour) -> None:
    """Antialiased polygon (n, 2) of x, y in pixels."""
    cv2.fillPoly(sheet, [np.round(points * 16).astype(np.int32)], _rgb(colour), cv2.LINE_AA, 4)


def bar(sheet: Canvas, x0: float, y0: float, x1: float, y1: float, colour: Colour) -> None:
    """Upright rectangle in pixels."""
    fill(sheet, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), colour)


def disc(sheet: Canvas, x: float, y: float, r: float, colour: Colour, squash: float = 1.0, turn: float = 0.0) -> None:
    """Ellipse of half axes `r` and `r * squash`, turned by `turn` degrees."""
    axes = (round(r * 16), round(r * squash * 16))
    cv2.ellipse(sheet, (round(x * 16), round(y * 16)), axes, turn, 0, 360, _rgb(colour), -1, cv2.LINE_AA, 4)


def write(
    sheet: Canvas, text: str, x: float, y: float, height: float, colour: Colour = INK, across: float | None = None
) -> None:
    """Text with its base line's start at (x, y), capitals of `height` px; `across`: centred in [x, x + across]."""
    font, scale = cv2.FONT_HERSHEY_DUPLEX, height / 21.0
    weight = max(1, round(height / 9))
    if across is not None:
        width = cv2.getTextSize(text, font, scale, weight)[0][0]
        scale *= min(1.0, 0.94 * across / width)
        x += (across - cv2.getTextSize(text, font, scale, weight)[0][0]) / 2
    cv2.putText(sheet, text, (round(x), round(y)), font, scale, _rgb(colour), weight, cv2.LINE_AA)


def prose(
    sheet: Canvas,
    box: tuple[float, float, float, float],
    rng: np.random.Generator,
    line: float = 9.0,
    ink: Colour = INK,
) -> None:
    """Lines of small type in `box` = (x0, y0, x1, y1), with indents and short last lines of paragraphs."""
    x0, y0, x1, y1 = box
    words = _PHRASE.split()
    y, fresh = y0 + line, True
    while y < y1:
        x = x0 + (1.5 * line if fresh else 0)
        end = x1 if rng.uniform() > 0.16 else x0 + (x1 - x0) * rng.uniform(0.3, 0.8)
        fresh = end < x1
        while True:
            word = words[rng.integers(len(words))]
            width = cv2.getTextSize(word, cv2.FONT_HERSHEY_PLAIN, line / 15, 1)[0][0]
            if x + width > end:
                break
            cv2.putText(sheet, word, (round(x), round(y)), cv2.FONT_HERSHEY_PLAIN, line / 15, _rgb(ink), 1, cv2.LINE_AA)
            x += width + 0.45 * line
        y += line


def finish(sheet: Canvas, seed: int, grain: float = 0.018) -> Image:
    """The sheet as an image, with the unevenness of ink on paper."""
    out = cv2.GaussianBlur(sheet.astype(np.float32) / 255, (0, 0), 0.55)
    shape = sheet.shape[:2]
    mottle = fractal(shape, seed, 24, 3, 0.6) * grain + fractal(shape, seed + 1, 200, 12, 1.2) * grain
    return out * (1 + mottle)[..., None]


def picture(kind: int, shape: tuple[int, int], rng: np.random.Generator, ground: Colour, inks: list[Colour]) -> Canvas:
    """Picture of a cover: leaves (0), tiles (1), hills with houses (2) or rings (3) on `ground`."""
    h, w = shape
    sheet = canvas(shape, ground)
    if kind == 0:
        k = np.linspace(0, 1, 9)
        side = np.stack([k, 0.3 * np.sin(np.pi * k)], 1)
        outline = np.concatenate([side, (side * (1, -1))[::-1]])
        size = np.clip(0.16 * np.sqrt(w * h), 14, 32)
        for i in range(round(3.2 * w * h / size**2)):
            a, at = rng.uniform(0, 2 * np.pi), rng.uniform((0, 0), (w, h))
            turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) * size * rng.uniform(0.7, 1.2)
            fill(sheet, outline @ turn.T + at, inks[i % len(inks)])
            fill(sheet, outline * (1, 0.13) @ turn.T + at, PAPER)
    elif kind == 1:
        size = w / max(4, round(w / 22))
        for x in np.arange(0, w, size):
            for y in np.arange(0, h, size):
                one, two = (inks[j] for j in rng.choice(len(inks), 2, replace=False))
                bar(sheet, x + 1, y + 1, x + size - 1, y + size - 1, one)
                disc(sheet, x + size / 2, y + size / 2, size * 0.36, two)
                disc(sheet, x + size / 2, y + size / 2, size * 0.16, PAPER)
    elif kind == 2:
        sheet = canvas(shape, inks[0])
        disc(sheet, 0.7 * w, 0.25 * h, 0.13 * w, inks[1])
        for layer in range(5):
            x = np.linspace(0, w, 24)
            y = h * (0.36 + 0.13 * layer) + 0.05 * h * np.cumsum(rng.normal(0, 0.35, 24))
            fill(sheet, np.concatenate([np.stack([x, y], 1), [[w, h], [0, h]]]), inks[2 + layer % (len(inks) - 2)])
            for j in rng.integers(1, 23, 7):
                s = rng.uniform(0.03, 0.05) * w
                bar(sheet, x[j] - s, y[j] - s, x[j] + s, y[j] + s, PAPER)
                fill(sheet, np.array([[-1.3, -0.9], [0, -2.1], [1.3, -0.9]]) * s + (x[j], y[j]), inks[1])
                bar(sheet, x[j] - 0.3 * s, y[j] - 0.2 * s, x[j] + 0.3 * s, y[j] + s, INK)
    else:
        size = np.clip(0.09 * np.sqrt(w * h), 10, 19)
        for i in range(round(1.1 * w * h / size**2)):
            at, r = rng.uniform((0, 0), (w, h)), size * rng.uniform(0.4, 1.3)
            for ring in range(4):
                disc(sheet, at[0], at[1], r * (1 - 0.25 * ring), inks[(i + ring) % len(inks)])
    return sheet


def paste(sheet: Canvas, pane: Canvas, x: float, y: float) -> None:
    """Copies `pane` into the sheet with its upper left corner at (x, y) in pixels."""
    sheet[round(y) : round(y) + len(pane), round(x) : round(x) + pane.shape[1]] = pane
