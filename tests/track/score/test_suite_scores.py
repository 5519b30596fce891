"""`rstrack score` against evo on the same files, plain loops and figures by hand; and what it finds in folders."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import synthetic
import yaml
from estimates import noisy, one_line
from evo.core import metrics as evo
from evo.tools import file_interface
from report_util import make_run

from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import write_estimate, write_poses
from rstrack.metrics.association import Truth, truth_of
from rstrack.report.leaderboard import leaderboard
from rstrack.report.page import render
from rstrack.score.scores import Score, Scores, SequenceScored, score_result
from rstrack.score.suite import About, MethodResults, Result, Suite, SuiteEntry, find_methods, read_suite, read_times

TRUTH = synthetic.make_spline()


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sequences of 1.2 s that differ in their readout, and a third that is listed but not there."""
    root = tmp_path_factory.mktemp("suite")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "DURATION_S", 1.2)
        for name, readout_s in (("slow", 0.02), ("fast", 0.005)):
            streams = [{"readout_s": readout_s}, {"readout_s": readout_s, "rate_hz": 30.0}]
            synthetic.make_sequence(root / name, synthetic.make_config(16, 12, *streams), frames=36)
    entries = [
        {"name": "slow", "tier": "small", "role": "train", "group": "ladder"},
        {"name": "fast", "tier": "small", "role": "test", "group": "ladder", "seconds": 1.2},
        {"name": "absent", "tier": "large"},
    ]
    (root / "suite.yaml").write_text(yaml.safe_dump({"name": "mine", "version": "1.0", "entries": entries}))
    return root


@pytest.fixture(scope="module")
def slow(suite: Path) -> tuple[Dataset, Truth]:
    dataset = open_dataset(suite / "slow")
    truth = truth_of(dataset)
    assert truth is not None
    return dataset, truth


def write(file: Path, stamps: np.ndarray, T: np.ndarray) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    write_poses(file, stamps, se3.orthonormalise(T))
    return file


# --- one result ------------------------------------------------------------------------------------------------------


def test_errors_are_those_of_evo_on_the_same_files(slow: tuple[Dataset, Truth], tmp_path: Path) -> None:
    stamps = slow[0].stamps
    true = write(tmp_path / "true.txt", stamps, TRUTH.pose(stamps))
    file = write(tmp_path / "est.txt", stamps[:-3], se3.exp(np.ones(6)) @ noisy(TRUTH.pose(stamps), 4)[:-3])
    score = score_result(*slow, Result(file), About())

    ref, est = (file_interface.read_tum_trajectory_file(str(path)) for path in (true, file))
    ref.reduce_to_ids(np.arange(len(stamps) - 3))
    for relation, name, scale in (
        (evo.PoseRelation.translation_part, "drift_mm_s", 1e3),
        (evo.PoseRelation.rotation_angle_deg, "drift_deg_s", 1.0),
    ):
        rpe = evo.RPE(relation, delta=30, delta_unit=evo.Unit.frames, all_pairs=True)
        rpe.process_data((ref, est))
        assert score.figures[name] == pytest.approx(scale * rpe.get_statistic(evo.StatisticsType.rmse), rel=1e-6)
    est.align(ref)
    ape = evo.APE(evo.PoseRelation.translation_part)
    ape.process_data((ref, est))
    assert score.figures["ate_mm"] == pytest.approx(1e3 * ape.get_statistic(evo.StatisticsType.rmse), rel=1e-6)
    assert score.status == "scored" and score.figures["tracked_pct"] == pytest.approx(100 * 33 / 36)
    assert score.figures["line_mm"] is None  # poses alone have no lines


def test_the_colour_cameras_poses_and_a_scale_are_taken_as_the_method_states_them(
    slow: tuple[Dataset, Truth], tmp_path: Path
) -> None:
    stamps = slow[0].stamps + 0.004  # of another camera, between depth's frames
    T_world_color = TRUTH.pose(stamps) @ se3.inverse(synthetic.T_COLOR_DEPTH)
    result = Result(write(tmp_path / "color.txt", stamps, T_world_color))
    exact, wrong = (score_result(*slow, result, About(camera=camera)) for camera in ("color", "depth"))
    assert exact.figures["ate_mm"] < 1e-3 < 1.0 < wrong.figures["ate_mm"]

    T = TRUTH.pose(stamps)
    T[:, :3, 3] *= 0.25
    result = Result(write(tmp_path / "small.txt", stamps, T))
    scaled = score_result(*slow, result, About(alignment="sim3"))
    assert scaled.figures["ate_mm"] < 1e-2 and "positions times 4," in scaled.notes[-1]
    assert score_result(*slow, result, About()).figures["ate_mm"] > 50.0


@pytest.mark.parametrize("camera", ["depth", "color"])
def test_nees_is_of_poses_against_the_first(camera: str, slow: tuple[Dataset, Truth], tmp_path: Path) -> None:
    rng, stamps = np.random.default_rng(5), slow[0].stamps
    T_depth_given = se3.inverse(synthetic.T_COLOR_DEPTH) if camera == "color" else np.eye(4)
    T_true = TRUTH.pose(stamps) @ T_depth_given
    half = 1e-3 * rng.normal(size=(len(stamps), 6, 6))
    C = half @ np.swapaxes(half, 1, 2) + 1e-7 * np.eye(6)
    C[0] = 0.0
    T = T_true @ se3.exp(1e-3 * rng.normal(size=(len(stamps), 6)))
    T[0] = T_true[0]
    file = write(tmp_path / "est.txt", stamps, T)
    lower = np.tril_indices(6)
    rows = [
        f"{line} {' '.join(f'{v:.12g}' for v in c[lower])}"
        for line, c in zip(file.read_text().splitlines()[2:], C, strict=True)
    ]
    cov = tmp_path / "est.cov"
    cov.write_text("#%FORMAT SQUARE/0.3\n#%TANGENT_ORDER translation_rotation\n" + "\n".join(rows) + "\n")

    expected = []
    for k in range(1, len(stamps)):
        step_true, step = np.linalg.inv(T_true[0]) @ T_true[k], np.linalg.inv(T[0]) @ T[k]
        xi = se3.log(np.linalg.inv(step_true) @ step)
        expected.append(xi @ np.linalg.solve(C[k], xi) / 6)
    score = score_result(*slow, Result(file, cov), About(camera=camera))
    assert score.figures["nees_first"] == pytest.approx(np.mean(expected), rel=1e-3)

    cov.write_text(cov.read_text().replace("translation_rotation", "rotation_translation"))
    with pytest.raises(UserError, match="only translation_rotation is read") as error:
        score_result(*slow, Result(file, cov), About())
    one_line(error)
    cov.write_text("\n".join(row.rsplit(" ", 1)[0] for row in rows))
    with pytest.raises(UserError, match="expected 29 numbers a line"):
        score_result(*slow, Result(file, cov), About())


def test_a_run_has_errors_by_line_times_and_the_nees_of_its_export(
    slow: tuple[Dataset, Truth], suite: Path, tmp_path: Path
) -> None:
    run = make_run(tmp_path / "run", suite / "slow")
    score = score_result(*slow, Result(run), About())
    assert score.figures["line_mm"] > 0.5 and score.figures["median_ms"] == 12.5 == score.figures["p95_ms"]

    stamps, upper = slow[0].stamps[:5], np.eye(6)[np.triu_indices(6)] * 1e-6
    frames = [{"stamp": t, "covariance": (k + 1) * upper, "drift_world": k * upper} for k, t in enumerate(stamps)]
    write_estimate(run, stamps, noisy(TRUTH.pose(stamps), 3, 1e-3), None, {"frames": frames})
    assert main(["export", str(run), "covariance", "--out", str(tmp_path / "run.cov")]) == 0
    of_run = score_result(*slow, Result(run), About())
    of_file = score_result(*slow, Result(run / "trajectory.txt", tmp_path / "run.cov"), About())
    assert of_run.figures["nees_first"] == pytest.approx(of_file.figures["nees_first"], rel=1e-5)
    assert of_run.status == "lost" and "5 of 36 frames" in of_run.reason
    assert of_run.value("ate_mm") is None and of_run.value("tracked_pct") == pytest.approx(100 * 5 / 36)


def test_times_are_the_last_number_of_a_line(tmp_path: Path) -> None:
    (tmp_path / "a.times").write_text("# stamp ms\n0.1 12\n\n0.2, 14.5 # slow\n9\n")
    assert read_times(tmp_path / "a.times").tolist() == [12.0, 14.5, 9.0]
    (tmp_path / "a.times").write_text("12\nfast\n")
    with pytest.raises(UserError, match="line 2: expected the ms"):
        read_times(tmp_path / "a.times")


# --- folders ---------------------------------------------------------------------------------------------------------


def test_results_are_found_wherever_they_lie(suite: Path, tmp_path: Path) -> None:
    names, stamps = ("slow", "fast"), np.arange(5) / 30
    T = TRUTH.pose(stamps)
    several = tmp_path / "several"
    for file in ("orb/slow.txt", "orb/fast.txt", "dso/slow.txt", "dso/slwo.txt"):
        write(several / file, stamps, T)
    (several / "orb/method.yaml").write_text("name: ORB\nurl: https://a.b\ncamera: color\n")
    (several / "orb/slow.times").write_text("3\n")
    (several / "readme.txt").write_text("how it was made")
    (several / "svo").mkdir()
    (several / "svo/slow.csv").touch()
    run = make_run(tmp_path / "runs/first", suite / "fast", method="gs-pg")
    make_run(tmp_path / "mine/slow", suite / "slow", method="ignored: the folder says")
    (tmp_path / "mine/method.yaml").write_text("note: tuned\n")
    make_run(tmp_path / "bench/cells/track/fast/rs-pg-no-fuse", suite / "fast")

    folders = [several, run, tmp_path / "mine", tmp_path / "bench"]
    found = {method.key: method for method in find_methods(folders, names)}
    assert {key: sorted(method.results) for key, method in found.items()} == {
        "dso": ["slow"], "orb": ["fast", "slow"], "svo": [], "gs-pg": ["fast"], "mine": ["slow"],
        "rs-pg-no-fuse": ["fast"],
    }  # fmt: skip
    assert found["orb"].name == "ORB" and found["orb"].about.camera == "color" and found["mine"].about.note == "tuned"
    assert found["orb"].results["slow"] == Result(several / "orb/slow.txt", times=several / "orb/slow.times")
    assert found["dso"].unknown == (several / "dso/slwo.txt",) and found["svo"].unknown == (several / "svo",)
    assert find_methods([several / "orb"], names)[0].results == found["orb"].results

    with pytest.raises(UserError, match="second result of gs-pg for fast"):
        find_methods([run, make_run(tmp_path / "again", suite / "fast", method="gs-pg")], names)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"holds no results of slow, fast: put trajectories at METHOD/SEQUENCE\.txt"):
        find_methods([tmp_path / "empty"], names)
    (several / "orb/method.yaml").write_text("url: javascript:alert(1)\n")
    with pytest.raises(UserError, match=r"method.yaml: url"):
        find_methods([several], names)


def test_a_suite_is_its_file_or_the_folders_that_are_there(suite: Path, tmp_path: Path) -> None:
    found = read_suite(suite)
    assert (found.name, found.version, found.tiers) == ("mine", "1.0", ("small", "large"))
    assert [entry.name for entry in read_suite(suite, ("te*", "large")).entries] == ["fast", "absent"]
    with pytest.raises(UserError, match="--only none: no sequence of"):
        read_suite(suite, ("none",))
    (tmp_path / "b").mkdir()
    (tmp_path / "b/rgb.txt").touch()
    (tmp_path / "notes").mkdir()
    assert [(entry.name, entry.tier) for entry in read_suite(tmp_path).entries] == [("b", "all")]
    (tmp_path / "suite.yaml").write_text("entries: [{name: a}, {name: a}]")
    with pytest.raises(UserError, match="'a' is there twice"):
        read_suite(tmp_path)
    (tmp_path / "suite.yaml").write_text("entries: [{name: ../a}]")
    with pytest.raises(UserError, match=r"suite.yaml: entries.0.name"):
        read_suite(tmp_path)


# --- the whole -------------------------------------------------------------------------------------------------------


def made_up() -> Scores:
    entries = tuple(SuiteEntry(name=name, tier="small", group="ladder") for name in "ab")
    sequences = tuple(
        SequenceScored(entry, 10, ms, has_lines=ms > 0) for entry, ms in zip(entries, (0.0, 28.0), strict=True)
    )
    methods = tuple(MethodResults(key, About(url=f"https://{key}.org", note="<i>")) for key in ("good", "half"))
    scores = {
        ("a", "good"): Score("scored", figures={"ate_mm": 1.0, "tracked_pct": 100.0, "nees": 4.0}),
        ("b", "good"): Score("scored", figures={"ate_mm": 4.0, "tracked_pct": 90.0, "nees": None, "line_mm": 3.0}),
        ("a", "half"): Score("scored", figures={"ate_mm": 0.5, "tracked_pct": 100.0}),
        ("b", "half"): Score("lost", "2 of 10 frames have a pose", {"ate_mm": 0.1, "tracked_pct": 20.0}),
    }
    return Scores(Suite(Path(), "made up", "2", entries), sequences, methods, scores)


def test_a_mean_is_of_a_whole_tier_or_there_is_none() -> None:
    data = json.loads(made_up().json_text())
    good, half = (data["means"]["small"][key] for key in ("good", "half"))
    assert (good["ate_mm"], good["tracked_pct"], good["nees"]) == (2.5, 95.0, None)
    assert (good["scored"], good["lost"]) == (["a", "b"], [])
    # Of the first the truth has no lines; of the second the other method's track is lost.
    assert good["line_mm"] == 3.0 and half["line_mm"] is None and good["line_deg"] is None
    assert (half["ate_mm"], half["tracked_pct"]) == (None, 60.0)
    assert (half["scored"], half["lost"]) == (["a"], ["b"])
    assert data["gaps"] == ["half, b: 2 of 10 frames have a pose"]
    assert data["suite"] == {"name": "made up", "version": "2"} and data["format"] == "rstrack-scores/1"
    assert data["scores"][3] == {
        "sequence": "b", "method": "half", "status": "lost", "reason": "2 of 10 frames have a pose",
        "figures": {"ate_mm": 0.1, "tracked_pct": 20.0}, "notes": [],
    }  # fmt: skip


def test_the_page_shows_what_is_lost_and_stands_alone() -> None:
    html = render(leaderboard(made_up()))
    assert ">lost<" in html.replace(" ", "").replace("\n", "") and "2 of 10 frames have a pose" in html
    assert html.count("data:image/svg+xml;base64,") == 1 and '<a href="https://good.org">good</a>' in html
    assert "<i>" not in html and len(html) < 300_000  # no plotly without its plots


def test_the_command_scores_what_is_there_and_tells_what_is_not(
    suite: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    stamps = open_dataset(suite / "slow").stamps
    for name in ("slow", "fast"):
        write(tmp_path / f"results/mine/{name}.txt", stamps, noisy(TRUTH.pose(stamps), 1))
    (tmp_path / "results/other").mkdir()
    (tmp_path / "results/other/slow.txt").write_text("0 0 0\n" * 9)
    words = ["score", str(suite), str(tmp_path / "results"), "--out", str(tmp_path / "board"), "--quiet"]
    assert main([*words]) == 1
    out, err = capfd.readouterr()
    assert "absent: is not in this folder" in err and "other, fast: no result" in err and "mine" in out
    data = json.loads((tmp_path / "board/scores.json").read_text())
    status = {(s["sequence"], s["method"]): s["status"] for s in data["scores"]}
    assert status == {
        ("slow", "mine"): "scored", ("fast", "mine"): "scored", ("absent", "mine"): "missing",
        ("slow", "other"): "failed", ("fast", "other"): "missing", ("absent", "other"): "missing",
    }  # fmt: skip
    assert [s["readout_ms"] for s in data["sequences"]] == [20.0, 5.0, None]
    assert data["means"]["small"]["mine"]["ate_mm"] > 1.0 and data["means"]["large"]["mine"]["ate_mm"] is None
    assert (tmp_path / "board/index.html").is_file()

    (tmp_path / "results/other/slow.txt").unlink()
    assert main([*words, "--only", "small"]) == 1
    assert "other: holds no trajectory of a sequence" in capfd.readouterr().err
    (tmp_path / "results/other").rmdir()
    assert main([*words, "--only", "small"]) == 0
    assert main(["score", str(suite), "--out", str(tmp_path / "board")]) == 2
    assert "no results to score" in capfd.readouterr().err


def test_our_methods_are_run_on_a_suite(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    synthetic.make_sequence(tmp_path / "suite/tiny", synthetic.make_config(64, 48), frames=6)
    words = ["score", str(tmp_path / "suite"), "--out", str(tmp_path / "board"), "--run", "gs-g", "--quiet"]
    assert main(words) == 0
    score = json.loads((tmp_path / "board/scores.json").read_text())["scores"][0]
    assert score["method"] == "gs-g" and score["figures"]["tracked_pct"] == 100.0 and score["figures"]["median_ms"] > 0
    run = tmp_path / "board/runs/cells/track/tiny/gs-g/run.json"
    before = run.stat().st_mtime_ns
    assert main(words) == 0 and run.stat().st_mtime_ns == before  # kept
    assert main([*words[:-2], "rs-xy"]) == 2 and "no method 'rs-xy'" in capfd.readouterr().err
