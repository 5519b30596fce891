"""The smoke tier: every measure runs, its records are written, and a second run finds them."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.__main__ import HERE, main, parts
from rstrack.bench.cells import load_benchmark
from rstrack.bench.record import read_records


@pytest.mark.nightly
def test_every_measure_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("benchmarks.__main__.RESULTS", tmp_path)
    where = ["--out", str(tmp_path / "out"), "--cache", str(tmp_path / "cache"), "--quiet"]
    assert main(["smoke", *where, "--accept"]) == 0
    records = read_records(tmp_path / "smoke.json")
    assert {record.measure for record in records.values()} >= {"track", "faults", "speed", "convergence", "light"}
    assert all(record.complete and record.error is None and record.machine["cores"] for record in records.values())
    assert records["track/box/rs-pg"].figures["ate_mm"] < records["track/box/baseline"].figures["ate_mm"]
    assert str(tmp_path) not in (tmp_path / "smoke.json").read_text()
    capsys.readouterr()
    # All of them are there: nothing runs again, and nothing has changed.
    assert main(["smoke", *where, "--against", str(tmp_path / "smoke.json")]) == 0
    assert "nothing got worse" in capsys.readouterr().out


def test_a_glob_that_names_no_cell(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gate", "--only", "track/nothing"]) == 2
    assert "no cell has such a name" in capsys.readouterr().err


def test_repetitions_of_what_is_timed_are_far_apart() -> None:
    cells = load_benchmark([HERE / "cases.yaml", HERE / "gate.yaml"]).cells
    planned = parts(cells, "local", {})
    timed = [part for part, where in planned if where == "local:1"]
    rest = [part for part, where in planned if where == "local"]
    assert [where for _, where in planned] == ["local:1", "local", "local:1", "local", "local:1"]
    assert [{cell.seeds for cell in part} for part in timed] == [{(0,)}, {(0, 1)}, {(0, 1, 2)}]
    assert all(cell.measure == "speed" for part in timed for cell in part)
    assert [*rest[0], *rest[1]] == [cell for cell in cells if cell.measure != "speed"]
    assert abs(len(rest[0]) - len(rest[1])) <= 2


def test_one_timed_cell_alone_and_none() -> None:
    cells = load_benchmark([HERE / "cases.yaml", HERE / "smoke.yaml"]).cells
    assert [where for _, where in parts(cells, None, {})] == [None, None]
    assert parts([cell for cell in cells if cell.measure != "speed"], "local", {})[0][1] == "local"
