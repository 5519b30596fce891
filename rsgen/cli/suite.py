"""The commands that make and check benchmark suites: `suite list`, `render`, `verify`, `card`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Quiet
from rsgen.console.progress import ProgressDisplay
from rsgen.console.scheduler import Scheduler, open_workers
from rsgen.suite.definition import RenderOptions, describe_suite, read_definition, suites_folder

SuiteName = Annotated[str | None, "of a suite that ships, or its YAML file (default: name those that ship)"]
SuiteFolder = Annotated[Path, "folder that 'rsgen suite render' wrote, or a copy of it"]


def list_(name: SuiteName = None) -> int:
    """List the suites that ship. With a suite's name: its sequences by tier, and what they would take."""
    suites = [read_definition(path.stem) for path in sorted(suites_folder().glob("*.yaml"))] if name is None else []
    for suite in suites:
        print(f"{suite.name.lower()}: {suite.name} {suite.version}, tiers {', '.join(suite.tiers)}: {suite.about}")
    if name is not None:
        print(describe_suite(read_definition(name)))
    return 0


def render(
    name: Annotated[str, "of a suite that 'rsgen suite list' lists, or its YAML file", "NAME"],
    chosen: RenderOptions,
    *,
    out: Annotated[Path, "folder of the suite; run the same command again to resume", "DIR"],
    scheduler: Scheduler = None,
    quiet: Quiet = False,
) -> int:
    """Render a suite: suite.yaml, manifest.json, and a folder for each sequence. Size and hours are said first. A run
    that is stopped, or killed, goes on with the same command, to the same bytes. --scheduler local:2 renders two
    sequences at a time.
    """
    from rsgen.suite.make import render_suite

    with ProgressDisplay(quiet) as progress, open_workers(scheduler) as workers:
        made = render_suite(read_definition(name), chosen, out, workers, progress)
    left_out = f", {len(made.skipped)} skipped" if made.skipped else ""
    print(f"{out}: {made.sequences} sequences, {made.new} of them new{left_out}; {made.files} files, "
          f"{made.bytes / 1e9:.3g} GB (rsgen suite verify {out}, rsgen suite card {out})")  # fmt: skip
    return 0


def verify(
    folder: SuiteFolder,
    *,
    against: Annotated[
        Path | None, "another rendering of the suite, which has to match as the manifest says of each file", "DIR"
    ] = None,
) -> int:
    """Check a copy against its manifest: a line for each file that is missing or another one, status 1 if there are
    any. With --against compare two renderings, of two types of machines, say: poses and listings have to be equal,
    exact depth within 0.1 mm, images within a PSNR.
    """
    from rsgen.suite.manifest import compare, read_manifest
    from rsgen.suite.manifest import verify as verify_copy

    files = read_manifest(folder)
    faults = verify_copy(folder, files) + ([] if against is None else compare(folder, against, files))
    for line in faults:
        print(line)
    beside = "" if against is None else f", and match {against}"
    print(f"{folder}: {len(faults)} faults in {len(files)} files" if faults
          else f"{folder}: {len(files)} files are those of the manifest{beside}")  # fmt: skip
    return 1 if faults else 0


def card(folder: SuiteFolder) -> int:
    """Write what a dataset is published with: README.md with Hugging Face's front matter, croissant.json, pictures."""
    from rsgen.suite.card import write_card

    for path in write_card(folder):
        print(f"{path}: written")
    return 0
