"""The `rsgen` command: thin wrappers that parse arguments, call one function each and print."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

# The fit's banded solves are small: threads only get in each other's way (measured, up to 1000x on a busy machine).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from rsgen.errors import UserError

_DESCRIPTION = """\
rsgen makes rolling-shutter RGB-D benchmark sequences with exact continuous-time ground truth.

  rsgen render configs/demo.yaml            a short sequence in out/demo
  rsgen verify out/demo                     read it back and check it against itself
  rsgen compare out/demo --frame 20         what the rolling shutter did to frame 20
  rsgen fit my_trajectory.txt               how well a spline represents a recorded trajectory
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0 done, 1 a check failed, 2 wrong input, 130 interrupted."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    parser = _parser()
    options, rest = parser.parse_known_args(arguments)
    if rest and options.run is not _render:
        parser.error(f"unrecognised arguments: {' '.join(rest)}")
    options.rest = rest
    try:
        return options.run(options)
    except UserError as error:
        print(f"rsgen: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 0
    except KeyboardInterrupt:
        print("rsgen: interrupted; the same command resumes", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("rsgen", description=_DESCRIPTION, formatter_class=raw)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(
        name: str, run: Callable[[argparse.Namespace], int], help: str, epilog: str = ""
    ) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=help, description=help, epilog=epilog, formatter_class=raw)
        command.set_defaults(run=run)
        return command

    render = add("render", _render, "render a sequence from a config; run again to resume", _RenderEpilog())
    render.add_argument("config", type=Path, help="YAML file, see configs/")
    render.add_argument("--out", type=Path, help="folder of the sequence (default: out/NAME)")
    render.add_argument("--frames", metavar="A:B", help="only frames A to B-1 (default: all)")
    render.add_argument("--quiet", action="store_true", help="no progress")

    fit = add("fit", _fit, "fit a spline to a trajectory: residuals and motion statistics")
    fit.add_argument("file", type=Path, help="TUM, ICL-NUIM (.freiburg) or EuRoC trajectory")
    fit.add_argument("--dt", type=float, default=0.05, help="knot spacing, s (default: 0.05)")
    fit.add_argument("--smoothing", type=float, default=0.0, help="weight of the acceleration penalty (default: 0)")
    fit.add_argument("--format", choices=("auto", "tum", "icl", "euroc"), default="auto", help="file format")
    fit.add_argument("--plot", type=Path, metavar="PNG", help="write residuals, speeds and accelerations as a picture")
    fit.add_argument("--json", action="store_true", help="print machine-readable figures")

    info = add("info", _info, "say what a sequence folder holds")
    info.add_argument("sequence", type=Path)

    verify = add("verify", _verify, "read a sequence back and check it: files, stamps, rows' poses, reprojection")
    verify.add_argument("sequence", type=Path)
    verify.add_argument("--pairs", type=int, default=20, help="neighbouring frames to reproject (default: 20)")

    compare = add("compare", _compare, "picture of one frame: global shutter, rolling shutter and their difference")
    compare.add_argument("sequence", type=Path)
    compare.add_argument("--frame", type=int, required=True, help="index of the frame")
    compare.add_argument("--out", type=Path, metavar="PNG", help="picture to write (default: SEQ/compare_FRAME.png)")
    compare.add_argument("--scene", type=Path, help="scene file, if it has moved since the sequence was rendered")

    preview = add("preview", _preview, "picture of some frames of a sequence with their depth")
    preview.add_argument("sequence", type=Path)
    preview.add_argument("--out", type=Path, metavar="PNG", help="picture to write (default: SEQ/preview.png)")
    preview.add_argument("--count", type=int, default=4, help="frames to show (default: 4)")

    light = add(
        "check-light", _check_light, "baked light against path tracing: PSNR of views along the config's trajectory"
    )
    light.add_argument("config", type=Path)
    light.add_argument("--views", type=int, default=5, help="views, evenly spread in time (default: 5)")
    light.add_argument("--spp", type=int, default=4096, help="samples per pixel of the path-traced reference")
    light.add_argument("--width", type=int, default=160, help="width of the views, px (default: 160)")
    light.add_argument("--out", type=Path, metavar="PNG", help="picture of both and eight times their difference")

    bench = add("bench", _bench, "time ratios: rolling shutter and blur against a still, baked against path tracing")
    bench.add_argument("config", type=Path)
    bench.add_argument("--frames", type=int, default=5, help="timed frames per mode and round (default: 5)")
    bench.add_argument("--spp", type=int, default=64, help="samples per pixel (default: 64)")
    for command in (light, bench):
        command.add_argument(
            "overrides", nargs="*", metavar="FIELD=VALUE", help="config fields, as trajectory.file=PATH"
        )
    return parser


class _RenderEpilog(str):
    """Text with every config field, made when help is asked for: reading the schema is not free."""

    def __mod__(self, other: object) -> str:
        return str(self)

    def __str__(self) -> str:
        from rsgen.config import describe_fields

        rows = [f"  --{name:<28} {text} (default: {default})" for name, default, text in describe_fields()]
        return "\n".join(["Any field of the config can be set, with its dotted name and a YAML value:", *rows])


def _load(path: Path, overrides: dict[str, str]):
    from rsgen.config import load_config

    return load_config(path, overrides)


def _overrides(rest: Sequence[str]) -> dict[str, str]:
    """`--a.b value` and `--a.b=value` pairs."""
    pairs: dict[str, str] = {}
    queue = list(rest)
    while queue:
        word = queue.pop(0)
        key, equals, value = word.removeprefix("--").partition("=")
        if not word.startswith("--") or not key:
            raise UserError(f"unexpected argument '{word}': config fields are set as --section.field VALUE")
        if not equals:
            if not queue:
                raise UserError(f"--{key} needs a value")
            value = queue.pop(0)
        pairs[key] = value
    return pairs


def _equals(words: Sequence[str]) -> dict[str, str]:
    bad = [word for word in words if "=" not in word]
    if bad:
        raise UserError(f"unexpected argument '{bad[0]}': config fields are set as section.field=VALUE")
    return dict(word.split("=", 1) for word in words)


def _render(options: argparse.Namespace) -> int:
    from rsgen.generate import parse_frames, render_sequence
    from rsgen.progress import ProgressDisplay

    config = _load(options.config, _overrides(options.rest))
    frames = parse_frames(options.frames)
    out = options.out or Path("out") / config.name
    with ProgressDisplay(options.quiet) as progress:
        render_sequence(config, out, frames, progress)
    print(f"{out}: written (rsgen info {out}, rsgen verify {out})")
    return 0


def _fit(options: argparse.Namespace) -> int:
    from rsgen.fit_report import fit_dict, fit_report

    if options.json:
        print(json.dumps(fit_dict(options.file, options.dt, options.smoothing, options.format), indent=2))
    else:
        print(fit_report(options.file, options.dt, options.smoothing, options.format, plot=options.plot))
    return 0


def _info(options: argparse.Namespace) -> int:
    from rsgen.sequence import sequence_info

    print(sequence_info(options.sequence))
    return 0


def _verify(options: argparse.Namespace) -> int:
    from rsgen.verify import verify_sequence

    report = verify_sequence(options.sequence, pairs=options.pairs)
    print(report.text())
    return 0 if report.ok else 1


def _compare(options: argparse.Namespace) -> int:
    from rsgen.inspect import compare_frame

    print(compare_frame(options.sequence, options.frame, options.out, options.scene))
    return 0


def _preview(options: argparse.Namespace) -> int:
    from rsgen.inspect import preview_sequence

    print(preview_sequence(options.sequence, options.out, options.count))
    return 0


def _check_light(options: argparse.Namespace) -> int:
    from rsgen.benchmark import check_light
    from rsgen.progress import ProgressDisplay

    config = _load(options.config, _equals(options.overrides))
    with ProgressDisplay() as progress:
        print(check_light(config, options.views, options.spp, options.width, options.out, progress))
    return 0


def _bench(options: argparse.Namespace) -> int:
    from rsgen.benchmark import time_modes
    from rsgen.progress import ProgressDisplay

    config = _load(options.config, _equals(options.overrides))
    with ProgressDisplay() as progress:
        print(time_modes(config, options.frames, options.spp, progress))
    return 0


if __name__ == "__main__":
    sys.exit(main())
