"""Printed matter of the things on and beside the table: covers, pages, cartons, labels, cards, toys; sRGB in 0..1.

Everything is our own design, drawn with fixed seeds; letters and figures are 1 to 5 mm at the sizes the things have.
"""

from __future__ import annotations

import numpy as np

from scenes.kit.textures import Colour, Image
from scenes.living_room.table_drawing import (
    INK,
    PAPER,
    Canvas,
    bar,
    canvas,
    disc,
    fill,
    finish,
    paste,
    picture,
    prose,
    write,
)

Rect = tuple[float, float, float, float]  # u0, v0, u1, v1 of a texture

COVERS = (4, 2)  # columns, rows of the atlas; the left SPINE of each cell is the spine
SPINE = 0.13
CARTONS = (2, 3)
CARDS = (3, 1)
LETTERS = (3, 2)


def cell(i: int, grid: tuple[int, int], part: Rect = (0.0, 0.0, 1.0, 1.0)) -> Rect:
    """(u0, v0, u1, v1) of cell `i` of an atlas of `grid` = (columns, rows), or of a `part` of that cell."""
    cols, rows = grid
    u, v, e = i % cols, i // cols % rows, 0.006
    a, b, c, d = (min(max(x, e), 1 - e) for x in part)
    return (u + a) / cols, (v + b) / rows, (u + c) / cols, (v + d) / rows


def _atlas(cells: list[Canvas], grid: tuple[int, int]) -> Canvas:
    cols, rows = grid
    return np.concatenate([np.concatenate(cells[r * cols : (r + 1) * cols], 1) for r in range(rows)], 0)


def covers(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of eight covers, COVERS cells: a spine with the title on the left, then the front."""
    cols, rows = COVERS
    h, w = shape[0] // rows, shape[1] // cols
    warm = [(0.78, 0.42, 0.26), (0.86, 0.68, 0.34), (0.55, 0.25, 0.24), (0.36, 0.44, 0.38)]
    cool = [(0.30, 0.46, 0.58), (0.55, 0.70, 0.72), (0.24, 0.32, 0.44), (0.78, 0.60, 0.36)]
    green = [(0.36, 0.52, 0.36), (0.62, 0.68, 0.38), (0.25, 0.38, 0.34), (0.80, 0.54, 0.42)]
    plum = [(0.52, 0.32, 0.45), (0.80, 0.58, 0.56), (0.34, 0.30, 0.42), (0.74, 0.70, 0.52)]
    designs: list[tuple[str, str, Colour, list[Colour], int]] = [
        ("LEAVES", "of the river bank", (0.80, 0.76, 0.62), green, 0),
        ("TILES", "a pattern book", (0.28, 0.36, 0.46), cool, 1),
        ("SEVEN HILLS", "walks and houses", (0.84, 0.72, 0.52), [cool[1], (0.84, 0.52, 0.30), *green], 2),
        ("ORBITS", "moons and rings", (0.32, 0.28, 0.36), plum, 3),
        ("HEARTH", "bread all year", (0.72, 0.36, 0.26), warm, 1),
        ("ROWS", "stories of late light", (0.62, 0.70, 0.68), [plum[1], warm[1], *cool], 2),
        ("WEEKEND", "garden - kitchen - maps", (0.86, 0.82, 0.72), [*warm, *green[:2]], 0),
        ("CARGO", "boats, cranes and ports", (0.46, 0.58, 0.62), [*cool, *warm[:2]], 3),
    ]
    cells = []
    for i, (title, under, ground, inks, kind) in enumerate(designs):
        rng = np.random.default_rng(seed + i)
        sheet = canvas((h, w), ground)
        dark = sum(ground) < 1.5
        ink, x0 = (PAPER if dark else INK), SPINE * w
        paste(sheet, picture(kind, (round(0.59 * h), round(w - x0) - 20), rng, ground, inks), x0 + 10, 0.29 * h)
        bar(sheet, x0 + 8, 0.05 * h, w - 8, 0.05 * h + 3, inks[0])
        write(sheet, title, x0, 0.16 * h, 24, ink, w - x0)
        write(sheet, under, x0, 0.235 * h, 10, ink, w - x0)
        write(sheet, f"number {i + 3}  -  with 148 plates", x0, 0.945 * h, 9, ink, w - x0)
        bar(sheet, 0, 0, x0 - 1, h, inks[-1])
        spine = canvas((round(x0) - 1, h), inks[-1])
        write(spine, f"{title}   {under}", 0, len(spine) / 2 + 5, 11, PAPER, h)
        bar(spine, 0.03 * h, 2, 0.03 * h + 5, len(spine) - 3, PAPER)
        bar(spine, 0.95 * h, 2, 0.95 * h + 5, len(spine) - 3, PAPER)
        sheet[:, : len(spine)] = np.rot90(spine, -1)
        cells.append(sheet)
    return finish(_atlas(cells, COVERS), seed + 50)


def spread(shape: tuple[int, int], seed: int) -> Image:
    """Two facing pages of an open book: type, an initial, plates with captions, page numbers."""
    h, w = shape
    rng = np.random.default_rng(seed)
    sheet = canvas(shape, (0.87, 0.84, 0.76))
    for page in range(2):
        x0, x1 = page * w / 2 + 0.045 * w, (page + 1) * w / 2 - 0.045 * w
        top = 0.10 * h
        write(sheet, ("Of rivers", "Bridges")[page], x0, 0.075 * h, 10, (0.55, 0.25, 0.22), x1 - x0)
        y = top + 4 if page else 0.60 * h
        inks = [(0.60, 0.70, 0.74), (0.70, 0.40, 0.30), (0.36, 0.46, 0.40), (0.52, 0.56, 0.40)]
        plate = picture(2 if page else 1, (round(0.29 * h), round(x1 - x0)), rng, PAPER, inks)
        paste(sheet, plate, x0, y)
        write(sheet, f"plate {14 + page}", x0, y + len(plate) + 10, 7, INK, x1 - x0)
        if page:
            prose(sheet, (x0, y + len(plate) + 14, x1, 0.92 * h), rng, 9.5)
        else:
            write(sheet, "A", x0, top + 26, 26, (0.62, 0.28, 0.22))
            prose(sheet, (x0 + 30, top, x1, top + 29), rng, 9.5)
            prose(sheet, (x0, top + 29, x1, y - 6), rng, 9.5)
        write(sheet, str(46 + page), x0, 0.965 * h, 8, INK, x1 - x0)
    return finish(sheet, seed + 1, 0.012)


def cartons(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of CARTONS cells: tea carton's front, its side; shoe box's lid, its side; biscuit tin's lid, newspaper."""
    cols, rows = CARTONS
    h, w = shape[0] // rows, shape[1] // cols
    rng = np.random.default_rng(seed)
    teal, cream, red, straw = (0.26, 0.46, 0.46), (0.88, 0.84, 0.72), (0.70, 0.30, 0.24), (0.82, 0.66, 0.38)
    side, lid, shoes, biscuits, news = (
        canvas((h, w), c) for c in (teal, (0.74, 0.62, 0.46), (0.74, 0.62, 0.46), red, (0.80, 0.79, 0.74))
    )
    tea = picture(0, (h, w), rng, teal, [(0.34, 0.55, 0.50), (0.44, 0.62, 0.48), (0.22, 0.40, 0.42)])
    bar(tea, 0.12 * w, 0.24 * h, 0.88 * w, 0.78 * h, cream)
    bar(tea, 0.14 * w, 0.27 * h, 0.86 * w, 0.75 * h, red)
    bar(tea, 0.155 * w, 0.29 * h, 0.845 * w, 0.73 * h, cream)
    write(tea, "MOUNTAIN TEA", 0.15 * w, 0.47 * h, 24, teal, 0.70 * w)
    write(tea, "first leaf - 40 bags", 0.15 * w, 0.60 * h, 12, INK, 0.70 * w)
    write(tea, "80 g", 0.15 * w, 0.69 * h, 10, red, 0.70 * w)
    bar(side, 0.07 * w, 0.07 * h, 0.93 * w, 0.93 * h, cream)
    write(side, "HOW TO BREW", 0.08 * w, 0.22 * h, 14, red, 0.84 * w)
    prose(side, (0.10 * w, 0.27 * h, 0.90 * w, 0.68 * h), rng, 11)
    edges = 0.10 * w + np.cumsum(rng.integers(2, 7, 60))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        if b < 0.6 * w:
            bar(side, float(a), 0.74 * h, float(b), 0.89 * h, INK)
    for sheet in (lid, shoes):
        for i in range(22):
            x = (i + 0.5) * w / 22
            bar(sheet, x, 0, x + 3, h, (0.68, 0.55, 0.40))
        bar(sheet, 0, 0.36 * h, w, 0.66 * h, (0.34, 0.36, 0.44))
        write(sheet, "NORTH ROAD SHOES", 0, 0.57 * h, 26, cream, w)
    write(lid, "made for long walks", 0, 0.82 * h, 13, INK, w)
    bar(shoes, 0.66 * w, 0.05 * h, 0.97 * w, 0.32 * h, PAPER)
    write(shoes, "size 42", 0.67 * w, 0.24 * h, 14, INK, 0.29 * w)
    for ring, colour in enumerate((straw, red, cream, (0.44, 0.24, 0.22))):
        r = 0.47 - 0.05 * ring
        bar(biscuits, (0.5 - r) * w, (0.5 - r) * h, (0.5 + r) * w, (0.5 + r) * h, colour)
    for i in range(60):
        a = 2 * np.pi * i / 60
        disc(biscuits, (0.5 + 0.29 * np.cos(a)) * w, (0.5 + 0.26 * np.sin(a)) * h, 5, (straw, cream)[i % 2])
    write(biscuits, "BISCUITS", 0.26 * w, 0.50 * h, 26, cream, 0.48 * w)
    write(biscuits, "butter and oat", 0.26 * w, 0.64 * h, 12, straw, 0.48 * w)
    write(news, "THE EVENING ROW", 0, 0.13 * h, 22, INK, w)
    bar(news, 0.03 * w, 0.17 * h, 0.97 * w, 0.18 * h, INK)
    greys: list[Colour] = [(g, g, g) for g in (0.62, 0.50, 0.42, 0.34)]
    paste(news, picture(2, (round(0.38 * h), round(0.61 * w)), rng, PAPER, greys), 0.36 * w, 0.22 * h)
    for i in range(3):
        x = (0.03 + 0.32 * i) * w
        prose(news, (x, (0.20 if i == 0 else 0.64) * h, x + 0.29 * w, 0.97 * h), rng, 9)
    return finish(_atlas([tea, side, lid, shoes, biscuits, news], CARTONS), seed + 50)


def bottle(shape: tuple[int, int], seed: int) -> Image:
    """Wrap of the bottle, neck at the top: green glaze, cork-coloured neck, a paper label all around."""
    h, w = shape
    rng = np.random.default_rng(seed)
    sheet = canvas(shape, (0.34, 0.44, 0.34))
    bar(sheet, 0, 0, w, 0.13 * h, (0.70, 0.54, 0.38))
    bar(sheet, 0, 0.16 * h, w, 0.19 * h, (0.80, 0.68, 0.40))
    bar(sheet, 0, 0.42 * h, w, 0.83 * h, PAPER)
    for y in (0.43, 0.81):
        bar(sheet, 0, y * h, w, (y + 0.012) * h, (0.62, 0.28, 0.24))
    for half in range(2):
        x = half * w / 2
        write(sheet, "OLIVE OIL", x, 0.52 * h, 20, (0.30, 0.40, 0.26), w / 2)
        sprig = picture(0, (round(0.13 * h), round(0.44 * w)), rng, PAPER, [(0.42, 0.52, 0.30), (0.58, 0.62, 0.34)])
        paste(sheet, sprig, x + 0.03 * w, 0.55 * h)
        prose(sheet, (x + 14, 0.69 * h, x + w / 2 - 14, 0.80 * h), rng, 9)
    return finish(sheet, seed + 1)


def tin(shape: tuple[int, int], seed: int) -> Image:
    """Wrap of a food tin, its lid at the top: stripes, name, a table of figures."""
    h, w = shape
    rng = np.random.default_rng(seed)
    sheet = canvas(shape, (0.66, 0.66, 0.64))
    bar(sheet, 0, 0.30 * h, w, 0.76 * h, (0.84, 0.72, 0.40))
    for i in range(24):
        slanted = np.array([[i, 0.30], [i + 0.5, 0.30], [i + 1, 0.38], [i + 0.5, 0.38]])
        fill(sheet, slanted * (w / 24, h), (0.70, 0.32, 0.22))
    bar(sheet, 0, 0.70 * h, w, 0.73 * h, (0.36, 0.48, 0.36))
    for i in range(3):
        x = i * w / 3
        write(sheet, ("TOMATO", "whole and peeled", "TOMATO")[i], x, 0.53 * h, 22, (0.60, 0.24, 0.20), w / 3)
        prose(sheet, (x + 10, 0.55 * h, x + w / 3 - 10, 0.69 * h), rng, 9)
    return finish(sheet, seed + 1)


def cards(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of three postcards, CARDS cells: white margin, a picture, a greeting."""
    cols, _ = CARDS
    h, w = shape[0], shape[1] // cols
    sheets = []
    for i in range(cols):
        sheet = canvas((h, w), PAPER)
        rng = np.random.default_rng(seed + i)
        inks = [(0.56, 0.70, 0.78), (0.82, 0.50, 0.32), (0.40, 0.54, 0.42), (0.66, 0.62, 0.40), (0.34, 0.42, 0.52)]
        view = picture((2, 3, 0)[i], (round(0.72 * h), round(0.90 * w)), rng, inks[4 - i], inks[i:] + inks[:i])
        paste(sheet, view, 0.05 * w, 0.07 * h)
        write(sheet, ("greetings from the hills", "happy birthday", "summer 1998")[i], 0, 0.93 * h, 10, INK, w)
        sheets.append(sheet)
    return finish(np.concatenate(sheets, 1), seed + 9)


def letters(shape: tuple[int, int], seed: int) -> Image:
    """Atlas of six faces of toy blocks, LETTERS cells: a letter in a coloured frame on limewood."""
    cols, rows = LETTERS
    h, w = shape[0] // rows, shape[1] // cols
    red, blue, yellow, green = (0.74, 0.30, 0.24), (0.26, 0.44, 0.60), (0.84, 0.66, 0.28), (0.34, 0.54, 0.36)
    paints = [red, blue, yellow, green, (0.56, 0.36, 0.52), (0.80, 0.48, 0.26)]
    cells = []
    for i, (letter, paint) in enumerate(zip("ROWSKE", paints, strict=True)):
        sheet = canvas((h, w), (0.83, 0.74, 0.58))
        bar(sheet, 6, 6, w - 6, h - 6, paint)
        bar(sheet, 12, 12, w - 12, h - 12, (0.85, 0.77, 0.62))
        write(sheet, letter, 0, 0.76 * h, 0.54 * h, paints[(i + 2) % 6], w)
        for x, y in ((17, 17), (w - 17, 17), (17, h - 17), (w - 17, h - 17)):
            disc(sheet, x, y, 3.5, paint)
        cells.append(sheet)
    return finish(_atlas(cells, LETTERS), seed, 0.025)


def remote(shape: tuple[int, int], seed: int) -> Image:
    """Top of a remote control: rows of keys, a ring, a red switch, small marks."""
    h, w = shape
    sheet = canvas(shape, (0.30, 0.30, 0.32))
    light = (0.70, 0.70, 0.68)
    disc(sheet, 0.25 * w, 0.07 * h, 0.08 * w, (0.74, 0.28, 0.24))
    disc(sheet, 0.5 * w, 0.27 * h, 0.30 * w, (0.46, 0.46, 0.48))
    disc(sheet, 0.5 * w, 0.27 * h, 0.14 * w, light)
    for i in range(21):
        x, y = (0.22 + 0.28 * (i % 3)) * w, (0.42 + 0.068 * (i // 3)) * h
        paint = [(0.36, 0.50, 0.62), (0.80, 0.66, 0.32), (0.40, 0.58, 0.40)][i % 3] if i > 17 else light
        disc(sheet, x, y, 0.10 * w, paint, 0.75)
        write(sheet, "123456789*0#<+>v-^abc"[i], x - 0.1 * w, y + 4, 7, INK, 0.2 * w)
    write(sheet, "HOME", 0, 0.93 * h, 10, light, w)
    return finish(sheet, seed)
