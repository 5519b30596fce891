"""The page of a run and of a benchmark: its numbers, pictures and figures, and that it loads nothing."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import yaml
from report_util import (
    FRAMES,
    NASTY,
    SPLINE,
    WORLD,
    Parsed,
    global_image,
    make_bench,
    make_epoch_run,
    make_run,
    make_sequence,
    parse,
    picture,
    shown,
)

from rsgen.console.command_line import Commands, run_program
from rsgen.console.tables import fixed, significant
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.bench.experiments.methods import read_results
from rstrack.bench.figures import PAPER_FIGURES
from rstrack.charts.chart import CameraPath, PathChart, upright_axes
from rstrack.cli.results import report as report_command
from rstrack.data.dataset import open_dataset
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.data.rig import Image, Rig
from rstrack.metrics.association import compare, truth_of
from rstrack.metrics.evaluate import Metrics, drift, evaluate
from rstrack.metrics.run_evaluate import run_evaluate
from rstrack.report.build import write_report
from rstrack.report.page import Note, Page, PageSection, render
from rstrack.report.pictures import rectified


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sequence(tmp_path_factory.mktemp("sequence") / "plain")


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sequence(tmp_path_factory.mktemp("sequence") / "twin", twin=True)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, twin: Path) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "run", twin)


@pytest.fixture(scope="module")
def report(run: Path) -> Path:
    return write_report(run)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, sequence: Path, twin: Path) -> Path:
    root = tmp_path_factory.mktemp("bench")
    make_bench(root, sequence, twin)
    return root


@pytest.fixture(scope="module")
def bench_report(bench: Path) -> Path:
    return write_report(bench)


# ---------------------------------------------------------------------------------------------------------------------


def test_the_tables_numbers_are_those_of_evaluate(report: Path, run: Path, twin: Path) -> None:
    m, page = run_evaluate(twin, run).metrics, parse(report)
    for row in m.table().rows:
        assert page.row(str(row[0])) == [str(entry) for entry in row]
    top = page.text[: page.text.index("Errors against")]
    for number in (
        f"{shown(m.ate_rmse_m, 1e3)} mm",
        f"{shown(m.rpe_rot_rmse_deg_per_s)} °/s",
        "27 of 31",
        "12.5 ms",
        "4 lost",
    ):
        assert number in top


def test_the_drift_that_is_drawn_is_the_one_of_evaluate(sequence: Path) -> None:
    truth = truth_of(open_dataset(sequence))
    assert truth is not None
    stamps = np.sort(np.random.default_rng(0).uniform(-0.15, 1.25, 80))  # pairs of all kinds, some without a partner
    xi = 0.01 * np.random.default_rng(1).normal(size=(80, 6))
    estimate = Estimate(stamps, se3.orthonormalise(WORLD @ SPLINE.pose(stamps) @ se3.exp(xi)))
    found, metrics = drift(estimate, compare(truth, estimate)), evaluate(truth, estimate)
    assert len(found.stamps) == metrics.rpe_pairs > 5
    assert np.sqrt(np.mean(found.translation_m**2)) == pytest.approx(metrics.rpe_trans_rmse_m_per_s)
    assert np.sqrt(np.mean(found.rotation_deg**2)) == pytest.approx(metrics.rpe_rot_rmse_deg_per_s)
    assert np.isin(found.stamps, stamps).all() and (found.stamps <= stamps[-1] - 0.9).all()


@pytest.mark.parametrize("page", ["report", "bench_report"])
def test_a_page_loads_nothing(page: str, request: pytest.FixtureRequest) -> None:
    path: Path = request.getfixturevalue(page)
    parsed = parse(path)
    for tag, name, value in parsed.attributes:
        if name in ("src", "href", "srcset", "action", "data", "poster", "background"):
            assert value.startswith(("data:", "#")), (tag, name, value[:60])
        assert name != "style" or "url(" not in value
    assert not re.search(r"url\(|@import|https?:", "".join(parsed.styles))
    ours = [script for script in parsed.scripts if "plotly.js v" not in script[:500]]
    assert len(ours) == len(parsed.scripts) - 1 == 2, "plotly.js is there once"
    assert not any("http" in script for script in ours)
    policy = next(v for tag, name, v in parsed.attributes if (tag, name) == ("meta", "content") and "-src" in v)
    assert "default-src 'none'" in policy and "http" not in policy and "*" not in policy
    assert path.stat().st_size < 8e6
    assert all(picture(uri).shape[1] in (64, 48) for uri in parsed.uris()) and parsed.uris()


@pytest.mark.parametrize("page", ["report", "bench_report"])
def test_plotly_knows_every_property_of_the_figures(page: str, request: pytest.FixtureRequest) -> None:
    from plotly.graph_objects import Figure  # type: ignore[import-untyped]

    figures = parse(request.getfixturevalue(page)).figures
    assert len(figures) >= 5
    for figure in figures:
        Figure(figure)  # raises ValueError for a wrong name or value


def test_the_path_is_the_aligned_one_and_breaks_where_the_track_was_lost(report: Path, twin: Path) -> None:
    true, estimated = next(f for f in parse(report).figures if "scene" in f["layout"])["data"]
    stamps = open_dataset(twin).stamps
    gap = estimated["x"].index(None)
    assert gap == 10 and [axis.count(None) for axis in (estimated["x"], estimated["y"], estimated["z"])] == [1, 1, 1]
    # The plot's axes are the world's, turned over: the camera's y points down and so does the world's here.
    order, sign = (0, 2, 1), np.array([1, 1, -1])
    kept = np.delete(np.arange(FRAMES), [10, 11, 12, 13])
    p_world = np.stack([np.delete(np.array(estimated[a], float), gap) for a in "xyz"], -1)
    expected = SPLINE.pose(stamps[kept])[:, order, 3] * sign
    assert np.abs(p_world - expected).max() < 0.02
    begin = [true[a][0] for a in "xyz"]
    np.testing.assert_allclose(begin, SPLINE.pose(stamps[0])[order, 3] * sign, atol=1e-4)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("down", [-1, 1])
def test_the_plot_points_upwards_in_any_world_and_is_no_mirror_image(axis: int, down: int) -> None:
    y = down * np.eye(3)[axis]
    z = np.eye(3)[(axis + 1) % 3]
    T = np.eye(4)[None].copy()
    T[0, :3, :3] = np.stack([np.cross(y, z), y, z], axis=-1)
    axes = np.stack([sign * np.eye(3)[k] for k, sign in upright_axes(T)])
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_array_equal(axes[2], -y)


def test_a_path_that_runs_away_does_not_shrink_the_others() -> None:
    stamps = np.arange(10) / 30
    T = SPLINE.pose(stamps)
    lost = T.copy()
    lost[-1, :3, 3] += 1e4
    paths = (CameraPath("true", "#000", stamps, T, is_true=True), CameraPath("lost", "#000", stamps, lost))
    size = np.ptp(T[:, :3, 3], axis=0).max()
    assert all(high - low < 3 * size for low, high in PathChart("Paths", paths).ranges)


@pytest.mark.parametrize("scan", ["top-bottom", "left-right"])
def test_rectifying_with_the_true_motion_gives_the_global_shutter_image(scan: Any) -> None:
    config = synthetic.make_config(160, 120, {"scan": scan, "readout_s": 0.03, "exposure_s": 0.004})
    color, depth, T = config.color, config.depth, np.array(config.T_color_depth)
    rig = Rig(depth.camera, depth.shutter, color.camera, color.shutter, T)
    z = Image(0.30, synthetic.render_depth(SPLINE, depth.camera, depth.shutter, 0.30))
    rolling = Image(0.31, synthetic.render_color(SPLINE, color.camera, color.shutter, 0.31, T))
    made = rectified(rig, SPLINE, z, rolling).astype(float)
    wanted = global_image(config, 0.31).astype(float)
    known = (made != 128).any(axis=-1)
    assert known.mean() > 0.85
    off = np.abs(made - wanted).max(axis=-1)[known]
    before = np.abs(rolling.pixels.astype(float) - wanted).max(axis=-1)[known]
    assert np.median(before) > 4.0 and np.median(off) <= 1.0
    assert (off < 5.0).mean() > 0.97


def test_depth_unlike_colour_in_size_and_lens_is_rectified_too() -> None:
    T = synthetic.T_COLOR_DEPTH
    fine = Camera(128, 96, 96.0, 96.0, 63.5, 47.5, "radtan", (-0.05, 0.01, 0.0, 0.0))
    coarse, shutter = Camera(64, 48, 48.0, 48.0, 31.5, 23.5), Shutter(0.03)
    z = Image(0.3, synthetic.render_depth(SPLINE, coarse, shutter, 0.3))
    rolling = Image(0.3, synthetic.render_color(SPLINE, fine, shutter, 0.3, T))
    made = rectified(Rig(coarse, shutter, fine, shutter, T), SPLINE, z, rolling).astype(float)
    middle = float(shutter.line_mid_time(0.3, 47.5, fine))
    off = np.abs(made - synthetic.render_color(SPLINE, fine, Shutter(), middle, T)).max(axis=-1)
    known = (made != 128).any(axis=-1)
    assert known.mean() > 0.8 and np.median(off[known]) <= 2.0


def test_the_slider_holds_the_frame_and_its_exact_twin(report: Path, twin: Path) -> None:
    page = parse(report)
    alts = [value for tag, name, value in page.attributes if (tag, name) == ("img", "alt")]
    uris = dict(zip(alts, page.uris(), strict=True))
    alt = next(a for a in alts if a.endswith("with a global shutter"))
    k = int(re.findall(r"frame (\d+)", alt)[0])
    sequence = open_dataset(twin).sequence
    assert sequence is not None
    true = {"rolling": sequence.color(k), "global": sequence.truth("global_middle", k)}
    for kind, other in (("rolling", "global"), ("global", "rolling")):
        image = picture(uris[alt.replace("global", kind)])[..., ::-1].astype(float)
        off = {name: np.mean((image - true[name]) ** 2) for name in true}
        assert off[kind] < 0.8 * off[other]  # what JPEG does to 64 pixels is not little
    # The frame is the one that moves fastest of those that the estimate covers.
    w = SPLINE.velocity(open_dataset(twin).stamps + 0.014)
    speed = np.linalg.norm(w[:, :3], axis=1) / 2 + np.linalg.norm(w[:, 3:], axis=1)
    assert k == np.argmax(speed)


def test_without_a_twin_the_page_says_how_to_get_one(sequence: Path, tmp_path: Path) -> None:
    text = parse(write_report(make_run(tmp_path / "run", sequence))).text
    assert "truth.global_shutter" in text and "rectified with the estimated motion" in text


def test_names_cannot_break_the_page() -> None:
    html = render(Page(NASTY, NASTY, (), (PageSection("a", NASTY, (Note(NASTY),)),)))
    assert html.count("<b>") == 0 and html.count("</script>") == 3
    page = Parsed()
    page.feed(html)
    assert page.text.count(NASTY) >= 4


def test_a_sequence_that_has_moved_is_found_where_it_is_said_to_be(sequence: Path, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", sequence, dataset={"name": "s", "path": str(tmp_path / "gone")})
    page = parse(write_report(run))
    assert "--sequence" in page.text and "ATE, mm" not in page.text and not page.uris()
    assert [f for f in page.figures if "scene" in f["layout"]]
    out = write_report(run, sequence, tmp_path / "new" / "page.html")
    assert out == tmp_path / "new" / "page.html" and "ATE, mm" in parse(out).text


def test_other_trackers_files_have_a_report_too(run: Path, sequence: Path, tmp_path: Path) -> None:
    shutil.copy(run / "trajectory.txt", tmp_path / "other.txt")
    out = write_report(tmp_path / "other.txt", sequence)
    assert out == tmp_path / "other.html"
    m: Metrics = run_evaluate(sequence, tmp_path / "other.txt").metrics
    assert parse(out).row("ATE, mm")[1] == fixed(m.ate_rmse_m, 3, 1e3)


def test_the_truths_clock_can_be_moved(sequence: Path, tmp_path: Path) -> None:
    """An estimate whose stamps are 20 ms late: without the offset, with it, and with a wrong one of words."""
    run = make_run(tmp_path / "run", sequence, error_m=1e-4)
    rows = np.loadtxt(run / "trajectory.txt")
    rows[:, 0] += 0.02
    np.savetxt(tmp_path / "late.txt", rows, fmt="%.9f")
    plain = parse(write_report(tmp_path / "late.txt", sequence, tmp_path / "plain.html"))
    moved = parse(write_report(tmp_path / "late.txt", sequence, tmp_path / "moved.html", truth_offset=-0.02))
    asked = run_evaluate(sequence, tmp_path / "late.txt", truth_offset=-0.02)
    assert moved.row("ATE, mm")[1] == fixed(asked.chosen.ate_rmse_m, 3, 1e3)
    assert float(moved.row("ATE, mm")[1]) < 0.2 * float(plain.row("ATE, mm")[1])
    assert "Truth's clock as stored" in moved.text and "Truth's clock moved, -20.0 ms" in moved.text
    assert asked.clocks and all(f"{line[0].upper()}{line[1:]}." in moved.text for line in asked.clocks)
    assert "Clocks as they are" not in plain.text
    # The curves are those of the moved clock too.
    curves = [np.array(f["data"][0]["y"], float) for f in moved.figures if "scene" not in f["layout"]]
    assert np.sqrt(np.nanmean(curves[0] ** 2)) == pytest.approx(1e3 * asked.chosen.ate_rmse_m, rel=0.02)
    write_estimate(tmp_path / "alone", rows[:, 0], SPLINE.pose(rows[:, 0]), None, {})
    with pytest.raises(UserError, match="there is no truth whose clock could be moved"):
        write_report(tmp_path / "alone", truth_offset=0.0)


def test_a_run_goes_by_its_own_cameras(tmp_path: Path) -> None:
    """A recording whose camera file says otherwise, says nothing, or is told by hand; an old run goes by the folder."""
    root, run = make_epoch_run(tmp_path)
    told = {"color": {"width": 32, "height": 24, "intrinsics": [24.0, 25.0, 15.5, 11.5], "readout_s": 0.01}}
    told["T_color_depth"] = se3.exp(np.array([0.2, 0.0, 0.1, 0.0, 0.0, 0.3])).tolist()  # type: ignore[assignment]
    by_hand = tmp_path / "by_hand.yaml"
    by_hand.write_text(yaml.safe_dump(told))

    def readouts(camera: Path | None = None) -> list[str]:
        text = parse(write_report(run, None, tmp_path / "page.html", camera)).text
        return re.findall(r"(\d+) ms readout", text)

    assert readouts() == ["26", "34"] and readouts(by_hand) == ["10", "10"]
    ours = run_evaluate(root, run).metrics
    # The folder's extrinsics would turn the colour camera's true poses into others for depth's.
    (root / "camera.yaml").write_text(by_hand.read_text())
    assert run_evaluate(root, run).metrics == ours and run_evaluate(root, run, by_hand).metrics != ours
    (root / "camera.yaml").unlink()
    assert readouts() == ["26", "34"] and run_evaluate(root, run).metrics == ours
    (root / "camera.yaml").write_text(by_hand.read_text())
    info = json.loads((run / "run.json").read_text())
    del info["dataset"]["camera"]
    (run / "run.json").write_text(json.dumps(info))
    assert readouts() == ["10", "10"] and run_evaluate(root, run).metrics != ours


def test_without_a_clock_to_fit_there_is_one_row_of_errors(report: Path, tmp_path: Path) -> None:
    text = parse(report).text
    assert (
        text.count("position error (ATE, RMSE)") == 1 and "Truth's clock" not in text and "--truth-offset" not in text
    )
    two = parse(write_report(make_epoch_run(tmp_path)[1])).text
    assert two.count("position error (ATE, RMSE)") == 2 and "go by the truth's clock as stored" in two


def test_an_early_end_is_said_at_the_top(sequence: Path, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", sequence, end="unreadable", error="depth/000031.png: is empty")
    text = parse(write_report(run)).text
    assert text.index("ended early: unreadable. depth/000031.png: is empty") < text.index("Errors against")


def test_wrong_input_is_refused_in_one_line(sequence: Path, run: Path, bench: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"neither trajectory\.txt, results\.json nor stress\.json"):
        write_report(tmp_path)
    with pytest.raises(UserError, match="no such folder"):
        write_report(run, tmp_path / "nowhere")
    with pytest.raises(UserError, match="leave --sequence"):
        write_report(bench, sequence)
    with pytest.raises(UserError, match=r"leave --truth-offset out \(give it to 'rstrack bench'\)"):
        write_report(bench, truth_offset=0.01)
    for text, complaint in (
        ("{", "Invalid JSON"),
        ('{"sequences": [{}], "methods": [], "records": []}', "sequences.0"),
    ):
        (tmp_path / "results.json").write_text(text)
        with pytest.raises(UserError, match=complaint) as error:
            write_report(tmp_path)
        assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)


def test_the_command_writes_the_page_or_one_line_of_complaint(
    run: Path, bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def command(*words: str) -> int:
        commands = Commands("rstrack", "")
        commands.add(report_command, "")
        return run_program("rstrack", lambda: commands.parser, ["report", *words], "")

    for folder, name in ((run, "run.html"), (bench, "bench.html")):
        assert command(str(folder), "--out", str(tmp_path / name), "--quiet") == 0
        assert (tmp_path / name).stat().st_size > 4e6 and f"{name}: written" in capsys.readouterr().out
    assert command(str(tmp_path)) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_benchmarks_tables(bench: Path, bench_report: Path) -> None:
    page, results = parse(bench_report), read_results(bench / "results.json")
    for name in ("robot_t1", "lr_kt2"):
        paired = zip(results.methods, page.row(name)[1:], strict=True)
        for method, text in paired:
            ate, theirs = results.figure(name, method, "ate_mm"), PAPER_FIGURES.get((name, method), {}).get("ate_mm")
            note = "" if theirs is None else f" {significant(theirs)}"
            mark = "" if ate is None or theirs is None or ate < theirs else " ▲"
            assert text == ("failed" if ate is None else f"{significant(ate, 3)}†{mark}{note}")
    better = page.row("better by")
    assert better[1] == "" and better[2].split()[1] == "%" and better[2].endswith("29 %") and better[3].endswith("%")
    assert page.row("robot_t1, 31 frames")[1:] == ["100"] * 3 and page.row("lr_kt2, 31 frames")[3] == "-"
    top = page.text[: page.text.index("Small print")]
    ate = results.figure("robot_t1", "rs-pg", "ate_mm")
    assert f"{shown(ate)} mm" in top and "paper: 9.2 mm" in top and "abacus" in page.text
    bars = next(f for f in page.figures if f["data"][0]["type"] == "bar")
    ours = next(t for t in bars["data"] if t["name"] == "rs-pg")
    assert ours["x"] == ["robot_t1", "lr_kt2"]
    figures = [results.figure(name, "rs-pg", "ate_mm") for name in ours["x"]]
    assert ours["y"] == pytest.approx([figure or 0.0 for figure in figures], rel=1e-3)
    names = [[t["name"] for t in f["data"]] for f in page.figures if "scene" in f["layout"]]
    assert names == [["true", "baseline", "rs-pg", "open3d-icp"], ["true", "baseline", "rs-pg"]]


def test_a_benchmark_whose_sequences_are_gone_keeps_its_tables(bench: Path, tmp_path: Path) -> None:
    results = json.loads((bench / "results.json").read_text())
    for entry in results["sequences"]:
        entry["path"] = str(tmp_path / "gone")
    (tmp_path / "results.json").write_text(json.dumps(results))
    page = parse(write_report(tmp_path))
    assert "No plots and images of robot_t1" in page.text and "†" in page.row("robot_t1")[1] and not page.uris()
