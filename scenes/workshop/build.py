"""Builds the workshop: `python scenes/workshop/build.py [--seed N] [--out DIR]` writes scene.xml, meshes/, textures/.

A machine shop of 20 x 12 x 6 m: lathes, mills, drills and saws in two rows, benches under tool boards, racks, a crane
under steel trusses, a roller door, bands of windows below the eaves and lamps on cords. Right-handed, y up, metres; the
floor is y = 0, x runs along the hall. Everything is procedural: two builds of one seed are equal byte for byte, another
seed arranges, paints and lights it differently. The result is a plain Mitsuba 3 scene of triangle meshes (one per BSDF,
binary PLY with normals and texture coordinates), diffuse, a few rough plastic and one rough metal, and area lights
(panes, lamps).

    build.py      puts it all together          benches.py    workbench, vice, tools, tool board
    hall.py       shell, steelwork, crane       storage.py    racks, crates, pallets, drums, bottles
    services.py   pipes, switch boxes, signs    machines.py   machine tools
    layout.py     what stands where             solids.py     bars, rods, wheels, profiles
    materials.py  BSDFs and their textures      surfaces.py   concrete, blockwork, enamel, rust
                                                drawings.py   signs, labels, sky
Solids, noise, wood, cloth and the writing of files are in scenes/kit.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

_ROOT = Path(__file__).resolve().parents[2]
if str(_ROOT) not in sys.path:  # so that it also runs as a script from anywhere
    sys.path.insert(0, str(_ROOT))

from scenes.kit import room_files  # noqa: E402
from scenes.kit.pieces import SHELL, Piece  # noqa: E402
from scenes.kit.room_files import AreaLamp, Room, command, write_room  # noqa: E402
from scenes.workshop import drawings, hall, layout  # noqa: E402
from scenes.workshop.materials import materials  # noqa: E402

ABOUT = "A machine shop: lathes, mills, benches, racks, a crane under steel trusses, windows below the eaves"
SKY, HORIZON = 7.0, 3.5  # radiance behind the panes
LAMP_RADIANCE = 190.0
SKIES = (("south", -1, 1.1), ("north", 1, 0.8))  # name, side of the panes, its part of the light


def contents(seed: int) -> tuple[list[Piece], list[AreaLamp]]:
    """Everything in the hall of this seed: the shell and pieces, and what shines."""
    housings, discs = layout.lamps(seed)
    pieces = [
        Piece(SHELL, [*hall.floor(layout.bays()), *hall.shell()]),
        Piece("bars", hall.window_bars(), "building"),
        Piece("doors", hall.doors(), "building"),
        Piece("steelwork", hall.steelwork(), "building"),
        Piece("crane", layout.crane(seed), "building"),
        Piece("lamps", housings, "building"),
        *layout.things(seed),
    ]
    tone, _ = _light(seed)
    lamps = [
        AreaLamp(f"lamp_{i}", "black", mesh, room_files.radiance(tuple(LAMP_RADIANCE * share * tone)))
        for i, (mesh, share) in enumerate(discs)
    ]
    for name, side, _ in SKIES:
        sky = room_files.radiance_map(f"textures/sky_{name}.pfm")
        lamps.append(AreaLamp(f"panes_{name}", "black", hall.panes(side), sky, atlas=True))
    return pieces, lamps


def _light(seed: int) -> tuple[np.ndarray, float]:
    """Colour of the lamps and brightness of the day."""
    rng = np.random.default_rng([seed, 5])
    tone = np.array([1.0, 0.94, 0.82]) if rng.uniform() < 0.5 else np.array([0.94, 1.0, 0.98])
    return tone, float(rng.uniform(0.8, 1.2))


def build(out: Path, seed: int = 0) -> Path:
    """Write the workshop of this seed into the folder `out` and return the path of its scene.xml, written last.

    Raises OSError if the folder cannot be written.
    """
    pieces, lamps = contents(seed)
    _, day = _light(seed)
    pictures = {}
    for name, side, light in SKIES:
        level = day * light
        pictures[f"sky_{name}"] = drawings.sky((64, 1024), 900 + 10 * seed + side, SKY * level, HORIZON * level)
    view = (-8.9, 1.65, 0.6), (0.0, 1.2, -0.8)
    return write_room(out, Room(pieces, materials(seed), lamps, view, pictures))


if __name__ == "__main__":
    command(build, "the workshop", __file__)
