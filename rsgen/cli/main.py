"""The `rsgen` command: every function here is a command, its parameters are the command's arguments.

argparse reads them (`console.command_line`): tyro and cyclopts, tried, take no YAML values such as [1, 2] and complain
in boxes, pydantic-settings in tracebacks, and repairing that would take as much code.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from rsgen.cli import suite
from rsgen.cli.results import export, info, preview, verify
from rsgen.config.config import describe_fields, load_config
from rsgen.config.faults import moved_to
from rsgen.config.sections import Up
from rsgen.console.command_line import Commands, Frames, Json, Parser, Quiet, SkipMissing, print_figures, run_program
from rsgen.console.configs import ConfigFile, config_file
from rsgen.console.progress import ProgressDisplay
from rsgen.console.scheduler import Scheduler, open_workers
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.formats import IMPORTS
from rsgen.pack.draw import PackOptions

_DESCRIPTION = """\
rsgen makes rolling-shutter RGB-D benchmark sequences with exact continuous-time ground truth.

  rsgen scenes                          the rooms that ship, and what can be rendered in them at once
  rsgen render demo                     a short sequence in out/demo
  rsgen verify out/demo                 read it back and check it against itself
  rsgen preview out/demo                a picture of it; with --frame 20 what the rolling shutter did to frame 20
  rsgen import room.blend room          a USD or Blender scene as one of Mitsuba's
  rsgen motion fit my_trajectory.txt    how well a spline represents a recorded trajectory
  rsgen motion suggest room.xml --out room.yaml      a tour through a scene of your own, to render or to edit
  rsgen pack demo --out packs/demo      pairs of rolling and global images, for training
  rsgen suite list                      benchmark suites: many sequences with roles, checksums and a card
  rsgen export euroc out/demo           for the tools of others: EuRoC, Kalibr, ROS, COLMAP, nerfstudio ...

A config is a YAML file or a name. Scenes are built, and their light is baked, once: in a checkout beside their scripts,
otherwise in $XDG_CACHE_HOME/rsgen (~/.cache/rsgen).
"""
_OF_CAMERA = re.compile(r"--streams(\.\w+){2,}")
# What became of commands that were.
_MOVED = {
    "configs": "scenes",
    "fit": "motion fit FILE",
    "import-scene": "import FILE OUT",
    "compare": "preview SEQ --frame N",
    "picture": "preview MESH ... --out PNG",
    "check-light": "verify SEQ --light N",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0 done, 1 a check failed, 2 wrong input, 130 interrupted."""
    return run_program("rsgen", _parser, arguments, "the same command resumes", _MOVED)


class _Parser(Parser):
    """Names the new option of a field of the config that has moved; takes any camera's fields, --streams.NAME.FIELD."""

    with_fields: Mapping[str, argparse.ArgumentParser] = MappingProxyType({})

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        command = self.with_fields.get(args[0]) if args else None
        for word in args or ():
            name = word.partition("=")[0]
            if name.startswith("--") and (now := moved_to(name[2:])) is not None:
                self.error(f"{name}: is now --{now}")
            # What cameras a rig has only its config says, which checks them.
            if command is not None and _OF_CAMERA.fullmatch(name) and name not in command._option_string_actions:
                command.add_argument(name, action=_Field, default=argparse.SUPPRESS, help=argparse.SUPPRESS)
        return super().parse_args(args, namespace)


@cache  # of some hundred options: whoever calls `main` often would wait for it each time
def _parser() -> Parser:
    raw = argparse.RawDescriptionHelpFormatter
    program = _Parser("rsgen", description=_DESCRIPTION, formatter_class=raw)
    commands = Commands("rsgen", _DESCRIPTION, program)
    add = commands.add
    add(scenes, "", "workshop", "workshop --seed 3 --out rooms/workshop3")
    add(import_, "room.blend scenes/room")
    motion = commands.group(
        "motion", "Fit a spline to a recorded trajectory, propose a motion, or measure those of configs."
    )
    motion.add(fit, "my_trajectory.txt --dt 0.04 --plot fit.png")
    motion.add(suggest, "room.xml --out room.yaml --seed 3, then: rsgen render room.yaml --out out/room")
    motion.add(stats, "robot_t1 table1")
    with_fields = [add(render, "demo --out out/trial --frames 0:10 --color.spp 64 --depth.readout_s 0")]
    add(info, "out/demo")
    add(verify, "out/demo --pairs 50", "out/demo --light 5")
    add(preview, "out/demo --count 6", "out/demo --frame 20", "room.yaml --every 1",
        "ours.ply theirs.ply --out meshes.png --label ours --label theirs")  # fmt: skip
    add(export, "euroc out/table1")
    suites = commands.group(
        "suite", "Make and check benchmark suites: sequences made to be compared on, with a manifest."
    )
    suites.add(suite.list_, "", "rollingrooms")
    suites.add(suite.render, "rollingrooms --tier small --out suites/rollingrooms --scheduler local:2")
    suites.add(suite.verify, "suites/rollingrooms", "suites/rollingrooms --against other/rollingrooms")
    suites.add(suite.card, "suites/rollingrooms")
    with_fields += [add(pack, "demo office1 --count 1000 --out packs/rooms --color.spp 8 --truth.spp 8")]
    for command in with_fields:
        _add_fields(command)
    program.with_fields = {command.prog.split()[-1]: command for command in with_fields}
    return commands.parser


def _add_fields(command: argparse.ArgumentParser) -> None:
    """One option for every field of the config, `--section.field VALUE`; the last one given counts.

    What several sections have alike, as the cameras and the controllers, is explained once.
    """
    command.usage = "%(prog)s [options] [--SECTION.FIELD VALUE ...] config"
    rows = describe_fields()
    sections = dict.fromkeys(name.partition(".")[0] for name, _, _ in rows if "." in name)
    of_all = command.add_argument_group("fields of the config, which these override (values are YAML)")
    groups = {section: command.add_argument_group(section) for section in sections}
    alike: dict[tuple[str, ...], list[str]] = {}
    for name, default, text in rows:
        alike.setdefault((name.rpartition(".")[2], default, text), []).append(name)
    for (_, default, text), names in alike.items():
        help = f"{text} (default: {default})".replace("%", "%%")
        groups.get(names[0].partition(".")[0], of_all).add_argument(
            *(f"--{name}" for name in names), action=_Field, default=argparse.SUPPRESS, metavar="VALUE", help=help
        )


class _Field(argparse.Action):
    """Keeps a value under the name of the option that it was given to."""

    def __call__(self, _: object, namespace: object, values: Any, option: str | None = None) -> None:
        setattr(namespace, str(option).removeprefix("--"), values)


def scenes(
    name: Annotated[str | None, "tell more of this scene"] = None,
    *,
    seed: Annotated[int | None, "another seed, another arrangement of it, to be built into --out", "N", int] = None,
    out: Annotated[Path | None, "build the scene NAME into this folder, not beside its script", "DIR"] = None,
    json: Json = False,
) -> int:
    """List the scenes that ship and the configs, by name, that are rendered in each. With a scene's name: more of that
    one; with --out: build it there, with --seed in another arrangement, and print what a config has to name.
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
    skip_missing: SkipMissing = False,
    quiet: Quiet = False,
    **fields: str,
) -> int:
    """Render a sequence from a config; run again to resume."""
    from rsgen.produce.generate import render_sequence

    chosen = load_config(config, fields | ({"scene.skip_missing": "true"} if skip_missing else {}))
    out = out or Path("out") / chosen.name
    with ProgressDisplay(quiet) as progress, open_workers(scheduler) as workers:
        render_sequence(chosen, out, frames or slice(None), progress, workers if scheduler else None)
    print(f"{out}: written (rsgen info {out}, rsgen verify {out})")
    return 0


def import_(
    file: Annotated[Path, f"file of USD, Blender or meshes: {' '.join(IMPORTS)}"],
    out: Annotated[Path, "folder of the scene"],
    *,
    force: Annotated[bool, "replace the folder if it is there"] = False,
    scale: Annotated[float | None, "metres per unit of the file (default: what it says)", float] = None,
    up: Annotated[Up | None, "axis of the file that is up (default: what it says; of .blend, y stands for z)"] = None,
) -> int:
    """Make a Mitsuba scene of a USD, Blender or mesh file. It is a folder with meshes and textures, whose scene.xml is
    what a config names as scene.file. Says what has been left out. USD needs the package usd-core, .blend files bpy.
    """
    from rsgen.formats.scenes.import_scene import import_scene

    made = import_scene(file, out, force, scale, up)
    print("\n".join([*made.found, *(f"note: {line}" for line in made.notes)]))
    print(f"{made.scene}: written (rsgen motion suggest {made.scene} --out mine.yaml)")
    return 0


def pack(
    configs: Annotated[list[Path], "YAML files, or names that 'rsgen scenes' lists", "config", config_file],
    drawn: PackOptions,
    *,
    out: Annotated[Path, "folder; run the same command again to resume, or with a larger --count", "DIR"],
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    **fields: str,
) -> int:
    """Render pairs of rolling and global images to train on, with flow, masks and gyroscope. They are short sequences
    along random stretches of the configs' motions, at random speed, view, readout and exposure. Another --seed, another
    pack; rooms by other seeds ('rsgen scenes') make more scenes; --color.spp 8 --truth.spp 8 do where light is baked.
    """
    from rsgen.pack.make import make_pack

    chosen = [load_config(config, fields) for config in configs]
    with ProgressDisplay(quiet) as progress, open_workers(scheduler) as workers:
        made = make_pack(chosen, drawn, chosen[0].seed, out, workers, progress)
    print(f"{out}: {made.pairs} pairs in {made.sequences} sequences, {made.new} of them new")
    return 0


def fit(
    file: Annotated[Path, "TUM, ICL-NUIM (.freiburg) or EuRoC trajectory"],
    *,
    dt: Annotated[float, "knot spacing, s", float] = 0.05,
    smoothing: Annotated[float, "weight of the acceleration penalty", float] = 0.0,
    format: Annotated[Literal["auto", "tum", "icl", "euroc"], "file format"] = "auto",
    plot: Annotated[Path | None, "write residuals, speeds and accelerations as a picture", "PNG"] = None,
    json: Json = False,
) -> int:
    """Fit a spline to a trajectory: residuals and motion statistics."""
    from rsgen.motion.statistics import plot_fit, summarise_fit

    summary = summarise_fit(file, dt, smoothing, format)
    if plot is not None:
        plot_fit(summary, plot)
    print_figures(summary, json)
    return 0


def stats(
    configs: Annotated[list[Path], "YAML files, or names that 'rsgen scenes' lists", "config", config_file],
) -> int:
    """Print length, mean speeds and accelerations of the configs' motions, a line a config, beside the paper's."""
    from rsgen.motion.statistics import motion_statistics, stats_table
    from rsgen.produce.parts import load_motion

    rows = []
    for file in configs:
        config = load_config(file)
        made = load_motion(config)
        rows.append((config.name, motion_statistics(made.spline, made.first_stamp, made.last_stamp)))
    print(stats_table(rows))
    return 0


def suggest(
    scene: Annotated[Path, "Mitsuba scene .xml, or a mesh file; metres, y up, or see --scale, --up"],
    *,
    out: Annotated[Path | None, "config to write (default: print it)", "YAML"] = None,
    scale: Annotated[float, "metres per unit of the file: 0.01 for one in centimetres (default: 1)", float] = 1.0,
    up: Annotated[Up, "axis of the file that is up (default: y)"] = "y",
    seconds: Annotated[float | None, "length of the sequence, s (default: 20, or as --like)", float] = None,
    speed: Annotated[float | None, "mean speed, m/s (default: 0.35, or as --like)", float] = None,
    like: Annotated[
        Path | None,
        "a config, or its name: take over its length, speed, turning, cameras, noise, truth",
        "CONFIG",
        config_file,
    ] = None,
    clearance: Annotated[float, "least distance to the scene's surfaces, m", float] = 0.2,
    seed: Annotated[int, "another seed, another tour (default: 0)", "N", int] = 0,
    name: Annotated[str | None, "the sequence's name (default: the scene's)"] = None,
    skip_missing: SkipMissing = False,
) -> int:
    """Propose a tour through a scene that has none: a config whose camera walks through the scene's largest room, or
    round what it holds, looks at what is 1 to 3 m away, and keeps its distance. Edit it, or render it as it is. With
    --like table1 it is the counterpart of table1 in this scene; --seed gives as many ways through it as are wanted. Of
    several tours that with the best worst views is taken; with --out each second's score is printed.
    """
    from rsgen.produce.suggest import Wish, suggest_tour, wish_like

    model = None if like is None else load_config(like)
    wish = Wish(clearance_m=clearance, seed=seed)
    wish = wish if model is None else wish_like(model, wish)
    wish = wish if seconds is None else replace(wish, seconds=seconds)
    wish = wish if speed is None else replace(wish, speed_m_s=speed)
    suggested = suggest_tour(scene, name, wish, scale, up, model, skip_missing)
    text = suggested.yaml((out or Path("here.yaml")).parent)
    if out is None:
        print(text.decode(), end="")
        return 0
    atomic_write(out, text)
    print("\n".join([*suggested.seconds, *suggested.found, f"{out}: written (rsgen render {out})"]))
    return 0
