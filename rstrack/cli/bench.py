"""The command `stress`: a benchmark of the tracker."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Quiet
from rsgen.console.configs import ConfigFile
from rstrack.options import Options


def stress(
    config: ConfigFile,
    tracker: Options,
    *,
    out: Annotated[Path, "sequences, runs and tables go here", "DIR"],
    frames: Annotated[int | None, "only the first N frames (default: all)", "N"] = None,
    quiet: Quiet = False,
) -> int:
    """Blur stress test: one motion at several exposures and speeds, constant against blur-aware weights."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.stress.cases import StressOptions
    from rstrack.bench.stress.run import run_stress
    from rstrack.bench.stress.tables import stress_text, write_stress

    with ProgressDisplay(quiet) as progress:
        result = run_stress(config, out, StressOptions(frames=frames, tracker=tracker), progress)
    written = write_stress(result, out)
    print(stress_text(result))
    print(f"{out}: {len(written)} tables and pictures written")
    return 0
