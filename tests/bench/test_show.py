"""What is written of records: tables with every cell, '-' for what is missing, and where ours is not the best."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from benchmarks import show
from benchmarks.inference import tolerances
from benchmarks.sections import PAPERS_GROUPS
from benchmarks.show import (
    BEGIN,
    END,
    HEADLINE,
    draw_readout,
    headline,
    readme_block,
    readout_charts,
    results_markdown,
    with_block,
)
from benchmarks.verdicts import beaten, sentences
from rsgen.errors import UserError
from rstrack.bench.record import CellRecord, read_records, write_records
from rstrack.bench.tables import provenance

HAND_HELD = ("robot_t1", "robot_t2", "robot_r1", "robot_r2", "table1", "table2")
LIVING_ROOM = ("lr_kt0", "lr_kt1", "lr_kt2", "lr_kt3")
ERRORS = {"rs-pg": 0.5, "rs-g": 0.9, "gs-pg": 12.0, "baseline": 20.0, "open3d-icp-keyframe": 15.0, "orb-slam3": 18.0}


def cell(
    case: str, method: str, *runs: Mapping[str, Any], measure: str = "track", group: str = "", sequence: str = "",
    options: dict[str, Any] | None = None, settings: dict[str, Any] | None = None,
) -> CellRecord:  # fmt: skip
    entry = {"method": method.partition("_")[0], "options": options} if options else {}
    defined = {"case": {"sequence": sequence or case}, "method": entry, "settings": settings or {}, "group": group}
    return CellRecord(
        f"{measure}/{case}/{method}", "key", defined, tuple(range(len(runs))), tuple(dict(run) for run in runs),
        complete=True, version="0.25.0", commit="abc", date="2026-11-26T04:00:00Z",
        machine={"cpu": "A processor", "cores": 2, "load": 0.2},
    )  # fmt: skip


def errors(ate_mm: float, **more: Any) -> dict[str, Any]:
    figures = {"frames": 100, "lost": 0, "silent": 0, "ate_mm": ate_mm, "drift_mm_s": 0.6 * ate_mm}
    return figures | {"drift_deg_s": 0.02 * ate_mm, "nees": 1.2, "coverage_90": 0.88, "peak_mb": 600.0} | more


def by_cell(*records: CellRecord) -> dict[str, CellRecord]:
    return {record.cell: record for record in records}


@pytest.fixture
def full() -> dict[str, CellRecord]:
    made = []
    for sequences, group in ((HAND_HELD, "hand-held"), (LIVING_ROOM, "living room"), (("fr1_rpy",), "real")):
        for k, sequence in enumerate(sequences):
            for method, ate_mm in ERRORS.items():
                lost = 3 if (sequence, method) == ("lr_kt0", "gs-pg") else 0
                made.append(cell(sequence, method, errors(ate_mm + 0.01 * k, lost=lost), group=group))
            made.append(cell(sequence, "rs-pg_loops", errors(0.4), group=group, options={"loops": "end"}))
        made.append(cell("table1", "rs-pgi", errors(0.3), group="hand-held"))
    for ms in (0, 14, 28):
        for method in ("rs-pg", "open3d-icp-keyframe"):
            runs = (errors(0.5 + s * ms if method != "rs-pg" else 0.5) for s in (0.9, 1.0, 1.1))
            made.append(cell(f"readout-demo-{ms}ms", method, *runs, sequence=f"demo-{ms}ms"))
    made.append(cell("demo", "rs-pg", errors(0.4)))
    made += [cell(f"demo-late_{k}ms", "rs-pg", errors(0.4 + k), sequence="demo", group="changes") for k in range(14)]
    kinds = [{"kind": k % 2, "silent": k == 3, "silent_fault": k == 3, "lost": k, "found_in_5": 1} for k in range(6)]
    made.append(cell("demo", "rs-pg", *kinds, measure="faults"))
    timed = {"median_ms": 50.0, "ratio": 1.25, "peer_ms": 40.0}
    made.append(cell("table1-640", "rs-pg", timed, measure="speed", settings={"peer": "open3d-icp"}))
    made.append(cell("table1", "rsgen", {"psnr_db": 44.5, "bias_pct": -0.3, "bake_s": 180.0}, measure="light"))
    made.append(cell("table1", "rsgen", {"still_s": 0.2}, measure="render"))
    made.append(cell("demo", "rs-pg", {"converged_pct_1x": 98.0, "wrong_unnoticed_1x": 1.0}, measure="convergence"))
    made.append(cell("demo", "rs-pg", {"found_pct_1x": 100.0}, measure="calibration"))
    skipped = cell("fr3_teddy", "rs-pg", group="real")
    made.append(dataclasses.replace(skipped, error="--data has no fr3", skipped=True, complete=False))
    return by_cell(*made)


@pytest.fixture
def gate() -> dict[str, CellRecord]:
    runs = (errors(0.5), errors(0.52), errors(0.48))
    return tolerances(by_cell(*(cell(f"{name}-320", "rs-pg", *runs, group="hand-held 320") for name in HAND_HELD)))


def section(text: str, title: str) -> str:
    return text.partition(f"## {title}")[2].partition("\n## ")[0]


def row(text: str, name: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(f"| `{name}` |"))


def test_results_have_every_section_and_are_short(gate: dict[str, CellRecord], full: dict[str, CellRecord]) -> None:
    text = results_markdown(gate, full)
    assert len(text.splitlines()) <= 250
    methods = section(text, "Methods")
    assert "| **0.525** |" in row(methods, "rs-pg") or "| 0.525 |" in row(methods, "rs-pg")
    assert "11.3 · 12.0 · 0.802" in row(methods, "rs-pg") and "12.0†" in row(methods, "gs-pg")
    assert "0.300 (1 of 6)" in row(methods, "rs-pgi")
    assert "0.500 · 0.300 · 0.0100" in row(section(text, "Real recordings"), "rs-pg")
    assert "0.500" in row(section(text, "ATE by sequence"), "rs-pg")
    assert "0.300 · 0.180 · 0.00600" in row(section(text, "With an IMU"), "hand-held")
    assert "0.400 · 0.240 · 0.00800" in row(section(text, "With an IMU"), "real")
    faults = section(text, "Faults")
    assert row(faults, "all") == "| `all` | 6 | 1 | 1 | 15 | 6 of 6 | - |"
    assert "13.4" in section(text, "What may be wrong") and "demo-late_13ms" in text
    assert "1.25" in row(section(text, "Speed"), "table1-640")
    assert "| 44.5 | -0.300 | 180 | 0.200 |" in section(text, "Light")
    assert "| 98 | 1 |" in section(text, "Convergence")
    assert "Skipped (--data has no fr3): track/fr3_teddy/rs-pg." in text
    assert "version 0.25.0, commit abc, 2026-11-26; A processor, 2 cores" in text
    assert all(len(line.split("|")) > 2 for line in text.splitlines() if line.startswith("|"))


def test_the_cliff_test_has_a_row_for_each_sequence_the_worst_first(gate: dict[str, CellRecord]) -> None:
    def told(sequence: str, *figures: dict[str, Any]) -> list[CellRecord]:
        names = (f"cliff-{sequence}-as_told-from_{k}" for k in range(len(figures)))
        return [cell(n, "rs-pg", f, sequence=sequence, group="cliff") for n, f in zip(names, figures, strict=True)]

    lost = {"frames": 100, "lost": 100, "silent": 0}
    found = by_cell(
        # Median 4 mm: 15 is not above 2.5 medians + 5 mm, 15.1 is.
        *told("demo", errors(3.9), errors(15.0), errors(4.0), errors(15.1), errors(1.0)),
        # Half the frames are too few for an error: these are off.
        *told("desk", errors(8.0, lost=1), errors(2.0, lost=2), errors(2.0, lost=60), lost),
        *told("gone", lost),
    )
    text = results_markdown(gate | found, {})
    told_by = section(text, "The cliff test")
    assert [line.split(" | ")[0] for line in told_by.splitlines() if line.startswith("| `")] == [
        "| `gone`", "| `desk`", "| `demo`",
    ]  # fmt: skip
    assert row(told_by, "gone") == "| `gone` | 1 | 0.0 | 1 | - | 1 |"
    assert row(told_by, "desk") == "| `desk` | 4 | 0.0 | 3 | 5.00 | 2 |"
    assert row(told_by, "demo") == "| `demo` | 5 | 100.0 | 0 | 4.00 | 1 |"
    # Nowhere else, and nowhere at all before it has run.
    assert "cliff-" not in text and "## The cliff test" not in results_markdown(gate, {})


def test_what_is_not_measured_is_left_out() -> None:
    text = results_markdown({}, {})
    assert "not measured yet" in text and "## Faults" not in text
    assert "Nothing is measured beside others yet." in text
    assert "not measured yet" in readme_block({}, {})
    only = by_cell(cell("table1", "rs-pg", errors(0.5), group="hand-held"))
    assert "| `rs-pg` |" in results_markdown({}, only)


def test_all_rows_of_a_table_are_as_long(gate: dict[str, CellRecord], full: dict[str, CellRecord]) -> None:
    lines = (results_markdown(gate, full) + readme_block({}, full)).splitlines()
    for above, line in itertools.pairwise(lines):
        if above.startswith("|") and line.startswith("|"):
            assert above.count("|") == line.count("|"), line


def test_where_ours_is_not_the_best(full: dict[str, CellRecord]) -> None:
    assert not beaten(full)  # at readout 0 Open3D is as good, not better
    assert "has the least errors" in sentences(full)
    worse = full | by_cell(
        cell("table1", "rs-pg", errors(30.0, drift_mm_s=1.0, drift_deg_s=0.01), group="hand-held"),
        cell("fr1_rpy", "orb-slam3", errors(0.1, lost=7, drift_mm_s=99.0, drift_deg_s=9.0), group="real"),
    )
    found = {(each.case, each.figure): each for each in beaten(worse)}
    assert set(found) == {("table1", "ate_mm"), ("fr1_rpy", "ate_mm")}
    assert found["table1", "ate_mm"].who == "the paper" and found["table1", "ate_mm"].theirs == pytest.approx(11.0)
    assert found["fr1_rpy", "ate_mm"].text() == "0.500 > 0.100 (orb-slam3, 7 frames lost)"
    words = sentences(worse)
    assert "beat `rs-pg` in 2 of" in words and "fr1_rpy" in words
    assert "In 1 of 1 timings" in words and "1.25 times" in words
    assert "| `table1` | 30.0 > 11.0 (the paper) |  |  |" in results_markdown({}, worse)


def test_losing_the_track_is_being_beaten(full: dict[str, CellRecord]) -> None:
    gone = full | by_cell(cell("fr1_rpy", "rs-pg", {"frames": 100, "lost": 100, "silent": 0}, group="real"))
    assert {each.figure for each in beaten(gone)} == {"ate_mm", "drift_mm_s", "drift_deg_s"}
    assert beaten(gone)[0].text().startswith("lost > 15.0 (open3d-icp-keyframe")


def test_the_readmes_block(full: dict[str, CellRecord]) -> None:
    text = readme_block({}, full)
    ours = row(text, "rs-pg")
    assert "rolling shutter, depth and colour" in ours and "13.2 · 5.28 · 0.122" in ours and "0.500 · 0.300" in ours
    assert "loops closed" in row(text, "rs-pg_loops") and "Open3D" in row(text, "open3d-icp-keyframe")
    assert "loops are off, and closed in the end in `rs-pg_loops`" in text
    assert "version 0.25.0" in text and "In 1 of 1 timings" in text


def test_the_block_is_put_between_its_markers(full: dict[str, CellRecord]) -> None:
    readme = f"# Title\n\n{BEGIN}\nold\n{END}\n\nrest\n"
    new = with_block(readme, readme_block({}, full))
    assert new.startswith("# Title\n") and new.endswith(f"{END}\n\nrest\n") and "\nold" not in new
    assert with_block(new, readme_block({}, full)) == new
    with pytest.raises(UserError, match="results:begin"):
        with_block("# Title\n", "")


def test_the_headline_has_the_averages_of_real_recordings(full: dict[str, CellRecord]) -> None:
    text = headline(full)
    assert "fr1_rpy" in text and "`rs-pg` 0.500 mm" in text and "ORB-SLAM3 18.0 mm" in text
    readme = f"a\n{HEADLINE[0]}\nold\n{HEADLINE[1]}\nb\n"
    assert with_block(readme, text, *HEADLINE) == readme.replace("old", text)
    assert headline({}) == "-"


def test_the_command_writes_and_checks(
    tmp_path: Path, gate: dict[str, CellRecord], full: dict[str, CellRecord], monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(show, "ROOT", tmp_path)
    for name, file in {
        "GATE": "gate.json", "FULL": "full.json", "RESULTS": "results.md", "README": "README.md", "READOUT": "r.png",
    }.items():  # fmt: skip
        monkeypatch.setattr(show, name, tmp_path / file)
    assert show.main([]) == 2
    write_records(tmp_path / "gate.json", gate.values())
    write_records(tmp_path / "full.json", full.values())
    assert read_records(tmp_path / "gate.json")["track/table1-320/rs-pg"].scatter["ate_mm"][0] == pytest.approx(
        0.04, 0.1
    )
    (tmp_path / "README.md").write_text("\n".join((*HEADLINE, BEGIN, END, "")))
    assert show.main(["--check"]) == 1
    assert "results.md" in capsys.readouterr().out
    assert show.main([]) == 0
    drawn = (tmp_path / "r.png").read_bytes()
    assert show.main(["--check"]) == 0
    assert show.main([]) == 0 and (tmp_path / "r.png").read_bytes() == drawn
    assert show.main(["--what"]) == 2


def test_the_readouts_picture(full: dict[str, CellRecord], tmp_path: Path) -> None:
    (chart,) = readout_charts(full)
    assert chart.title.startswith("demo") and [line.name for line in chart.lines] == ["rs-pg", "open3d-icp-keyframe"]
    line = chart.lines[1]
    assert line.low is not None and line.high is not None and line.is_dashed
    assert list(line.x) == [0.0, 14.0, 28.0]
    assert line.low[2] < line.y[2] < line.high[2]
    assert not draw_readout({}, tmp_path / "none.png") and not (tmp_path / "none.png").exists()


def test_numbers_in_names_are_in_their_order(full: dict[str, CellRecord], gate: dict[str, CellRecord]) -> None:
    changes = section(results_markdown(gate, full), "What may be wrong")
    assert changes.index("demo-late_9ms") < changes.index("demo-late_10ms")
    shuffled = dict(sorted(full.items(), reverse=True))
    assert (
        results_markdown(gate, shuffled).partition("Skipped")[2] == results_markdown(gate, full).partition("Skipped")[2]
    )


def test_groups_are_those_of_the_paper() -> None:
    assert PAPERS_GROUPS == ("hand-held", "living room")


def test_where_records_are_from_is_named_one_by_one_while_they_are_few() -> None:
    made = [
        CellRecord(f"a/{k}", "", {}, (0,), ({},), True, version="1.0", commit=f"c{k}", date=f"2026-01-{9 - k:02d}T00")
        for k in range(5)
    ]
    assert "commit c2, c1, c0, 2026-01-07 to 2026-01-09;" in provenance(made[:3])
    many = provenance(made)
    assert "commit c4 to c0 (5 commits: each record names its own), 2026-01-05" in many and "5 cells." in many
