"""The `rstrack` command: help that teaches, runs that can be evaluated, and one line for everything that is wrong."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_type_hints

import cv2
import numpy as np
import pytest
import synthetic
from rstrack_command import FRAMES, make_seq, read_info, refused, run

from rsgen.console.progress import no_progress
from rstrack.cli.main import main
from rstrack.data.estimate import read_estimate
from rstrack.options import METHODS, Options
from rstrack.tracking.runs import run as run_module
from rstrack.tracking.runs.done import Done

COMMANDS = ("import", "info", "calibrate", "track", "refine", "evaluate", "report", "map", "export", "bench")


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sequence seq/ and the default method's run of it, run/."""
    folder = tmp_path_factory.mktemp("rstrack")
    make_seq(folder / "seq")
    assert main(["track", str(folder / "seq"), "--out", str(folder / "run"), "--quiet"]) == 0
    return folder


def without_times(folder: str) -> list[Any]:
    info = read_info(folder)
    del info["timings"]
    return [info, Path(folder, "trajectory.txt").read_bytes(), Path(folder, "spline.npz").read_bytes()]


def test_the_time_that_frames_are_waited_for_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=5.0)

    def slowly(load: Any, keys: range, ahead: int) -> Iterator[Any]:
        for seconds in (0.1, 0.3):
            clock.now += seconds
            yield None, ("damaged",)

    monkeypatch.setattr(run_module, "prefetched", slowly)
    monkeypatch.setattr(run_module, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    idle: Any = SimpleNamespace(
        done=Done(), chosen=range(2), load=None, tracker=SimpleNamespace(keyframes=0), checkpoint=None
    )
    assert run_module.feed(idle, no_progress, None, None) == ("done", "")
    assert idle.done.waited == pytest.approx([0.1, 0.3]) and idle.done.count == 2


# --- help ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        main([command, "--help"])
    out, error = capfd.readouterr()
    assert exit.value.code == 0 and error == ""
    assert f"example: rstrack {command} " in out


def test_the_main_help_lists_every_command_and_version_says_the_version(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capfd.readouterr().out
    assert all(f"\n    {command}" in text for command in COMMANDS) and "rstrack track out/demo" in text
    with pytest.raises(SystemExit) as exit:
        main(["--version"])
    out = capfd.readouterr().out.split()
    assert exit.value.code == 0 and out[0] == "rstrack" and out[1][0].isdigit()


def test_every_option_of_the_tracker_is_explained(capfd: pytest.CaptureFixture[str]) -> None:
    hints = get_type_hints(Options, include_extras=True)
    with pytest.raises(SystemExit):
        main(["track", "--help"])
    text = "".join(capfd.readouterr().out.split())
    for field in dataclasses.fields(Options):
        is_told = "".join(get_args(hints[field.name])[1].split()) in text
        assert (f"--{field.name.replace('_', '-')}" in text and is_told) is not bool(field.metadata), field.name


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("", ["COMMAND"]),
        ("trak seq", ["trak"]),
        ("track", ["sequence"]),
        ("track seq", ["--out"]),
        ("track nowhere --out r", ["nowhere", "no such folder"]),
        ("track run --out r", ["run", "rgb.txt"]),
        ("track seq --out r surplus", ["surplus"]),
        ("track seq --out r --metho gs-g", ["--metho"]),
        ("track seq --out r --method rs-x", ["rs-x", "rs-pg"]),
        ("track seq --out r --backend opencl", ["opencl", "llvm"]),
        ("track seq --out r --knot-spacing-s 0", ["knot_spacing_s"]),
        ("track seq --out r --knot-spacing-s -1e-3", ["knot_spacing_s", "-0.001"]),
        ("track seq --out r --knot-spacing-s soon", ["--knot-spacing-s", "soon"]),
        ("track seq --out r --max-depth nan", ["--max-depth", "nan"]),
        ("track seq --out r --bootstrap-frames 4", ["--bootstrap-frames", "Options(bootstrap_frames=...)"]),
        ("track seq --out r --frames 5:5", ["--frames 5:5"]),
        ("track seq --out r --frames 14:20", ["seq", "14", "0 to 13"]),
        ("track seq --out r --noise-depth -1", ["noise", "depth", "-1"]),
        ("track seq --out r --noise-intensity inf", ["--noise-intensity", "inf"]),
        ("track seq --out r --seed -3 --noise-depth 1e-3", ["seed", "-3"]),
        ("track seq --out r --camera cameras.yaml", ["cameras.yaml"]),
        ("track seq --out seq", ["seq", "--out"]),
        ("track seq --out run/run.json", ["run.json"]),
        ("evaluate seq", ["run"]),
        ("evaluate seq nowhere", ["nowhere"]),
        ("evaluate seq seq/rgb", ["seq/rgb", "trajectory.txt"]),
        ("report run --out run/run.json/p.png", ["run.json/p.png"]),
        ("report run --out p.docx", ["p.docx"]),
        ("export run covariance --out c.txt --sequence seq", ["--sequence", "covariance"]),
        ("export run pictures --out p", ["pictures"]),
        ("evaluate seq mesh.ply --against run", ["--against", "a mesh"]),
        ("evaluate seq mesh.ply", ["mesh.ply"]),
        ("plot seq run --out p.png", ["plot: is now 'rstrack report RUN --sequence SEQ --out FILE.png'"]),
        ("map-eval mesh.ply seq/scene.ply", ["map-eval: is now 'rstrack evaluate SEQ MESH'"]),
        ("keyframes seq run --out k", ["keyframes: is now 'rstrack export RUN keyframes --sequence SEQ --out DIR'"]),
        ("info run/run.json", ["run.json"]),
    ],
)  # fmt: skip
def test_what_is_given_wrongly_is_named_in_one_line(
    words: str, parts: list[str], place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = sorted(path for path in place.rglob("*") if path.name != "r")
    refused(capfd, words, *parts)
    assert sorted(path for path in place.rglob("*") if path.name != "r") == before


# --- runs ------------------------------------------------------------------------------------------------------------


def test_a_run_folder_holds_the_trajectory_and_what_made_it(place: Path, original: Path) -> None:
    estimate, info = read_estimate(Path("run")), read_info("run")
    assert len(estimate.stamps) == FRAMES and estimate.spline is not None
    chosen = Options(fuse=True, knot_spacing_s=0.025, loops="end")
    assert info["options"] == dataclasses.asdict(chosen) and info["method"] == "rs-pg"
    where = str((original / "seq").resolve())
    frames = {
        "frames": [0, FRAMES],
        "frames_in_all": FRAMES,
        "color_falloff": 0.0,
        "camera": None,
        "depth_pattern": None,
    }
    assert info["dataset"] == {"name": "synthetic", "path": where, **frames}
    assert set(info["versions"]) == {"rstrack", "numpy", "scipy", "numba", "drjit"} and info["backend"] in (
        "llvm",
        "cuda",
    )
    assert (info["end"], info["error"], info["lost"]) == ("done", None, 0) and info["keyframes"] >= 1
    times = info["timings"]
    assert len(times["frame_ms"]) == FRAMES and 0.0 < times["wait_ms"] <= times["p99_wait_ms"]
    assert times["total_s"] * 1e3 > sum(times["frame_ms"]) + FRAMES * times["wait_ms"]
    assert min(times["frame_ms"]) <= times["median_ms"] <= times["p95_ms"] <= max(times["frame_ms"])
    np.testing.assert_allclose([frame["stamp"] for frame in info["frames"]], estimate.stamps, atol=1e-9)
    for stream in ("depth", "color"):
        parts = [frame[f"inliers_{stream}"] for frame in info["frames"]]
        assert parts[0] is None and max(parts[1:]) == 1.0 and min(parts[1:]) > 0.3
    # From the first line of the first frame to the last line of the last one.
    np.testing.assert_allclose(info["spline_valid"], [[0.0, 13 / 30 + 0.028 * 119 / 120]], atol=1e-6)


def test_a_run_is_accurate_and_evaluate_agrees_with_it(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    status, out, error = run(capfd, "evaluate seq run --json")
    metrics, noted = json.loads(out), read_info("run")["metrics"]
    assert status == 0 and error == ""
    assert metrics["ate_rmse_m"] < 1e-3 and metrics["row_rmse_m"] < 2e-3
    assert metrics["frames_tracked"] == metrics["frames"] == FRAMES
    for name in ("ate_rmse_m", "row_rmse_m", "row_rot_rmse_deg"):
        assert metrics[name] == pytest.approx(noted[name], rel=1e-3)
    text = run(capfd, "evaluate seq run/trajectory.txt")[1]
    assert f"{1e3 * metrics['ate_rmse_m']:.3f}" in text and "14 of 14" in text


def test_track_sums_up_and_shows_progress_with_the_error(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    status, out, error = run(capfd, "track seq --method gs-g --out r")
    ate = 1e3 * read_info("r")["metrics"]["ate_rmse_m"]
    assert status == 0 and "gs-g on synthetic: 14 frames" in out and "none lost" in out
    assert f"{ate:.3f}" in out and out.splitlines()[-1].startswith("r: written")
    assert "tracking 100 %" in error and "frames/s" in error and f"ATE {ate:.2f} mm" in error
    assert run(capfd, "track seq --method gs-g --out r --quiet")[2] == ""


@pytest.mark.parametrize("method", METHODS)
def test_every_method_runs(method: str, place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    status, out, error = run(capfd, f"track seq --method {method} --out r --frames 0:8 --quiet")
    if method.endswith("i"):
        # With one: test_inertial_tracking.
        assert status == 2 and f"has no IMU, which --method {method} needs: take {method[:-1]}" in error
        return
    assert status in (0, 1) and f"{method} on synthetic" in out
    assert Path("r/spline.npz").exists() == (method != "baseline")


def test_two_runs_are_the_same_bit_by_bit_and_noise_depends_on_its_seed(
    place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    line = "track seq --method rs-g --frames 0:9 --quiet --noise-depth 1.2e-3 --noise-intensity 0.01 --seed"
    for folder, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert run(capfd, f"{line} {seed} --out {folder}")[0] == 0
    assert without_times("a") == without_times("b")
    assert without_times("a")[1] != without_times("c")[1]
    assert read_info("a")["noise"] == {"sigma_depth": 1.2e-3, "sigma_intensity": 0.01, "seed": 1}


def test_options_reach_the_tracker(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = "track seq --out r --quiet --frames 2:9 --method gs-g --knot-spacing-s 0.04 --no-fuse --max-depth 9"
    assert run(capfd, words)[0] == 0
    info = read_info("r")
    chosen = {"method": "gs-g", "knot_spacing_s": 0.04, "fuse": False, "max_depth": 9.0}
    assert info["options"] == dataclasses.asdict(Options(loops="end")) | chosen
    estimate = read_estimate(Path("r"))
    assert estimate.spline is not None and estimate.spline.dt == 0.04
    np.testing.assert_allclose(estimate.stamps, np.arange(2, 9) / 30, atol=1e-6)
    assert info["metrics"]["frames"] == 7 and info["dataset"]["frames"] == [2, 9]


def test_report_draws_runs_and_tum_files(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for what in ("run", "run/trajectory.txt"):
        assert run(capfd, f"report {what} --sequence seq --out p.png") == (0, "p.png: written\n", "")
        assert cv2.imread("p.png").shape[1] == 1600
        Path("p.png").unlink()


def test_info_says_what_would_be_tracked(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capfd, "info seq")
    assert status == 0
    for part in ("160x120", "14 images at 30 Hz", "readout 28 ms", "one colour image", "33 control points 50 ms apart"):
        assert part in out, part
    distance = 1e3 * np.linalg.norm(synthetic.T_COLOR_DEPTH[:3, 3])
    assert f"{distance:.1f} mm" in out
