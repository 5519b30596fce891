"""The measure `size`: what is counted, how a change of it is told, and that it never makes a comparison fail."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from benchmarks.compare import compare
from benchmarks.show import results_markdown
from benchmarks.size import CELL, WHAT, constants, size_record


def test_constants_are_assignments_in_capitals_at_the_top() -> None:
    text = "A = 1\n_B, C2 = 2, 3\nD: int = 4\ne = Fg = 5\nclass H:\n    I = 6\nif A:\n    J = 7\nA.K = L[0] = 8\n"
    assert constants(text) == 4


def test_growth_is_shown_and_never_worse(tmp_path: Path) -> None:
    for name, text in {
        "rsgen/errors.py": "A = 1\n",
        "rsgen/light/a.py": "\n\n",
        "rsgen/light/deep/b.py": "_B = 2\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    old = size_record(tmp_path)
    assert [old.figures[what] for what in WHAT] == [4, 3, 2]
    assert [old.figures[f"{what}_rsgen.light"] for what in WHAT] == [3, 2, 1] and old.figures["lines_rsgen"] == 1
    (tmp_path / "rsgen/light/c.py").write_text("C = 3\n" * 1000)
    new = size_record(tmp_path)
    found = compare({CELL: old}, {CELL: new})
    assert not (found.worse or found.better or found.unknown or found.cells) and found.compared == 0
    assert found.size[1:] == (
        "  all: lines 4 -> 1004, modules 3 -> 4, constants 2 -> 1002",
        "  rsgen.light: lines 3 -> 1003, modules 2 -> 3, constants 1 -> 1001",
    )
    assert all(line in found.text() for line in found.size)
    assert (
        not compare({CELL: old}, {CELL: dataclasses.replace(new, runs=old.runs)}).size
        and not compare({}, {CELL: new}).size
    )
    assert "| `rsgen` | 1004 | 4 | 1002 | itself 1, light 1003 |" in results_markdown({CELL: new}, {})


@pytest.mark.parametrize("what", WHAT)
def test_the_product_has_every_wing(what: str) -> None:
    figures = size_record(Path(__file__).parents[2]).figures
    wings = [name for name in figures if name.startswith(f"{what}_")]
    assert {f"{what}_rsgen.light", f"{what}_rstrack.tracking", f"{what}_benchmarks.measures"} <= {*wings}
    assert figures[what] == sum(figures[name] for name in wings)
