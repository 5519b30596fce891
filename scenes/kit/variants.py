"""Rooms that vary by seed: what a seed draws, the colour of lamps, and the command line of their build scripts."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

_GREY = np.array([0.2126, 0.7152, 0.0722])


def draw(seed: int, what: str) -> np.random.Generator:
    """The random numbers of one aspect of a variant: other aspects draw from others, and may change by themselves."""
    return np.random.default_rng([seed, *what.encode()])


def kelvin(temperature: float) -> np.ndarray:
    """(3,) linear sRGB of a black body of 2000 to 12000 K, of luminance 1.

    Chromaticity by the cubic of Kim et al. (US patent 7024034, 2002) for the Planckian locus in CIE xy.
    """
    t = 1e3 / temperature
    if temperature < 4000:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
    if temperature < 2222:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif temperature < 4000:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    xyz = np.array([x / y, 1.0, (1 - x - y) / y])
    matrix = [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
    rgb = np.maximum(np.array(matrix) @ xyz, 0.02)
    return rgb / float(_GREY @ rgb)


def command(build: Callable[[Path, int], Path], what: str, folder: Path) -> None:
    """Command line of a build script: `--seed` and `--out`, by default `folder`; prints the scene's path."""
    parser = argparse.ArgumentParser(
        description=f"Build {what} as a Mitsuba 3 scene.",
        epilog="A config names a variant by its folder: ROOM/seed3/scene.xml is built with --seed 3 if absent.",
    )
    parser.add_argument("--seed", type=int, default=0, help="variant: arrangement, colours, lamps (default: 0)")
    parser.add_argument("--out", type=Path, help="folder to write to (default: this script's, or its seedN)")
    words = parser.parse_args()
    if words.seed < 0:
        parser.error(f"--seed {words.seed}: give 0 or more")
    print(build(words.out or (folder / f"seed{words.seed}" if words.seed else folder), words.seed))
