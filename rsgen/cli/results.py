"""The commands that work on a finished sequence: `info`, `verify`, `preview`, `export`."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Annotated, Literal

from rsgen.config.config import load_config
from rsgen.console.command_line import Quiet, refuse_options
from rsgen.console.configs import config_file
from rsgen.console.progress import Progress, ProgressDisplay
from rsgen.errors import UserError
from rsgen.formats import EXPORTS, OF_RIGS, exporter

SequenceFolder = Annotated[Path, "folder that 'rsgen render' wrote"]
SceneFile = Annotated[Path | None, "scene file, if it has moved since the sequence was rendered"]
Storage = Literal["sqlite3", "mcap"]


def info(sequence: SequenceFolder) -> int:
    """Say what a sequence folder holds."""
    from rsgen.sequence.reader import sequence_info

    print(sequence_info(sequence))
    return 0


@dataclass(frozen=True)
class LightCheck:
    """The comparison of baked light with path tracing."""

    light: Annotated[int, "path trace N views, evenly spread in time, and tell the PSNR of baked light", "N"] = 0
    light_spp: Annotated[int, "samples per pixel of the path-traced views"] = 4096
    light_width: Annotated[int, "width of the views, px"] = 160
    light_picture: Annotated[Path | None, "write both and eight times their difference as a picture", "PNG"] = None
    scene: SceneFile = None


def verify(
    sequence: SequenceFolder,
    check_of_light: LightCheck,
    *,
    pairs: Annotated[int, "neighbouring frames to reproject"] = 20,
    raycast: Annotated[int, "cast N frames again with another ray caster (embreex)", "N"] = 0,
) -> int:
    """Read a sequence back and check it: files, stamps, rows' poses, reprojection. With --light also its baked light
    against path tracing: a frame is enough of a sequence for that ('rsgen render CONFIG --frames 0:1').
    """
    from rsgen.check.verify import verify_sequence

    chosen = check_of_light
    if not chosen.light:
        _refuse_others("a check without --light", chosen, LightCheck())
    found = verify_sequence(sequence, pairs=pairs, raycast=raycast)
    print(found.text())
    if not chosen.light:
        return 0 if found.ok else 1
    from rsgen.check.light import check_light
    from rsgen.pictures.frames import config_of
    from rsgen.sequence.reader import read_sequence

    rendered = read_sequence(sequence)
    config = config_of(sequence, rendered.meta, chosen.scene)
    with ProgressDisplay() as progress:
        table, is_good = check_light(
            config, rendered.spline, chosen.light, chosen.light_spp, chosen.light_width, chosen.light_picture, progress
        )
    print(table)
    return 0 if found.ok and is_good else 1


@dataclass(frozen=True)
class MeshView:
    """How meshes are drawn."""

    from_: Annotated[
        str | None, "where the camera is, world, m (default: above, ceilings seen from behind left out)", "X,Y,Z"
    ] = None
    at: Annotated[str | None, "with --from: what it looks at, world, m (default: the middle)", "X,Y,Z"] = None
    label: Annotated[list[str] | None, "once a mesh (default: the files' names)", "TEXT"] = None
    width: Annotated[int, "of each mesh's picture, px"] = 800
    height: Annotated[int, "of each mesh's picture, px"] = 600
    grey: Annotated[bool, "leave the colours out, for the shapes"] = False


def preview(
    what: Annotated[
        list[Path], "folder that 'rsgen render' wrote, mesh files (.ply), or with --every a config", "SEQ|MESH|CONFIG"
    ],
    meshes: MeshView,
    *,
    out: Annotated[
        Path | None, "picture to write: .png .jpg .svg .pdf (default: in the folder; of meshes it is needed)", "PNG"
    ] = None,
    count: Annotated[int | None, "frames to show (default: 4)"] = None,
    frame: Annotated[int | None, "show this frame beside the same with a global shutter, and what differs", "N", int]
    = None,
    every: Annotated[float | None, "a contact sheet: small pictures of colour and depth every S seconds", "S", float]
    = None,
    scene: SceneFile = None,
    quiet: Quiet = False,
) -> int:  # fmt: skip
    """Draw a sequence, what the rolling shutter did to one of its frames, or meshes. Of a sequence some frames with
    their depth, with --frame N that one: global shutter, rolling shutter and their difference. With --every S a contact
    sheet of a sequence, or of the motion of a config that has not been rendered yet. Meshes side by side, seen by one
    camera from above or from a place you name.
    """
    from rsgen.pictures.frames import compare_frame, preview_sequence
    from rsgen.pictures.meshes import parse_point, picture_meshes

    of_meshes = every is None and any(path.suffix and not path.is_dir() for path in what)
    if of_meshes:
        refuse_options("meshes", {"--count": count, "--frame": frame is not None, "--scene": scene})
    else:
        _refuse_others("a sequence", meshes, MeshView())
        if len(what) > 1:
            raise UserError(f"{what[1]}: is more than one sequence: give one")
    if every is not None:
        refuse_options("a contact sheet", {"--count": count, "--frame": frame is not None, "--scene": scene})
        if every <= 0:
            raise UserError(f"--every {every:g}: must be above 0 s")
    with ProgressDisplay(quiet) as progress:
        if of_meshes:
            if out is None:
                raise UserError("--out: is needed for a picture of meshes")
            eye, target = (None if text is None else parse_point(text) for text in (meshes.from_, meshes.at))
            size = meshes.width, meshes.height
            made = picture_meshes(what, out, meshes.label, eye, target, *size, meshes.grey, progress)
        elif every is not None:
            made = _contact_sheet(what[0], out, every, progress)
        elif frame is None:
            refuse_options("a preview without --frame", {"--scene": scene})
            made = preview_sequence(what[0], out, count or 4)
        else:
            refuse_options("one --frame", {"--count": count})
            made = compare_frame(what[0], frame, out, scene, progress)
    print(made)
    return 0


def _contact_sheet(what: Path, out: Path | None, every_s: float, progress: Progress) -> Path:
    """Of a sequence, else of the config that is called so."""
    from rsgen.pictures.frames import sheet_of_config, sheet_of_sequence

    if what.is_dir():
        return sheet_of_sequence(what, out, every_s)
    return sheet_of_config(load_config(config_file(str(what))), out, every_s, progress)


def _refuse_others(what: str, given: object, default: object) -> None:
    names = (field.name for field in fields(given))  # type: ignore[arg-type]
    refuse_options(
        what, {f"--{n.strip('_').replace('_', '-')}": getattr(given, n) != getattr(default, n) for n in names}
    )


def _export_name(word: str) -> str:
    if word not in EXPORTS:
        raise argparse.ArgumentTypeError(f"invalid choice: '{word}' (choose from {', '.join(EXPORTS)})")
    return word


def _export_help() -> str:
    by_help = groupby(EXPORTS, lambda name: EXPORTS[name][2])
    return "; ".join(f"{', '.join(names)}: {text}" for text, names in by_help)


def export(
    to: Annotated[str, _export_help(), "|".join(EXPORTS), _export_name],
    sequence: SequenceFolder,
    *,
    out: Annotated[Path | None, "where to (default: within the sequence's folder)", "PATH"] = None,
    copy: Annotated[bool, "of exports that are folders: copy images instead of linking them"] = False,
    scene: Annotated[Path | None, "video: scene file, if it has moved since the sequence was rendered"] = None,
    storage: Annotated[Storage, "ros2: what the bag is stored in"] = "sqlite3",
    color: Annotated[str | None, "of a rig, where one colour camera is exported: its name (default: the first)"] = None,
    depth: Annotated[str | None, "of a rig, where one depth camera is exported: its name (default: the first)"] = None,
    quiet: Quiet = False,
) -> int:
    """Write a sequence in the layout of other tools."""
    from rsgen.formats.export.shared import ExportOptions
    from rsgen.sequence.reader import read_rig, read_sequence

    options = ExportOptions(to, copy, scene, storage)
    with ProgressDisplay(quiet) as progress:
        is_whole = to in OF_RIGS and color is None and depth is None
        recorded = read_rig(sequence) if is_whole else read_sequence(sequence, color, depth)
        place = sequence / EXPORTS[to][1].format(recorded.name)
        done = exporter(to)(recorded, out or place, options, progress)
    print(done)
    return 0
