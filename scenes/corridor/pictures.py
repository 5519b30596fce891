"""Drawn pictures of the corridor: notices on the boards, plates at the doors, safety signs; (h, w, 3) in 0..1."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from scenes.kit.prints import atlas, page, plate, poster
from scenes.kit.textures import Colour, Image

NOTICES = (6, 3)  # columns, rows of the atlas of notices
PLATES = (4, 4)  # of the atlas of plates: twelve doors, then EXIT, extinguisher, assembly, no smoking
EXIT, FIRE, FLOOR_1, FLOOR_2 = 12, 13, 14, 15

_INKS: list[Colour] = [(0.60, 0.26, 0.24), (0.25, 0.36, 0.56), (0.24, 0.42, 0.30), (0.22, 0.22, 0.24)]


def notices(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of NOTICES = (columns, rows) sheets and bills of many colours."""
    rng = np.random.default_rng(seed)
    papers: list[Colour] = [
        (0.88, 0.88, 0.86),
        (0.88, 0.86, 0.72),
        (0.86, 0.74, 0.70),
        (0.74, 0.84, 0.76),
        (0.72, 0.80, 0.88),
    ]
    palettes: list[list[Colour]] = [
        [(0.88, 0.84, 0.74), (0.74, 0.40, 0.30), (0.26, 0.40, 0.50), (0.82, 0.64, 0.32)],
        [(0.46, 0.58, 0.64), (0.86, 0.82, 0.72), (0.78, 0.50, 0.36), (0.30, 0.36, 0.40)],
        [(0.84, 0.82, 0.72), (0.40, 0.52, 0.40), (0.66, 0.70, 0.42), (0.84, 0.60, 0.42)],
    ]
    titles = ("CHOIR", "SPORTS", "ROOM 9", "TO LET", "CHESS", "LAB 3")
    cells: list[Callable[[tuple[int, int]], Image]] = []
    for i in range(NOTICES[0] * NOTICES[1]):
        if i % 3 == 2:
            palette = palettes[int(rng.integers(3))]
            cells.append(partial(poster, seed=seed + 13 * i, palette=palette, title=titles[i % 6]))
        else:
            paper, ink = papers[int(rng.integers(5))], _INKS[int(rng.integers(4))]
            cells.append(partial(page, seed=seed + 13 * i, paper=paper, accent=ink))
    return atlas(cells, NOTICES[0])(shape)


def plates(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of PLATES = (columns, rows): numbers of rooms, then four signs."""
    floor = 1 + seed % 4
    white: Colour = (0.84, 0.84, 0.82)
    texts: list[tuple[str, Colour, Colour, float]] = [
        (f"{floor}.{k + 1:02d}", (0.36, 0.38, 0.42), white, 0.36) for k in range(12)
    ]
    texts += [
        ("EXIT >", (0.26, 0.52, 0.36), white, 0.36),
        ("FIRE", (0.70, 0.24, 0.22), white, 0.40),
        (f"LEVEL {floor}", (0.30, 0.42, 0.58), white, 0.26),
        (f"LEVEL {floor + 1}", (0.30, 0.42, 0.58), white, 0.26),
    ]
    cells: list[Callable[[tuple[int, int]], Image]] = [
        partial(plate, text=text, ground=ground, ink=ink, seed=seed + i, size=size)
        for i, (text, ground, ink, size) in enumerate(texts)
    ]
    return atlas(cells, PLATES[0])(shape)
