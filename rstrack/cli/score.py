"""The command `rstrack score`: anybody's trajectories of a suite against the truth, and a leaderboard."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Quiet
from rsgen.console.scheduler import Scheduler
from rsgen.errors import UserError

SCORE_STATUS = "exit status: 0 done, 1 something is lost, missing or failed, 2 wrong input, 130 interrupted"


def score(
    suite: Annotated[
        Path, "folder that holds SEQUENCE/ folders; its suite.yaml, if any, states their tiers and groups"
    ],
    results: Annotated[
        tuple[Path, ...],
        "folders with METHOD/SEQUENCE.txt (TUM), such a METHOD, run folders of 'rstrack track', or the folder of "
        "'rstrack bench'",
    ] = (),
    *,
    out: Annotated[Path, "folder for scores.json and the page index.html, made if need be", "DIR"],
    only: Annotated[
        tuple[str, ...] | None, "only sequences whose name, tier, role or group is this; * and ? allowed", "NAME"
    ] = None,
    run: Annotated[
        tuple[str, ...] | None,
        "also track the suite with these methods or peers, for example rs-pg gs-pg kiss-icp; 'peers' is all peers. "
        "Runs are kept in DIR/runs, and the same command resumes",
        "METHOD",
    ] = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
) -> int:
    """Score trajectories of any tracker on a suite of sequences: writes scores.json and a leaderboard. Beside
    METHOD/SEQUENCE.txt may lie SEQUENCE.cov (covariances as smfeval reads them) and SEQUENCE.times (ms a frame), and
    METHOD/method.yaml with name, url, note, camera (depth or color: whose poses these are), alignment (se3 or sim3)
    and ms_per_frame.
    """
    from rsgen.console.progress import ProgressDisplay
    from rsgen.files import atomic_write, write_error
    from rstrack.report.build import write_page
    from rstrack.report.leaderboard import leaderboard, summary
    from rstrack.score.results import find_methods
    from rstrack.score.scores import score_suite
    from rstrack.score.suite import read_suite

    chosen = read_suite(suite, only or ())
    names = [entry.name for entry in chosen.entries]
    if not (results or run):
        raise UserError("no results to score: name folders with METHOD/SEQUENCE.txt, or methods to --run")
    given = find_methods(results, names)  # complain before hours of tracking
    with ProgressDisplay(quiet) as progress:
        if run:
            from rstrack.score.running import run_methods

            outcome = run_methods(chosen, run, out / "runs", scheduler, progress)
            for record in outcome.records.values():
                if record.error is not None:
                    print(f"not tracked: {record.method}, {record.case}: {record.error}", file=sys.stderr)
            if outcome.interrupted:
                print(f"rstrack: interrupted; the same command goes on with {out / 'runs'}", file=sys.stderr)
                return 130
            given = find_methods((*results, out / "runs"), names)
        scores = score_suite(chosen, given, progress)
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise write_error(out, error) from None
        atomic_write(out / "scores.json", scores.json_text().encode())
        page = write_page(leaderboard(scores), out / "index.html")
    print(summary(scores))
    for line in scores.gaps:
        print(f"not scored: {line}", file=sys.stderr)
    print(f"\n{page}: written, open it in a browser; all figures are in {out / 'scores.json'}")
    return 1 if scores.gaps else 0
