"""The command `rstrack report`: one HTML page of a run, a calibration, a benchmark or a stress test."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Quiet
from rstrack.cli.options import CameraFile, TruthOffset


def report(
    run: Annotated[
        Path,
        "folder that 'rstrack track' or 'rstrack bench' wrote, a calibration.json, or a TUM file with --sequence",
    ],
    *,
    sequence: Annotated[Path | None, "the run's sequence (default: where it was)", "DIR"] = None,
    camera: CameraFile = None,
    truth_offset: TruthOffset = None,
    out: Annotated[Path | None, "page to write (default: report.html in the folder)", "FILE"] = None,
    quiet: Quiet = False,
) -> int:
    """One HTML page of a run, a calibration, a benchmark or a stress test, all in it: tables, plots, the path in 3D,
    rolling against global shutter.
    """
    from rsgen.console.progress import ProgressDisplay
    from rstrack.report.build import write_report

    with ProgressDisplay(quiet) as progress:
        page = write_report(run, sequence, out, camera, progress, truth_offset)
    print(f"{page}: written, open it in a browser")
    return 0
