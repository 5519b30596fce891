"""Builds the office: `python scenes/office/build.py [--seed N] [--out DIR]` writes scene.xml, meshes/, textures/ there.

An office for four, 8 x 2.8 x 6 m, beside a meeting room behind glass. Frame: right-handed, y up, metres; x from -4 to
4, z from -3 (whiteboard, door) to 3 (windows), floor at y = 0, the glass at x = 1.4. Everything is procedural and
seeded: two builds of one seed are equal byte for byte. A seed draws the plan of the desks and what is on them, colours,
lamps (which are on, their temperature), screens, blinds, sky. The result is a plain Mitsuba 3 scene of triangle meshes:
diffuse surfaces, a few rough plastics and metals, thin glass, area lights (ceiling panels, screens, window panes).

    build.py      puts it all together          room.py       building, partition, windows, lamps
    materials.py  BSDFs and their textures      furniture.py  desks, chairs, shelves, tables
    pictures.py   screens, binders, whiteboard  equipment.py  screens, keyboards, papers, mugs
                                                layout.py     what stands where
"""

from __future__ import annotations

import sys
from pathlib import Path

ABOUT = "An office of desks, screens and shelves, with a meeting room behind a glass partition"
_ROOT = Path(__file__).resolve().parents[2]
if str(_ROOT) not in sys.path:  # so that it also runs as a script from anywhere
    sys.path.insert(0, str(_ROOT))

from scenes.kit import room_files  # noqa: E402
from scenes.kit.pieces import SHELL, Piece, draw, kelvin  # noqa: E402
from scenes.kit.prints import town  # noqa: E402
from scenes.kit.room_files import AreaLamp, Room, command, write_room  # noqa: E402
from scenes.office import layout, pictures, room  # noqa: E402
from scenes.office.materials import materials  # noqa: E402

PANEL_RADIANCE = 35.0  # of each of eight panels; fewer shine brighter
SCREEN_RADIANCE = 0.75  # of a white pixel
SKY, GROUND = 1.7, 0.6


def contents(seed: int) -> tuple[list[Piece], list[AreaLamp]]:
    """Everything in the office of this seed: the shell and pieces, and what shines."""
    arrangement = layout.arrange(seed)
    rng = draw(seed, "light")
    pieces = [Piece(SHELL, room.shell()), *room.fixtures(rng), *arrangement.pieces]
    colour = kelvin(float(rng.uniform(3800, 6000))) / kelvin(4600)  # as a camera balanced for 4600 K sees it
    on = rng.uniform(size=len(room.PANELS)) > 0.15
    on[[0, 4, 6]] = True
    power = PANEL_RADIANCE * len(on) / on.sum()
    lamps = []
    for i, place in enumerate(room.PANELS):
        housing, face = room.panel(*place)
        pieces.append(Piece(f"panel {i}", housing if on[i] else [*housing, ("diffuser", face)]))
        if on[i]:
            lamps.append(AreaLamp(f"panel_{i}", "diffuser", face, room_files.radiance(tuple(power * colour))))
    glow = room_files.radiance_map("textures/screens.pfm")
    for i, screen in enumerate(arrangement.screens):
        if rng.uniform() < 0.75:
            lamps.append(AreaLamp(f"screen_{i}", "plastic", screen, glow, atlas=True))
        else:
            pieces.append(Piece(f"dark screen {i}", [("dark_glass", screen)]))
    view = room_files.radiance_map("textures/town.pfm")
    lamps += [AreaLamp(f"window_{i}", "black", pane, view, atlas=True) for i, pane in enumerate(room.panes())]
    return pieces, lamps


def build(out: Path, seed: int = 0) -> Path:
    """Write the office of this seed into the folder `out` and return the path of its scene.xml, written last.

    Raises OSError if the folder cannot be written.
    """
    pieces, lamps = contents(seed)
    sky = float(draw(seed, "sky").uniform(0.6, 1.1))
    view = (-3.2, 1.6, -2.5), (0.4, 0.8, 0.9)
    shown = {
        "screens": SCREEN_RADIANCE * pictures.screens((640, 2048), 900 + seed),
        "town": town((512, 768), 910 + seed, SKY * sky, GROUND * sky),
    }
    return write_room(out, Room(pieces, materials(seed), lamps, view, shown))


if __name__ == "__main__":
    command(build, "the office", __file__)
