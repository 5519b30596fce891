"""The pictures of `rstrack bench`: bars of the ATE, and for each sequence the paths and the errors over time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rstrack.bench.methods.config import SequenceInfo
from rstrack.bench.methods.results import Results
from rstrack.bench.tables import paper
from rstrack.bench.tables.cells import folder_of, truth_offset_s
from rstrack.charts.chart import Bars, Chart, method_colors, numbers
from rstrack.charts.runs import compared_errors, path_chart
from rstrack.charts.to_file import write_charts
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.metrics.tracked import Tracked, load_run


def draw_plots(results: Results, out: Path, progress: Progress, warn: Callable[[str], None]) -> list[Path]:
    """Write plots/ate.png and plots/SEQUENCE.png into `out`; returns what was written.

    Runs that cannot be read are left out and said to `warn`, a line each. Raises UserError.
    """
    count = 1 + len(results.sequences)
    written = [out / "plots" / "ate.png"]
    write_charts([ate_chart(results)], written[0])
    for k, sequence in enumerate(results.sequences, 1):
        progress("plots", k / count, sequence.name)
        path = out / "plots" / f"{sequence.name}.png"
        if draw_sequence(results, sequence, out, path, warn):
            written.append(path)
    progress("plots", 1.0, f"{len(written)} pictures")
    return written


def ate_chart(results: Results) -> Chart:
    """The ATE of every cell as a bar on a logarithmic scale, the paper's as a mark on it."""
    names, bars = [s.name for s in results.sequences], []
    shown = [results.shown(s.group) for s in results.sequences]
    rows = list(dict.fromkeys(row for variants in shown for row in variants))
    colors = method_colors(rows)
    for row in rows:
        ours = [results.figure(name, variants[row], "ate_mm") for name, variants in zip(names, shown, strict=True)]
        theirs = numbers([paper.FIGURES.get((name, row), {}).get("ate_mm") for name in names])
        bars.append(Bars(row, colors[row], numbers(ours), theirs))
    note = "Logarithmic. Marks on the bars: the paper's figures for that method, in its own rooms."
    if any(row != name for variants in shown for row, name in variants.items()):
        note += " Without a model of the shutter: with or without fused keyframes, whichever is better in the group."
    return Chart("ATE (RMSE) by sequence and method", "mm", bars=tuple(bars), groups=tuple(names), is_log=True,
                 note=note)  # fmt: skip


def draw_sequence(
    results: Results, sequence: SequenceInfo, out: Path, path: Path, warn: Callable[[str], None]
) -> bool:  # fmt: skip
    """Paths from above and errors over time of what the tables show of one sequence; False if there is none to draw."""
    runs = shown_runs(results, sequence, out, open_dataset(sequence.path), warn)
    runs = {method: run for method, run in runs.items() if run.found is not None}
    if runs:
        write_charts([path_chart(runs), compared_errors(runs)], path, sequence.name)
    return bool(runs)


def shown_runs(
    results: Results, sequence: SequenceInfo, out: Path, dataset: Dataset, warn: Callable[[str], None]
) -> dict[str, Tracked]:  # fmt: skip
    """The runs of a sequence that the tables show, by name, in the order of the tables."""
    runs = {}
    for method in results.shown(sequence.group).values():
        record = results.record(sequence.name, method)
        if record is not None and record.error is None:
            try:
                offset_s = truth_offset_s(record)
                runs[method] = load_run(out / folder_of(record), dataset=dataset, truth_offset=offset_s)
            except UserError as error:
                warn(f"No plots of {method} on {sequence.name}: {error}.")
    return runs
