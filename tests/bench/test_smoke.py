"""The smoke tier: every measure runs, its records are written, and a second run finds them."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.__main__ import main
from rstrack.bench.record import read_records


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
