"""Tables and bars of the benchmark, of made-up results."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from bench_evaluation import made_up_record
from matplotlib.figure import Figure

import rsgen.figures
from rsgen.console.tables import csv_text
from rstrack.bench.experiments.method_tables import csv_rows, method_tables, notes, write_results
from rstrack.bench.experiments.methods import Results, SequenceInfo, better_pct, read_results
from rstrack.bench.experiments.pictures import ate_chart
from rstrack.bench.figures import PAPER_FIGURES, PAPER_NAMES, paper_average
from rstrack.bench.record import CellRecord
from rstrack.bench.tables import tables_markdown, tables_text
from rstrack.charts.to_file import write_charts
from rstrack.charts.to_page import figure_of


def cell(sequence: str, method: str, ate_m: float, lost: int = 0, error: str | None = None) -> CellRecord:
    figures = {"ate_mm": 1e3 * ate_m, "drift_mm_s": 2e3 * ate_m, "drift_deg_s": 100 * ate_m}
    return made_up_record(sequence, method, error, frames=100, lost=lost, total_s=5.0, **figures)


def made_up() -> Results:
    """Two groups; 'theirs' has no c; rs-pg is lost on b."""
    infos = (("a", "one"), ("b", "one"), ("c", "one"), ("robot_t1", "two"))
    ate = {"baseline": (0.01, 0.02, 0.03, 1.2669), "rs-pg": (0.001, 0.002, 0.004, 0.0001234), "theirs": (5e-4, 1, 0)}
    cells = [cell(infos[k][0], method, value) for method, values in ate.items() for k, value in enumerate(values)]
    cells[5] = cell("b", "rs-pg", 0.002, lost=51)
    cells[6] = cell("c", "rs-pg", 0.004, lost=3)
    cells[10] = cell("c", "theirs", 0.0, error="c.txt: cannot be read")
    sequences = tuple(SequenceInfo(name, group, Path("/x") / name, 100) for name, group in infos)
    return Results(sequences=sequences, methods=tuple(ate), records=tuple(cells))


def test_averages_by_hand() -> None:
    found = made_up()
    assert found.averaged("one") == ("a", "c")  # rs-pg is lost on b, so b counts for nobody
    baseline, ours = (found.average("one", method).figures for method in ("baseline", "rs-pg"))
    assert baseline == pytest.approx({"ate_mm": 20.0, "drift_mm_s": 40.0, "drift_deg_s": 2.0})
    assert ours["ate_mm"] == pytest.approx(2.5) and better_pct(2.5, 20.0) == pytest.approx(87.5)
    assert found.average("one", "theirs").figures == found.average("two", "theirs").figures == {}
    assert found.average("two", "rs-pg").figures["ate_mm"] == pytest.approx(0.1234)


def test_the_better_setting_is_shown_and_the_other_one_kept() -> None:
    """Group one: fusing helps the baseline on two of three, and loses gs-g's track on c; group two: it harms both."""
    infos = (("a", "one"), ("b", "one"), ("c", "one"), ("robot_t1", "two"))
    ate = {
        "baseline": (0.01, 0.02, 0.03, 0.05), "baseline-fuse": (0.012, 0.001, 0.02, 0.06),
        "gs-g": (0.02, 0.02, 0.02, 0.02), "gs-g-fuse": (0.001, 0.001, 0.001, 0.03),
        "rs-g": (0.001, 0.001, 0.001, 0.001), "rs-g-no-fuse": (0.0005, 0.0005, 0.0005, 0.0005),
    }  # fmt: skip
    cells = [cell(infos[k][0], name, value) for name, values in ate.items() for k, value in enumerate(values)]
    cells[14] = cell("c", "gs-g-fuse", 0.001, lost=80)
    sequences = tuple(SequenceInfo(name, group, Path("/x") / name, 100) for name, group in infos)
    results = Results(sequences=sequences, methods=tuple(ate), records=tuple(cells))
    assert list(results.shown("one").items()) == [
        ("baseline", "baseline-fuse"), ("gs-g", "gs-g"), ("rs-g", "rs-g"), ("rs-g-no-fuse", "rs-g-no-fuse"),
    ]  # fmt: skip
    assert list(results.shown("two").values()) == ["baseline", "gs-g", "rs-g", "rs-g-no-fuse"]
    assert results.average("one", "baseline-fuse").figures["ate_mm"] == pytest.approx(11.0)
    assert results.averaged("one") == ("a", "b", "c") and not results.average("one", "gs-g-fuse").figures
    (row,) = [r for r in csv_rows(results) if (r["group"], r["sequence"], r["method"]) == ("one", "average", "rs-g")]
    assert row["better_ate_mm_pct"] == pytest.approx(100 * (1 - 0.001 / 0.011))
    lines = [line.split() for line in tables_text(method_tables(results), notes(results)).split("\n\n")[3].splitlines()]
    assert lines[2:] == [
        ["baseline", "50.0", "50.0"], ["paper:", "Baseline", "12.9", "12.9"],
        ["gs-g", "20.0", "20.0", "60", "%"], ["paper:", "Spline", "GS", "G", "16.9", "16.9", "-31", "%"],
        ["rs-g", "1.00", "1.00", "98", "%"], ["paper:", "Spline", "RS", "G", "12.9", "12.9", "0", "%"],
        ["rs-g-no-fuse", "0.500", "0.500", "99", "%"],
    ]  # fmt: skip
    said = "\n".join(notes(results))
    assert "the other one: baseline 20.0, gs-g-fuse -" in said and "baseline-fuse 60.0, gs-g-fuse 30.0" in said
    bars = {bar.name: list(bar.values) for bar in ate_chart(results).bars}
    assert bars["baseline"] == pytest.approx([12.0, 1.0, 20.0, 50.0]) and len(bars) == 4


def test_text_by_hand() -> None:
    blocks = tables_text(method_tables(made_up()), notes(made_up())).split("\n\n")
    lines = [line.split() for line in blocks[0].splitlines()]
    assert lines == [
        ["one,", "ATE,", "mm"],
        ["method", "a", "b", "c", "average", "better", "by"],
        ["baseline", "10.0", "20.0", "30.0", "20.0"],
        ["rs-pg", "1.00", "lost", "4.00†", "2.50", "88", "%"],
        ["theirs", "0.500", "1000", "failed", "-", "-"],
    ]
    # Of robot_t1 the paper has figures: .0129 and .0092 m, 29 % less.
    assert [line.split() for line in blocks[3].splitlines()] == [
        ["two,", "ATE,", "mm"],
        ["method", "robot_t1", "average", "better", "by"],
        ["baseline", "1267", "1267"],
        ["paper:", "Baseline", "12.9", "12.9"],
        ["rs-pg", "0.123", "0.123", "100", "%"],
        ["paper:", "Spline", "RS", "P+G", "9.20", "9.20", "29", "%"],
        ["theirs", "-", "-", "-"],
    ]
    assert "0.0123" in blocks[5].splitlines()[4]
    said = "\n".join(notes(made_up()))
    for part in (
        "rs-pg on c 3", "rs-pg on b (poses for 49 of 100)", "(c.txt: cannot be read): track/c/theirs", "not run yet",
        "average of one: only over a, c", "abacus", "1.2.3", "compare the orders",
    ):  # fmt: skip
        assert part in said, part


def test_markdown_and_csv_by_hand() -> None:
    text = tables_markdown(method_tables(made_up()), notes(made_up()))
    table = text.split("\n\n")[1].splitlines()
    assert table[0] == "| method | a | b | c | average | better by |" and set(table[1]) <= set("| -:")
    assert table[3] == "| `rs-pg` | 1.00 | lost | **4.00†** | **2.50** | 88 % |"
    assert table[4] == "| `theirs` | **0.500** | 1000 | failed | - | - |"
    assert "| **0.123** (9.20) |" in text and "**One, ATE, mm**" in text
    rows = list(csv.DictReader(io.StringIO(csv_text(csv_rows(made_up())))))
    assert len(rows) == 11 + 6
    (lost,) = [r for r in rows if (r["sequence"], r["method"]) == ("b", "rs-pg")]
    assert (lost["ate_mm"], lost["lost"]) == ("", "51")
    (average,) = [r for r in rows if (r["group"], r["sequence"], r["method"]) == ("one", "average", "rs-pg")]
    assert float(average["better_drift_mm_s_pct"]) == pytest.approx(87.5)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    text = write_results(made_up(), tmp_path)
    found = read_results(tmp_path / "results.json")
    assert (
        found == made_up()
        and tables_text(method_tables(found), notes(found)) == text == (tmp_path / "results.txt").read_text()[:-1]
    )


def test_the_papers_averages_are_those_of_its_rows() -> None:
    # The two 'average' lines of Tables 2 and 3, rounded there to four digits.
    published = {
        "hand": ((0.0422, 2.0704, 0.1285), (0.0173, 1.5059, 0.0259), (0.0132, 0.8078, 0.0159),
                 (0.0165, 1.4984, 0.0283), (0.0120, 0.8019, 0.0113)),
        "kt": ((0.2301, 17.4030, 0.4165), (0.0249, 0.4127, 0.1218), (0.0102, 0.2958, 0.0495),
               (0.0093, 0.2033, 0.0233), (0.0053, 0.1224, 0.0132)),
    }  # fmt: skip
    names = dict.fromkeys(sequence for sequence, _ in PAPER_FIGURES)
    groups = {"hand": [n for n in names if "kt" not in n], "kt": [n for n in names if "kt" in n]}
    for group, rows in published.items():
        for method, expected in zip(PAPER_NAMES, rows, strict=True):
            mean = paper_average(groups[group], method)
            found = (1e-3 * mean["drift_mm_s"], mean["drift_deg_s"], 1e-3 * mean["ate_mm"])
            assert found == pytest.approx(expected, abs=1.01e-4), (group, method)
    assert paper_average([], "rs-pg") == paper_average(["table1", "mine"], "rs-pg") == {}
    assert paper_average(["table1"], "gs-p") == {}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that would have been written."""
    figures: list[Figure] = []
    monkeypatch.setattr(rsgen.figures, "save", lambda figure, path: figures.append(figure))
    return figures


def test_bars(drawn: list[Figure]) -> None:
    write_charts([ate_chart(made_up())], Path("x.png"))
    (axis,) = drawn[0].axes
    heights = [[bar.get_height() for bar in bars] for bars in axis.containers]
    np.testing.assert_allclose(heights[0], [10, 20, 30, 1266.9])
    np.testing.assert_allclose(heights[1], [1, np.nan, 4, 0.1234])
    assert [label.get_text() for label in axis.get_xticklabels()] == ["a", "b", "c", "robot_t1"]
    lines = [line for collection in axis.collections for line in collection.get_segments()]  # type: ignore[attr-defined]
    marks = [line[:, 1] for line in lines if len(line) and np.isfinite(line).all()]
    np.testing.assert_allclose(marks, [[12.9, 12.9], [9.2, 9.2]])
    data = figure_of(ate_chart(made_up()), 9)["data"]
    assert data[1]["y"] == [1.0, None, 4.0, 0.1234] and data[3]["y"] == [None, None, None, 12.9]
