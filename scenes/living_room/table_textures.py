"""What the things on and beside the table are painted with: china, globe, ball, leaves and the prints, all diffuse."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import expit

from scenes.kit import textures as tx
from scenes.kit.materials import Material
from scenes.kit.textures import Colour, Image
from scenes.living_room import table_prints as prints
from scenes.living_room.table_drawing import INK

MUG_AROUND = 2 * np.pi * 0.042  # circumference of decor.mug, m


def _axes(shape: tuple[int, int]) -> tuple[Image, Image]:
    """u across and v down, in 0..1, of every texel."""
    v, u = np.meshgrid(*((np.arange(n, dtype=np.float32) + 0.5) / n for n in shape), indexing="ij")
    return u, v


def _soft(distance: Image, texels: float) -> Image:
    """1 where `distance` (in uv) is positive, 0 where negative, over about two of the `texels` of a uv unit."""
    return expit(distance * texels * 1.6)


def _flat(shape: tuple[int, int], colour: Colour) -> Image:
    return np.broadcast_to(np.array(colour, np.float32), (*shape, 3))


def stripes(shape: tuple[int, int], seed: int) -> Image:
    """Hand-painted rings of a mug: v is the way up its side; even around."""
    u, v = _axes(shape)
    wob = 0.04 * np.sin(2 * np.pi * 3 * u) + 0.035 * tx.fractal(shape, seed, 90, 10, 1.2)
    ring = _soft(0.22 - np.abs((v * 12 + wob) % 1 - 0.5), shape[0] / 12)
    out = tx.mix(_flat(shape, (0.86, 0.82, 0.72)), (0.28, 0.42, 0.54), ring)
    dots = 0.20 - np.hypot((u * 36) % 1 - 0.5, ((v * 12 + 0.5) % 1 - 0.5))
    out = tx.mix(out, (0.78, 0.44, 0.26), _soft(dots, shape[0] / 12))
    return out * (1 + 0.03 * tx.fractal(shape, seed + 1, 30, 3, 0.6))[..., None]


def china(shape: tuple[int, int], seed: int) -> Image:
    """Blue and rust tendrils and dots on cream: a repeating hand-painted pattern."""
    u, v = _axes(shape)
    wob = 0.006 * tx.fractal(shape, seed, 120, 10, 1.2)
    out = tx.tint((0.85, 0.81, 0.70), (tx.fractal(shape, seed + 1, 60, 3, 0.7), (0.018, 0.018, 0.018)))
    for n, colour in ((5, (0.26, 0.40, 0.56)), (7, (0.34, 0.50, 0.46))):
        stem = 0.09 - np.abs((v * n + 0.28 * np.sin(2 * np.pi * n * u)) % 1 - 0.5) + wob * n
        out = tx.mix(out, colour, _soft(stem, shape[0] / n))
    x, y = (u * 10) % 1 - 0.5, (v * 5 + 0.5) % 1 - 0.5
    r, a = np.hypot(x, 2 * y), np.arctan2(2 * y, x)
    flower = 0.30 * (1 + 0.28 * np.cos(5 * a)) - r + 4 * wob
    out = tx.mix(out, (0.74, 0.38, 0.28), _soft(flower, shape[1] / 10))
    return tx.mix(out, (0.86, 0.72, 0.38), _soft(0.11 - r, shape[1] / 10))


def globe(shape: tuple[int, int], seed: int) -> Image:
    """Map of a made-up world, poles above and below: seas, land in several tones, borders, graticule."""
    u, v = _axes(shape)
    land = tx.fractal(shape, seed, 260, 5, 1.7)
    relief = tx.fractal(shape, seed + 1, 60, 3.2, 1.0)
    out = tx.tint((0.46, 0.62, 0.70), (tx.fractal(shape, seed + 2, 200, 6, 1.2), (0.03, 0.03, 0.025)))
    tone = np.clip(0.5 + 0.35 * tx.fractal(shape, seed + 3, 200, 60, 1.2), 0, 1)
    ground = tx.mix(_flat(shape, (0.50, 0.58, 0.36)), (0.82, 0.68, 0.42), tone) * (1 + 0.09 * relief)[..., None]
    out = tx.mix(out, ground, expit((land - 0.25) * 25))
    out = tx.mix(out, INK, 0.8 * np.exp(-(((land - 0.25) / 0.05) ** 2)))
    state = np.abs(tx.fractal(shape, seed + 4, 120, 20, 1.3))
    out = tx.mix(out, (0.66, 0.30, 0.24), 0.8 * expit((land - 0.35) * 25) * np.exp(-((state / 0.06) ** 2)))
    lines = np.minimum(np.abs((u * 24) % 1 - 0.5) * shape[1] / 24, np.abs((v * 12) % 1 - 0.5) * shape[0] / 12)
    return tx.mix(out, (0.30, 0.36, 0.42), 0.55 * np.exp(-((lines / 0.9) ** 2)))


def ball(shape: tuple[int, int], seed: int) -> Image:
    """Toy ball: eight coloured gores with stars, a band of dots at the equator."""
    u, v = _axes(shape)
    paints = np.array([(0.76, 0.30, 0.24), (0.86, 0.80, 0.66), (0.28, 0.44, 0.62), (0.84, 0.66, 0.30)], np.float32)
    out: Image = paints[np.floor(u * 8).astype(int) % 4]
    x, y = ((u * 16) % 1 - 0.5) * np.sin(np.pi * v), (v * 10) % 1 - 0.5
    r, a = np.hypot(x, y * 0.8), np.arctan2(y, x)
    out = tx.mix(out, (0.34, 0.30, 0.36), _soft(0.19 * (1 + 0.35 * np.cos(5 * a)) - r, shape[1] / 16))
    out = tx.mix(out, (0.36, 0.52, 0.40), _soft(0.035 - np.abs(v - 0.5), shape[0]))
    dots = 0.30 - np.hypot((u * 48) % 1 - 0.5, (v - 0.5) * 24)
    out = tx.mix(out, (0.88, 0.84, 0.72), _soft(dots, shape[1] / 48))
    return out * (1 + 0.04 * tx.fractal(shape, seed, 60, 3, 0.7))[..., None]


def rings(shape: tuple[int, int], seed: int) -> Image:
    """Wrap of a stacking toy, top first: one paint a ring, each with a thin line and turned scratches."""
    _, v = _axes(shape)
    warm = [(0.80, 0.70, 0.52), (0.74, 0.30, 0.26), (0.84, 0.56, 0.26)]
    paints = np.array([*warm, (0.84, 0.74, 0.34), (0.36, 0.54, 0.38), (0.28, 0.44, 0.60)], np.float32)
    out: Image = paints[np.floor(v * 12).astype(int) % 6]
    out = tx.mix(out, (0.88, 0.84, 0.74), _soft(0.10 - np.abs((v * 12) % 1 - 0.5), shape[0] / 12))
    return out * (1 + 0.06 * tx.fractal(shape, seed, 50, 3, 0.7, (1.0, 6.0)))[..., None]


def _aloe(shape: tuple[int, int]) -> Image:
    spots = np.clip(tx.fractal(shape, 451, 18, 4, 0.8, (1.6, 1.0)) - 0.9, 0, 1)
    base = tx.tint((0.36, 0.52, 0.36), (tx.fractal(shape, 452, 100, 5, 1.2), (0.05, 0.05, 0.03)))
    return tx.mix(base, (0.74, 0.80, 0.60), spots)


def _pot(shape: tuple[int, int]) -> Image:
    u, v = _axes(shape)
    out = tx.tint((0.70, 0.42, 0.30), (tx.fractal(shape, 461, 50, 3, 0.8), (0.04, 0.03, 0.025)))
    zigzag = 0.12 - np.abs((v * 6 + 2 * np.abs((u * 20) % 1 - 0.5)) % 1 - 0.5)
    return tx.mix(out, (0.84, 0.74, 0.58), _soft(zigzag, shape[0] / 6))


def _soil(shape: tuple[int, int]) -> Image:
    return tx.tint((0.36, 0.29, 0.23), (tx.fractal(shape, 491, 30, 3, 0.6), (0.08, 0.07, 0.06)))


def _edges(shape: tuple[int, int]) -> Image:
    leaves = tx.fractal(shape, 471, 24, 2.8, 0.3, (1.0, 40.0))
    return tx.tint((0.82, 0.77, 0.66), (leaves, (0.06, 0.06, 0.065)))


def _pencil(shape: tuple[int, int]) -> Image:
    u, v = _axes(shape)
    lanes = np.array([(0.80, 0.60, 0.22), (0.36, 0.30, 0.28), (0.74, 0.32, 0.24)], np.float32)
    out: Image = lanes[np.floor(v * 3).astype(int) % 3]
    out = tx.mix(out, (0.86, 0.76, 0.58), _soft(0.05 - u, shape[1]) + _soft(u - 0.90, shape[1]))
    return out * (1 + 0.05 * tx.fractal(shape, 481, 30, 3, 0.6, (1.0, 5.0)))[..., None]


def _of(paint: Callable[[tuple[int, int], int], Image], seed: int) -> Callable[[tuple[int, int]], Image]:
    return lambda shape: paint(shape, seed)


OBJECT_MATERIALS: dict[str, Material] = {
    "covers": Material(_of(prints.covers, 501), (640, 960)),
    "spread": Material(_of(prints.spread, 511), (352, 512)),
    "cartons": Material(_of(prints.cartons, 521), (660, 640)),
    "bottle": Material(_of(prints.bottle, 531), (384, 448)),
    "tin": Material(_of(prints.tin, 541), (320, 448)),
    "cards": Material(_of(prints.cards, 551), (144, 624)),
    "letters": Material(_of(prints.letters, 561), (192, 288)),
    "remote": Material(_of(prints.remote, 571), (320, 96)),
    "stripes": Material(_of(stripes, 581), (256, 320), (MUG_AROUND, 0.21)),
    "china": Material(_of(china, 591), (256, 512), (1.0, 1.0)),
    "globe": Material(_of(globe, 601), (320, 640)),
    "ball": Material(_of(ball, 611), (256, 512)),
    "rings": Material(_of(rings, 621), (256, 192)),
    "aloe": Material(_aloe, (128, 128), (0.08, 0.08)),
    "pot": Material(_pot, (160, 384)),
    "soil": Material(_soil, (96, 96), (0.08, 0.08)),
    "edges": Material(_edges, (128, 128), (0.05, 0.05)),
    "wood": Material(lambda s: tx.wood(s, 495, (0.62, 0.46, 0.32), (0.36, 0.25, 0.17), 14), (128, 256), (0.2, 0.1)),
    "pencil": Material(_pencil, (48, 192)),
}
