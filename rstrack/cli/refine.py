"""The command `rstrack refine`: the best spline that a recording holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Quiet
from rstrack.cli.options import CameraFile, ImuFile


def refine(
    run: Annotated[Path, "folder that 'rstrack track' wrote, of a method with a spline"],
    *,
    sequence: Annotated[Path | None, "the run's sequence (default: where it was)", "DIR"] = None,
    camera: CameraFile = None,
    imu: ImuFile = None,
    out: Annotated[Path, "folder for the refined run, made if need be", "DIR"],
    rounds: Annotated[int, "rounds at most; fewer where nothing moves any more", "N"] = 3,
    quiet: Quiet = False,
) -> int:
    """Align every frame of a run to all keyframes that see it, at once, beside its IMU: writes a run folder with the
    refined spline."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.tracking.runs.refining import refine_run

    with ProgressDisplay(quiet) as progress:
        result = refine_run(run, out, sequence, camera, rounds, progress, imu)
    print(result.text())
    print(f"{out}: written")
    return 0
