"""The commands that draw: compare, preview, picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from rsgen.console.command_line import Commands, count


def add_pictures(commands: Commands) -> None:
    """Add them to the parser."""
    compare = commands.add(
        "compare", _compare, "picture of one frame: global shutter, rolling shutter and their difference",
        "out/demo --frame 20",
    )  # fmt: skip
    compare.add_argument("sequence", type=Path, help="folder that 'rsgen render' wrote")
    compare.add_argument("--frame", type=int, required=True, help="index of the frame")
    compare.add_argument("--out", type=Path, metavar="PNG", help="picture to write (default: SEQ/compare_FRAME.png)")
    compare.add_argument("--scene", type=Path, help="scene file, if it has moved since the sequence was rendered")

    preview = commands.add(
        "preview", _preview, "picture of some frames of a sequence with their depth", "out/demo --count 6"
    )
    preview.add_argument("sequence", type=Path, help="folder that 'rsgen render' wrote")
    preview.add_argument("--out", type=Path, metavar="PNG", help="picture to write (default: SEQ/preview.png)")
    preview.add_argument("--count", type=count, default=4, help="frames to show (default: 4)")

    picture = commands.add(
        "picture", _picture, "picture of meshes side by side, seen by one camera from above or from a place you name",
        "ours.ply theirs.ply --out meshes.png --label ours --label theirs",
    )  # fmt: skip
    picture.add_argument("meshes", type=Path, nargs="+", metavar="MESH", help="mesh files (.ply), coloured or not")
    picture.add_argument("--out", type=Path, required=True, metavar="PNG", help="to write (.png .jpg .svg .pdf)")
    where = picture.add_mutually_exclusive_group()
    where.add_argument("--above", action="store_true", help="look down into the room, its ceiling left out (default)")
    where.add_argument("--from", dest="eye", metavar="X,Y,Z", help="where the camera is, world, m")
    picture.add_argument("--at", metavar="X,Y,Z", help="with --from: what it looks at, world, m (default: the middle)")
    picture.add_argument("--label", action="append", metavar="TEXT", help="once a mesh (default: the files' names)")
    picture.add_argument("--width", type=count, default=800, help="of each mesh's picture, px (default: 800)")
    picture.add_argument("--height", type=count, default=600, help="of each mesh's picture, px (default: 600)")
    picture.add_argument("--grey", action="store_true", help="leave the colours out, for the shapes")
    picture.add_argument("--quiet", action="store_true", help="no progress")


def _compare(options: argparse.Namespace) -> int:
    from rsgen.pictures.frames import compare_frame

    print(compare_frame(options.sequence, options.frame, options.out, options.scene))
    return 0


def _preview(options: argparse.Namespace) -> int:
    from rsgen.pictures.frames import preview_sequence

    print(preview_sequence(options.sequence, options.out, options.count))
    return 0


def _picture(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rsgen.pictures.meshes import parse_point, picture_meshes

    eye, target = (None if text is None else parse_point(text) for text in (options.eye, options.at))
    size = options.width, options.height
    with ProgressDisplay(options.quiet) as progress:
        made = picture_meshes(
            options.meshes, options.out, options.label, eye, target, *size, options.grey, progress
        )  # fmt: skip
    print(made)
    return 0
