"""The commands that draw: compare, preview, picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Quiet
from rsgen.errors import UserError

SequenceFolder = Annotated[Path, "folder that 'rsgen render' wrote"]


def compare(
    sequence: SequenceFolder,
    *,
    frame: Annotated[int, "index of the frame", int],
    out: Annotated[Path | None, "picture to write (default: SEQ/compare_FRAME.png)", "PNG"] = None,
    scene: Annotated[Path | None, "scene file, if it has moved since the sequence was rendered"] = None,
) -> int:
    """Picture of one frame: global shutter, rolling shutter and their difference."""
    from rsgen.pictures.frames import compare_frame

    print(compare_frame(sequence, frame, out, scene))
    return 0


def preview(
    sequence: SequenceFolder,
    *,
    out: Annotated[Path | None, "picture to write (default: SEQ/preview.png)", "PNG"] = None,
    count: Annotated[int, "frames to show"] = 4,
) -> int:
    """Picture of some frames of a sequence with their depth."""
    from rsgen.pictures.frames import preview_sequence

    print(preview_sequence(sequence, out, count))
    return 0


def picture(
    meshes: Annotated[list[Path], "mesh files (.ply), coloured or not", "MESH"],
    *,
    out: Annotated[Path, "to write (.png .jpg .svg .pdf)", "PNG"],
    above: Annotated[bool, "look down into the room, its ceiling left out (default)"] = False,
    from_: Annotated[str | None, "where the camera is, world, m", "X,Y,Z"] = None,
    at: Annotated[str | None, "with --from: what it looks at, world, m (default: the middle)", "X,Y,Z"] = None,
    label: Annotated[list[str] | None, "once a mesh (default: the files' names)", "TEXT"] = None,
    width: Annotated[int, "of each mesh's picture, px"] = 800,
    height: Annotated[int, "of each mesh's picture, px"] = 600,
    grey: Annotated[bool, "leave the colours out, for the shapes"] = False,
    quiet: Quiet = False,
) -> int:
    """Picture of meshes side by side, seen by one camera from above or from a place you name."""
    from rsgen.console.progress import ProgressDisplay
    from rsgen.pictures.meshes import parse_point, picture_meshes

    if above and from_ is not None:
        raise UserError("--above: not with --from, which looks from another place")
    eye, target = (None if text is None else parse_point(text) for text in (from_, at))
    with ProgressDisplay(quiet) as progress:
        print(picture_meshes(meshes, out, label, eye, target, width, height, grey, progress))
    return 0
