"""docs/results.md and the README's block say what the committed records say, and these are of nearly this version."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.show import FULL, GATE, README, RESULTS, documents
from rstrack.bench.record import CellRecord, read_records, versions_behind
from rstrack.bench.runner import OLDEST

ROOT = Path(__file__).parents[2]
NOTEBOOK = sorted((ROOT / "docs/notebook").glob("*.md"))


def records(path: Path) -> dict[str, CellRecord]:
    if not path.is_file():
        pytest.skip(f"{path.relative_to(ROOT)} is not there yet: './run.sh bench {path.stem} --accept' writes it")
    return read_records(path)


def behind(path: Path) -> list[tuple[str, int]]:
    """Cells of records, and how many minor versions older they are than the code."""
    return [(name, versions_behind(record.version)) for name, record in records(path).items()]


@pytest.mark.parametrize("path", [RESULTS, README], ids=lambda path: path.name)
def test_documents_say_what_the_records_say(path: Path) -> None:
    wanted = documents(records(GATE), records(FULL))[path]
    assert path.is_file() and path.read_text() == wanted, "run 'python -m benchmarks.show'"


def test_the_results_are_short() -> None:
    records(GATE)
    assert len(RESULTS.read_text().splitlines()) <= 260


def test_the_gate_is_of_this_version() -> None:
    assert not [(name, by) for name, by in behind(GATE) if by != 0], "run './run.sh bench gate --accept'"


def test_the_full_tier_is_not_old() -> None:
    late = [(name, by) for name, by in behind(FULL) if not 0 <= by <= OLDEST]
    assert not late, "run './run.sh bench full --accept'"


def test_the_readmes_figures_are_measured_ones() -> None:
    """Those beside its block, which is written from the records, stand in the results or in the notebook."""
    sources = [path.read_text() for path in (RESULTS, *NOTEBOOK)]
    block = README.read_text().partition("<!-- results:begin")[2].partition("<!-- results:end")[0]
    cells = re.findall(r"[\d.]+ · [\d.]+ · [\d.]+", README.read_text().replace(block, ""))
    assert not [c for c in cells if not any(re.search(rf"(?<![\d.]){re.escape(c)}(?![\d.])", text) for text in sources)]
