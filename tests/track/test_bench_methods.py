"""The whole evaluation: its cells against `rstrack evaluate`, what is kept and what is run again, and the tables."""

from __future__ import annotations

import csv
import io
import json
import pickle
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
import yaml
from bench_evaluation import FRAMES, NAMES, SPEEDS, VARIANTS, main, make_data, plan, write_tum
from matplotlib.figure import Figure

import rsgen.figures
import rstrack.bench.methods.grid
import rstrack.peers.clouds
import rstrack.peers.open3d
import rstrack.peers.orb_slam3
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.sequence.format import pose_rows
from rstrack.bench.methods.grid import read_cell, run_plan
from rstrack.bench.methods.plots import draw_sequence
from rstrack.bench.methods.results import Cell, averages
from rstrack.bench.methods.tables import results_text
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
    real = rstrack.bench.methods.grid.track

    def watched(dataset: Any, options: Options, *rest: Any, **named: Any) -> Any:
        calls.append(f"{dataset.root.name} {options.method}{'+' if options.fuse else ''}")
        return real(dataset, options, *rest, **named)

    monkeypatch.setattr(rstrack.bench.methods.grid, "track", watched)
    yield calls


# ---------------------------------------------------------------------------------------------------------------------
# the command


def test_figures_are_those_of_evaluate(original: Path) -> None:
    data = json.loads((original / "bench/results.json").read_text())
    assert [(c["sequence"], c["method"]) for c in data["cells"]] == [
        (name, method) for name in NAMES for method in VARIANTS
    ]
    for cell in data["cells"]:
        metrics = run_evaluate(original / "data" / cell["sequence"], original / "bench" / cell["run"]).metrics
        assert cell["ate_m"] == pytest.approx(metrics.ate_rmse_m, rel=1e-4)
        assert cell["rpe_m_s"] == pytest.approx(metrics.rpe_trans_rmse_m_per_s, rel=1e-4)
        assert cell["rpe_deg_s"] == pytest.approx(metrics.rpe_rot_rmse_deg_per_s, rel=1e-4)
        assert (cell["frames"], cell["lost"], cell["error"]) == (FRAMES, 0, None) and cell["seconds"] > 0.0
        kept = json.loads((original / "bench" / cell["run"] / "cell.json").read_text())
        assert kept["metrics"]["ate_rmse_m"] == cell["ate_m"] and len(kept["key"]) == 64
        info = read_estimate(original / "bench" / cell["run"]).info
        assert info["method"] == cell["method"].partition(" ")[0] and len(info["frames"]) == FRAMES
        assert info["options"]["fuse"] == cell["fuse"] == (cell["method"] in ("gs-g --fuse", "rs-g"))
    by = {(c["sequence"], c["method"]): c["ate_m"] for c in data["cells"]}
    assert by["robot_t1", "rs-g"] < by["robot_t1", "gs-g"]
    (entry, _) = data["sequences"]
    assert entry == {
        "name": "robot_t1", "group": "hand-held", "path": str((original / "data/robot_t1").resolve()), "frames": FRAMES,
    }  # fmt: skip
    assert data["methods"] == list(VARIANTS) and data["machine"]["cpu_count"] >= 1 and data["version"]
    assert {"sequence": "lr_kt2", "method": "rs-g", "ate_m": 0.0109, "rpe_m_s": 0.0044, "rpe_deg_s": 0.0723} in data[
        "paper"
    ]
    assert len(data["paper"]) == 4


def test_what_is_written(original: Path) -> None:
    text = (original / "bench/results.txt").read_text()
    data = json.loads((original / "bench/results.json").read_text())
    ate = {(c["sequence"], c["method"]): c["ate_m"] for c in data["cells"]}
    (line,) = [line for line in text.split("\n\n")[0].splitlines() if line.startswith("rs-g ") and "--" not in line]
    shown = line.split()
    assert float(shown[1]) == pytest.approx(1e3 * ate["robot_t1", "rs-g"], rel=6e-3) and shown[1] == shown[2]
    assert "hand-held, ATE, mm" in text and "living room, drift, deg/s" in text
    rows = list(csv.DictReader(io.StringIO((original / "bench/results.csv").read_text())))
    assert len(rows) == 8 + 8 and float(rows[2]["ate_m"]) == ate["robot_t1", "rs-g"]
    assert rows[2]["better_ate_m_pct"] == "" and rows[2]["paper_ate_m"] == "0.0129"  # no baseline
    assert [row["paper_ate_m"] for row in rows[:4]] == ["0.0169", "0.0169", "0.0129", ""]  # the paper fuses
    assert [row["fuse"] for row in rows[:4]] == ["False", "True", "True", "False"]
    assert "| `rs-g` | **" in (original / "bench/results.md").read_text()
    for name in ("ate", *NAMES):
        picture = cv2.imread(str(original / f"bench/plots/{name}.png"))
        assert picture is not None and picture.std() > 10.0


def test_finished_cells_are_kept(place: Path, tracked: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    before = (place / "bench/results.json").read_bytes()
    assert main("bench bench.yaml --data data --out bench --quiet") == 0
    # The folder has moved, nothing else.
    now = (place / "bench/results.json").read_text()
    assert tracked == []
    assert [c["ate_m"] for c in json.loads(now)["cells"]] == [c["ate_m"] for c in json.loads(before)["cells"]]
    (place / "bench/cells/lr_kt2/rs-g/cell.json").unlink()
    (place / "bench/cells/robot_t1/rs-g/trajectory.txt").unlink()
    (place / "bench/cells/robot_t1/gs-g/cell.json").write_text("{")
    assert main("bench bench.yaml --data data --out bench --quiet --sequence lr_kt2") == 0
    assert tracked == ["lr_kt2 rs-g+"]
    plan_now = plan()
    assert [read_cell(job) is None for job in plan_now.jobs] == [True, False, True, False] + 4 * [False]


def test_another_clock_of_the_truth_is_only_evaluated(place: Path, tracked: list[str]) -> None:
    # Poses of the colour camera, as TUM has them, on a clock that is 12 ms ahead of the images'.
    t = np.arange(-19, 121) / 100.0
    T_world_color = synthetic.make_spline(SPEEDS[0]).pose(t) @ se3.inverse(synthetic.T_COLOR_DEPTH)
    rows = np.column_stack([t + 0.012, pose_rows(T_world_color)])
    root = place / "data/robot_t1"
    (root / "groundtruth.txt").write_text("".join(" ".join(f"{v:.9f}" for v in row) + "\n" for row in rows))
    camera = {"width": 112, "height": 84, "intrinsics": [84.0, 84.0, 55.5, 41.5], "readout_s": 0.028}
    cameras = {"color": camera, "depth": camera, "T_color_depth": synthetic.T_COLOR_DEPTH.tolist()}
    (root / "camera.yaml").write_text(yaml.safe_dump(cameras))
    (root / "sequence.yaml").unlink()
    how: dict[str, Any] = {"sequences": ["robot_t1"], "methods": ["rs-g"], "options": Options(fuse=True)}
    (before,) = run_plan(plan(**how)).cells
    assert tracked == ["robot_t1 rs-g+"] and before.truth_offset_s is None
    moved = plan(**how, truth_offset=0.012)
    assert read_cell(moved.jobs[0]) is None
    results = run_plan(moved)
    (after,) = results.cells
    assert tracked == ["robot_t1 rs-g+"] and after == read_cell(moved.jobs[0]) and after.seconds == before.seconds
    asked = run_evaluate(root, before_run := place / "bench" / before.folder, truth_offset=0.012)
    assert after.truth_offset_s == 0.012 and after.metrics is not None
    assert after.metrics["ate_rmse_m"] == pytest.approx(asked.chosen.ate_rmse_m, rel=1e-6)
    assert before.metrics is not None and after.metrics["ate_rmse_m"] < 0.3 * before.metrics["ate_rmse_m"]
    assert "0.012 s after the stamps" in results_text(results) and before_run.is_dir()
    # A second of poses has too few pairs one second apart to find it: clocks as they are, and that is said.
    sought = run_plan(plan(**how, truth_offset="auto"))
    assert sought.cells[0].figure("ate_rmse_m") == pytest.approx(before.figure("ate_rmse_m"), rel=1e-6)
    assert sought.cells[0].truth_offset_s is None
    assert "no offset of the truth's clock was found" in results_text(sought)


def test_an_interrupt_keeps_what_is_finished(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree("bench/cells/lr_kt2")

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(rstrack.bench.methods.grid, "track", interrupted)
    assert main("bench bench.yaml --data data --out bench --quiet") == 130
    out, error = capfd.readouterr()
    assert "the same command" in error and "not run yet (-)" in out
    data = json.loads((place / "bench/results.json").read_text())
    assert [c["sequence"] for c in data["cells"]] == 4 * ["robot_t1"]


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
    results = run_plan(made, Elsewhere(), lambda _, fraction, note: seen.append((fraction, note)))
    assert [c.method for c in results.cells] == ["gs-g", "mine"]
    assert seen[0] == (0.5, "lr_kt2 mine done") and seen[-1] == (1.0, "lr_kt2 gs-g done")
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions) and len(seen) == 2 + 14 and "lr_kt2 gs-g, " in seen[7][1]
    assert all(cell == read_cell(job) for cell, job in zip(results.cells, made.jobs, strict=True))
    assert all(cell.frames == 14 and cell.lost == 0 for cell in results.cells)


def test_workers_have_to_share_the_folder(place: Path) -> None:
    class Far:
        def apply(self, function: Any, jobs: Sequence[Any], progress: Any) -> Iterator[tuple[int, Any]]:
            yield 0, Cell(jobs[0].key, jobs[0].sequence, jobs[0].method, {}, 31, 0, 1.0)

    with pytest.raises(UserError, match=r"gs-g: a worker has written it, but not here"):
        run_plan(plan(options=Options(max_depth=5.0)), Far())


# ---------------------------------------------------------------------------------------------------------------------
# other trackers; what goes wrong


def test_a_tracker_of_ones_own(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_tum(place / "mine/robot_t1.txt", "robot_t1")
    words = "bench bench.yaml --data data --out bench --quiet --add mine=mine"
    assert main(words) == 1  # no file for lr_kt2
    out, error = capfd.readouterr()
    assert error == "" and "failed: mine on lr_kt2" in out and "lr_kt2.txt" in out
    data = json.loads((place / "bench/results.json").read_text())
    mine = [c for c in data["cells"] if c["method"] == "mine"]
    metrics = run_evaluate(place / "data/robot_t1", place / "mine/robot_t1.txt").metrics
    assert mine[0]["ate_m"] == pytest.approx(metrics.ate_rmse_m, rel=1e-9) and mine[1]["ate_m"] is None
    write_tum(place / "mine/lr_kt2.txt", "lr_kt2")
    assert main(words) == 0
    before = plan(added={"mine": Path("mine")}).jobs[4]
    write_tum(place / "mine/robot_t1.txt", "robot_t1", error_m=0.002)
    after = plan(added={"mine": Path("mine")}).jobs[4]
    assert before.key != after.key and read_cell(before) is not None and read_cell(after) is None


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
    assert "failed: mine on lr_kt2: mine: ended with status 1: no such room {sequence} (all of it is in" in out
    data = json.loads((place / "bench/results.json").read_text())
    mine = [c for c in data["cells"] if c["method"] == "mine"]
    assert mine[0]["ate_m"] < 1e-6 and mine[0]["seconds"] > 0.0 and mine[1]["ate_m"] is None
    assert "looking at" in (place / "bench/cells/robot_t1/mine/command.log").read_text()
    one, other = (plan(commands={"mine": text}).jobs[-1].key for text in (command, command + " --slow"))
    assert one != other


@pytest.mark.parametrize(("kept", "word", "lost"), [(range(29), "†", 2), (range(15), "lost", 16)])
def test_lost_frames_are_marked_and_lost_tracks_do_not_count(
    place: Path, kept: Sequence[int], word: str, lost: int
) -> None:
    for name in NAMES:
        write_tum(place / f"mine/{name}.txt", name)
    write_tum(place / "mine/robot_t1.txt", "robot_t1", kept)
    made = plan(added={"mine": Path("mine")})
    results = run_plan(made)
    cell = results.cell("robot_t1", "mine")
    assert cell is not None
    assert cell.lost == lost and cell.error is None
    (line,) = [line for line in results_text(results).split("\n\n")[0].splitlines() if line.startswith("mine")]
    assert word in line.split()[1]
    (ours,) = [a for a in averages(results) if (a.group, a.method) == ("hand-held", "rs-g")]
    (theirs,) = [a for a in averages(results) if (a.group, a.method) == ("hand-held", "mine")]
    assert ours.sequences == ("robot_t1",) and ours.values["ate_m"] is not None
    assert (theirs.values["ate_m"] is None) == (word == "lost")


def test_paths_and_errors(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(rsgen.figures, "save", lambda figure, path: drawn.append(figure))
    write_tum(place / "mine/robot_t1.txt", "robot_t1", range(4, 25))
    made = plan(sequences=["robot_t1"], added={"mine": Path("mine")})
    results = run_plan(made)
    assert draw_sequence(results, made.sequences[0], Path("bench"), Path("x.png"))
    path, errors = drawn[0].axes
    shown = list(results.shown("hand-held").values())
    assert shown[1:] == ["rs-g", "rs-g --no-fuse", "mine"]
    assert [line.get_label() for line in errors.lines] == shown and len(path.lines) == 5
    for line, done in zip(errors.lines, [results.cell("robot_t1", name) for name in shown], strict=True):
        values = np.asarray(line.get_ydata(), float)
        assert done is not None and done.metrics is not None
        assert np.sqrt(np.mean(values**2)) == pytest.approx(1e3 * done.metrics["ate_rmse_m"], rel=1e-4)
    true = synthetic.make_spline(SPEEDS[0]).pose(np.array([0.0, 1.0]))[:, [0, 2], 3]
    np.testing.assert_allclose(np.asarray(path.lines[0].get_xydata())[[0, -1]], true, atol=1e-6)
    np.testing.assert_allclose(np.asarray(path.lines[2].get_xydata())[[0, -1]], true, atol=0.01)
