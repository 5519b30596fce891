"""The sections of docs/results.md, each from records alone: a heading, a table, a line about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from statistics import geometric_mean

from benchmarks.measures.injected import KINDS
from benchmarks.size import size_table
from benchmarks.verdicts import FAMILY, beaten, beaten_table, peer_of, sentences
from rsgen.console.tables import NOTHING, Entry, Table, significant
from rstrack.bench.record import (
    CellRecord,
    Figures,
    methods_in_order,
)
from rstrack.bench.tables import (
    ERRORS,
    Average,
    Records,
    averages,
    by_case,
    by_sequence,
    cases_of,
    cell_triple,
    joined,
    measured_table,
    of_group,
    of_measure,
    paper_triple,
    pivot,
    sequences_of,
    triple,
)

PAPERS_GROUPS = ("hand-held", "living room")
_STARTS = "starts"
_IMU = ("rs-pgi", "rs-gi")
_REFINED = {"ATE": "ate_mm_ratio", "drift": "drift_mm_s_ratio"}
_ERRORS = ("ATE, mm", "mm/s", "deg/s")
_COLUMNS: dict[str, tuple[str, ...]] = {
    "speed": ("median_ms", "p95_ms", "p99_ms", "ratio", "ratio_p95", "ratio_p99", "peer_ms", "read_ms", "lost"),
    "loops": ("keyframes", "loops", "false", "alike", "accepted", "median_mm", "median_mrad", "worst_mm", "nees"),
    "calibration": (
        "found_pct*", "not_converged*+", "refused*+", "wrong*+", "within_2_sigma_pct", "rms_over_sigma",
        "calibration_s",
    ),
    "crossed": ("ate_mm", "drift_mm_s", "drift_deg_s", "nees", "coverage_90", "lost", "silent", "calibration_s"),
    "lens": ("before_px", "after_px", "after_px_max", "within_2_sigma_pct", "rms_over_sigma", "calibration_s"),
    "convergence": ("converged_pct*", "wrong*+", "starts", "failed", "silent", "ate_mm", "ate_max_mm"),
    "light": (
        "psnr_db", "psnr_least_db", "surely_least_db", "bias_pct", "estimate_db", "bake_s", "bake_mb", "*_s", "*_ratio"
    ),
    "long": ("frames", "median_second_ms", "median_last_ms", "ratio", "lost", "keyframes", "peak_mb", "growth_mb"),
}  # fmt: skip
"""Of each measure, what is shown of its figures; of one that is not here, or has none of them, the first ten."""


def methods(full: Records) -> list[str]:
    """Averages of the two groups that the paper has, all methods: a row a method."""
    lines = []
    groups = {group: of_group(full, group) for group in PAPERS_GROUPS}
    for group, records in groups.items():
        lines.append(f"{group}: averages over {', '.join(cases_of(records)) or 'nothing yet'}.")
    every = [record for records in groups.values() for record in records]
    first, second = (_averages(records, methods_in_order(every)) for records in groups.values())
    rows = tuple((*left, *right[1:]) for left, right in zip(first.rows, second.rows, strict=True))
    one, two = (f"{group}: {_ERRORS[0]}" for group in PAPERS_GROUPS)
    return _section("Methods", Table(("method", one, *first.head[2:], two, *first.head[2:]), rows), every, *lines, "")


def per_sequence(full: Records) -> list[str]:
    """ATE of every method, with the fusion that it has by default, on every sequence of these groups."""
    records = [record for group in PAPERS_GROUPS for record in of_group(full, group)]
    records = [record for record in records if not {"fuse", "no-fuse"} & set(record.options)]
    return _section("ATE by sequence, mm", by_sequence(records), records)


def real(full: Records) -> list[str]:
    """Recordings: all methods and peers, errors with the truth's clock fitted."""
    records = of_group(full, "real", changes=True)
    found = {(record.method, record.case): record for record in records}
    table = pivot("method", methods_in_order(records), cases_of(records), lambda *at: Entry(cell_triple(found.get(at))))
    rows: list[tuple[Entry | str, ...]] = []
    for row in table.rows:
        mine = [record for record in records if record.method == row[0]]
        lost, frames, silent = (sum(round(r.total(name)) for r in mine) for name in ("lost", "frames", "silent"))
        rows.append((*row, f"{lost} of {frames}", str(silent)))
    clocks = [
        f"{record.case} {significant(record.figures['truth_offset_ms'])}"
        for record in records
        if record.method == "rs-pg" and "truth_offset_ms" in record.figures and not record.is_change
    ]
    about = f" Offsets with `rs-pg`, ms: {', '.join(clocks)}." if clocks else ""
    clock = f"The truth has a clock of its own, which is fitted for each track.{about}"
    table = Table((*table.head, "lost", "silently wrong"), tuple(rows))
    return _section("Real recordings: ATE mm · mm/s · deg/s", table, records, clock, "")


def loops(full: Records) -> list[str]:
    """With an IMU, with loops closed, and without, and how true loops are."""
    tracks = [record for record in of_measure(full, "track") if _is_close(record)]
    lines = _beside(
        "With an IMU, with loops closed, and without", tracks,
        lambda record: record.program in _IMU or "loops" in record.options,
    )  # fmt: skip
    found = of_measure(full, "loops")
    if found:
        table = measured_table(found, _COLUMNS["loops"]).markdown()
        lines += ["Loops against the truth, and places that look alike:", "", table, ""]
    return [*lines, *_refined(of_measure(full, "refined"))]


def faults(full: Records) -> list[str]:
    """Injected faults, those of a kind together."""
    lines = ["## Faults", ""]
    records = of_measure(full, "faults")
    for method in methods_in_order(records):
        runs = [run for record in records if record.method == method for run in record.runs]
        by_kind: dict[float | None, list[Figures]] = {}
        for run in runs:
            by_kind.setdefault(run.get("kind"), []).append(run)
        rows: list[tuple[Entry | str, ...]] = [
            ("any" if kind is None else list(KINDS)[int(kind)], *_fault_entries(by_kind[kind]))
            for kind in sorted(by_kind, key=lambda kind: -1.0 if kind is None else kind)
        ]
        rows.append(("all", *_fault_entries(runs)))
        head = ("kind", "faults", "silently wrong", "frames of these", "lost frames", "found in 5", "worst, mm")
        cases = ", ".join(cases_of([record for record in records if record.method == method]))
        lines += [f"`{method}`, one fault a run, on {cases}:", "", Table(head, tuple(rows)).markdown(), ""]
    return lines if records else []


def changes(full: Records) -> list[str]:
    """What may be wrong with a recording, beside the same as it is, by the method that most of it was asked of."""
    tracks = [record for record in of_measure(full, "track") if record.group != "real"]
    asked = Counter(record.method for record in tracks if record.is_change).most_common(1)
    tracks = [record for record in tracks if asked and record.method == asked[0][0]]
    changed = [record for record in tracks if record.is_change]
    bases = {record.sequence for record in changed}
    records = [record for record in tracks if record.case in bases] + changed
    places = list(dict.fromkeys(record.sequence for record in records))
    records.sort(key=lambda record: places.index(record.sequence))
    return _section("What may be wrong: ATE mm · mm/s · deg/s", by_case(records, triples=True), records)


def readout(full: Records) -> list[str]:
    """Error against readout."""
    records = [record for record in of_measure(full, "track") if record.case.startswith("readout-")]
    return _section("Readout: ATE, mm", by_case(records), records)


def others(full: Records) -> list[str]:
    """Sequences of no group above."""
    shown = {*PAPERS_GROUPS, "real", "", FAMILY, _STARTS}
    tracks = of_measure(full, "track")
    records = [record for record in tracks if record.group not in shown and not record.is_change]
    return _section("Other sequences: ATE, mm", by_case(records), records)


def starts(full: Records) -> list[str]:
    """Tracks begun at other frames, whose mean says more than one does: a line."""
    records, parts = of_group(full, _STARTS), []
    for sequence in sequences_of(records):
        mine = [record for record in records if record.sequence == sequence]
        errors = [value for record in mine for value in record.values("ate_mm")]
        mark = "†" if any(record.total("lost") for record in mine) else ""
        found = f"{significant(geometric_mean(errors))}{mark} ({significant(max(errors))})" if errors else "lost"
        parts.append(f"`{sequence}` {found}")
    text = "Begun at three to nine frames of each, `rs-pg`, ATE in mm, geometric mean (worst): " + ", ".join(parts)
    return [text + ".", ""] if parts else []


def speed(full: Records) -> list[str]:
    """Times, and ratios to the peer's in the same run."""
    peers = ", ".join(dict.fromkeys(peer_of(record) for record in of_measure(full, "speed"))) or "the peer"
    return measured(f"Speed, ms a frame; ratios to {peers}, in turns on the same frames", "speed")(full)


def memory(full: Records) -> list[str]:
    """Most memory of a track, by method: a line."""
    tracks = [record for record in of_measure(full, "track") if record.values("peak_mb")]
    found = averages(tracks)
    most = ", ".join(f"`{method}` {found[method].peak_mb or 0:.0f}" for method in methods_in_order(tracks))
    return [f"Memory of the process with all it holds, most of all tracks, MB: {most}.", ""] if tracks else []


def measured(title: str, *measures: str) -> Callable[[Records], list[str]]:
    """The section of a measure, or of several on the same cases."""

    def section(full: Records) -> list[str]:
        records = [record for measure in measures for record in of_measure(full, measure)]
        records = joined(records) if len(measures) > 1 else records
        return _section(title, measured_table(records, _COLUMNS[measures[0]]), records)

    return section


def size(records: Records) -> list[str]:
    """How large the product is, by wing."""
    found = of_measure(records, "size")
    return _section("Size of the product", size_table(found[0]), found) if found else []


def not_the_best(full: Records) -> list[str]:
    """In words and figures."""
    found = beaten(full)
    words = sentences(full) or "Nothing is measured beside others yet."
    table = ["", beaten_table(found).markdown()] if found else []
    return ["## Where ours is not the best", "", words, *table, ""]


# ---------------------------------------------------------------------------------------------------------------------


def _averages(records: Sequence[CellRecord], shown: Sequence[str]) -> Table:
    """Of each method: errors, the paper's, counts, and how true its covariances are."""
    found, names = averages(records), dict(zip(_ERRORS, ERRORS, strict=True))
    ours = {record.method: record.program for record in records if not record.is_others}

    def value(method: str, column: str) -> float | None:
        return found[method].figures.get(names.get(column, "")) if method in found else None

    def entry(method: str, column: str) -> Entry:
        if column == "the paper":
            return Entry(paper_triple(sequences_of(records), ours[method]) if method in ours else "")
        if method not in found:
            return Entry(NOTHING)
        if column in names:
            return Entry(significant(value(method, column)), mark=found[method].mark if column == _ERRORS[0] else "")
        average = found[method]
        texts = {"NEES/6": significant(average.figures.get("nees")), "lost": str(average.lost)}
        texts["in 90 %"] = significant(average.figures.get("coverage_90"), 2)
        return Entry(texts.get(column, NOTHING if average.silent is None else str(average.silent)))

    return pivot("method", shown, (*_ERRORS, "the paper", "lost", "silent", "NEES/6", "in 90 %"), entry, value)


def _refined(records: Sequence[CellRecord]) -> list[str]:
    """What refining runs came to, in a sentence."""
    changed = [record for record in records if not record.figures.get("given_back")]
    ratios = {what: [r.figures[name] for r in changed if name in r.figures] for what, name in _REFINED.items()}
    parts = [
        f"{what} × {min(of):.2f} to {max(of):.2f}, {geometric_mean(of):.2f} in the mean"
        for what, of in ratios.items()
        if of
    ]
    given_back = len(records) - len(changed)
    text = f"`rstrack refine` of {len(records)} runs: {'; '.join(parts)}; {given_back} were given back as they were."
    return [text, ""] if parts else []


def _beside(title: str, tracks: Sequence[CellRecord], chosen: Callable[[CellRecord], bool]) -> list[str]:
    """Averages of groups of some cases, over those that the chosen methods ran on; `others` has single ones."""
    means: dict[tuple[str, str], Average] = {}
    for group in dict.fromkeys(record.group for record in tracks if not record.is_change):
        cases = {r.case for r in tracks if r.group == group and chosen(r) and not r.is_change}
        if group not in (*PAPERS_GROUPS, "real") and len(cases) < 3:
            continue
        found = averages([record for record in tracks if record.case in cases])
        means |= {(group or "others", method): average for method, average in found.items()}

    def entry(*at: str) -> Entry:
        return Entry(triple(means[at].figures, means[at].mark) if at in means else NOTHING)

    table = pivot("average of", list(dict.fromkeys(group for group, _ in means)), methods_in_order(tracks), entry)
    return _section(f"{title}: ATE mm · mm/s · deg/s", table, tracks if means else ())


def _is_close(record: CellRecord) -> bool:
    """Whether it is with an IMU, or the same without."""
    plain = [program.removesuffix("i") for program in _IMU]
    return not record.is_others and record.program in (*_IMU, *plain) and "fuse" not in record.options


def _fault_entries(runs: Sequence[dict[str, float | None]]) -> list[Entry]:
    def values(name: str) -> list[float]:
        return [value for run in runs if (value := run.get(name)) is not None]

    found, worst = values("found_in_5"), values("worst_mm")
    wrong = values("silent_fault") or [float(value > 0) for value in values("silent")]
    texts = [str(len(runs)), f"{sum(wrong):.0f}", f"{sum(values('silent')):.0f}", f"{sum(values('lost')):.0f}"]
    texts += [f"{sum(found):.0f} of {len(found)}" if found else NOTHING, significant(max(worst, default=None))]
    return [Entry(text) for text in texts]


def _section(title: str, table: Table, records: Sequence[CellRecord], *lines: str) -> list[str]:
    """Nothing where there are no records."""
    return [f"## {title}", "", *lines, table.markdown(), ""] if records else []
