"""Writes what the committed records say: docs/results.md, the README's block, docs/readout.png.

python -m benchmarks.show              # writes them
python -m benchmarks.show --check      # 1 where the texts differ from what the records say
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from benchmarks import sections
from benchmarks.verdicts import cliff, sentences
from rsgen.console.tables import Entry, Table, significant
from rsgen.errors import UserError
from rsgen.files import atomic_write, read_text
from rstrack.bench.experiments.readout import errors, readout_chart
from rstrack.bench.record import CellRecord, methods_in_order, read_records
from rstrack.bench.tables import (
    Records,
    averages,
    closes_loops,
    failures,
    is_default,
    of_group,
    of_measure,
    paper_triple,
    provenance,
    sequences_of,
    triple,
)
from rstrack.charts.chart import Chart
from rstrack.charts.to_file import write_charts

ROOT = Path(__file__).parents[1]
GATE, FULL = (ROOT / "benchmarks/results" / f"{tier}.json" for tier in ("gate", "full"))
RESULTS, README, READOUT = ROOT / "docs/results.md", ROOT / "README.md", ROOT / "docs/readout.png"
BEGIN, END = "<!-- results:begin (python -m benchmarks.show writes this) -->", "<!-- results:end -->"
HEADLINE = ("<!-- headline:begin -->", "<!-- headline:end -->")
_ABOUT = """\
Written by `python -m benchmarks.show` from the records in `benchmarks/results`: change nothing here. How to measure it
again is in [its README](../benchmarks/README.md), what was learnt on the way in [the notebook](notebook/README.md)."""
_PAPERS = (
    "The paper's figures are of its own recordings and renderings of such motions: compare the orders, not the digits."
)
_WORDS = f"""\
ATE and drift over a second are RMSE, means over seeds; counts are sums. † frames were lost; silent: frames given, not \
lost, though 20 mm or 2° off. NEES/6 is 1 where errors are as large as covariances say, and 90 % should lie in 90 %. \
All is computed by the `llvm` backend: no GPU has run a cell. {_PAPERS}"""
_CASE = re.compile(r"readout-(.+)-(\d+(?:\.\d+)?)ms")
_WHAT = {
    "rs-pg": "rolling shutter, depth and colour",
    "rs-g": "rolling shutter, depth",
    "rs-p": "rolling shutter, colour",
    "rs-pgi": "rolling shutter, depth, colour, IMU",
    "rs-gi": "rolling shutter, depth, IMU",
    "gs-pg": "global shutter, depth and colour",
    "gs-g": "global shutter, depth",
    "gs-p": "global shutter, colour",
    "baseline": "one pose a frame, depth",
    "open3d-icp": "Open3D, point-to-plane, to the frame before",
    "open3d-hybrid": "Open3D, hybrid, to the frame before",
    "open3d-icp-keyframe": "Open3D, point-to-plane, to a keyframe",
    "open3d-hybrid-keyframe": "Open3D, hybrid, to a keyframe",
    "kiss-icp": "lidar odometry",
    "small-gicp": "lidar odometry",
    "orb-slam3": "SLAM with loops, depth and colour",
}
# What a newcomer compares first.
_HEADLINE = {
    "rs-pg": "`rs-pg`",
    "gs-pg": "the same with a global shutter",
    "orb-slam3": "ORB-SLAM3",
    "open3d-icp-keyframe": "Open3D's point-to-plane ICP",
}


def results_markdown(gate: Records, full: Records) -> str:
    """All of docs/results.md. Cells that the full tier has not are the gate's; empty sections are left out."""
    parts = (
        sections.methods, sections.per_sequence, sections.real, sections.not_the_best, sections.loops,
        sections.faults, sections.changes, cliff, sections.starts, sections.readout, sections.speed, sections.memory,
        sections.measured("Calibration", "calibration"),
        sections.measured("Wrong lenses, calibrated: RMS over the image", "lens"),
        sections.measured("With the camera found on another recording", "crossed"),
        sections.measured("Convergence and start", "convergence", "bootstrap"),
        sections.measured("Light and rendering", "light", "render"),
        sections.measured("Long runs", "long"),
        sections.size,
    )  # fmt: skip
    tiers = [*_provenance("Full tier", full), *_provenance("Gate", gate)]
    missing = [*failures(full.values()), *failures(gate.values())]
    lines = ["# Results", "", _ABOUT, "", *tiers, *missing, "", _WORDS, ""]
    lines += [*(line for part in parts for line in part({**gate, **full})), *sections.others(full)]
    return "\n".join(lines).rstrip() + "\n"


def readme_block(gate: Records, full: Records) -> str:
    """The README's table with its sentences, without the markers; real recordings are the gate's if not in full."""
    groups = {name: of_group(full, name) for name in sections.PAPERS_GROUPS}
    groups["real"] = of_group(full, "real") or of_group(gate, "real")
    every = [record for records in groups.values() for record in records]
    shown = [record for record in every if is_default(record) or closes_loops(record)]
    means = {name: averages(records) for name, records in groups.items()}
    rows = []
    for method in methods_in_order(shown):
        record = next(record for record in shown if record.method == method)
        cells: list[Entry | str] = [_what(method, record.program, closes_loops(record))]
        for name, records in groups.items():
            average = means[name].get(method)
            cells.append(Entry("-" if average is None else triple(average.figures, average.mark)))
            if name != "real":
                is_papers = is_default(record) and not record.is_others
                cells.append(paper_triple(sequences_of(records), method) if is_papers else "")
        rows.append((method, *cells))
    head = ("method", "what it does", "hand-held", "the paper", "living room", "the paper", "real recordings")
    table = Table(head, tuple(rows), words=(0, 1)).markdown() if rows else "-"
    listed = {name: ", ".join(sequences_of(records)) or "nothing yet" for name, records in groups.items()}
    loops = sorted({record.method for record in shown if closes_loops(record)})
    but = f", and closed in the end in {' and '.join(f'`{method}`' for method in loops)}" if loops else ""
    words = sentences({**gate, **full})
    return "\n".join([
        f"Averages over sequences: hand-held (blurred, noisy, unregistered: {listed['hand-held']}),",
        f"living room (noise-free: {listed['living room']}),",
        f"real recordings ({listed['real']}, the truth's clock fitted).",
        "Cells are ATE in mm · drift in mm/s · drift in degrees/s, all RMSE. † frames were lost; (n of m) has so many.",
        "", table, "", _PAPERS,
        f"Settings are defaults; loops are off{but}. `rstrack track` closes them in the end by default.",
        *_provenance("Measured", full or gate), *([words] if words else []),
        "Every sequence, recording and measure is in [docs/results.md](docs/results.md).",
    ])  # fmt: skip


def headline(full: Records) -> str:
    """The README's first figures: errors on real recordings, ours and others', the same averages as in its table."""
    real = of_group(full, "real")
    means = averages(real)
    errors = {method: means[method].figures["ate_mm"] for method in _HEADLINE if method in means}
    listed = [f"{_HEADLINE[method]} {significant(error)} mm" for method, error in errors.items()]
    if not listed:
        return "-"
    what = f"{', '.join(sequences_of(real))}; a guessed camera file, the truth's clock fitted"
    return f"On real recordings ({what}) the ATE is {', '.join(listed)}: [all results](docs/results.md)."


def with_block(readme: str, block: str, begin: str = BEGIN, end: str = END) -> str:
    """The README with another block between two markers. Raises UserError: it has none."""
    head, found, rest = readme.partition(begin.partition(" (")[0])
    _, last, tail = rest.partition(end)
    if not found or not last:
        raise UserError(f"README.md: has no lines '{begin}' and '{end}': put them around the results")
    return f"{head}{begin}\n{block.strip()}\n{end}{tail}"


def documents(gate: Records, full: Records) -> dict[Path, str]:
    """Every text that shows records, as it should be. Raises UserError."""
    return {
        RESULTS: results_markdown(gate, full),
        README: with_block(with_block(read_text(README), readme_block(gate, full)), headline(full), *HEADLINE),
    }


def readout_charts(full: Records) -> list[Chart]:
    """ATE over readout, one chart a motion, of cells track/readout-MOTION-Nms/METHOD."""
    motions: dict[str, dict[str, dict[float, CellRecord]]] = defaultdict(lambda: defaultdict(dict))
    records = of_measure(full, "track")
    order = methods_in_order(records)
    for record in sorted(records, key=lambda record: order.index(record.method)):
        named = _CASE.fullmatch(record.case)
        if named and errors(record):
            motions[named[1]][record.method][1e-3 * float(named[2])] = record
    return [readout_chart(motion, methods) for motion, methods in motions.items()]


def draw_readout(full: Records, path: Path) -> bool:
    """Write the picture, the same bytes for the same records and versions; whether there is anything to draw."""
    charts = readout_charts(full)
    if charts:
        write_charts(charts, path, "", columns=len(charts), one_legend=True)
    return bool(charts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given not in ([], ["--check"]):
        print("usage: python -m benchmarks.show [--check]", file=sys.stderr)
        return 2
    try:
        gate, full = (read_records(path) if path.is_file() else {} for path in (GATE, FULL))
        if not gate and not full:
            raise UserError(f"{GATE.parent}: has no records: make them with './run.sh bench gate --accept'")
        wanted = documents(gate, full)
        stale = [path for path, text in wanted.items() if not path.is_file() or read_text(path) != text]
        if given:
            for path in stale:
                print(f"{path.relative_to(ROOT)}: is not what the records say: run 'python -m benchmarks.show'")
            return int(bool(stale))
        for path in stale:
            atomic_write(path, wanted[path].encode())
        drawn = [READOUT] if draw_readout(full, READOUT) else []
        print("written: " + (", ".join(str(path.relative_to(ROOT)) for path in (*stale, *drawn)) or "nothing new"))
    except UserError as error:
        print(f"show: {error}", file=sys.stderr)
        return 2
    return 0


# ---------------------------------------------------------------------------------------------------------------------


def _what(method: str, program: str, with_loops: bool) -> str:
    """What a row's method does, in a few words."""
    what = _WHAT.get(program, "")
    return f"{what}, loops closed" if with_loops and method != program else what


def _provenance(tier: str, records: Records) -> list[str]:
    return [f"{tier}: {provenance(records.values()) if records else 'not measured yet.'}"]


if __name__ == "__main__":
    sys.exit(main())
