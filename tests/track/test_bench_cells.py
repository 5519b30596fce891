"""The evaluation's config, its plan and single cells of it; what is asked for in the wrong way or is not there."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml
from bench_evaluation import FRAMES, VARIANTS, main, make_data, plan, write_tum

import rstrack.bench.methods.grid
import rstrack.peers.clouds
import rstrack.peers.open3d
import rstrack.peers.orb_slam3
from rsgen.config.config import load_config
from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.bench.methods import paper
from rstrack.bench.methods.config import choose, load_bench_config
from rstrack.bench.methods.grid import read_cell, run_cell, run_plan
from rstrack.bench.methods.tables import results_text
from rstrack.data.estimate import Estimate, read_estimate
from rstrack.options import CLOUD_PEERS, METHODS, PEERS, SLAM_PEERS, Options
from rstrack.peers.command import run_command

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """data/ with two sequences, and bench.yaml."""
    folder = tmp_path_factory.mktemp("evaluation")
    make_data(folder)
    return folder


# ---------------------------------------------------------------------------------------------------------------------
# the plan


def test_what_a_cell_depends_on(place: Path) -> None:
    keys = [job.key for job in plan().jobs]
    assert len(set(keys)) == 8
    assert not {job.key for job in plan(options=Options(knot_spacing_s=0.03)).jobs} & set(keys)
    assert not {job.key for job in plan(frames=slice(0, 20)).jobs} & set(keys)
    assert [job.key for job in plan(options=Options(method="gs-p"), frames=slice(0, FRAMES)).jobs] == keys
    # One setting that is asked for is that of a cell of its own, and the other one is not run.
    for fuse, names in ((True, ["gs-g --fuse", "rs-g"]), (False, ["gs-g", "rs-g --no-fuse"])):
        jobs = plan(options=Options(fuse=fuse), sequences=["robot_t1"]).jobs
        assert [job.method for job in jobs] == names
        assert [job.key for job in jobs] == [keys[VARIANTS.index(name)] for name in names]
    rgb = place / "data/lr_kt2/rgb.txt"
    rgb.write_text("# another\n" + rgb.read_text())
    assert [job.key == key for job, key in zip(plan().jobs, keys, strict=True)] == 4 * [True] + 4 * [False]


def test_quick_is_a_subset_and_words_beat_it(place: Path) -> None:
    jobs = plan(quick=True).jobs
    assert [(j.sequence, j.method, j.first, j.last) for j in jobs] == [("lr_kt2", m, 0, 12) for m in VARIANTS[2:]]
    jobs = plan(quick=True, methods=["gs-pg", "rs-g"], frames=slice(3, 9)).jobs
    names = ("gs-pg", "gs-pg --fuse", "rs-g", "rs-g --no-fuse")
    assert [(j.sequence, j.method, j.first, j.last) for j in jobs] == [("lr_kt2", m, 3, 9) for m in names]
    assert [(j.options.method, j.options.fuse) for j in jobs[:2]] == [("gs-pg", False), ("gs-pg", True)]
    assert [j.out.name for j in jobs] == ["gs-pg", "gs-pg_fuse", "rs-g", "rs-g_no-fuse"]


# ---------------------------------------------------------------------------------------------------------------------
# single cells; what goes wrong


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("nowhere/mytracker {sequence} {out}", "cannot run 'nowhere/mytracker'"),
        ("true {sequence} {out}", "wrote no .*command.txt"),
        ("cp {sequence}/rgb.txt {out}", "command.txt"),
        ("false {sequence} {out}", "ended with status 1: it said nothing"),
    ],
)
def test_commands_that_give_nothing(place: Path, command: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        run_command("mine", command, place / "data/robot_t1", place / "peer")


def test_poses_outside_the_frames_do_not_count(place: Path) -> None:
    write_tum(place / "mine/robot_t1.txt", "robot_t1")
    job = plan(sequences=["robot_t1"], frames=slice(5, 20), added={"mine": Path("mine")}).jobs[-1]
    cell = run_cell(job)
    assert cell.metrics is not None and cell.metrics["poses"] == 15 and cell.metrics["frames"] == 15


def test_a_track_that_never_began_is_a_finished_cell(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = rstrack.bench.methods.grid.track

    def lost(*arguments: Any, **named: Any) -> Any:
        result = real(*arguments, **named)
        few = Estimate(result.estimate.stamps[:2], result.estimate.T_world_depth[:2], None, result.estimate.info)
        return dataclasses.replace(result, estimate=few, end="broke down")

    monkeypatch.setattr(rstrack.bench.methods.grid, "track", lost)
    made = plan(sequences=["robot_t1"], methods=["gs-g"], frames=slice(0, 12))
    results = run_plan(made)
    assert read_cell(made.jobs[0]) == results.cells[0]
    assert (results.cells[0].metrics, results.cells[0].lost, results.cells[0].error) == (None, 12, None)
    assert "lost (fewer than half" in results_text(results) and results.cells[0].figure("ate_rmse_m") is None


def test_an_unreadable_image_is_not_kept_as_a_result(place: Path) -> None:
    image = place / "data/robot_t1/depth/000009.png"
    whole = image.read_bytes()
    image.write_bytes(whole[:100])
    made = plan(sequences=["robot_t1"], methods=["gs-g"], frames=slice(0, 12))
    cell = run_plan(made).cells[0]
    assert cell.error is not None and "000009.png" in cell.error and read_cell(made.jobs[0]) is None
    image.write_bytes(whole)
    assert run_plan(made).cells[0].counts


def test_peers_are_methods(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def run_peer(name: str, dataset: Any, frames: slice, progress: Any) -> Estimate:
        asked.append(name)
        assert dataset.root.name == "robot_t1" and frames == slice(0, FRAMES)
        return Estimate(dataset.stamps, se3.orthonormalise(dataset.truth.pose(dataset.stamps)))

    monkeypatch.setattr(rstrack.peers.open3d, "run_peer", run_peer)
    monkeypatch.setattr(rstrack.peers.clouds, "run_cloud_peer", run_peer)

    def run_slam(dataset: Any, frames: slice, progress: Any, seed: int) -> Estimate:
        return run_peer("orb-slam3", dataset, frames, progress)

    monkeypatch.setattr(rstrack.peers.orb_slam3, "run_orb_slam3", run_slam)
    made = plan(sequences=["robot_t1"], methods=["gs-g"], peers=True)
    assert made.methods == ("gs-g", "gs-g --fuse", *PEERS, *CLOUD_PEERS, *SLAM_PEERS)
    for job in (made.jobs[2], made.jobs[-2], made.jobs[-1]):
        cell = run_cell(job)
        assert cell.metrics is not None and cell.metrics["ate_rmse_m"] < 1e-9 and cell.seconds is not None
        assert read_estimate(job.out).info["method"] == job.method
    assert asked == [PEERS[0], CLOUD_PEERS[-1], SLAM_PEERS[-1]]


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("--sequence nope", ["--sequence nope", "robot_t1, lr_kt2"]),
        ("--method nope", ["'nope'", "rs-pg"]),
        ("--frames 50:60", ["robot_t1", "no frame 50", "0 to 30"]),
        ("--frames 5:5", ["--frames 5:5"]),
        ("--add mine", ["--add mine", "NAME=DIR"]),
        ("--add ..=x", ["--add ..=x", "NAME=DIR"]),
        ("--add rs-g=x", ["--add rs-g", "another name"]),
        ("--peer-command mine", ["--peer-command mine", "NAME=COMMAND"]),
        ("--peer-command mine=track", ["'track'", "{sequence}"]),
        ("""--peer-command 'mine=track {sequence}'""", ["'track {sequence}'", "does not say {out}"]),
        ("""--peer-command 'rs-g=track {sequence} {out}'""", ["--peer-command rs-g", "another name"]),
        ("--knot-spacing-s 9", ["knot_spacing_s"]),
        ("--data nowhere", ["rsgen render robot_t1.yaml --out nowhere/robot_t1; rsgen render lr_kt2.yaml --out nowh"]),
        ("--data nowhere --quick", ["nowhere: has no lr_kt2:", "--out nowhere/lr_kt2 --frames 0:12"]),
    ],
)
def test_wrong_words(place: Path, capfd: pytest.CaptureFixture[str], words: str, parts: list[str]) -> None:
    assert main(f"bench bench.yaml --data data --out new --quiet {words}") == 2
    out, error = capfd.readouterr()
    assert out == "" and error.startswith("rstrack: ") and error.count("\n") == 1
    assert all(part in error for part in parts), error
    assert not (place / "new").exists()


def test_a_sequence_that_is_not_whole(place: Path) -> None:
    for name in ("rgb.txt", "depth.txt"):
        listing = place / "data/robot_t1" / name
        listing.write_text("".join(listing.read_text().splitlines(keepends=True)[:-11]))
    with pytest.raises(UserError, match=r"20 of 31 frames.*rsgen render robot_t1.yaml --out data/robot_t1'.*0:20"):
        plan()
    assert plan(frames=slice(0, 20)).sequences[0].frames == 20


def test_a_sequence_without_a_truth(place: Path) -> None:
    camera = {"width": 96, "height": 72, "intrinsics": [72.0, 72.0, 47.5, 35.5], "readout_s": 0.0}
    (place / "data/robot_t1/camera.yaml").write_text(yaml.safe_dump({"color": camera, "depth": camera}))
    for name in ("sequence.yaml", "groundtruth.txt"):
        (place / "data/robot_t1" / name).unlink()
    with pytest.raises(UserError, match="robot_t1: has no ground truth"):
        plan()


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"sequences": []}, ["sequences"]),
        ({"extra": 1}, ["extra"]),
        ({"methods": ["rs-g", "rs-g"]}, ["methods", "'rs-g' is there twice"]),
        ({"methods": ["../x"]}, ["methods.0"]),
        ({"quick": {"sequences": ["nope"], "methods": ["rs-g"], "frames": 20}}, ["quick.sequences", "nope"]),
        ({"quick": {"sequences": ["lr_kt2"], "methods": ["rs-g"], "frames": 0}}, ["quick.frames"]),
    ],
)
def test_wrong_configs(place: Path, change: dict[str, Any], parts: list[str]) -> None:
    data = yaml.safe_load(Path("bench.yaml").read_text()) | change
    Path("wrong.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(UserError) as caught:
        load_bench_config(Path("wrong.yaml"))
    assert all(part in str(caught.value) for part in ("wrong.yaml", *parts)), caught.value


def test_quick_needs_its_section(place: Path) -> None:
    data = yaml.safe_load(Path("bench.yaml").read_text())
    del data["quick"]
    Path("bare.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(UserError, match="--quick"):
        choose(load_bench_config(Path("bare.yaml")), quick=True)


def test_the_projects_own_config() -> None:
    config = load_bench_config(ROOT / "configs/evaluation.yaml")
    assert {(s.name, m) for s in config.sequences for m in config.methods} == set(paper.FIGURES)
    assert all(load_config(s.config).name == s.name for s in config.sequences)
    assert {s.group for s in config.sequences} == {"hand-held", "living room"} and config.quick is not None
    assert [m for m in config.methods if m not in METHODS] == []
