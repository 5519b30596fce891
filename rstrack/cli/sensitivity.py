"""The command `rstrack sensitivity`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Frames, Quiet
from rsgen.errors import UserError
from rstrack.cli.options import CameraFile, SequenceFolder
from rstrack.options import Options


def sensitivity(
    sequence: SequenceFolder,
    tracker: Options,
    *,
    camera: CameraFile = None,
    frames: Frames = None,
    insults: Annotated[
        int | None,
        "instead, N seeded insults (blackouts, jumps, shuffled frames, ...), and what the tracker says of them",
        "N",
    ] = None,
    seed: Annotated[int, "of jitter and holes, and of the first insult", int] = 0,
    out: Annotated[
        Path | None,
        "json file to write after each case, from which the same command resumes; or md, which has the table, with the "
        "json beside it",
        "FILE",
    ] = None,
    quiet: Quiet = False,
) -> int:
    """What wrong stamps, readouts, scales, colours and missing depth do to the track of a sequence with truth."""
    from rsgen.console.progress import ProgressDisplay
    from rsgen.files import atomic_write
    from rstrack.bench.sensitivity.insulted import InsultReport, run_insults
    from rstrack.bench.sensitivity.run import Sensitivity, run_sensitivity
    from rstrack.data.dataset import open_dataset

    if out is not None and out.suffix not in (".json", ".md"):
        raise UserError(f"--out {out}: expected a name that ends in .json or .md")
    dataset, figures = open_dataset(sequence, camera), out and out.with_suffix(".json")
    chosen = frames or slice(None)
    report: Sensitivity | InsultReport
    with ProgressDisplay(quiet) as progress:
        if insults is None:
            report = run_sensitivity(dataset, tracker, chosen, seed, figures, progress)
        else:
            report = run_insults(dataset, tracker, insults, chosen, seed, figures, progress)
    if out is not None and out.suffix == ".md":
        atomic_write(out, report.markdown().encode())
    print(report.text())
    return 0
