"""What the office is painted with, by seed: its BSDFs, their textures and the size in metres of one texture tile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import expit

from scenes.kit import prints
from scenes.kit import textures as tx
from scenes.kit.materials import Material, fabric, plain, wood
from scenes.kit.pieces import draw
from scenes.kit.textures import Colour, Image
from scenes.office import pictures

Painter = Callable[[tuple[int, int]], Image]
Pair = tuple[Colour, Colour]


def carpet(seed: int, base: Colour, other: Colour) -> Painter:
    """Carpet tiles of 0.5 m, four by four: loops that lie along and across by turns, some tiles of another tone."""

    def paint(shape: tuple[int, int]) -> Image:
        h, w = shape
        along, across = (tx.fractal(shape, seed + k, 24, 2.6, 0.35, s) for k, s in enumerate([(1.0, 5.0), (5.0, 1.0)]))
        y, x = np.ogrid[:h, :w]
        row, column = y * 4 // h, x * 4 // w
        tone = np.random.default_rng(seed).normal(0, 1, (4, 4)).astype(np.float32)[row, column]
        pile = np.where((row + column) % 2 == 0, along, across)
        clouds = tx.fractal(shape, seed + 2, 500, 30, 1.4)
        out = tx.tint(base, (pile, (0.05, 0.05, 0.05)), (clouds, (0.014, 0.014, 0.014)), (tone, (0.018, 0.018, 0.018)))
        flecks = np.clip(tx.fractal(shape, seed + 3, 40, 4, 0.8) - 1.1, 0, 1)
        out = tx.mix(out, other, 0.7 * flecks)
        seam = np.minimum(np.minimum(y * 4 % h, h - y * 4 % h), np.minimum(x * 4 % w, w - x * 4 % w)) / 4
        return out * (1 - 0.25 * np.exp(-((seam / 1.6) ** 2)))[..., None]

    return paint


def ceiling_tiles(seed: int, n: int = 4) -> Painter:
    """Suspended ceiling, `n` by `n` mineral tiles of 0.6 m with fissures and pinholes between white bars."""

    def paint(shape: tuple[int, int]) -> Image:
        h, w = shape
        fissures = np.clip(tx.fractal(shape, seed, 30, 3, 0.7, (1.0, 2.5)) - 1.2, 0, 1.4)
        pores = np.clip(tx.fractal(shape, seed + 1, 9, 2.6, 0.3) - 1.7, 0, 1.4)
        grain = tx.fractal(shape, seed + 2, 300, 3, 0.9)
        out = tx.tint(
            (0.84, 0.84, 0.82), (grain, (0.012, 0.012, 0.012)), (fissures, (-0.20,) * 3), (pores, (-0.22,) * 3)
        )
        y, x = np.ogrid[:h, :w]
        tone = np.random.default_rng(seed).normal(0, 0.008, (n, n)).astype(np.float32)[y * n // h, x * n // w]
        out = out + tone[..., None]
        cell = h / n
        near = np.minimum(np.minimum(y % cell, cell - y % cell), np.minimum(x % cell, cell - x % cell)) * 0.6 / cell
        out = tx.mix(out, (0.87, 0.87, 0.87), expit((0.012 - near) * 2500))
        return tx.mix(out, (0.55, 0.55, 0.55), 0.8 * np.exp(-(((near - 0.0135) / 0.0022) ** 2)))

    return paint


def _speckled(seed: int, base: Colour, contrast: float = 1.0) -> Painter:
    """Moulded plastic or powder coat: faint mottling and a fine grain."""
    c = contrast
    return lambda s: tx.tint(
        base,
        (tx.fractal(s, seed, 200, 20, 1.3), (0.018 * c,) * 3),
        (tx.fractal(s, seed + 1, 12, 2.6, 0.4), (0.022 * c,) * 3),
    )


def _wall(seed: int, base: Colour, contrast: float) -> Painter:
    """Rolled emulsion on plasterboard with scuffs near the floor; the image is 2.8 m high."""
    return lambda s: prints.worn(
        tx.plaster(s, seed, base, contrast), seed + 8, s[0] / 2.8, 90, (0.52, 0.50, 0.48), (0.62, 0.99)
    )


CARPETS: list[Pair] = [
    ((0.40, 0.43, 0.47), (0.58, 0.60, 0.62)),
    ((0.36, 0.42, 0.44), (0.62, 0.58, 0.42)),
    ((0.47, 0.44, 0.41), (0.34, 0.38, 0.44)),
    ((0.34, 0.39, 0.48), (0.52, 0.58, 0.66)),
]
ACCENTS: list[Colour] = [(0.52, 0.66, 0.66), (0.70, 0.62, 0.46), (0.50, 0.58, 0.70), (0.62, 0.66, 0.52)]
CLOTHS: list[Pair] = [
    ((0.33, 0.36, 0.41), (0.28, 0.30, 0.34)),
    ((0.30, 0.44, 0.56), (0.26, 0.36, 0.46)),
    ((0.62, 0.40, 0.30), (0.48, 0.30, 0.24)),
    ((0.40, 0.50, 0.40), (0.32, 0.40, 0.33)),
]
WOODS: list[Pair] = [
    ((0.78, 0.66, 0.50), (0.60, 0.46, 0.32)),
    ((0.82, 0.76, 0.66), (0.68, 0.60, 0.50)),
    ((0.62, 0.46, 0.33), (0.42, 0.29, 0.20)),
]


def materials(seed: int) -> dict[str, Material]:
    """All materials of the office of this seed."""
    rng = draw(seed, "colours")

    def one(options: list[Pair]) -> Pair:
        return options[int(rng.integers(len(options)))]

    base, other = one(CARPETS)
    accent = ACCENTS[int(rng.integers(len(ACCENTS)))]
    chair, screen = one(CLOTHS), one(CLOTHS)
    desk, table, shelf = one(WOODS), one(WOODS), one(WOODS)
    n = 10_000 * (seed + 1)
    white = (0.83, 0.82, 0.79)
    return {
        "floor": Material(carpet(n + 11, base, other), (1024, 1024), (2.0, 2.0)),
        "ceiling": Material(ceiling_tiles(n + 21), (1024, 1024), (2.4, 2.4)),
        "wall": Material(_wall(n + 31, white, 0.75), (1024, 1536), (4.2, 2.8)),
        "wall_accent": Material(_wall(n + 41, accent, 0.85), (1024, 1536), (4.2, 2.8)),
        "reveal": Material(plain(n + 51, white, 0.5), (512, 512), (1.0, 1.0)),
        "skirting": Material(plain(n + 52, (0.62, 0.62, 0.61), 0.6), (512, 512), (1.0, 1.0)),
        "frame": Material(_speckled(n + 61, (0.36, 0.37, 0.39)), (512, 512), (0.8, 0.8)),
        "steel": Material(_speckled(n + 62, (0.62, 0.63, 0.64)), (512, 512), (0.8, 0.8)),
        "paint": Material(_speckled(n + 63, (0.82, 0.82, 0.80), 0.7), (512, 512), (0.8, 0.8)),
        "door": Material(wood(n + 71, *one(WOODS), 30), (1024, 512), (2.1, 1.05)),
        "laminate": Material(wood(n + 81, *desk, 26), (1024, 1024), (1.7, 1.7)),
        "table_wood": Material(wood(n + 85, *table, 24), (1024, 1024), (2.4, 1.6)),
        "shelf": Material(wood(n + 91, *shelf, 24), (1024, 1024), (1.9, 1.2)),
        "cabinet": Material(_speckled(n + 95, (0.74, 0.74, 0.72), 0.9), (512, 512), (0.8, 0.8)),
        "chair": Material(fabric(n + 101, *chair, 7), (512, 512), (0.5, 0.5)),
        "divider": Material(fabric(n + 111, *screen, 6), (512, 512), (0.6, 0.6)),
        "black": Material(_speckled(n + 121, (0.27, 0.27, 0.28)), (256, 256), (0.4, 0.4)),
        "plastic": Material(_speckled(n + 122, (0.31, 0.31, 0.33)), (256, 256), (0.4, 0.4)),
        "key": Material(_speckled(n + 123, (0.42, 0.42, 0.44), 1.6), (256, 256), (0.2, 0.2)),
        "mat": Material(fabric(n + 124, (0.34, 0.36, 0.42), (0.26, 0.28, 0.33), 5), (256, 256), (0.25, 0.25)),
        "paper": Material(wood(n + 131, (0.88, 0.87, 0.85), (0.74, 0.73, 0.70), 5), (256, 256), (0.3, 0.3)),
        "page": Material(lambda s: pictures.pages(s, n + 141), (1290, 1216)),
        "binder": Material(lambda s: pictures.binders(s, n + 151), (512, 1536)),
        "whiteboard": Material(lambda s: pictures.whiteboard(s, n + 161), (768, 1280)),
        "board": Material(plain(n + 165, (0.80, 0.80, 0.80), 0.4), (256, 256), (0.8, 0.8)),
        "poster": Material(lambda s: pictures.posters(s, n + 171), (640, 1344)),
        "glaze": Material(plain(n + 181, ACCENTS[int(rng.integers(len(ACCENTS)))], 0.9), (256, 256), (0.4, 0.4), 0.15),
        "pen": Material(fabric(n + 185, (0.30, 0.40, 0.62), (0.66, 0.30, 0.26), 40), (128, 128), (0.05, 0.05)),
        "carton": Material(_speckled(n + 187, (0.62, 0.52, 0.40), 1.5), (256, 256), (0.5, 0.5)),
        "leaf": Material(lambda s: tx.leaf(s, n + 191), (256, 512)),
        "bark": Material(wood(n + 195, (0.52, 0.46, 0.32), (0.34, 0.28, 0.20), 14), (256, 256), (0.3, 0.3)),
        "terracotta": Material(plain(n + 197, (0.80, 0.79, 0.77), 0.6), (512, 512), (0.7, 0.7)),
        "soil": Material(plain(n + 199, (0.34, 0.28, 0.24), 1.6), (256, 256), (0.3, 0.3)),
        "blind": Material(fabric(n + 203, (0.80, 0.78, 0.73), (0.68, 0.66, 0.61), 5), (512, 512), (0.8, 0.8)),
        "diffuser": Material(plain(n + 207, (0.80, 0.80, 0.79), 0.4), (256, 256), (0.6, 0.6)),
        "dark_glass": Material(plain(n + 209, (0.25, 0.25, 0.26), 0.5), (256, 256), (0.5, 0.5), 0.1),
        "film": Material(plain(n + 211, (0.78, 0.79, 0.79), 0.5), (256, 256), (0.5, 0.5)),
        "metal": Material(None, metal="Al", alpha=0.25),
        "chrome": Material(None, metal="Cr", alpha=0.2),
        "glass": Material(None, glass=True),
    }
