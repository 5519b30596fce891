"""The evaluation's config, its plan and single cells of it; what is asked for in the wrong way or is not there."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml
from bench_evaluation import FRAMES, VARIANTS, main, make_data, plan, record_file, results, run, write_tum

import rstrack.bench.measures.track
import rstrack.peers.clouds
import rstrack.peers.open3d
import rstrack.peers.orb_slam3
from rsgen.config.config import load_config
from rsgen.console.configs import config_file
from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.bench.cells import OTHERS
from rstrack.bench.experiments.method_tables import method_tables, notes
from rstrack.bench.experiments.methods import load_methods
from rstrack.bench.figures import PAPER_FIGURES
from rstrack.bench.record import counts, read_record
from rstrack.bench.tables import tables_text
from rstrack.data.estimate import Estimate, read_estimate
from rstrack.options import CLOUD_PEERS, METHODS, PEERS, SLAM_PEERS, Options
from rstrack.peers.peer import run_command

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """data/ with two sequences, and bench.yaml."""
    folder = tmp_path_factory.mktemp("evaluation")
    make_data(folder)
    return folder


# ---------------------------------------------------------------------------------------------------------------------
# the plan


def test_one_setting_that_is_asked_for_is_that_of_a_cell_of_its_own(place: Path) -> None:
    whole = {cell.name: cell for cell in plan(options=Options(method="gs-p")).benchmark.cells}
    assert [cell.method for cell in whole.values()] == 2 * list(VARIANTS)
    for fuse, names in ((True, ["gs-g-fuse", "rs-g"]), (False, ["gs-g", "rs-g-no-fuse"])):
        cells = plan(options=Options(fuse=fuse), sequences=["robot_t1"]).benchmark.cells
        assert [cell.method for cell in cells] == names
        assert [cell.options for cell in cells] == [whole[cell.name].options for cell in cells]
    (cell,) = plan(
        options=Options(knot_spacing_s=0.03, fuse=True), sequences=["lr_kt2"], methods=["rs-g"]
    ).benchmark.cells
    assert (cell.options.knot_spacing_s, cell.options.method, cell.options.fuse) == (0.03, "rs-g", True)


def test_quick_is_a_subset_and_words_beat_it(place: Path) -> None:
    cells = plan(quick=True).benchmark.cells
    assert [(c.case, c.method, c.frames) for c in cells] == [("lr_kt2", m, slice(0, 12)) for m in VARIANTS[2:]]
    cells = plan(quick=True, methods=["gs-pg", "rs-g"], frames=slice(3, 9)).benchmark.cells
    names = ("gs-pg", "gs-pg-fuse", "rs-g", "rs-g-no-fuse")
    assert [(c.case, c.method, c.frames) for c in cells] == [("lr_kt2", m, slice(3, 9)) for m in names]
    assert [(c.options.method, c.options.fuse) for c in cells[:2]] == [("gs-pg", False), ("gs-pg", True)]


# ---------------------------------------------------------------------------------------------------------------------
# single cells; what goes wrong


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("nowhere/mytracker {sequence} {out}", "cannot run 'nowhere/mytracker'"),
        ("true {sequence} {out}", "wrote no .*command.txt"),
        ("cp {sequence}/rgb.txt {out}", "command.txt"),
        ("false {sequence} {out}", "ended with status 1: it printed nothing"),
    ],
)
def test_commands_that_give_nothing(place: Path, command: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        run_command("mine", command, place / "data/robot_t1", place / "peer")


def test_poses_outside_the_frames_do_not_count(place: Path) -> None:
    write_tum(place / "mine/robot_t1.txt", "robot_t1")
    made = plan(sequences=["robot_t1"], methods=["gs-g"], frames=slice(5, 20), added={"mine": Path("mine")})
    figures = results(made).records[-1].figures
    assert (figures["frames"], figures["lost"]) == (15, 0)
    assert len(read_estimate(record_file("robot_t1", "mine").parent).stamps) == 15


def test_a_track_that_never_began_is_a_finished_cell(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = rstrack.bench.measures.track.track

    def lost(*arguments: Any, **named: Any) -> Any:
        result = real(*arguments, **named)
        few = dataclasses.replace(
            result.estimate, stamps=result.estimate.stamps[:2], T_world_depth=result.estimate.T_world_depth[:2]
        )  # fmt: skip
        return dataclasses.replace(result, estimate=few, end="broke down")

    monkeypatch.setattr(rstrack.bench.measures.track, "track", lost)
    made = plan(sequences=["robot_t1"], methods=["gs-g"], frames=slice(0, 12), options=Options(fuse=False))
    found = results(made)
    (record,) = found.records
    assert record.error is None and not counts(record.figures) and record.figures["lost"] == 12
    assert "ate_mm" not in record.figures and "lost (fewer than half" in tables_text(method_tables(found), notes(found))


def test_an_unreadable_image_is_not_kept_as_a_result(place: Path) -> None:
    image = place / "data/robot_t1/depth/000009.png"
    whole = image.read_bytes()
    image.write_bytes(whole[:100])
    made = plan(sequences=["robot_t1"], methods=["gs-g"], frames=slice(0, 12), options=Options(fuse=False))
    (record,) = results(made).records
    assert record.error is not None and "000009.png" in record.error
    assert read_record(record_file("robot_t1", "gs-g")) is None
    image.write_bytes(whole)
    assert counts(results(made).records[0].figures)


def test_peers_are_methods(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def run_peer(name: str, dataset: Any, frames: slice, progress: Any) -> Estimate:
        asked.append(name)
        assert dataset.root.name == "robot_t1" and frames == slice(0, FRAMES)
        return Estimate(dataset.stamps, se3.orthonormalise(dataset.truth.pose(dataset.stamps)))

    def run_slam(dataset: Any, frames: slice, progress: Any, seed: int) -> Estimate:
        return run_peer("orb-slam3", dataset, frames, progress)

    monkeypatch.setattr(rstrack.peers.open3d, "run_peer", run_peer)
    monkeypatch.setattr(rstrack.peers.clouds, "run_cloud_peer", run_peer)
    monkeypatch.setattr(rstrack.peers.orb_slam3, "run_orb_slam3", run_slam)
    monkeypatch.setattr(rstrack.bench.measures.track, "find_spec", lambda name: name)
    made = plan(sequences=["robot_t1"], methods=[PEERS[0], "rs-g"], peers=True, options=Options(fuse=True))
    assert made.methods == (PEERS[0], "rs-g", *OTHERS[1:])
    found = {record.method: record for record in results(made).records}
    for name in OTHERS:
        assert found[name].figures["ate_mm"] < 1e-6 and found[name].figures["total_s"] > 0.0
        assert read_estimate(record_file("robot_t1", name).parent).info["method"] == name
    assert sorted(asked) == sorted((*PEERS, *CLOUD_PEERS, *SLAM_PEERS))


def test_a_peer_that_is_not_installed_is_skipped(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rstrack.bench.measures.track, "find_spec", lambda name: None)
    made = plan(sequences=["robot_t1"], methods=["kiss-icp"])
    (record,) = run(made).records.values()
    assert record.skipped and record.error == "kiss-icp: kiss_icp is not installed"


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
        ("--add kiss-icp=x", ["--add kiss-icp", "another name"]),
        ("--speed --add mine=x", ["--add", "--speed"]),
        ("--width 320", ["is no sweep"]),
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
        ({"sequences": {}}, ["sequences"]),
        ({"extra": 1}, ["extra"]),
        ({"methods": ["rs-g", "rs-g"]}, ["methods", "'rs-g' is there twice"]),
        ({"methods": ["../x"]}, ["methods.0"]),
        ({"sequences": {"a": {"group": "x"}}}, ["sequences.a", "config"]),
        ({"quick": {"sequences": ["nope"], "methods": ["rs-g"], "frames": 20}}, ["quick.sequences", "nope"]),
        ({"quick": {"sequences": ["lr_kt2"], "methods": ["rs-g"], "frames": 0}}, ["quick.frames"]),
    ],
)
def test_wrong_configs(place: Path, change: dict[str, Any], parts: list[str]) -> None:
    data = yaml.safe_load(Path("bench.yaml").read_text()) | change
    Path("wrong.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(UserError) as caught:
        load_methods(Path("wrong.yaml"))
    assert all(part in str(caught.value) for part in ("wrong.yaml", *parts)), caught.value


def test_quick_needs_its_section(place: Path) -> None:
    data = yaml.safe_load(Path("bench.yaml").read_text())
    del data["quick"]
    Path("bench.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(UserError, match="--quick"):
        plan(quick=True)


def test_the_projects_own_config() -> None:
    config = load_methods(ROOT / "configs/evaluation.yaml")
    assert {(name, method) for name in config.sequences for method in config.methods} == set(PAPER_FIGURES)
    assert all(load_config(config_file(str(s.config))).name == name for name, s in config.sequences.items())
    assert {s.group for s in config.sequences.values()} == {"hand-held", "living room"} and config.quick is not None
    assert [m for m in config.methods if m not in METHODS] == []
