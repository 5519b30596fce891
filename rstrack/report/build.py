"""`rstrack report`: which page a folder or file gets, and where it is written.

out = write_report(Path("runs/lr_kt2"))
"""

from __future__ import annotations

import dataclasses
from importlib.metadata import version
from pathlib import Path

from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, write_error
from rstrack.bench.experiments.method_results import RESULTS
from rstrack.bench.experiments.stress import STRESS
from rstrack.calibration.record import read_record
from rstrack.data.estimate import TRAJECTORY
from rstrack.metrics.clock import TruthOffset
from rstrack.report.bench import bench_page, stress_page
from rstrack.report.calibration import calibration_page
from rstrack.report.page import Page, render
from rstrack.report.run import run_page

REPORT = "report.html"


def write_report(
    folder: Path, sequence: Path | None = None, out: Path | None = None, camera_file: Path | None = None,
    progress: Progress = no_progress, truth_offset: TruthOffset | None = None,
) -> Path:  # fmt: skip
    """Write the page of a run folder, a TUM file with a sequence, a calibration.json, or the folder of a benchmark or
    of a stress test.

    Returns its path. sequence: where the run's sequence is, by default where run.json says. out: the file, by default
    report.html in the folder. camera_file: as in `open_tracked`. progress: called with a stage, the
    fraction done (0 to 1) and a note. truth_offset: of the truth's clock, as in `evaluate_clocks`; a benchmark has its
    own. Raises UserError: `folder` is none of these, something that was named cannot be read, no such offset is found,
    or the page cannot be written.
    """
    folder = Path(folder)
    page = _page(folder, sequence, camera_file, progress, truth_offset)
    return write_page(page, out or (folder / REPORT if folder.is_dir() else folder.with_suffix(".html")))


def write_page(page: Page, out: Path) -> Path:
    """Write a page, its folder too if need be; returns its path. Raises UserError."""
    page = dataclasses.replace(page, made_with=f"rstrack {version('rolling-shutter-rgbd')}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(out, error) from None
    atomic_write(out, render(page).encode())
    return out


def _page(
    folder: Path, sequence: Path | None, camera_file: Path | None, progress: Progress, truth_offset: TruthOffset | None
) -> Page:  # fmt: skip
    is_bench = (folder / RESULTS).is_file()
    if is_bench or (folder / STRESS).is_file():
        if sequence is not None or camera_file is not None:
            kind = "benchmark" if is_bench else "stress test"
            raise UserError(f"{folder}: a {kind} knows its sequences: leave --sequence and --camera out")
        if truth_offset is not None:
            how = "give it to 'rstrack bench'" if is_bench else "its sequences have one clock"
            raise UserError(f"{folder}: the errors are there already: leave --truth-offset out ({how})")
        return bench_page(folder, progress) if is_bench else stress_page(folder)
    if folder.suffix == ".json":
        if sequence is not None or camera_file is not None or truth_offset is not None:
            raise UserError(f"{folder}: a calibration is all there: leave --sequence, --camera and --truth-offset out")
        return calibration_page(read_record(folder))
    if folder.is_dir() and not (folder / TRAJECTORY).is_file():
        raise UserError(
            f"{folder}: holds neither {TRAJECTORY}, {RESULTS} nor {STRESS}: give a folder that 'rstrack track' "
            "or 'rstrack bench' wrote"
        )
    return run_page(folder, sequence, camera_file, truth_offset)
