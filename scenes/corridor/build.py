"""Builds the corridor: `python scenes/corridor/build.py [--seed N] [--out DIR]` writes scene.xml, meshes/, textures/.

A corridor of a school or an institute, 18.2 x 3 x 2.4 m, with seven doors alike, and a staircase at its end: ten steps
up to a landing under a window. Frame: right-handed, y up, metres; x along the corridor from 0 to 18.2, the stairwell
from 14 on (4.7 m high), z from -1.2 to 1.2, floor at y = 0, landing at y = 1.7. Everything is procedural and seeded:
two builds of one seed are equal byte for byte. A seed draws colours, boards and notices, lockers or benches, lamps
(which are on, their temperature), sky. The result is a plain Mitsuba 3 scene of triangle meshes: diffuse surfaces,
handles of metal, area lights.

    build.py      puts it all together          room.py       walls, doors, lamps, pipes
    materials.py  BSDFs and their textures      stairs.py     flight, balustrade, handrails
    pictures.py   notices, plates, signs        layout.py     boards, radiators, lockers, signs
"""

from __future__ import annotations

import sys
from pathlib import Path

ABOUT = "A long corridor of doors alike, poor in texture, with a staircase at its end"
_ROOT = Path(__file__).resolve().parents[2]
if str(_ROOT) not in sys.path:  # so that it also runs as a script from anywhere
    sys.path.insert(0, str(_ROOT))

from scenes.corridor import layout, room  # noqa: E402
from scenes.corridor.materials import materials  # noqa: E402
from scenes.kit import room_files  # noqa: E402
from scenes.kit.pieces import SHELL, Piece, draw, kelvin  # noqa: E402
from scenes.kit.prints import town  # noqa: E402
from scenes.kit.room_files import AreaLamp, Room, command, write_room  # noqa: E402

LAMP_RADIANCE = 58.0
SKY, GROUND = 2.0, 0.6


def contents(seed: int) -> tuple[list[Piece], list[AreaLamp]]:
    """Everything in the corridor of this seed: the shell and pieces, and what shines."""
    rng = draw(seed, "light")
    pieces = [Piece(SHELL, room.shell()), *room.fixtures(), *layout.arrange(seed)]
    lamps = []
    colour = kelvin(float(rng.uniform(3800, 6000))) / kelvin(4600)  # as a camera balanced for 4600 K sees it
    dark = int(rng.integers(len(room.LAMPS))) if rng.uniform() < 0.6 else -1
    for i, place in enumerate(room.LAMPS):
        housing, face = room.lamp(*place)
        if i == dark:
            pieces.append(Piece(f"lamp {i}", [*housing, ("diffuser", face)]))
        else:
            pieces.append(Piece(f"lamp {i}", housing))
            power = LAMP_RADIANCE * float(rng.uniform(0.8, 1.15))  # some tubes are older
            lamps.append(AreaLamp(f"lamp_{i}", "diffuser", face, room_files.radiance(tuple(power * colour))))
    view = room_files.radiance_map("textures/town.pfm")
    lamps.append(AreaLamp("window", "black", room.pane(), view, atlas=True))
    return pieces, lamps


def build(out: Path, seed: int = 0) -> Path:
    """Write the corridor of this seed into the folder `out` and return the path of its scene.xml, written last.

    Raises OSError if the folder cannot be written.
    """
    pieces, lamps = contents(seed)
    sky = float(draw(seed, "sky").uniform(0.6, 1.1))
    view = (9.5, 1.6, 0.2), (14.5, 1.2, -0.2)
    shown = {"town": town((768, 640), 920 + seed, SKY * sky, GROUND * sky)}
    return write_room(out, Room(pieces, materials(seed), lamps, view, shown))


if __name__ == "__main__":
    command(build, "the corridor", __file__)
