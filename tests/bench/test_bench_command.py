"""The whole evaluation: its cells against `rstrack evaluate`, what is kept and what is run again, and the tables."""

from __future__ import annotations

import csv
import io
import pickle
import shlex
import shutil
import sys
import types
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
import yaml
from bench_evaluation import (
    FRAMES,
    NAMES,
    SPEEDS,
    VARIANTS,
    main,
    make_data,
    plan,
    record_file,
    results,
    run,
    write_tum,
)
from matplotlib.figure import Figure

import rsgen.figures
import rstrack.bench.measures.track
from rsgen.geometry import se3
from rsgen.sequence.format import pose_rows
from rstrack.bench.experiments.method_tables import method_tables, notes
from rstrack.bench.experiments.methods import read_results
from rstrack.bench.experiments.pictures import draw_sequence
from rstrack.bench.record import read_record
from rstrack.bench.tables import tables_text
from rstrack.data.estimate import read_estimate
from rstrack.metrics.run_evaluate import run_evaluate
from rstrack.options import Options


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """data/ with two sequences, bench.yaml, and bench/, which the command made of them."""
    folder = tmp_path_factory.mktemp("evaluation")
    make_data(folder)
    assert main(f"bench {folder}/bench.yaml --data {folder}/data --out {folder}/bench --quiet") == 0
    return folder


@pytest.fixture
def tracked(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """What is tracked from now on, as 'SEQUENCE METHOD', and '+' where depth is fused."""
    calls: list[str] = []
    real = rstrack.bench.measures.track.track

    def watched(dataset: Any, options: Options, *rest: Any, **named: Any) -> Any:
        calls.append(f"{dataset.root.name} {options.method}{'+' if options.fuse else ''}")
        return real(dataset, options, *rest, **named)

    monkeypatch.setattr(rstrack.bench.measures.track, "track", watched)
    yield calls


# ---------------------------------------------------------------------------------------------------------------------
# the command


def test_figures_are_those_of_evaluate(original: Path) -> None:
    found = read_results(original / "bench/results.json")
    assert [(r.case, r.method) for r in found.records] == [(name, method) for name in NAMES for method in VARIANTS]
    for record in found.records:
        folder, figures = original / "bench/cells" / record.cell, record.figures
        metrics = run_evaluate(original / "data" / record.case, folder).metrics
        assert figures["ate_mm"] == pytest.approx(1e3 * metrics.ate_rmse_m, rel=1e-4)
        assert metrics.rpe_trans_rmse_m_per_s is not None
        assert figures["drift_mm_s"] == pytest.approx(1e3 * metrics.rpe_trans_rmse_m_per_s, rel=1e-4)
        assert figures["drift_deg_s"] == pytest.approx(metrics.rpe_rot_rmse_deg_per_s, rel=1e-4)
        assert (figures["frames"], figures["lost"], record.error) == (FRAMES, 0, None) and figures["total_s"] > 0.0
        kept = read_record(folder / "record.json")
        assert (
            kept is not None
            and kept.figures["ate_mm"] == pytest.approx(figures["ate_mm"], rel=1e-5)
            and len(kept.key) == 64
        )
        info = read_estimate(folder).info
        assert info["method"] == record.method[:4] and len(info["frames"]) == FRAMES
        assert info["options"]["fuse"] == (record.method in ("gs-g-fuse", "rs-g"))
        assert record.machine["cores"] >= 1 and record.version
    by = {(r.case, r.method): r.figures["ate_mm"] for r in found.records}
    assert by["robot_t1", "rs-g"] < by["robot_t1", "gs-g"]
    first = found.sequences[0]
    path = (original / "data/robot_t1").resolve()
    assert (first.name, first.group, first.path, first.frames) == ("robot_t1", "hand-held", path, FRAMES)
    assert found.methods == VARIANTS


def test_what_is_written(original: Path) -> None:
    text = (original / "bench/results.txt").read_text()
    found = read_results(original / "bench/results.json")
    ate = {(r.case, r.method): r.figures["ate_mm"] for r in found.records}
    (line,) = [line for line in text.split("\n\n")[0].splitlines() if line.startswith("rs-g ")]
    shown = line.split()
    assert float(shown[1]) == pytest.approx(ate["robot_t1", "rs-g"], rel=6e-3) and shown[1] == shown[2]
    assert "hand-held, ATE, mm" in text and "living room, drift, deg/s" in text
    rows = list(csv.DictReader(io.StringIO((original / "bench/results.csv").read_text())))
    assert len(rows) == 8 + 8 and float(rows[2]["ate_mm"]) == ate["robot_t1", "rs-g"]
    assert rows[2]["better_ate_mm_pct"] == "" and float(rows[2]["paper_ate_mm"]) == pytest.approx(12.9)  # no baseline
    assert [row["paper_ate_mm"] for row in rows[:4]] == ["16.9", "16.9", "12.9", ""]  # the paper fuses
    assert [row["fuse"] for row in rows[:4]] == ["False", "True", "True", "False"]
    assert "| `rs-g` | **" in (original / "bench/results.md").read_text()
    for name in ("ate", *NAMES):
        picture = cv2.imread(str(original / f"bench/plots/{name}.png"))
        assert picture is not None and picture.std() > 10.0


def test_finished_cells_are_kept(place: Path, tracked: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    before = read_results(place / "bench/results.json")
    assert main("bench bench.yaml --data data --out bench --quiet") == 0
    # The folder has moved, nothing else.
    now = read_results(place / "bench/results.json")
    assert tracked == [] and [r.key for r in now.records] == [r.key for r in before.records]
    record_file("lr_kt2", "rs-g").unlink()
    record_file("robot_t1", "gs-g").write_text("{")
    assert main("bench bench.yaml --data data --out bench --quiet --sequence lr_kt2") == 0
    assert tracked == ["lr_kt2 rs-g+"]
    rgb = place / "data/lr_kt2/rgb.txt"
    rgb.write_text("# another\n" + rgb.read_text())
    tracked.clear()
    run(plan())
    assert tracked == ["robot_t1 gs-g", "lr_kt2 gs-g", "lr_kt2 gs-g+", "lr_kt2 rs-g+", "lr_kt2 rs-g"]


def test_another_clock_of_the_truth(place: Path) -> None:
    # Poses of the colour camera, as TUM has them, on a clock that is 12 ms ahead of the images'.
    t = np.arange(-19, 121) / 100.0
    T_world_color = synthetic.make_spline(SPEEDS[0]).pose(t) @ se3.inverse(synthetic.T_COLOR_DEPTH)
    rows = np.column_stack([t + 0.012, pose_rows(T_world_color)])
    root = place / "data/robot_t1"
    (root / "groundtruth.txt").write_text("".join(" ".join(f"{v:.9f}" for v in row) + "\n" for row in rows))
    camera = {"width": 112, "height": 84, "intrinsics": [84.0, 84.0, 55.5, 41.5], "readout_s": 0.028}
    cameras = {"color": camera, "depth": camera, "T_color_depth": synthetic.T_COLOR_DEPTH.tolist()}
    cameras |= {"sigma": {"depth_image": 0.0}}
    (root / "camera.yaml").write_text(yaml.safe_dump(cameras))
    (root / "sequence.yaml").unlink()
    how: dict[str, Any] = {"sequences": ["robot_t1"], "methods": ["rs-g"], "options": Options(fuse=True)}
    (before,) = run(plan(**how)).records.values()
    assert before.truth_offset_s is None
    found = results(plan(**how, truth_offset=0.012))
    (after,) = found.records
    asked = run_evaluate(root, place / "bench/cells" / after.cell, truth_offset=0.012)
    assert after.truth_offset_s == 0.012
    assert after.figures["ate_mm"] == pytest.approx(1e3 * asked.chosen.ate_rmse_m, rel=1e-6)
    assert after.figures["ate_mm"] < 0.3 * before.figures["ate_mm"]
    assert "0.012 s after the stamps" in tables_text(method_tables(found), notes(found))
    # A second of poses has too few pairs one second apart to find it: clocks as they are, and that is said.
    sought = results(plan(**how, truth_offset="auto"))
    assert sought.records[0].figures["ate_mm"] == pytest.approx(before.figures["ate_mm"], rel=1e-6)
    assert sought.records[0].truth_offset_s is None
    assert "no offset of the truth's clock was found" in tables_text(method_tables(sought), notes(sought))


def test_an_interrupt_keeps_what_is_finished(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree("bench/cells/track/lr_kt2")

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(rstrack.bench.measures.track, "track", interrupted)
    assert main("bench bench.yaml --data data --out bench --quiet") == 130
    out, error = capfd.readouterr()
    assert "the same command" in error and "not run yet (-)" in out
    assert [r.case for r in read_results(place / "bench/results.json").records] == 4 * ["robot_t1"]


def test_cells_can_run_elsewhere(place: Path) -> None:
    shutil.rmtree("bench")

    class Elsewhere:
        def apply(self, function: Any, jobs: Sequence[Any], progress: Any) -> Iterator[tuple[int, Any]]:
            sent, received = pickle.loads(pickle.dumps((function, list(jobs))))
            for k in reversed(range(len(jobs))):
                yield k, pickle.loads(pickle.dumps(sent(received[k], progress)))

    write_tum(place / "mine/lr_kt2.txt", "lr_kt2")
    how = {"added": {"mine": Path("mine")}, "options": Options(fuse=False)}
    made = plan(sequences=["lr_kt2"], methods=["gs-g"], frames=slice(0, 14), **how)
    seen: list[tuple[float, str]] = []
    found = run(made, Elsewhere(), lambda _, fraction, note: seen.append((fraction, note)))
    assert [r.method for r in found.records.values()] == ["gs-g", "mine"]
    assert seen[0] == (0.5, "track/lr_kt2/mine done") and seen[-1] == (1.0, "track/lr_kt2/gs-g done")
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions) and len(seen) >= 2 + 14 and "track/lr_kt2/gs-g " in seen[7][1]
    assert all((r.figures["frames"], r.figures["lost"]) == (14, 0) for r in found.records.values())


def test_the_scheduler(place: Path) -> None:
    shutil.rmtree("bench")
    words = "--sequence lr_kt2 --method gs-g --no-fuse --frames 0:12 --no-meshes --scheduler local:1"
    assert main(f"bench bench.yaml --data data --out bench --quiet {words}") == 0
    assert read_record(record_file("lr_kt2", "gs-g")) is not None


def test_speed_in_place_of_errors(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def measured(task: Any, progress: Any) -> dict[str, float]:
        return {"median_ms": 10.0 + len(task.cell.method), "p95_ms": 20.0, "read_ms": 2.5}

    fake = types.ModuleType("speed")
    fake.speed_cell = measured  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "rstrack.bench.measures.speed", fake)
    assert main("bench bench.yaml --data data --out speed --quiet --speed --method rs-g gs-pg --sequence lr_kt2") == 0
    lines = capfd.readouterr().out.splitlines()
    assert [line.split() for line in lines[:4]] == [
        ["ms", "a", "frame"],
        ["case", "median,", "ms", "95", "%,", "ms", "read,", "ms"],
        ["lr_kt2", "rs-g", "14", "20", "2.50"],
        ["lr_kt2", "gs-pg", "15", "20", "2.50"],
    ]
    assert (place / "speed/speed.json").is_file() and not (place / "speed/results.json").exists()


# ---------------------------------------------------------------------------------------------------------------------
# other trackers; what goes wrong


def test_a_tracker_of_ones_own(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_tum(place / "mine/robot_t1.txt", "robot_t1")
    words = "bench bench.yaml --data data --out bench --quiet --add mine=mine"
    assert main(words) == 1  # no file for lr_kt2
    out, error = capfd.readouterr()
    assert error == "" and "Failed (" in out and "track/lr_kt2/mine." in out and "lr_kt2.txt" in out
    mine = [r for r in read_results(place / "bench/results.json").records if r.method == "mine"]
    metrics = run_evaluate(place / "data/robot_t1", place / "mine/robot_t1.txt").metrics
    assert mine[0].figures["ate_mm"] == pytest.approx(1e3 * metrics.ate_rmse_m, rel=1e-9) and mine[1].figures == {}
    write_tum(place / "mine/lr_kt2.txt", "lr_kt2")
    assert main(words) == 0
    before = read_record(record_file("robot_t1", "mine"))
    write_tum(place / "mine/robot_t1.txt", "robot_t1", error_m=0.002)
    assert main(words) == 0
    after = read_record(record_file("robot_t1", "mine"))
    assert before is not None and after is not None and before.key != after.key
    assert after.figures["ate_mm"] > 1.5 * before.figures["ate_mm"]


def test_a_command_of_ones_own(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """It reads the sequence's folder, here its truth, and writes poses; where it fails its last words are told."""
    script = place / "my tracker.py"
    script.write_text(
        "import pathlib, sys\nfolder, out = map(pathlib.Path, sys.argv[1:])\nprint('looking at', folder)\n"
        "if folder.name == 'lr_kt2':\n    sys.exit('no such room {sequence}')\n"
        "out.write_text((folder / 'groundtruth.txt').read_text())\n"
    )
    command = f"{shlex.quote(sys.executable)} {shlex.quote(str(script))} {{sequence}} {{out}}"
    words = "bench bench.yaml --data data --out bench --quiet --method rs-g --fuse"
    assert main(f"{words} --peer-command {shlex.quote(f'mine={command}')}") == 1
    out = capfd.readouterr().out
    assert "Failed (mine: ended with status 1: no such room {sequence} (all of it is in" in out
    mine = [r for r in read_results(place / "bench/results.json").records if r.method == "mine"]
    assert mine[0].figures["ate_mm"] < 1e-3 and mine[0].figures["total_s"] > 0.0 and mine[1].figures == {}
    assert "looking at" in (record_file("robot_t1", "mine").parent / "command.log").read_text()


@pytest.mark.parametrize(("kept", "word", "lost"), [(range(29), "†", 2), (range(15), "lost", 16)])
def test_lost_frames_are_marked_and_lost_tracks_do_not_count(
    place: Path, kept: Sequence[int], word: str, lost: int
) -> None:
    for name in NAMES:
        write_tum(place / f"mine/{name}.txt", name)
    write_tum(place / "mine/robot_t1.txt", "robot_t1", kept)
    made = plan(added={"mine": Path("mine")})
    found = results(made)
    record = found.record("robot_t1", "mine")
    assert record is not None and record.figures["lost"] == lost and record.error is None
    (line,) = [
        line
        for line in tables_text(method_tables(found), notes(found)).split("\n\n")[0].splitlines()
        if line.startswith("mine")
    ]
    assert word in line.split()[1]
    assert found.averaged("hand-held") == ("robot_t1",) and found.average("hand-held", "rs-g").figures
    assert ("ate_mm" not in found.average("hand-held", "mine").figures) == (word == "lost")


def test_paths_and_errors(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(rsgen.figures, "save", lambda figure, path: drawn.append(figure))
    write_tum(place / "mine/robot_t1.txt", "robot_t1", range(4, 25))
    made = plan(sequences=["robot_t1"], added={"mine": Path("mine")})
    found = results(made)
    assert draw_sequence(found, made.sequences[0], Path("bench"), Path("x.png"), pytest.fail)
    path, errors = drawn[0].axes
    shown = list(found.shown("hand-held").values())
    assert shown[1:] == ["rs-g", "rs-g-no-fuse", "mine"]
    assert [line.get_label() for line in errors.lines] == shown and len(path.lines) == 5
    for line, done in zip(errors.lines, [found.record("robot_t1", name) for name in shown], strict=True):
        values = np.asarray(line.get_ydata(), float)
        assert done is not None
        assert np.sqrt(np.mean(values**2)) == pytest.approx(done.figures["ate_mm"], rel=1e-4)
    true = synthetic.make_spline(SPEEDS[0]).pose(np.array([0.0, 1.0]))[:, [0, 2], 3]
    np.testing.assert_allclose(np.asarray(path.lines[0].get_xydata())[[0, -1]], true, atol=1e-6)
    np.testing.assert_allclose(np.asarray(path.lines[2].get_xydata())[[0, -1]], true, atol=0.01)
