"""What the living room is painted with: its BSDFs, their textures and the size in metres of one texture tile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import expit

from scenes.kit import textures as tx
from scenes.kit.materials import Material, fabric, plain, wood
from scenes.kit.textures import Image
from scenes.living_room import pictures


def _striped(shape: tuple[int, int]) -> Image:
    base = tx.fabric(shape, 331, (0.86, 0.82, 0.74), (0.78, 0.73, 0.65), 6.0)
    x = np.arange(shape[1], dtype=np.float32)[None] / shape[1] * np.ones((shape[0], 1), np.float32)
    for at, width, colour in (
        (0.2, 0.05, (0.35, 0.42, 0.50)),
        (0.5, 0.1, (0.66, 0.37, 0.29)),
        (0.8, 0.03, (0.4, 0.45, 0.5)),
    ):
        base = tx.mix(base, colour, 0.85 * expit((width - np.abs(x - at)) * 500))
    return base


def _soil(shape: tuple[int, int]) -> Image:
    return tx.tint((0.34, 0.27, 0.22), (tx.fractal(shape, 351, 40, 3, 0.6), (0.07, 0.06, 0.05)))


def _fruit(seed: int, base: tx.Colour, blush: tx.Colour) -> Callable[[tuple[int, int]], Image]:
    def paint(shape: tuple[int, int]) -> Image:
        skin = tx.tint(base, (tx.fractal(shape, seed, 12, 2.8, 0.4), (0.03, 0.03, 0.02)))
        return tx.mix(skin, blush, 0.35 + 0.35 * tx.fractal(shape, seed + 1, 300, 20, 1.5))

    return paint


def _glaze(seed: int, base: tx.Colour, band: tx.Colour) -> Callable[[tuple[int, int]], Image]:
    """Speckled stoneware with a few painted bands."""

    def paint(shape: tuple[int, int]) -> Image:
        out = tx.plaster(shape, seed, base, 0.7)
        y = np.arange(shape[0], dtype=np.float32)[:, None] / shape[0] + 0.01 * tx.fractal(shape, seed + 9, 200, 20, 1.2)
        for at in (0.15, 0.22, 0.55, 0.82):
            out = tx.mix(out, band, 0.8 * expit((0.018 - np.abs(y - at)) * 400))
        speck = np.clip(tx.fractal(shape, seed + 10, 18, 4, 0.8) - 1.9, 0, 1)
        return tx.mix(out, (0.30, 0.26, 0.24), speck)

    return paint


MATERIALS: dict[str, Material] = {
    "floor": Material(lambda s: tx.planks(s, 11, s[1] / 5.0), (2048, 2048), (5.0, 5.0)),
    "ceiling": Material(plain(21, (0.86, 0.855, 0.83), 0.75), (2048, 2048), (5.0, 5.0)),
    "wall_back": Material(lambda s: tx.wallpaper(s, 31, s[1] / 5.0), (1024, 2048), (5.0, 2.5)),
    "wall_right": Material(plain(41, (0.82, 0.79, 0.71), 0.95), (1024, 2048), (5.0, 2.5)),
    "wall_left": Material(lambda s: tx.brick(s, 51, s[1] / 5.0), (1024, 2048), (5.0, 2.5)),
    "wall_front": Material(plain(61, (0.83, 0.755, 0.66), 0.95), (1024, 2048), (5.0, 2.5)),
    "paint": Material(plain(71, (0.86, 0.85, 0.82), 0.55), (1024, 1024), (2.0, 2.0)),
    "door": Material(wood(81, (0.60, 0.68, 0.68), (0.42, 0.52, 0.54), 30), (1024, 1024), (2.1, 1.0)),
    "beam": Material(wood(91, (0.58, 0.43, 0.30), (0.32, 0.22, 0.15), 24), (1024, 2048), (4.0, 1.4)),
    "rug": Material(lambda s: pictures.rug(s, 101), (1024, 1408)),
    "sofa_a": Material(fabric(111, (0.56, 0.60, 0.62), (0.40, 0.46, 0.50)), (1024, 1024), (1.6, 1.6)),
    "sofa_b": Material(fabric(121, (0.72, 0.62, 0.48), (0.58, 0.46, 0.33)), (1024, 1024), (1.6, 1.6)),
    "armchair": Material(fabric(131, (0.68, 0.42, 0.30), (0.50, 0.28, 0.20)), (1024, 1024), (1.5, 1.5)),
    "pillow_a": Material(_striped, (512, 512), (0.6, 0.6)),
    "pillow_b": Material(lambda s: tx.wallpaper(s, 141, 800.0), (512, 512), (0.6, 0.6)),
    "pillow_c": Material(fabric(151, (0.84, 0.66, 0.36), (0.66, 0.46, 0.22), 8), (512, 512), (0.6, 0.6)),
    "curtain": Material(fabric(161, (0.80, 0.74, 0.64), (0.66, 0.58, 0.48), 5), (1024, 1024), (1.6, 1.6)),
    "oak": Material(wood(171, (0.76, 0.60, 0.42), (0.50, 0.34, 0.20), 22), (1024, 1024), (1.8, 0.9)),
    "walnut": Material(wood(181, (0.50, 0.36, 0.26), (0.28, 0.19, 0.13), 20), (1024, 1024), (1.8, 0.9)),
    "lacquer": Material(wood(191, (0.56, 0.40, 0.28), (0.33, 0.21, 0.14), 20), (1024, 1024), (1.8, 0.9), 0.18),
    "picture": Material(lambda s: pictures.paintings(s, 201), (1024, 1792)),
    "book": Material(lambda s: pictures.books(s, 211), (512, 1536)),
    "pages": Material(wood(221, (0.88, 0.84, 0.75), (0.74, 0.68, 0.57), 5), (256, 256), (0.25, 0.25)),
    "leaf": Material(lambda s: tx.leaf(s, 231), (256, 512)),
    "bark": Material(wood(241, (0.58, 0.46, 0.34), (0.32, 0.24, 0.17), 14), (512, 512), (0.3, 0.3)),
    "terracotta": Material(_glaze(251, (0.72, 0.44, 0.32), (0.80, 0.60, 0.48)), (512, 1024), (1.3, 0.6)),
    "soil": Material(_soil, (256, 256), (0.3, 0.3)),
    "glaze_blue": Material(_glaze(261, (0.42, 0.55, 0.62), (0.84, 0.82, 0.76)), (512, 1024), (0.6, 0.3), 0.15),
    "glaze_white": Material(_glaze(271, (0.84, 0.81, 0.75), (0.62, 0.38, 0.30)), (512, 1024), (0.5, 0.25), 0.15),
    "orange": Material(_fruit(281, (0.86, 0.56, 0.24), (0.82, 0.44, 0.18)), (128, 256), (0.3, 0.15)),
    "apple": Material(_fruit(291, (0.66, 0.68, 0.32), (0.70, 0.26, 0.20)), (128, 256), (0.3, 0.15), 0.2),
    "black": Material(plain(301, (0.33, 0.32, 0.32), 1.0), (256, 256), (0.5, 0.5), 0.2),
    "shade": Material(fabric(311, (0.88, 0.83, 0.73), (0.80, 0.74, 0.62), 6), (512, 1024), (1.2, 0.6)),
    "wicker": Material(fabric(321, (0.76, 0.60, 0.40), (0.44, 0.31, 0.19), 22), (512, 1024), (1.0, 0.5)),
    "clock": Material(lambda s: pictures.clock(s, 341), (384, 384)),
    "brass": Material(None, metal="Cu", alpha=0.25),
}
