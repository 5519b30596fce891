"""The runner: what is run, what is kept, what is run again; errors, skipped cells, interrupts, workers."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import synthetic
import yaml

from rsgen.errors import UserError
from rstrack.bench import record as record_module
from rstrack.bench import runner
from rstrack.bench.cells import Benchmark, CaseEntry, Cell, MethodEntry, NoiseEntry, SequenceEntry
from rstrack.bench.record import CellRecord, read_record, read_records, versions_behind, write_records
from rstrack.bench.runner import Outcome, run_cells
from rstrack.bench.task import Absent, Sources, Task

CALLS: list[str] = []
FAILURES: dict[str, BaseException] = {}


def counted(task: Task, progress: Any) -> dict[str, float | None]:
    """A measure: notes the cell and its seed, fails where it is told to."""
    CALLS.append(f"{task.cell.method} {task.seed}")
    progress("counting", 0.5, "half of it")
    if CALLS[-1] in FAILURES:
        raise FAILURES[CALLS[-1]]
    return {"ate_mm": 1.0 + task.seed, "frames": len(task.frames), "nees": None}


MEASURES = {"counted": f"{__name__}:counted"}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    CALLS.clear()
    FAILURES.clear()
    synthetic.make_sequence(tmp_path / "data/a", synthetic.make_config(), 4)
    return tmp_path / "data"


def cell(method: str = "rs-g", seeds: int = 1, measure: str = "counted", **changes: Any) -> Cell:
    case = CaseEntry(**({"sequence": "a"} | changes.pop("case", {})))
    sequence = SequenceEntry(**({"path": Path("a")} | changes.pop("sequence", {})))
    how = MethodEntry(**changes.pop("how", {}))
    return Cell(measure, "a", method, tuple(range(seeds)), case, sequence, how, changes)


def run(data: Path, *cells: Cell, every: str = "version", **how: Any) -> Outcome:
    return run_cells(Benchmark(cells, every), data.parent / "out", Sources(data), measures=MEASURES, **how)


def record(outcome: Outcome) -> CellRecord:
    (found,) = outcome.records.values()
    return found


def test_a_record_holds_what_was_measured_on_what(data: Path) -> None:
    found = record(run(data, cell(case={"frames": "1:3"}, seeds=2)))
    assert found.complete and found.error is None and found.seeds == (0, 1)
    assert found.figures["ate_mm"] == 1.5 and found.values("ate_mm") == [1.0, 2.0] and found.total("frames") == 4
    assert "nees" not in found.figures and found.figures["peak_mb"] > 10.0
    assert (found.measure, found.case, found.method) == ("counted", "a", "rs-g")
    assert found.settings["case"] == {"sequence": "a", "frames": "1:3"} and found.machine["cores"] >= 1
    file = data.parent / "out/cells/counted/a/rs-g/record.json"
    assert read_record(file) == dataclasses.replace(
        found, runs=tuple({k: v if k != "peak_mb" else float(f"{v:.6g}") for k, v in run.items()} for run in found.runs)
    )
    write_records(data.parent / "all.json", [found])
    assert list(read_records(data.parent / "all.json")) == ["counted/a/rs-g"]


def test_finished_cells_are_kept_and_others_are_run(data: Path) -> None:
    run(data, cell(), cell("gs-g"))
    assert CALLS == ["rs-g 0", "gs-g 0"]
    told: list[str] = []
    outcome = run(data, cell(), cell("gs-g"), cell("kiss-icp"), done=lambda record: told.append(record.method))
    assert CALLS[2:] == ["kiss-icp 0"] == [f"{name} 0" for name in told] and len(outcome.records) == 3
    (data.parent / "out/cells/counted/a/gs-g/record.json").write_text("{")
    run(data, cell(), cell("gs-g"))
    assert CALLS[3:] == ["gs-g 0"]


@pytest.mark.parametrize(
    "change",
    [
        {"how": {"method": "rs-g", "options": {"knot_spacing_s": 0.05}}}, {"how": {"method": "gs-g"}},
        {"how": {"command": "mine {sequence} {out}"}}, {"case": {"frames": "0:3"}},
        {"case": {"noise": NoiseEntry(depth=0.001)}}, {"case": {"changes": ({"darkened": {}},)}},
        {"case": {"truth_offset": 0.01}}, {"pairs": 3},
    ],
)  # fmt: skip
def test_a_cell_is_run_again_when_its_definition_changes(data: Path, change: dict[str, Any]) -> None:
    first, second = record(run(data, cell())), record(run(data, cell(**change)))
    assert len(CALLS) == 2 and first.key != second.key


def test_a_cell_is_run_again_when_its_files_change(data: Path, tmp_path: Path) -> None:
    camera, results = tmp_path / "c.yaml", tmp_path / "mine"
    results.mkdir()
    told = {"width": 64, "height": 48, "intrinsics": [48.0, 48.0, 31.5, 23.5], "readout_s": 0.02}
    camera.write_text(yaml.safe_dump({"color": told, "depth": told}))
    (results / "a.txt").write_text("0 0 0 0 0 0 0 1\n")
    made = cell(case={"camera": camera}, how={"results": results})
    for path in (camera, results / "a.txt", data / "a/rgb.txt"):
        run(data, made)
        before = len(CALLS)
        run(data, made)
        assert len(CALLS) == before
        path.write_text(path.read_text() + "# more\n")
    run(data, made)
    assert len(CALLS) == 4


def test_a_cell_is_run_again_with_other_code(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(data, cell())
    monkeypatch.setattr("rstrack.bench.runner.package_version", lambda: "99.0")
    run(data, cell())
    assert len(CALLS) == 2


@pytest.mark.parametrize(("behind", "is_run_again"), [(0, False), (2, False), (3, True), (-1, True)])
def test_what_takes_hours_stands_for_three_minor_versions(
    data: Path, monkeypatch: pytest.MonkeyPatch, behind: int, is_run_again: bool
) -> None:
    run(data, cell(), every="third version")
    monkeypatch.setattr(runner, "versions_behind", lambda _: behind)
    run(data, cell(), every="third version")
    assert len(CALLS) == 1 + is_run_again


def test_versions_are_counted_by_their_second_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record_module, "package_version", lambda: "0.27.1")
    assert [versions_behind(v) for v in ("0.27.0", "0.25.3", "0.28.0")] == [0, 2, -1]
    assert versions_behind("1.27.0") > 2


def test_seeds_that_are_missing_are_run(data: Path) -> None:
    FAILURES["rs-g 1"] = KeyboardInterrupt()
    outcome = run(data, cell(seeds=3))
    assert outcome.interrupted and outcome.records == {} and CALLS == ["rs-g 0", "rs-g 1"]
    FAILURES.clear()
    assert record(run(data, cell(seeds=3))).seeds == (0, 1, 2) and CALLS[2:] == ["rs-g 1", "rs-g 2"]
    # More of them are added, fewer are looked up.
    assert record(run(data, cell(seeds=5))).seeds == (0, 1, 2, 3, 4) and CALLS[4:] == ["rs-g 3", "rs-g 4"]
    few = record(run(data, cell(seeds=2)))
    assert few.seeds == (0, 1) and few.figures["ate_mm"] == 1.5 and len(CALLS) == 6
    assert record(run(data, cell(seeds=5))).seeds == (0, 1, 2, 3, 4) and len(CALLS) == 6


def test_an_error_is_the_records_and_is_tried_again(data: Path) -> None:
    FAILURES["rs-g 1"] = UserError("frame 3: cannot be read")
    outcome = run(data, cell(seeds=2), cell("gs-g"))
    failed = outcome.records["counted/a/rs-g"]
    assert (failed.error, failed.skipped, failed.complete) == ("frame 3: cannot be read", False, False)
    assert outcome.records["counted/a/gs-g"].complete and not outcome.interrupted
    FAILURES.clear()
    again = run(data, cell(seeds=2), cell("gs-g"))
    assert all(r.complete and r.error is None for r in again.records.values())
    assert CALLS == ["rs-g 0", "rs-g 1", "gs-g 0", "rs-g 1"]


def test_what_is_not_at_hand_is_skipped(data: Path) -> None:
    FAILURES["kiss-icp 0"] = Absent("kiss_icp is not installed")
    outcome = run(data, cell("kiss-icp"), cell(sequence={"path": Path("b")}))
    peer, far = outcome.records.values()
    assert peer.skipped and peer.error == "kiss_icp is not installed"
    assert far.skipped and far.error is not None and "b: is not there" in far.error
    assert not list((data.parent / "out").rglob("record.json"))


def test_measures_that_there_are_not_are_said_in_one_line(data: Path) -> None:
    with pytest.raises(UserError, match=r"^no measure 'nope': choose track, [^\n]*counted$"):
        run(data, cell(measure="nope"))


def test_sequences_are_rendered_before_workers_begin(data: Path, tmp_path: Path) -> None:
    """Once each: two workers would render the same one into one folder."""
    rendered: list[str] = []

    def render(words: Sequence[str]) -> None:
        out = words[words.index("--out") + 1]
        rendered.append(out)
        synthetic.make_sequence(Path(out), synthetic.make_config(), 4)

    class Elsewhere:
        def apply(self, function: Any, jobs: Sequence[Any], progress: Any) -> Iterator[tuple[int, Any]]:
            assert len(rendered) == 1
            for k, job in enumerate(jobs):
                yield k, function(job, progress)

    config = tmp_path / "tiny.yaml"
    config.write_text("name: tiny\n")
    made = [cell(method, sequence={"path": None, "config": config, "frames": "0:4"}) for method in ("rs-g", "gs-g")]
    sources = Sources(cache=tmp_path / "cache", render=render)
    outcome = run_cells(Benchmark(tuple(made)), tmp_path / "out", sources, Elsewhere(), measures=MEASURES)
    assert len(rendered) == 1 and all(r.error is None for r in outcome.records.values())
    # The key is that of the rendered sequence: nothing is run again.
    run_cells(Benchmark(tuple(made)), tmp_path / "out", sources, measures=MEASURES)
    assert CALLS == ["rs-g 0", "gs-g 0"]


def test_workers_have_to_share_the_folder(data: Path) -> None:
    class Far:
        def apply(self, function: Any, jobs: Sequence[Any], progress: Any) -> Iterator[tuple[int, Any]]:
            yield 0, CellRecord(jobs[0].cell.name, "", {}, (0,), ({},), True)

    with pytest.raises(UserError, match=r"rs-g: a worker has written it, but not here"):
        run(data, cell(), workers=Far())


def test_progress_counts_what_is_left_by_the_time_it_took_before(data: Path) -> None:
    seen: list[float] = []
    slow = {"counted/a/rs-g": 90.0, "counted/a/gs-g": 10.0}
    run(data, cell(), cell("gs-g"), expected_s=slow, progress=lambda stage, fraction, note: seen.append(fraction))
    assert seen == pytest.approx([0.45, 0.9, 0.95, 1.0])


def test_files_that_are_no_records_are_refused_in_one_line(tmp_path: Path) -> None:
    for text in ("{", "[3]", json.dumps([{"cell": "a/b/c"}])):
        (tmp_path / "r.json").write_text(text)
        with pytest.raises(UserError, match=r"r\.json: is no file of benchmark records[^\n]*$"):
            read_records(tmp_path / "r.json")
        assert read_record(tmp_path / "r.json") is None


def test_a_cell_that_breaks_down_does_not_end_the_others(data: Path) -> None:
    FAILURES["rs-g 0"] = ZeroDivisionError("a defect")
    found = run(data, cell(), cell("gs-g"))
    assert found.records["counted/a/rs-g"].error == "broke down: ZeroDivisionError: a defect"
    assert found.records["counted/a/gs-g"].complete
