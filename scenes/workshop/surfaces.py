"""Painters of the workshop's surfaces: concrete with worn paint, blockwork, sheet metal, enamel, rust, boards."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.special import expit

from scenes.kit import textures as tx
from scenes.kit.textures import Colour, Image

Painter = Callable[[tuple[int, int]], Image]


def _cracks(shape: tuple[int, int], seed: int, longest: float, width: float) -> Image:
    """Wandering lines, 0..1: where a smooth noise passes through zero, here and there."""
    field = tx.fractal(shape, seed, longest, longest / 14, 1.5)
    steep = np.hypot(*np.gradient(field)) + 1e-6
    here = expit(4 * (tx.fractal(shape, seed + 1, longest, longest / 3, 1.2) - 0.9))
    return np.exp(-((field / steep / width) ** 2)) * here


@lru_cache(maxsize=1)
def concrete(shape: tuple[int, int], seed: int, metre: float) -> Image:
    """Floated floor of concrete: clouds, aggregate, oil and tyre marks, cracks."""
    base = tx.tint(
        (0.55, 0.54, 0.51),
        (tx.fractal(shape, seed, 3.0 * metre, 0.2 * metre, 1.4), (0.045, 0.045, 0.045)),
        (tx.fractal(shape, seed + 1, 0.25 * metre, 3, 0.9), (0.040, 0.040, 0.038)),
        (tx.fractal(shape, seed + 2, 9, 2.6, 0.4), (0.026, 0.026, 0.026)),
        (np.clip(tx.fractal(shape, seed + 3, 10, 3, 0.5) - 1.8, 0, 1), (0.16, 0.15, 0.13)),
    )
    oil = expit(7 * (tx.fractal(shape, seed + 4, 0.7 * metre, 0.05 * metre, 1.6) - 1.9))
    base = tx.mix(base, (0.30, 0.29, 0.27), 0.75 * oil)
    tyre = np.clip(tx.fractal(shape, seed + 5, 0.5 * metre, 4, 0.8, (1.0, 14.0)) - 1.5, 0, 1)
    base = tx.mix(base, (0.33, 0.33, 0.33), 0.5 * tyre)
    return tx.mix(base, (0.27, 0.26, 0.25), 0.7 * _cracks(shape, seed + 6, 1.6 * metre, 1.1))


def _worn_off(shape: tuple[int, int], seed: int, metre: float) -> Image:
    """How much of a floor's paint is left, 0..1: scuffed through in places."""
    scuffs = tx.fractal(shape, seed, 0.9 * metre, 4, 1.2) + 0.5 * tx.fractal(shape, seed + 1, 20, 2.8, 0.6)
    return 0.9 * expit(5 * (1.15 - scuffs))


def floor(seed: int, metre: float, stripe: Colour | None = None, hazard: bool = False) -> Painter:
    """Concrete, or the same concrete under worn floor paint: of one colour, or in black and yellow stripes."""

    def paint(shape: tuple[int, int]) -> Image:
        ground = concrete(shape, seed, metre)
        if stripe is None:
            return ground
        colour: Image | Colour = stripe
        if hazard:
            y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32) / (0.15 * metre)
            bars = expit(40 * (np.abs((x + y) % 2 - 1) - 0.5))
            colour = tx.mix(np.broadcast_to(np.array(stripe, np.float32), (*shape, 3)), (0.25, 0.25, 0.25), bars)
        return ground + (np.asarray(colour, np.float32) - ground) * _worn_off(shape, seed + 20, metre)[..., None]

    return paint


def blockwork(seed: int, base: Colour, tile: float, dirt: float = 1.0) -> Painter:
    """Painted blocks of 0.4 by 0.2 m in running bond on a square of `tile` m: joints, roller marks, runs of dirt."""

    def paint(shape: tuple[int, int]) -> Image:
        h, w = shape
        metre = w / tile
        rng = np.random.default_rng(seed)
        rows, cols = round(h / (0.2 * metre)), round(w / (0.4 * metre))
        wob = tx.fractal(shape, seed + 1, 0.2 * metre, 6, 1.2)
        y = (np.arange(h, dtype=np.float32)[:, None] + 0.5 * wob) * rows / h
        row = np.floor(y).astype(int) % rows
        x = (np.arange(w, dtype=np.float32)[None] + 0.5 * wob) * cols / w + 0.5 * (row % 2)
        tone = rng.normal(0, 1, (rows, cols)).astype(np.float32)[row, np.floor(x).astype(int) % cols]
        edge = np.maximum(np.abs(y % 1 - 0.5) * 200 - 95, np.abs(x % 1 - 0.5) * 400 - 195)  # mm from a block's edge
        joint = np.exp(-((edge / 3.2) ** 2))
        out = tx.plaster(shape, seed + 2, base, 0.8) * (1 + 0.022 * tone - 0.20 * joint)[..., None]
        pores = np.clip(tx.fractal(shape, seed + 7, 12, 2.8, 0.5) - 1.7, 0, 1)
        runs = np.clip(tx.fractal(shape, seed + 8, 0.6 * metre, 4, 1.0, (9.0, 1.0)) - 1.0, 0, 1.5)
        return out * (1 - 0.22 * pores - 0.07 * dirt * runs)[..., None]

    return paint


def sheet(seed: int, base: Colour, pitch: float) -> Painter:
    """Profiled sheet seen from below: ribs across u every `pitch` texels, panels of slightly different tone, stains."""

    def paint(shape: tuple[int, int]) -> Image:
        rng = np.random.default_rng(seed)
        w = shape[1]
        ribs = round(w / pitch)
        x = np.arange(w, dtype=np.float32)[None] * ribs / w
        shade = 0.10 * np.tanh(3 * np.sin(2 * np.pi * x)) - 0.12 * np.exp(-(((x % 1 - 0.5) * 9) ** 2))
        panels = rng.normal(0, 0.02, 4)[(x * 4 / ribs).astype(int) % 4]
        stains = 0.05 * tx.fractal(shape, seed + 1, 400, 8, 1.3, (4.0, 1.0)) + 0.015 * tx.fractal(
            shape, seed + 2, 12, 2.6, 0.4
        )
        return np.array(base, np.float32) * (1 + shade + panels + stains)[..., None].astype(np.float32)

    return paint


def enamel(seed: int, base: Colour, wear: float = 1.0, under: Colour = (0.34, 0.32, 0.31)) -> Painter:
    """Painted metal: clouds, grime in streaks, scratches, and chips down to the metal `under`."""

    def paint(shape: tuple[int, int]) -> Image:
        out = tx.plaster(shape, seed, base, 0.55)
        grime = np.clip(tx.fractal(shape, seed + 5, 260, 6, 1.1, (5.0, 1.0)) - 0.6, 0, 2)
        out = out * (1 - 0.07 * wear * grime)[..., None]
        scratch = np.clip(tx.fractal(shape, seed + 6, 60, 2.8, 0.4, (1.0, 16.0)) - 2.0, 0, 1)
        out = tx.mix(out, 1.2 * np.array(base, np.float32), 0.6 * wear * scratch)
        chips = expit(14 * (tx.fractal(shape, seed + 7, 70, 4, 1.1) - (2.9 - 0.6 * wear)))
        return tx.mix(out, under, 0.85 * chips)

    return paint


def rusty(seed: int, base: Colour, rust: float) -> Painter:
    """Rolled steel with mill scale, `rust` from 0 (bare) to 1 (all over)."""

    def paint(shape: tuple[int, int]) -> Image:
        out = tx.tint(
            base,
            (tx.fractal(shape, seed, 200, 8, 1.1, (1.0, 6.0)), (0.035, 0.035, 0.04)),
            (tx.fractal(shape, seed + 1, 16, 2.7, 0.5), (0.03, 0.03, 0.03)),
        )
        patches = expit(4 * (tx.fractal(shape, seed + 2, 220, 5, 1.2) - 2.2 + 3.6 * rust))
        grain = tx.fractal(shape, seed + 3, 30, 2.7, 0.6)
        red = tx.tint((0.47, 0.31, 0.22), (grain, (0.06, 0.045, 0.03)))
        return out + (red - out) * patches[..., None]

    return paint


def pegboard(seed: int, base: Colour, pitch: float) -> Painter:
    """Perforated board: round holes every `pitch` texels."""

    def paint(shape: tuple[int, int]) -> Image:
        h, w = shape
        y = np.arange(h, dtype=np.float32)[:, None] % pitch - pitch / 2
        x = np.arange(w, dtype=np.float32)[None] % pitch - pitch / 2
        holes = expit((0.20 * pitch - np.hypot(x, y)) * 1.6)
        return tx.mix(tx.plaster(shape, seed, base, 0.6), (0.24, 0.23, 0.22), 0.9 * holes)

    return paint


def chequer(seed: int, base: Colour) -> Painter:
    """Rubber matting with small raised studs."""

    def paint(shape: tuple[int, int]) -> Image:
        y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
        studs = np.cos(2 * np.pi * x / 16) * np.cos(2 * np.pi * y / 16)
        out = tx.plaster(shape, seed, base, 1.0)
        return out * (1 + 0.16 * np.tanh(3 * studs))[..., None]

    return paint
