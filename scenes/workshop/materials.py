"""What the workshop is painted with, for a seed: its BSDFs, their textures and the size in metres of one tile."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scenes.kit import textures as tx
from scenes.kit.materials import Material, fabric, plain, wood
from scenes.kit.textures import Colour
from scenes.workshop import drawings
from scenes.workshop import surfaces as sf

FLOOR_PIXELS, FLOOR_TILE = (1792, 3072), (10.0, 10.0 * 1792 / 3072)
# Colours that machines, walls and steel are painted in; the seed picks.
_MACHINES: tuple[Colour, ...] = (
    (0.42, 0.56, 0.48), (0.47, 0.56, 0.63), (0.76, 0.73, 0.62), (0.60, 0.63, 0.62), (0.36, 0.50, 0.56),
    (0.62, 0.66, 0.50),
)  # fmt: skip
_DADOS: tuple[Colour, ...] = ((0.46, 0.56, 0.52), (0.50, 0.55, 0.62), (0.60, 0.52, 0.44), (0.52, 0.56, 0.50))
_WALLS: tuple[Colour, ...] = ((0.82, 0.81, 0.76), (0.83, 0.80, 0.72), (0.79, 0.81, 0.80))
_STEELS: tuple[Colour, ...] = ((0.50, 0.56, 0.60), (0.56, 0.58, 0.54), (0.50, 0.38, 0.33), (0.62, 0.62, 0.60))
_FURNITURE: tuple[Colour, ...] = (
    (0.38, 0.48, 0.62), (0.60, 0.61, 0.59), (0.66, 0.36, 0.29), (0.44, 0.55, 0.44), (0.74, 0.56, 0.30),
)  # fmt: skip


def materials(seed: int) -> dict[str, Material]:
    """All materials by name; equal seeds give equal materials."""
    rng = np.random.default_rng([seed, 1])
    k = 10_000 * seed

    def pick(colours: Sequence[Colour], count: int) -> list[Colour]:
        chosen = [colours[i] for i in rng.permutation(len(colours))[:count]]
        return [tuple(float(c * f) for c, f in zip(x, rng.uniform(0.96, 1.04, 3), strict=True)) for x in chosen]  # type: ignore[misc]

    machines, furniture = pick(_MACHINES, 3), pick(_FURNITURE, 4)
    (dado,), (wall,), (steel,) = pick(_DADOS, 1), pick(_WALLS, 1), pick(_STEELS, 1)
    metre = FLOOR_PIXELS[1] / FLOOR_TILE[0]
    line: Colour = (0.84, 0.68, 0.22) if rng.uniform() < 0.6 else (0.82, 0.81, 0.77)

    def floor(stripe: Colour | None = None, hazard: bool = False) -> Material:
        return Material(sf.floor(k + 11, metre, stripe, hazard), FLOOR_PIXELS, FLOOR_TILE)

    def painted(number: int, base: Colour, wear: float = 1.0, size: float = 1.0) -> Material:
        return Material(sf.enamel(k + number, base, wear), (512, 512), (size, size))

    out = {
        "floor": floor(), "floor_line": floor(line), "floor_hazard": floor((0.84, 0.68, 0.22), True),
        "wall_upper": Material(sf.blockwork(k + 31, wall, 4.0), (2048, 2048), (4.0, 4.0)),
        "wall_lower": Material(sf.blockwork(k + 51, dado, 4.0, 1.6), (2048, 2048), (4.0, 4.0)),
        "roof": Material(sf.sheet(k + 71, (0.72, 0.73, 0.72), 64), (1024, 1024), (3.2, 3.2)),
        "steel": painted(91, steel, 0.7), "purlin": painted(101, (0.64, 0.62, 0.58), 0.5),
        "window_paint": painted(111, (0.60, 0.64, 0.62), 0.6), "crane": painted(121, (0.86, 0.69, 0.22), 0.8),
        "roller": Material(sf.enamel(k + 131, (0.60, 0.64, 0.66), 0.8), (1024, 1024), (2.0, 2.0)),
        "door": painted(141, (0.44, 0.52, 0.56), 0.8), "frame": painted(151, (0.40, 0.42, 0.44), 1.0),
        "trim": painted(161, (0.72, 0.72, 0.69), 0.7), "panel": painted(171, (0.38, 0.39, 0.41), 0.6, 0.6),
        "cast": Material(sf.rusty(k + 181, (0.42, 0.42, 0.42), 0.12), (512, 512), (0.6, 0.6)),
        "raw_steel": Material(sf.rusty(k + 191, (0.52, 0.53, 0.55), 0.25), (512, 512), (0.6, 0.6)),
        "rust": Material(sf.rusty(k + 201, (0.44, 0.40, 0.38), 0.75), (512, 512), (0.6, 0.6)),
        "bright": Material(None, metal="Cr", alpha=0.32),
        "stone": Material(plain(k + 211, (0.72, 0.71, 0.68), 1.2), (256, 256), (0.3, 0.3)),
        "rubber": Material(plain(k + 221, (0.28, 0.28, 0.28), 1.2), (256, 256), (0.3, 0.3), 0.25),
        "cable": Material(plain(k + 226, (0.29, 0.29, 0.30), 1.2), (256, 256), (0.3, 0.3)),
        "mat": Material(sf.chequer(k + 231, (0.31, 0.31, 0.32)), (512, 512), (0.6, 0.6)),
        "glass": Material(plain(k + 241, (0.28, 0.34, 0.36), 0.6), (256, 256), (0.3, 0.3), 0.12),
        "button_green": Material(plain(k + 251, (0.32, 0.60, 0.36), 0.8), (128, 128), (0.1, 0.1), 0.15),
        "button_red": Material(plain(k + 256, (0.76, 0.26, 0.24), 0.8), (128, 128), (0.1, 0.1), 0.15),
        "bench_wood": Material(wood(k + 261, (0.70, 0.56, 0.40), (0.42, 0.31, 0.21), 20), (1024, 1024), (1.6, 0.8)),
        "ply": Material(wood(k + 271, (0.76, 0.65, 0.49), (0.60, 0.47, 0.33), 34), (512, 512), (1.2, 0.6)),
        "pallet": Material(wood(k + 281, (0.73, 0.62, 0.47), (0.48, 0.38, 0.28), 14), (1024, 1024), (1.3, 0.65)),
        "handle_wood": Material(wood(k + 291, (0.76, 0.60, 0.40), (0.56, 0.40, 0.25), 12), (256, 256), (0.3, 0.15)),
        "handle_red": Material(plain(k + 301, (0.72, 0.28, 0.22), 0.9), (256, 256), (0.3, 0.3), 0.2),
        "pegboard": Material(sf.pegboard(k + 311, (0.70, 0.60, 0.46), 16), (512, 512), (0.8, 0.8)),
        "card": Material(_card(k + 321), (1024, 1024), (1.2, 1.2)),
        "tape": Material(plain(k + 331, (0.66, 0.54, 0.38), 0.8), (256, 256), (0.4, 0.4), 0.2),
        "label": Material(lambda s: drawings.labels(s, k + 341), (768, 1024)),
        "sign": Material(lambda s: drawings.signs(s, k + 351), (960, 1280)),
        "rack_board": painted(371, (0.64, 0.65, 0.64), 1.2), "rack_lip": painted(381, (0.80, 0.48, 0.24), 1.0),
        "lamp_housing": painted(391, (0.66, 0.68, 0.68), 0.4, 0.6),
        "black": Material(plain(k + 401, (0.33, 0.32, 0.32), 1.0), (256, 256), (0.5, 0.5)),
    }  # fmt: skip
    for i, base in enumerate(machines):
        out[f"machine_{'abc'[i]}"] = painted(421 + 10 * i, base)
    for i, (name, base) in enumerate(zip(("rack", "locker", "drawer", "drum_a"), furniture, strict=True)):
        out[name] = painted(461 + 10 * i, base)
    solid: dict[str, Colour] = {
        "drum_b": (0.40, 0.44, 0.50), "crate_red": (0.72, 0.30, 0.24), "crate_blue": (0.30, 0.45, 0.66),
        "crate_grey": (0.55, 0.57, 0.58), "tin_a": (0.80, 0.78, 0.70), "tin_b": (0.42, 0.56, 0.66),
        "tin_c": (0.78, 0.52, 0.24),
        "gas_blue": (0.36, 0.47, 0.60), "gas_maroon": (0.52, 0.27, 0.27), "pipe_a": (0.78, 0.66, 0.26),
        "pipe_b": (0.42, 0.56, 0.64), "conduit": (0.68, 0.69, 0.68), "extinguisher": (0.74, 0.25, 0.22),
    }  # fmt: skip
    for i, (name, base) in enumerate(solid.items()):
        out[name] = painted(521 + 10 * i, base, 0.7, 0.7)
    out["hose_blue"] = Material(fabric(k + 661, (0.32, 0.42, 0.58), (0.26, 0.34, 0.48), 6), (256, 256), (0.2, 0.2))
    out["hose_red"] = Material(fabric(k + 671, (0.62, 0.28, 0.24), (0.5, 0.22, 0.2), 6), (256, 256), (0.2, 0.2))
    return out


def _card(seed: int) -> sf.Painter:
    """Corrugated cardboard."""
    return lambda shape: tx.mix(
        tx.plaster(shape, seed, (0.66, 0.53, 0.39), 0.9),
        (0.50, 0.39, 0.28),
        0.25 * np.clip(tx.fractal(shape, seed + 9, 20, 2.8, 0.4, (18.0, 1.0)), 0, 1),
    )
