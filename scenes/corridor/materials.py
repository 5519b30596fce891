"""What the corridor is painted with, by seed: its BSDFs, their textures and the size in metres of one texture tile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scenes.corridor import pictures
from scenes.kit import prints
from scenes.kit import textures as tx
from scenes.kit.materials import Material, plain, wood
from scenes.kit.pieces import draw
from scenes.kit.textures import Colour, Image

Painter = Callable[[tuple[int, int]], Image]
Pair = tuple[Colour, Colour]

DADOS: list[Colour] = [(0.60, 0.68, 0.62), (0.72, 0.66, 0.52), (0.58, 0.65, 0.72), (0.74, 0.70, 0.66)]
LINOS: list[Pair] = [
    ((0.50, 0.53, 0.51), (0.62, 0.64, 0.60)),
    ((0.56, 0.48, 0.40), (0.66, 0.60, 0.50)),
    ((0.46, 0.50, 0.56), (0.60, 0.62, 0.64)),
    ((0.44, 0.52, 0.46), (0.60, 0.64, 0.54)),
]
DOORS: list[Pair] = [
    ((0.70, 0.58, 0.43), (0.52, 0.40, 0.27)),
    ((0.52, 0.60, 0.66), (0.46, 0.54, 0.60)),
    ((0.60, 0.42, 0.30), (0.42, 0.28, 0.19)),
]


def _lino(seed: int, base: Colour, marble: Colour) -> Painter:
    """Marbled linoleum, 4 m of it along u, trodden duller along its middle, with scratches and a welded seam."""

    def paint(shape: tuple[int, int]) -> Image:
        h, w = shape
        veins = tx.fractal(shape, seed, 160, 4, 0.9, (1.0, 3.5))
        flecks = tx.fractal(shape, seed + 1, 24, 3, 0.5, (1.0, 3.0))
        clouds = tx.fractal(shape, seed + 2, 900, 60, 1.5)
        out = tx.tint(base, (clouds, (0.02, 0.02, 0.02)))
        out = tx.mix(out, marble, 0.32 + 0.20 * veins + 0.12 * flecks)
        y = np.arange(h, dtype=np.float32)[:, None] / h
        trodden = np.exp(-(((y - 0.5) / 0.22) ** 2)) * (0.8 + 0.25 * clouds)
        out = out * (1 - 0.08 * trodden)[..., None]
        out = prints.worn(out, seed + 3, w / 4.0, 160, (0.34, 0.33, 0.32), (0.05, 0.95))
        seam = np.exp(-(((y - 0.833) * h / 1.6) ** 2)) * np.ones((1, w), np.float32)
        return tx.mix(out, (0.36, 0.37, 0.36), 0.7 * seam)

    return paint


def _terrazzo(seed: int) -> Painter:
    """Cast stone with chips of several greys."""

    def paint(shape: tuple[int, int]) -> Image:
        out = tx.tint((0.60, 0.58, 0.55), (tx.fractal(shape, seed, 300, 20, 1.3), (0.02, 0.02, 0.02)))
        for k, colour in enumerate([(0.36, 0.35, 0.35), (0.78, 0.76, 0.72), (0.50, 0.42, 0.36)]):
            chips = np.clip(4 * (tx.fractal(shape, seed + 2 + k, 14 + 5 * k, 5, 1.4) - 1.15), 0, 1)
            out = tx.mix(out, colour, 0.85 * chips)
        return out

    return paint


def _gloss(seed: int, base: Colour, height: float, scuffs: int) -> Painter:
    """Painted wall of `height` metres: faint roller marks, runs, dents, and scuffs all over it."""
    return lambda s: prints.worn(
        tx.plaster(s, seed, base, 0.5) + 0.012 * tx.fractal(s, seed + 6, 40, 3, 0.6, (3.0, 1.0))[..., None],
        seed + 8, s[0] / height, scuffs, (0.48, 0.46, 0.44), (0.05, 0.97),
    )  # fmt: skip


def _cork(seed: int) -> Painter:
    return lambda s: tx.tint(
        (0.66, 0.52, 0.37),
        (tx.fractal(s, seed, 16, 3, 0.6), (0.07, 0.06, 0.05)),
        (tx.fractal(s, seed + 1, 200, 20, 1.2), (0.02, 0.02, 0.02)),
    )


def materials(seed: int) -> dict[str, Material]:
    """All materials of the corridor of this seed."""
    rng = draw(seed, "colours")
    dado = DADOS[int(rng.integers(len(DADOS)))]
    lino = LINOS[int(rng.integers(len(LINOS)))]
    door = DOORS[int(rng.integers(len(DOORS)))]
    n = 10_000 * (seed + 1) + 5_000
    frame = tuple(0.62 * c for c in dado)
    return {
        "floor": Material(_lino(n + 11, *lino), (1228, 2048), (4.0, 2.4)),
        "ceiling": Material(plain(n + 21, (0.83, 0.83, 0.80), 0.5), (1024, 1024), (3.0, 3.0)),
        "wall": Material(_gloss(n + 31, (0.82, 0.80, 0.75), 1.8, 26), (820, 2048), (4.5, 1.8)),
        "dado": Material(_gloss(n + 41, dado, 1.2, 120), (546, 2048), (4.5, 1.2)),
        "reveal": Material(plain(n + 51, (0.78, 0.76, 0.72), 0.5), (512, 512), (1.0, 1.0)),
        "skirting": Material(plain(n + 52, (0.36, 0.36, 0.36), 0.8), (512, 512), (1.0, 1.0)),
        "frame": Material(plain(n + 61, (frame[0], frame[1], frame[2]), 0.6), (512, 512), (1.0, 1.0)),
        "door": Material(wood(n + 71, *door, 34), (1024, 512), (2.1, 1.05)),
        "paint": Material(plain(n + 75, (0.82, 0.82, 0.80), 0.6), (512, 512), (1.0, 1.0)),
        "terrazzo": Material(_terrazzo(n + 81), (768, 768), (1.2, 1.2)),
        "stair_side": Material(_gloss(n + 85, (0.74, 0.72, 0.68), 1.8, 30), (820, 1024), (2.25, 1.8)),
        "nosing": Material(plain(n + 87, (0.28, 0.28, 0.28), 1.6), (256, 256), (0.4, 0.4)),
        "rail": Material(wood(n + 91, (0.60, 0.42, 0.28), (0.40, 0.26, 0.17), 14), (512, 512), (1.0, 0.5)),
        "steel": Material(plain(n + 95, (0.34, 0.36, 0.38), 0.8), (512, 512), (0.8, 0.8)),
        "pipe": Material(plain(n + 97, (0.72, 0.70, 0.66), 0.8), (512, 512), (1.0, 1.0)),
        "cabinet": Material(plain(n + 101, (0.58, 0.63, 0.68), 0.6), (512, 512), (1.0, 1.0)),
        "black": Material(plain(n + 111, (0.28, 0.28, 0.28), 0.9), (256, 256), (0.5, 0.5)),
        "red": Material(plain(n + 121, (0.72, 0.24, 0.21), 0.8), (256, 256), (0.5, 0.5), 0.2),
        "bench": Material(wood(n + 131, (0.72, 0.56, 0.38), (0.52, 0.37, 0.24), 20), (512, 512), (1.4, 0.7)),
        "cork": Material(_cork(n + 141), (512, 512), (0.6, 0.6)),
        "notice": Material(lambda s: pictures.notices(s, n + 151), (1152, 1632)),
        "plate": Material(lambda s: pictures.plates(s, n + 161), (512, 1024)),
        "diffuser": Material(plain(n + 171, (0.80, 0.80, 0.79), 0.4), (256, 256), (0.6, 0.6)),
        "dark_glass": Material(plain(n + 175, (0.25, 0.25, 0.26), 0.5), (256, 256), (0.5, 0.5), 0.1),
        "metal": Material(None, metal="Al", alpha=0.25),
    }
