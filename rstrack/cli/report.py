"""The command `rstrack report`: one HTML page of a run, a benchmark or a stress test."""

from __future__ import annotations

import argparse
from pathlib import Path

from rsgen.console.command_line import Commands


def add_report(commands: Commands) -> None:
    """Add it to the parser."""
    report = commands.add(
        "report", _report, "one HTML page of a run, a benchmark or a stress test, all in it: tables, plots, the path "
        "in 3D, rolling against global shutter", "runs/lr_kt2 --sequence out/lr_kt2",
    )  # fmt: skip
    report.add_argument(
        "run_path", type=Path, metavar="run",
        help="folder that 'rstrack track', 'rstrack bench' or 'rstrack stress' wrote, or a TUM file with --sequence",
    )  # fmt: skip
    report.add_argument("--sequence", type=Path, metavar="DIR", help="the run's sequence (default: where it was)")
    report.add_argument(
        "--camera", type=Path, metavar="FILE", help="cameras of a TUM or ICL-NUIM folder (default: one inside it)"
    )
    report.add_argument("--out", type=Path, metavar="FILE", help="page to write (default: report.html in the folder)")
    report.add_argument("--quiet", action="store_true", help="no progress")


def _report(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rstrack.report.build import write_report

    with ProgressDisplay(options.quiet) as progress:
        out = write_report(options.run_path, options.sequence, options.out, options.camera, progress)
    print(f"{out}: written, open it in a browser")
    return 0
