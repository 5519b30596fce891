"""Arguments that several `rstrack` commands share."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from rsgen.console.command_line import count
from rstrack.options import Options

HELP = {
    "method": "rs models the rolling shutter, gs takes it for a global one; p photometric, g geometric error; baseline "
    "has one pose a frame",
    "knot_spacing_s": "time between control points of the spline, s",
    "knot_phase": "the first knot lies this part of the spacing before the first line",
    "backend": "where kernels run",
    "keyframe_overlap": "new keyframe once less than this part of the first points is seen",
    "keyframe_distance": "new keyframe after this distance, m",
    "keyframe_angle_deg": "new keyframe after this rotation, degrees",
    "keyframe_strategy": "the last frame that has converged, or the newest, rolling until it has",
    "fuse": "average the depth of later frames into the keyframe (default: yes, but not if a rolling shutter is taken "
    "for a global one)",
    "bootstrap_frames": "frames that are aligned jointly at the start",
    "max_depth": "depth beyond this counts as missing, m",
    "reference": "what new frames are aligned to: keyframes, or a model of all that was seen, older keyframes "
    "included: less drift where the camera comes back",
    "voxel_m": "voxels of that model, m",
    "blur_sigma_px": "colour that motion blurs counts less, by exp(-length / this squared), px; 0: all alike",
}
"""What the fields of Options mean, on the command line."""


def add_sequence(command: argparse.ArgumentParser) -> None:
    """The folder with the images."""
    command.add_argument("sequence", type=Path, help="rsgen sequence, TUM RGB-D or ICL-NUIM folder")
    command.add_argument(
        "--camera", type=Path, metavar="FILE", help="cameras of a TUM or ICL-NUIM folder (default: one inside it)"
    )


def add_run(command: argparse.ArgumentParser) -> None:
    """The estimate."""
    command.add_argument("run_path", type=Path, metavar="run", help="folder that 'rstrack track' wrote, or a TUM file")


def add_options(command: argparse.ArgumentParser, leave_out: Sequence[str] = ()) -> None:
    """One option for every field of `Options`."""
    group = command.add_argument_group("the tracker")
    hints = get_type_hints(Options)
    for field in dataclasses.fields(Options):
        if field.name in leave_out:
            continue
        flag, kind = f"--{field.name.replace('_', '-')}", hints[field.name]
        text = f"{HELP.get(field.name, '')} (default: {field.default})"
        how: dict[str, Any] = {"dest": field.name, "default": field.default}
        if bool in (kind, *get_args(kind)):
            text = HELP.get(field.name, "")
            group.add_argument(flag, action=argparse.BooleanOptionalAction, help=text, **how)
        elif get_args(kind):
            group.add_argument(flag, choices=get_args(kind), help=text, **how)
        else:
            group.add_argument(flag, type={int: count, float: number}[kind], metavar="X", help=text, **how)


def number(text: str) -> float:
    """A finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"expected a finite number, got '{text}'")
    return number


def options_of(options: argparse.Namespace, **changed: Any) -> Options:
    """What `add_options` parsed. Raises UserError."""
    given = vars(options)
    return Options(**{f.name: given[f.name] for f in dataclasses.fields(Options) if f.name in given} | changed)
