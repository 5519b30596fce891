"""Sets the table: `python scenes/living_room/table.py [--out DIR]` writes table.xml and objects/ there.

table.xml is the room (scene.xml, included and built first if it is not there) plus everyday things on the coffee table
and on the floor around it, each under 35 cm, with prints of 1 to 5 mm. All is procedural and seeded: two builds are
equal byte for byte. All of it is diffuse.

    table_objects.py   the things' shapes     table_prints.py   covers, labels, pages
    table_textures.py  their materials        table_drawing.py  shapes and type on a sheet
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2

_ROOT = Path(__file__).resolve().parents[2]
if str(_ROOT) not in sys.path:  # so that it also runs as a script from anywhere
    sys.path.insert(0, str(_ROOT))

from scenes.kit import materials  # noqa: E402
from scenes.kit.pieces import Piece, parts_rows  # noqa: E402
from scenes.kit.room_files import command, write_ply  # noqa: E402
from scenes.kit.shapes import Parts, merge, move_parts, rotation  # noqa: E402
from scenes.living_room import build as room  # noqa: E402
from scenes.living_room import table_objects as ob  # noqa: E402
from scenes.living_room.decor import RUG  # noqa: E402
from scenes.living_room.layout import ON_FLOOR  # noqa: E402
from scenes.living_room.room import FLOOR  # noqa: E402
from scenes.living_room.table_textures import OBJECT_MATERIALS  # noqa: E402

ABOUT = "The living room with its table set: everyday things with fine print"
REST = 0.0003  # kept between a thing and what it stands on
TABLE = (0.50, 0.72)  # x, z of the table's middle; its top is 0.70 m by 1.15 m
LEVELS = {"table": 0.54, "rug": ON_FLOOR + RUG - 0.0009, "floor": FLOOR}  # heights; the rug's is its crests'


def _arrangement() -> list[tuple[str, Parts, str, float, float, float]]:
    """(name, parts, on, x, z, turn about y in degrees): x, z from the table's middle."""
    return [
        ("stack", ob.stack([(4, 0.150, 0.205, 0.027, 6), (1, 0.142, 0.195, 0.019, -7), (3, 0.118, 0.165, 0.032, 12)]),
         "table", 0.245, -0.008, -4),
        ("open book", ob.open_book(0.236, 0.160), "table", -0.244, -0.185, 87),
        ("striped mug", ob.striped_mug(), "table", 0.015, 0.112, 15),
        ("teapot", ob.teapot(), "table", -0.045, -0.405, 68),
        ("cup", ob.cup_and_saucer(), "table", -0.268, 0.205, 140),
        ("tea", ob.tea_carton(), "table", -0.290, 0.512, 24),
        ("aloe", ob.aloe(7), "table", 0.255, -0.225, 0),
        ("block a", ob.block(0), "table", -0.300, 0.075, 12),
        ("block b", ob.block(1), "table", -0.243, 0.070, -20),
        ("block c", ob.block(2), "block b", -0.244, 0.069, 24),
        ("block d", ob.block(5), "table", -0.190, 0.105, 41),
        ("magazine", ob.magazine(6), "table", 0.213, 0.402, -7),
        ("remote", ob.remote(), "magazine", 0.206, 0.335, 62),
        ("card on magazine", ob.card(0), "magazine", 0.213, 0.477, -4),
        ("card", ob.card(2), "table", -0.262, -0.5115, 2),
        ("oil", ob.oil_bottle(), "table", -0.298, 0.420, -60),
        ("tomatoes", ob.food_tin(), "table", -0.296, 0.325, 35),
        ("globe", ob.globe(0.066), "table", 0.268, -0.430, 35),
        ("pencil", ob.pencil(), "table", 0.074, 0.470, 84),
        ("shoe box", ob.shoe_box(), "rug", -0.700, -0.380, 74),
        ("ball", ob.toy_ball(0.085), "rug", -0.560, 0.020, 30),
        ("tower", ob.ring_tower(), "rug", -0.480, -0.180, 0),
        ("news", ob.newspaper(), "rug", -0.900, 0.060, 62),
        ("biscuits", ob.biscuit_tin(), "rug", -0.700, 0.330, -28),
        ("block e", ob.block(3), "rug", -0.520, 0.240, 33),
        ("block f", ob.block(4), "rug", -0.470, 0.310, -10),
        ("block g", ob.block(0), "rug", -0.535, 0.355, 60),
        ("book on rug", ob.book(7, 0.160, 0.220, 0.022), "rug", -0.120, 0.725, 22),
        ("card on rug", ob.card(1), "rug", 0.100, 0.760, -35),
        ("magazine on rug", ob.magazine(2, 0.014), "rug", -0.560, 0.640, 18),
        ("book on floor", ob.book(5, 0.150, 0.210, 0.030), "floor", 0.560, 0.110, -72),
        ("card on floor", ob.card(2), "floor", 0.520, -0.180, 110),
    ]  # fmt: skip


def things() -> list[Piece]:
    """Everything that table.xml adds to the room, in place."""
    tops, out = dict(LEVELS), []
    for name, parts, on, x, z, turn in _arrangement():
        at = (TABLE[0] + x, tops[on] + REST, TABLE[1] + z)
        thing = Piece(name, move_parts(parts, at, rotation("y", turn)), on)
        tops[name] = float(thing.bounds[1, 1])
        out.append(thing)
    return out


def build(out: Path) -> Path:
    """Write table.xml and objects/ into the folder `out` (made if need be); the scene.xml beside is not touched.

    Returns the path of table.xml, written last. Raises OSError if the folder cannot be written.
    """
    (out / "table.xml").unlink(missing_ok=True)
    folder = out / "objects"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    pieces = things()
    parts = [part for thing in pieces for part in thing.parts]
    lines = ['<scene version="3.0.0">', '  <include filename="scene.xml"/>']
    for name, material in OBJECT_MATERIALS.items():
        write_ply(folder / f"{name}.ply", merge([m for used, m in parts if used == name]), material.tile)
        image = materials.texture(material)[..., ::-1]
        # A quarter of the PNG's size; without the halved chroma that blurs small coloured print.
        quality = [cv2.IMWRITE_JPEG_QUALITY, 92, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        cv2.imwrite(str(folder / f"{name}.jpg"), image, quality)
        lines += [
            f'  <bsdf type="twosided" id="table_{name}"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
            f'<string name="filename" value="objects/{name}.jpg"/></texture></bsdf></bsdf>',
            f'  <shape type="ply" id="table_mesh_{name}"><string name="filename" value="objects/{name}.ply"/>'
            f'<ref id="table_{name}"/></shape>',
        ]
    rows = parts_rows(pieces, OBJECT_MATERIALS, "table_mesh_")
    (out / "parts_table.csv").write_text("\n".join(["shape,first,name", *rows, ""]))
    path = out / "table.xml"
    path.write_text("\n".join([*lines, "</scene>", ""]))
    return path


def build_with_room(out: Path) -> Path:
    """`build`, and the room beside it if its scene.xml is missing."""
    if not (out / "scene.xml").is_file():
        room.build(out)
    return build(out)


if __name__ == "__main__":
    command(build_with_room, "the living room with its table set", __file__)
