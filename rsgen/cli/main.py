"""The `rsgen` command: every function here is a command, its parameters are the command's arguments.

argparse reads them (`console.command_line`): tyro and cyclopts, tried, take no YAML values such as [1, 2] and complain
in boxes, pydantic-settings in tracebacks, and repairing that would take as much code.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Literal

from rsgen.cli.motion import fit, stats, suggest
from rsgen.cli.pictures import SequenceFolder, compare, picture, preview
from rsgen.config.sections import Up
from rsgen.console.command_line import Commands, Frames, Json, Parser, Quiet, print_figures, run_program
from rsgen.console.configs import ConfigFile, config_file, configs_text
from rsgen.console.scheduler import Scheduler, open_workers
from rsgen.errors import UserError
from rsgen.formats import EXPORTS, IMPORTS, exporter
from rsgen.pack.draw import PackOptions

Storage = Literal["sqlite3", "mcap"]
_DESCRIPTION = """\
rsgen makes rolling-shutter RGB-D benchmark sequences with exact continuous-time ground truth.

  rsgen configs                         what can be rendered at once
  rsgen scenes                          the rooms that ship; rsgen scenes NAME --seed N --out DIR makes others like them
  rsgen render demo                     a short sequence in out/demo
  rsgen verify out/demo                 read it back and check it against itself
  rsgen compare out/demo --frame 20     what the rolling shutter did to frame 20
  rsgen fit my_trajectory.txt           how well a spline represents a recorded trajectory
  rsgen motion suggest room.xml --out room.yaml      a tour through a scene of your own, to render or to edit
  rsgen import-scene room.blend room    a USD or Blender scene as one of Mitsuba's
  rsgen motion stats table1             how far and how fast a config's camera moves
  rsgen pack demo --out packs/demo      pairs of rolling and global images, for training
  rsgen export euroc out/demo           for the tools of others: EuRoC, Kalibr, ROS, COLMAP, nerfstudio ...

A config is a YAML file or a name. Scenes are built, and their light is baked, once: in a checkout beside their scripts,
otherwise in $XDG_CACHE_HOME/rsgen (~/.cache/rsgen).
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0 done, 1 a check failed, 2 wrong input, 130 interrupted."""
    return run_program("rsgen", _parser, arguments, "the same command resumes")


class _Parser(Parser):
    """Names the new option of a field of the config that has moved."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        from rsgen.config.faults import moved_to

        for word in args or ():
            name = word.partition("=")[0]
            if name.startswith("--") and (now := moved_to(name[2:])) is not None:
                self.error(f"{name}: is now --{now}")
        return super().parse_args(args, namespace)


@cache  # of some hundred options: whoever calls `main` often would wait for it each time
def _parser() -> Parser:
    raw = argparse.RawDescriptionHelpFormatter
    commands = Commands("rsgen", _DESCRIPTION, _Parser("rsgen", description=_DESCRIPTION, formatter_class=raw))
    add = commands.add
    add(configs, "")
    add(scenes, "workshop, or: rsgen scenes workshop --seed 3 --out rooms/workshop3")
    with_fields = [add(render, "demo --out out/trial --frames 0:10 --color.spp 64 --depth.readout_s 0")]
    add(fit, "my_trajectory.txt --dt 0.04 --plot fit.png")
    motion = commands.group("motion", "Motions of cameras: propose one for a scene, or tell how those of configs are.")
    motion.add(suggest, "room.xml --out room.yaml --seed 3, then: rsgen render room.yaml --out out/room")
    motion.add(stats, "robot_t1 table1")
    add(import_scene, "room.blend scenes/room, then: rsgen motion suggest scenes/room/scene.xml --out room.yaml")
    add(info, "out/demo")
    add(verify, "out/demo --pairs 50")
    add(compare, "out/demo --frame 20")
    add(preview, "out/demo --count 6")
    add(picture, "ours.ply theirs.ply --out meshes.png --label ours --label theirs")
    add(export, "euroc out/table1")
    with_fields += [add(pack, "demo office1 --count 1000 --out packs/rooms --color.spp 8 --truth.spp 8")]
    with_fields += [add(check_light, "demo --spp 1024 --out light.png")]
    for command in with_fields:
        _add_fields(command)
    return commands.parser


def _add_fields(command: argparse.ArgumentParser) -> None:
    """One option for every field of the config, `--section.field VALUE`; the last one given counts."""
    from rsgen.config.config import describe_fields

    command.usage = "%(prog)s [options] [--SECTION.FIELD VALUE ...] config"
    group = command.add_argument_group("fields of the config, which these override (values are YAML)")
    for name, default, text in describe_fields():
        help = f"{text} (default: {default})".replace("%", "%%")
        group.add_argument(f"--{name}", default=argparse.SUPPRESS, metavar="VALUE", help=help)


def configs() -> int:
    """List the configs that can be named."""
    print(configs_text())
    return 0


def scenes(
    name: Annotated[str | None, "tell more of this scene"] = None,
    *,
    seed: Annotated[int | None, "another seed, another arrangement of it, to be built into --out", "N", int] = None,
    out: Annotated[Path | None, "build the scene NAME into this folder, not beside its script", "DIR"] = None,
    json: Json = False,
) -> int:
    """List the scenes that ship: what each is, its size, configs, whether it is built and lit. With a name: more of
    that one; with --out: build it there, with --seed in another arrangement, and print what a config has to name.
    """
    from rsgen.produce.library import build_variant, describe_scene, list_scenes

    if seed is not None and out is None:
        raise UserError("--seed: needs --out DIR, the folder to build into, and the scene's name")
    if out is None:
        print_figures(list_scenes() if name is None else describe_scene(name), json)
        return 0
    if name is None:
        raise UserError(f"--out {out}: needs the name of a scene before it (rsgen scenes lists them)")
    built = build_variant(name, seed, out)
    print(f"scene: {{file: {built.resolve()}}}")
    return 0


def render(
    config: ConfigFile,
    *,
    out: Annotated[Path | None, "folder of the sequence (default: out/NAME)", "DIR"] = None,
    frames: Frames = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    **fields: str,
) -> int:
    """Render a sequence from a config; run again to resume."""
    from rsgen.config.config import load_config
    from rsgen.console.progress import ProgressDisplay
    from rsgen.produce.generate import render_sequence

    chosen = load_config(config, fields)
    out = out or Path("out") / chosen.name
    with ProgressDisplay(quiet) as progress, open_workers(scheduler) as workers:
        render_sequence(chosen, out, frames or slice(None), progress, workers if scheduler else None)
    print(f"{out}: written (rsgen info {out}, rsgen verify {out})")
    return 0


def import_scene(
    file: Annotated[Path, f"file of USD, Blender or meshes: {' '.join(IMPORTS)}"],
    out: Annotated[Path, "folder of the scene"],
    *,
    force: Annotated[bool, "replace the folder if it is there"] = False,
    scale: Annotated[float | None, "metres per unit of the file (default: what it says)", float] = None,
    up: Annotated[Up | None, "axis of the file that is up (default: what it says; of .blend, y stands for z)"] = None,
) -> int:
    """Make a Mitsuba scene of one of another program, in a folder with its meshes and textures: name its scene.xml in
    scene.file of a config. Says what has been left out. USD needs the package usd-core, .blend files bpy.
    """
    from rsgen.formats.scenes.import_scene import import_scene as make

    made = make(file, out, force, scale, up)
    print("\n".join([*made.found, *(f"note: {line}" for line in made.notes)]))
    print(f"{made.scene}: written (rsgen motion suggest {made.scene} --out mine.yaml)")
    return 0


def info(sequence: SequenceFolder) -> int:
    """Say what a sequence folder holds."""
    from rsgen.sequence.info import sequence_info

    print(sequence_info(sequence))
    return 0


def verify(
    sequence: SequenceFolder,
    *,
    pairs: Annotated[int, "neighbouring frames to reproject"] = 20,
    raycast: Annotated[int, "cast N frames again with another ray caster (embreex)", "N"] = 0,
) -> int:
    """Read a sequence back and check it: files, stamps, rows' poses, reprojection."""
    from rsgen.check.verify import verify_sequence

    found = verify_sequence(sequence, pairs=pairs, raycast=raycast)
    print(found.text())
    return 0 if found.ok else 1


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
    copy: Annotated[bool, "euroc, registered, kalibr, colmap, nerfstudio: copy images instead of linking them"] = False,
    scene: Annotated[Path | None, "video: scene file, if it has moved since the sequence was rendered"] = None,
    storage: Annotated[Storage, "ros2: what the bag is stored in"] = "sqlite3",
    quiet: Quiet = False,
) -> int:
    """Write a sequence in the layout of other tools."""
    from rsgen.console.progress import ProgressDisplay
    from rsgen.formats.export.shared import ExportOptions
    from rsgen.sequence.reader import read_sequence

    options = ExportOptions(to, copy, scene, storage)
    with ProgressDisplay(quiet) as progress:
        recorded = read_sequence(sequence)
        place = sequence / EXPORTS[to][1].format(recorded.name)
        done = exporter(to)(recorded, out or place, options, progress)
    print(done)
    return 0


def check_light(
    config: ConfigFile,
    *,
    views: Annotated[int, "views, evenly spread in time"] = 5,
    spp: Annotated[int, "samples per pixel of the path-traced reference"] = 4096,
    width: Annotated[int, "width of the views, px"] = 160,
    out: Annotated[Path | None, "picture of both and eight times their difference", "PNG"] = None,
    **fields: str,
) -> int:
    """Baked light against path tracing: PSNR of views along the config's trajectory."""
    from rsgen.check.light import check_light as check
    from rsgen.config.config import load_config
    from rsgen.console.progress import ProgressDisplay

    chosen = load_config(config, fields)
    with ProgressDisplay() as progress:
        table, ok = check(chosen, views, spp, width, out, progress)
    print(table)
    return 0 if ok else 1


def pack(
    configs: Annotated[list[Path], "YAML files, or names that 'rsgen configs' lists", "config", config_file],
    drawn: PackOptions,
    *,
    out: Annotated[Path, "folder; run the same command again to resume, or with a larger --count", "DIR"],
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    **fields: str,
) -> int:
    """Render pairs of rolling and global images to train on: short sequences along random stretches of the configs'
    motions, at random speed, view, readout and exposure, with flow, masks and gyroscope. Another --seed, another
    pack; rooms by other seeds ('rsgen scenes') make more scenes; --color.spp 8 --truth.spp 8 do where light is baked.
    """
    from rsgen.config.config import load_config
    from rsgen.console.progress import ProgressDisplay
    from rsgen.pack.make import make_pack

    chosen = [load_config(config, fields) for config in configs]
    with ProgressDisplay(quiet) as progress, open_workers(scheduler) as workers:
        made = make_pack(chosen, drawn, chosen[0].seed, out, workers, progress)
    print(f"{out}: {made.pairs} pairs in {made.sequences} sequences, {made.new} of them new")
    return 0
