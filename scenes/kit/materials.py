"""What surfaces are painted with: BSDFs, their textures, the size in metres of one tile; and the commonest paints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scenes.kit import textures as tx
from scenes.kit.textures import Image

DARKEST, LIGHTEST = 0.045, 0.80  # linear albedo of anything in a room


@dataclass(frozen=True)
class Material:
    """A BSDF: `paint` makes its sRGB image of `pixels` (h, w), laid over `tile` = (u, v) metres; tile (1, 1): an atlas.

    `alpha` > 0 makes it a rough plastic of that roughness, `metal` a rough conductor
    of the stuff that Mitsuba calls `conductor`.
    """

    paint: Callable[[tuple[int, int]], Image] | None
    pixels: tuple[int, int] = (512, 512)
    tile: tuple[float, float] = (1.0, 1.0)
    alpha: float = 0.0
    metal: bool = False
    conductor: str = "Cu"


def plain(seed: int, base: tx.Colour, contrast: float = 0.6) -> Callable[[tuple[int, int]], Image]:
    """Painter of a flat surface with a faint structure, as paint or plaster has it."""
    return lambda shape: tx.plaster(shape, seed, base, contrast)


def fabric(seed: int, warp: tx.Colour, weft: tx.Colour, thread: float = 6.0) -> Callable[[tuple[int, int]], Image]:
    """Painter of woven cloth."""
    return lambda shape: tx.fabric(shape, seed, warp, weft, thread)


def wood(seed: int, light: tx.Colour, dark: tx.Colour, ring: float = 26.0) -> Callable[[tuple[int, int]], Image]:
    """Painter of planed wood."""
    return lambda shape: tx.wood(shape, seed, light, dark, ring)


def texture(material: Material) -> np.ndarray:
    """(h, w, 3) uint8 sRGB image of a material, its linear albedo kept within [DARKEST, LIGHTEST]."""
    assert material.paint is not None
    image = material.paint(material.pixels)

    def srgb(linear: float) -> float:
        return 1.055 * linear ** (1 / 2.4) - 0.055

    return np.round(np.clip(image, srgb(DARKEST), srgb(LIGHTEST)) * 255).astype(np.uint8)
