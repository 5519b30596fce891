"""Builds the living room: `python scenes/living_room/build.py [--out DIR]` writes scene.xml, meshes/, textures/ there.

A furnished room of ICL-NUIM's dimensions (4.94 x 2.50 x 4.93 m) in the frame of its trajectories: right-handed, y up,
metres, x = -x_POV, so that kt0..kt3 pass through it. Everything is procedural and seeded: two builds are equal byte for
byte. The result is a plain Mitsuba 3 scene of triangle meshes (one per BSDF, binary PLY with normals and texture
coordinates), diffuse and a few rough plastic BSDFs, and area lights (window pane, ceiling spots, lamp shades).

    build.py      puts it all together          room.py       shell, window, door, mouldings, spots
    materials.py  BSDFs and their textures      furniture.py  sofas, tables, shelves, lamps
    pictures.py   paintings, books, rug, view   decor.py      pictures, pottery, plants
                                                layout.py     what stands where
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
from scenes.living_room import layout, pictures, room  # noqa: E402
from scenes.living_room.materials import MATERIALS  # noqa: E402

ABOUT = "A furnished living room of ICL-NUIM's dimensions, through which its trajectories pass"
SHADE_RADIANCE = (0.62, 0.46, 0.28)
SKY, GROUND = 2.2, 0.62  # radiance behind the window
SPOT_COLOUR = np.array([1.05, 0.98, 0.86])


def contents() -> tuple[list[Piece], list[AreaLamp]]:
    """Everything in the room: the shell and pieces, and what shines."""
    furniture, shades = layout.furnishing()
    housings, discs = room.spots()
    pieces = [Piece(SHELL, room.architecture()), Piece("spots", housings), *furniture]
    shade = room_files.radiance(SHADE_RADIANCE)
    lamps = [AreaLamp(f"lamp_shade_{i}", "shade", mesh, shade) for i, mesh in enumerate(shades)]
    lamps += [
        AreaLamp(f"spot_{i}", "black", mesh, room_files.radiance(tuple(power * SPOT_COLOUR)))
        for i, (mesh, power) in enumerate(discs)
    ]
    garden = room_files.radiance_map("textures/garden.pfm")
    return pieces, [*lamps, AreaLamp("window_pane", "black", room.pane(), garden, atlas=True)]


def build(out: Path) -> Path:
    """Write the living room into the folder `out` and return the path of its scene.xml, written last.

    Raises OSError if the folder cannot be written.
    """
    pieces, lamps = contents()
    view = (-1.6, 1.55, 1.9), (0.7, 0.75, -0.9)
    garden = pictures.garden((512, 512), 901, SKY, GROUND)
    return write_room(out, Room(pieces, MATERIALS, lamps, view, {"garden": garden}))


if __name__ == "__main__":
    command(build, "the living room", __file__)
