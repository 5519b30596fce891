"""Pictures with something drawn on them, as atlases: signs, notices, packing labels; and the sky behind panes."""

from __future__ import annotations

import cv2
import numpy as np

from scenes.kit import textures as tx
from scenes.kit.textures import Image

SIGNS = (4, 3)  # columns, rows of the atlas of signs
LABELS = (4, 4)
Rect = tuple[float, float, float, float]
_WHITE, _BLACK = (0.88, 0.87, 0.84), (0.22, 0.22, 0.23)
_YELLOW, _BLUE, _RED, _GREEN = (0.88, 0.72, 0.22), (0.25, 0.42, 0.66), (0.74, 0.27, 0.25), (0.28, 0.56, 0.38)


def _rect(index: int, grid: tuple[int, int]) -> Rect:
    cols, rows = grid
    i, j = index % cols, (index // cols) % rows
    inset = 0.012
    return ((i + inset) / cols, (j + inset) / rows, (i + 1 - inset) / cols, (j + 1 - inset) / rows)


def sign_rect(index: int) -> Rect:
    """(u0, v0, u1, v1) of a sign in the atlas of signs."""
    return _rect(index, SIGNS)


def label_rect(index: int) -> Rect:
    """(u0, v0, u1, v1) of a label in the atlas of labels."""
    return _rect(index, LABELS)


def _text(
    image: Image, words: str, centre: tuple[float, float], width: float, colour: tx.Colour, bold: int = 2
) -> None:
    """Words centred at a point and `width` wide, all in fractions of the image."""
    h, w = image.shape[:2]
    font = cv2.FONT_HERSHEY_SIMPLEX
    (base, _), _ = cv2.getTextSize(words, font, 1.0, bold)
    scale = width * w / base
    (tw, th), _ = cv2.getTextSize(words, font, scale, bold)
    at = (round(centre[0] * w - tw / 2), round(centre[1] * h + th / 2))
    ink = np.zeros((h, w), np.uint8)
    cv2.putText(ink, words, at, font, scale, 255, bold, cv2.LINE_AA)
    image[:] = tx.mix(image, colour, ink.astype(np.float32) / 255)


def _points(shape: tuple[int, int], points: list[tuple[float, float]]) -> np.ndarray:
    return np.round(np.array(points) * (shape[1], shape[0])).astype(np.int32)


def _triangle(image: Image, words: str) -> None:
    h, w = image.shape[:2]
    image[:] = _YELLOW
    cv2.fillPoly(image, [_points((h, w), [(0.5, 0.06), (0.93, 0.74), (0.07, 0.74)])], _BLACK, cv2.LINE_AA)
    cv2.fillPoly(image, [_points((h, w), [(0.5, 0.17), (0.83, 0.68), (0.17, 0.68)])], _YELLOW, cv2.LINE_AA)
    cv2.fillPoly(
        image, [_points((h, w), [(0.46, 0.30), (0.54, 0.30), (0.52, 0.54), (0.48, 0.54)])], _BLACK, cv2.LINE_AA
    )
    cv2.circle(image, (w // 2, round(0.60 * h)), round(0.028 * w), _BLACK, -1, cv2.LINE_AA)
    _text(image, words, (0.5, 0.87), 0.84, _BLACK)


def _order(image: Image, words: str, ears: bool) -> None:
    h, w = image.shape[:2]
    image[:] = _WHITE
    cv2.circle(image, (w // 2, round(0.40 * h)), round(0.33 * w), _BLUE, -1, cv2.LINE_AA)
    cv2.circle(image, (w // 2, round(0.42 * h)), round(0.15 * w), _WHITE, -1, cv2.LINE_AA)
    for s in (-1, 1):
        at = (round((0.5 + s * (0.16 if ears else 0.07)) * w), round(0.40 * h))
        cv2.circle(image, at, round(0.06 * w), _WHITE if ears else _BLUE, -1, cv2.LINE_AA)
    _text(image, words, (0.5, 0.88), 0.86, _BLACK)


def _band(image: Image, colour: tx.Colour, words: list[str]) -> None:
    image[:] = colour
    h, w = image.shape[:2]
    cv2.rectangle(image, (round(0.04 * w), round(0.04 * h)), (round(0.96 * w), round(0.96 * h)), _WHITE, 3, cv2.LINE_AA)
    for k, line in enumerate(words):
        _text(image, line, (0.5, (k + 1) / (len(words) + 1)), 0.8, _WHITE, 4)


def _notice(image: Image, seed: int) -> None:
    """A typed sheet or chart: a headline, lines of text, a diagram."""
    h, w = image.shape[:2]
    rng = np.random.default_rng(seed)
    image[:] = _WHITE
    image[: round(0.14 * h)] = (_BLUE, _RED, _GREEN)[seed % 3]
    _text(image, ("MAINTENANCE", "DRILL SIZES", "SHIFT PLAN")[seed % 3], (0.5, 0.075), 0.8, _WHITE)
    for y in np.arange(0.19, 0.56, 0.032):
        x = 0.07
        while x < 0.9:
            end = min(x + float(rng.uniform(0.03, 0.13)), 0.93)
            a, b = (round(x * w), round(y * h)), (round(end * w), round((y + 0.012) * h))
            cv2.rectangle(image, a, b, _BLACK, -1)
            x = end + 0.02
    for k in range(9):
        high = float(rng.uniform(0.06, 0.3))
        a, b = (round((0.1 + 0.09 * k) * w), round((0.93 - high) * h)), (round((0.16 + 0.09 * k) * w), round(0.93 * h))
        cv2.rectangle(image, a, b, (_BLUE, _RED, _GREEN, _YELLOW)[int(rng.integers(4))], -1)


def signs(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of safety signs and notices, slightly faded and stained."""
    cols, rows = SIGNS
    h, w = shape[0] // rows, shape[1] // cols
    out = np.zeros((*shape, 3), np.float32)
    for index in range(cols * rows):
        cell = np.empty((h, w, 3), np.float32)
        if index < 3:
            _triangle(cell, ("MOVING PARTS", "CRANE ABOVE", "400 VOLT")[index])
        elif index < 5:
            _order(cell, ("EAR PROTECTION", "WEAR GOGGLES")[index - 3], index == 3)
        elif index < 8:
            words = [["EXIT", "->"], ["NO", "SMOKING"], ["FIRST", "AID"]][index - 5]
            _band(cell, (_GREEN, _RED, _GREEN)[index - 5], words)
        elif index == 8:
            _band(cell, _RED, ["FIRE", "POINT"])
        else:
            _notice(cell, seed + index)
        j, i = divmod(index, cols)
        out[j * h : (j + 1) * h, i * w : (i + 1) * w] = cell
    dirt = 1 + 0.035 * tx.fractal(shape, seed, 200, 6, 1.2) + 0.02 * tx.fractal(shape, seed + 1, 12, 2.6, 0.4)
    return out * dirt[..., None]


def labels(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of packing labels: part numbers, bars, arrows, stamps."""
    cols, rows = LABELS
    h, w = shape[0] // rows, shape[1] // cols
    rng = np.random.default_rng(seed)
    out = np.zeros((*shape, 3), np.float32)
    for index in range(cols * rows):
        cell = np.empty((h, w, 3), np.float32)
        cell[:] = np.array(_WHITE) * rng.uniform(0.9, 1.0)
        _text(cell, f"{rng.integers(100, 999)}-{rng.integers(10, 99)}", (0.36, 0.16), 0.58, _BLACK, 3)
        x = 0.07
        while x < 0.62:
            wide = float(rng.choice([0.008, 0.014, 0.022]))
            cell[round(0.32 * h) : round(0.58 * h), round(x * w) : round((x + wide) * w)] = _BLACK
            x += wide + float(rng.choice([0.012, 0.02]))
        for y in (0.66, 0.76, 0.86):
            cell[round(y * h) : round((y + 0.05) * h), round(0.07 * w) : round(rng.uniform(0.35, 0.65) * w)] = _BLACK
        colour = (_RED, _BLUE, _GREEN, _YELLOW)[index % 4]
        cell[round(0.1 * h) : round(0.9 * h), round(0.72 * w) : round(0.93 * w)] = colour
        arrow = [(0.825, 0.2), (0.90, 0.42), (0.85, 0.42), (0.85, 0.8), (0.80, 0.8), (0.80, 0.42), (0.75, 0.42)]
        cv2.fillPoly(cell, [_points((h, w), arrow)], _WHITE, cv2.LINE_AA)
        j, i = divmod(index, cols)
        out[j * h : (j + 1) * h, i * w : (i + 1) * w] = cell
    return out * (1 + 0.04 * tx.fractal(shape, seed + 1, 60, 3, 0.8))[..., None]


def sky(shape: tuple[int, int], seed: int, zenith: float, horizon: float) -> Image:
    """Linear radiance behind a band of patterned glass: a bright, clouded sky above, roofs and trees below, blurred."""
    h, w = shape
    v = np.linspace(0, 1, h, dtype=np.float32)[:, None] * np.ones((1, w), np.float32)
    clouds = tx.fractal(shape, seed, w / 3, 24, 1.6)
    level = zenith + (horizon - zenith) * v**1.5 + 0.10 * zenith * clouds
    out = level[..., None] * np.array((0.94, 1.0, 1.08), np.float32)
    roofs = 0.80 + 0.10 * tx.fractal((1, w), seed + 1, w / 4, 20, 1.4)
    ground = np.clip((v - roofs) / 0.05, 0, 1)
    out = tx.mix(out, (0.40 * horizon, 0.43 * horizon, 0.36 * horizon), ground)
    return np.maximum(out, 0.05 * horizon)
