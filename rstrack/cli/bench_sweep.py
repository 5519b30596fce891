"""What `rstrack bench` does with the config of a readout sweep."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rsgen.console.scheduler import open_workers
from rsgen.errors import UserError
from rstrack.options import Options


@dataclass(frozen=True)
class SweepChoice:
    """What a readout sweep is narrowed down to; None: what its config says."""

    width: Annotated[int | None, "of all images, px: small ones are rendered and tracked sooner", "PX"] = None
    readout: Annotated[tuple[float, ...] | None, "only these readouts, s", "S"] = None
    exposure: Annotated[tuple[float, ...] | None, "only these exposures, s", "S"] = None
    seeds: Annotated[int | None, "runs of each, with other noise every time", "N"] = None


def refuse_for_sweep(given: Sequence[str], frames: slice | None) -> None:
    """Raises UserError for options that a sweep does not have."""
    if given:
        raise UserError(f"{given[0]}: is not for a readout sweep (its config names the methods, --method chooses)")
    if frames is not None and frames.start:
        raise UserError(
            f"--frames {frames.start}:...: a readout sweep begins with frame 0: --frames 0:{frames.stop or 60}"
        )


def bench_sweep(
    config: Path, choice: SweepChoice, tracker: Options, out: Path, frames: int | None, motions: Sequence[str],
    methods: Sequence[str], scheduler: str | None, quiet: bool,
) -> int:  # fmt: skip
    """Run, write and print it; returns the exit status of `rstrack bench`. Raises UserError."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.readout.config import load_sweep_config, narrow
    from rstrack.bench.readout.plot import draw_sweep
    from rstrack.bench.readout.results import write_sweep
    from rstrack.bench.readout.run import run_sweep

    chosen = narrow(
        load_sweep_config(config), motions=motions, methods=methods, readouts_s=choice.readout or (),
        exposures_s=choice.exposure or (), seeds=choice.seeds, width=choice.width, frames=frames,
    )  # fmt: skip

    def say(line: str) -> None:
        if not quiet:
            print(f"rstrack: {line}", file=sys.stderr)

    with ProgressDisplay(quiet) as progress, open_workers(scheduler) as workers:
        result = run_sweep(chosen, out, tracker, workers, progress, say, scheduler)
        text = write_sweep(result, out)
        if not result.interrupted:
            draw_sweep(result, out / "plots" / "readout.png")
    print(text)
    sys.stdout.flush()
    if result.interrupted:
        print(f"rstrack: interrupted; {out} holds what is finished, and the same command goes on", file=sys.stderr)
        return 130
    print(f"\n{out}: results.txt, .md, .csv, .json, plots/readout.png, sequences/* and cells/SEQUENCE/METHOD written")
    return 0 if all(cell.counts for cells in result.cells.values() for cell in cells) else 1
