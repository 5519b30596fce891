"""The generator end to end on a tiny room: what it writes verifies, however it is interrupted, split or configured."""

from __future__ import annotations

import ctypes
import logging
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tiny
import trimesh
import yaml

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.config import load_config
from rsgen.console.command_line import parse_frames
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.produce.camera_sources import ColorSource
from rsgen.produce.generate import render_sequence
from rsgen.produce.parts import load_motion, open_frames
from rsgen.sequence.reader import read_sequence

ROOT = Path(__file__).parents[3]
FRAMES = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tiny")


@pytest.fixture(scope="module")
def config(folder: Path) -> Path:
    return tiny.write_config(folder, FRAMES)


@pytest.fixture(scope="module")
def whole(folder: Path, config: Path) -> Path:
    """The sequence rendered in one go."""
    assert render(config, folder / "whole") == 0
    return folder / "whole"


def render(config: Path, out: Path, *more: str) -> int:
    return main(["render", str(config), "--out", str(out), "--quiet", *more])


def assert_verifies(path: Path) -> None:
    report = verify_sequence(path)
    assert report.ok, report.text()


def test_a_rendered_sequence_verifies(whole: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(whole)]) == 0
    assert "all checks passed" in capfd.readouterr().out
    sequence = read_sequence(whole)
    assert [len(sequence.streams[s].paths) for s in ("color", "depth")] == [FRAMES, FRAMES]
    # Something is to be seen: lit, textured pictures, and walls and ball at the distances that the scene puts them.
    assert all(20 < sequence.color(k).mean() < 235 and sequence.color(k).std() > 10 for k in range(FRAMES))
    assert 0.5 < sequence.truth_depth(0).min() < sequence.truth_depth(0).max() < 5.0


def test_info_names_what_is_there(whole: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(whole)]) == 0
    text = capfd.readouterr().out
    for part in ("tiny", f"{FRAMES} frames at 30 Hz", "48x36 pinhole", "readout 28 ms top-bottom", "0.167 s"):
        assert part in text


@pytest.mark.parametrize(
    ("words", "default"), [(["preview"], "preview.png"), (["preview", "--frame", "2"], "compare_000002.png")]
)
def test_pictures_are_written(whole: Path, tmp_path: Path, words: list[str], default: str) -> None:
    before = tiny.digests(whole)
    assert main([words[0], str(whole), *words[1:], "--out", str(tmp_path / "it.png")]) == 0
    assert tiny.digests(whole) == before
    assert main([words[0], str(whole), *words[1:]]) == 0
    for path in (tmp_path / "it.png", whole / default):
        image = cv2.imread(str(path))
        assert image.shape[0] > 400 and image.shape[1] > 1000 and image.std() > 20
    (whole / default).unlink()


def test_contact_sheets(whole: Path, config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k, what in enumerate((whole, config)):
        out = tmp_path / f"{k}.png"
        assert main(["preview", str(what), "--every", "0.06", "--out", str(out), "--quiet"]) == 0
        image = cv2.imread(str(out))
        columns = math.floor((FRAMES - 1) / 30 / 0.06) + 1
        assert image.shape[1] // columns in range(48, 52) and image.std() > 20
    for words in (
        ["--every", "0"],
        ["--every", "1e-5"],
        ["--every", "1", "--out", "x.jpg"],
        ["--every", "1", "--count", "3"],
    ):
        assert main(["preview", str(whole), *words]) == 2
    assert capsys.readouterr().err.count("\n") == 4


def test_compare_needs_no_origin_if_the_scene_is_named(folder: Path, whole: Path, tmp_path: Path) -> None:
    origin = (whole / "origin.yaml").read_bytes()
    (whole / "origin.yaml").unlink()
    try:
        words = ["preview", str(whole), "--frame", "0", "--out", str(tmp_path / "c.png"), "--quiet"]
        assert main(words) == 2
        assert main([*words, "--scene", str(folder / "scene.xml")]) == 0
    finally:
        (whole / "origin.yaml").write_bytes(origin)


def test_compare_says_if_the_scene_has_changed(
    folder: Path, whole: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    words = ["preview", str(whole), "--frame", "0", "--out", str(tmp_path / "c.png"), "--scene"]
    with caplog.at_level(logging.WARNING, "rsgen"):
        assert main([*words, str(folder / "scene.xml")]) == 0 and not caplog.messages
        other = tiny.write_scene(tmp_path / "other")
        other.write_text(other.read_text().replace("0.7, 0.3, 0.2", "0.1, 0.1, 0.9"))
        assert main([*words, str(other)]) == 0
    assert len(caplog.messages) == 1 and "has changed" in caplog.messages[0]


def test_overrides_reach_the_sequence(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    tiny.write_trajectory(tmp_path / "here/other.txt", 4)
    monkeypatch.chdir(tmp_path)
    overrides = ["--color.spp", "2", "--color.readout_s=0", "--depth.offset_s", "-0.01"]
    overrides += ["--trajectory.file", "here/other.txt", "--seed", "5", "--seed", "6"]
    assert render(config, Path("seq"), *overrides) == 0
    sequence = read_sequence(tmp_path / "seq")
    meta = sequence.meta
    assert meta["config"]["color"]["spp"] == 2 and meta["seed"] == 6
    assert meta["config"]["trajectory"]["file"] == "other.txt"
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    assert color.shutter.readout_s == 0 and depth.shutter.readout_s == 0.028
    assert depth.stamps[0] == pytest.approx(-0.01) and len(color.paths) == 4
    assert_verifies(tmp_path / "seq")


def test_parts_rendered_one_after_the_other_equal_the_whole_byte_for_byte(
    config: Path, whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "parts"
    assert render(config, out, "--frames", "2:4") == 0
    partial = read_sequence(out)
    assert partial.streams["color"].indices.tolist() == partial.streams["depth"].indices.tolist() == [2, 3]
    assert_verifies(out)
    assert render(config, out, "--frames", "5") == 0
    assert render(config, out) == 0
    assert tiny.digests(out) == tiny.digests(whole)
    inodes = {path: path.stat().st_ino for path in (out / "rgb").iterdir()}
    assert render(config, out) == 0  # nothing is left to do, and nothing is done
    assert inodes == {path: path.stat().st_ino for path in (out / "rgb").iterdir()}


def test_one_deleted_frame_is_rendered_again_to_the_same_bytes(config: Path, whole: Path) -> None:
    before = tiny.digests(whole)
    for name in ("rgb/000003.png", "truth/depth/000001.exr", "scene.ply", "rgb.txt"):
        (whole / name).unlink()
    assert render(config, whole) == 0
    assert tiny.digests(whole) == before


def test_a_killed_render_resumes_to_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    """SIGKILL with some frames on disk, then with some more, then the rest; against one go in another process."""
    config, out = tiny.write_config(folder / "killed", 60), tmp_path / "killed"
    command = [sys.executable, "-m", "rsgen", "render", str(config), "--out", str(out), "--quiet"]
    written = 0
    for _ in range(2):
        child, before = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL), written
        while child.poll() is None and written < before + 2:
            time.sleep(0.001)
            written = len(list((out / "rgb").glob("0*.png")))
        child.kill()
        assert child.wait() == -signal.SIGKILL
        assert before < written < 60 and not (out / "rgb.txt").exists()
    assert subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL).returncode == 0
    assert render(config, tmp_path / "whole") == 0
    assert tiny.digests(out) == tiny.digests(tmp_path / "whole")


def test_an_interrupted_render_leaves_a_readable_shorter_sequence(
    config: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    expose = ColorSource.expose

    def interrupted(self: ColorSource, spline: Any, stamp: float, frame: int, *more: Any) -> Any:
        if frame == 4:
            raise KeyboardInterrupt
        return expose(self, spline, stamp, frame, *more)

    with monkeypatch.context() as patch:
        patch.setattr(ColorSource, "expose", interrupted)
        assert render(config, tmp_path / "seq") == 130
    assert capfd.readouterr().err == "rsgen: interrupted; the same command resumes\n"
    assert read_sequence(tmp_path / "seq").streams["color"].indices.tolist() == [0, 1, 2, 3]
    assert_verifies(tmp_path / "seq")
    assert render(config, tmp_path / "seq") == 0
    assert tiny.digests(tmp_path / "seq") == tiny.digests(whole)


def test_two_configs_in_one_folder_are_refused(
    config: Path, whole: Path, capfd: pytest.CaptureFixture[str], folder: Path
) -> None:
    before = tiny.digests(whole)
    for override, field in (("--color.spp=5", "color.spp"), ("--seed=1", "seed"), ("--depth.scan=bottom-top", "scan")):
        assert render(config, whole, override) == 2
        error = capfd.readouterr().err
        assert error.startswith("rsgen: ") and error.count("\n") == 1 and field in error and str(whole) in error
    paper = (folder / "paper.png").read_bytes()
    try:  # the same config, but the scene has another texture now
        cv2.imwrite(str(folder / "paper.png"), np.zeros((8, 8, 3), np.uint8))
        assert render(config, whole) == 2
        assert "inputs.scene" in capfd.readouterr().err
    finally:
        (folder / "paper.png").write_bytes(paper)
    assert tiny.digests(whole) == before
    assert render(config, whole) == 0


def test_frames_depend_neither_on_order_nor_on_threads(config: Path, whole: Path) -> None:
    """Backwards, on one thread, in a source of its own: the pictures that are on disk."""
    mitsuba()
    import drjit as dr

    loaded = load_config(config)
    sequence, source = read_sequence(whole), open_frames(loaded)
    threads = dr.thread_count()
    try:
        for count in (1, threads):
            dr.set_thread_count(count)
            for k in reversed(range(FRAMES)):
                stamp = float(sequence.streams["color"].stamps[k])
                np.testing.assert_array_equal(source.color.picture(sequence.spline, stamp, k), sequence.color(k))
                np.testing.assert_array_equal(source.depth.exact(sequence.spline, stamp), sequence.truth_depth(k))
    finally:
        dr.set_thread_count(threads)


def test_seeds_and_frames_have_noise_of_their_own(config: Path, whole: Path) -> None:
    sequence = read_sequence(whole)
    stamp = float(sequence.streams["color"].stamps[0])
    linear = [
        open_frames(load_config(config, {"seed": seed})).color.linear(sequence.spline, stamp, frame)
        for seed, frame in (("0", 0), ("0", 1), ("1", 0))
    ]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(linear[a] - linear[b]).max() > 1e-3 and np.abs(linear[a].mean() - linear[b].mean()) < 0.02


def resident_pages() -> int:
    """Pages in memory, after what has been freed is given back: else a leak hides in what baking left behind."""
    ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1])


@pytest.mark.skipif(
    not (Path("/proc/self/statm").exists() and hasattr(ctypes.CDLL(None), "malloc_trim")),
    reason="resident memory is read from /proc, with glibc",
)
def test_memory_stays_flat(config: Path, tmp_path: Path) -> None:
    """150 frames of both streams, all written: keeping linear colour and depth (28 kB a frame) would take 4 MB."""
    trajectory = tiny.write_trajectory(tmp_path / "long.txt", 180)
    pages = []
    render_sequence(
        load_config(config, {"trajectory.file": str(trajectory)}), tmp_path / "seq", slice(None),
        lambda stage, *_: pages.append(resident_pages()) if stage == "frames" else None,
    )  # fmt: skip
    assert len(pages) == 360
    begin, middle, end = (max(pages[at : at + 20]) for at in (40, 190, 340))
    # What is kept of each frame grows in both halves; what other tests of the process left behind grows once.
    growth = min(middle - begin, end - middle) * os.sysconf("SC_PAGESIZE")
    assert growth < 0.75e6, f"{growth / 1e6:.1f} MB in 75 frames"


T_COLOR_DEPTH = [[0.9998, 0.0, -0.02, -0.05], [0.0, 1.0, 0.0, 0.01], [0.02, 0.0, 0.9998, 0.002], [0.0, 0.0, 0.0, 1.0]]
VARIANTS: dict[str, dict[str, Any]] = {
    "unsynchronised streams of two cameras": {
        "color": {
            "width": 40, "height": 30, "intrinsics": [30.0, 31.0, 19.0, 15.0], "rate_hz": 25.0, "offset_s": 0.013,
            "model": "radtan", "distortion": [-0.1, 0.02, 0.001, -0.002], "scan": "left-right", "readout_s": 0.02,
            "exposure_s": 0.01,
        },
        "depth": {"scan": "bottom-top", "offset_s": -0.004, "rate_hz": 40.0},
        "T_color_depth": T_COLOR_DEPTH,
    },
    "distorted depth, sideways": {
        "depth": {"model": "radtan", "distortion": [-0.1, 0.02, 0.001, -0.002, 0.003], "scan": "right-left"},
    },
    "fisheye": {
        "color": {"model": "fisheye", "distortion": [0.02, -0.01, 0.002, 0.0]},
        "depth": {"model": "fisheye", "distortion": [0.02, -0.01, 0.002, 0.0]},
    },
    "exposure": {"color": {"exposure_s": 0.02}, "depth": {"exposure_s": 0.01}},
    "global shutter": {"color": {"readout_s": 0.0}, "depth": {"readout_s": 0.0}},
    "path tracing": {"light": {"mode": "path", "max_depth": 4}},
}  # fmt: skip


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_verify(folder: Path, tmp_path: Path, name: str) -> None:
    config = tiny.write_config(folder, FRAMES, name.split()[0].strip(","), **VARIANTS[name])
    assert render(config, tmp_path / "seq") == 0
    assert_verifies(tmp_path / "seq")
    assert read_sequence(tmp_path / "seq").color(1).std() > 10


def test_baked_and_path_traced_pictures_look_alike(folder: Path, whole: Path) -> None:
    path = load_config(tiny.write_config(folder, FRAMES, "both", light={"mode": "path"}, color={"spp": 256}))
    sequence, traced = read_sequence(whole), open_frames(path).color.linear(load_motion(path).spline, 0.0, 0)
    baked = open_frames(load_config(folder / "tiny.yaml")).color.linear(sequence.spline, 0.0, 0)
    assert np.abs(baked.mean() / traced.mean() - 1) < 0.2  # one bounce of nine, coarse
    assert np.corrcoef(baked.mean(-1).ravel(), traced.mean(-1).ravel())[0, 1] > 0.9


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_a_mesh_file_is_a_scene(tmp_path: Path, suffix: str) -> None:
    box = trimesh.creation.box(extents=(4, 3, 5))
    box.apply_transform(trimesh.transformations.rotation_matrix(0.3, (0, 1, 0)))
    ball = trimesh.creation.icosphere(3, 0.5)
    ball.apply_translation((0.3, 0.4, 1.6))
    trimesh.util.concatenate([box, ball]).export(tmp_path / f"mesh{suffix}")
    config = tiny.write_config(tmp_path, 4, scene={"file": f"mesh{suffix}"})
    assert render(config, tmp_path / "seq") == 0
    assert_verifies(tmp_path / "seq")
    written = trimesh.load(tmp_path / "seq/scene.ply", force="mesh")
    assert len(written.faces) == len(box.faces) + len(ball.faces)


# --- motion ----------------------------------------------------------------------------------------------------------


def motion_of(folder: Path, first_s: float) -> Any:
    config = tiny.write_config(folder, 12)
    tiny.write_trajectory(folder / "motion.txt", 12, first_s=first_s)
    return load_motion(load_config(config))


def test_ordinary_stamps_stay_those_of_the_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "rsgen"):
        motion = motion_of(tmp_path, 999_000.25)
    assert motion.first_stamp == 999_000.25 and not caplog.messages


def test_unix_stamps_are_counted_from_the_first(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "rsgen"):
        motion = motion_of(tmp_path, 1_403_636_579.763555)
    assert motion.first_stamp == 0.0 and motion.last_stamp == pytest.approx(11 / 30, abs=1e-6)
    (message,) = caplog.messages
    assert "motion.txt" in message and "1403636579.76355" in message
    np.testing.assert_allclose(motion.spline.pose(0.0)[:3, 3], tiny.poses(12)[0, 1:4], atol=1e-3)


def test_euroc_stamps_render_and_verify(tmp_path: Path) -> None:
    rows = tiny.poses(4)
    lines = [
        f"{1403636579763555584 + round(t * 1e9)},{x},{y},{z},{qw},{qx},{qy},{qz}"
        for t, x, y, z, qx, qy, qz, qw in rows.tolist()
    ]
    (tmp_path / "data.csv").write_text("\n".join(["#timestamp,p,q", *lines, ""]))
    config = tiny.write_config(tmp_path, 4, trajectory={"file": "data.csv"})
    assert render(config, tmp_path / "seq") == 0
    assert_verifies(tmp_path / "seq")
    assert read_sequence(tmp_path / "seq").streams["color"].stamps.tolist() == [0.0, 0.033333333, 0.066666667, 0.1]


def test_a_trajectory_is_placed_in_the_scene(tmp_path: Path) -> None:
    T = [[0.0, 0.0, 1.0, 0.5], [0.0, 1.0, 0.0, -0.25], [-1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]]
    config = tiny.write_config(tmp_path, 12)
    plain = load_motion(load_config(config)).spline
    placed = load_motion(load_config(config, {"trajectory.T_world_file": yaml.safe_dump(T)})).spline
    t = np.linspace(0.0, 0.3, 7)
    np.testing.assert_allclose(placed.pose(t), np.array(T) @ plain.pose(t), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "expected"),
    [(None, range(10)), ("2:4", range(2, 4)), (":3", range(3)), ("7:", range(7, 10)), ("5", range(5, 6)),
     (":", range(10)), ("8:99", range(8, 10))],
)  # fmt: skip
def test_frames_are_parsed(text: str | None, expected: range) -> None:
    assert range(*parse_frames(text).indices(10)) == expected


@pytest.mark.parametrize("text", ["", "a", "1:b", "-1", "-3:2", "4:4", "4:2", "1:2:3", "1.5:3", ":0", "1,2", "nan"])
def test_nonsense_frames_are_refused(text: str) -> None:
    with pytest.raises(UserError, match="--frames"):
        parse_frames(text)


# --- pictures --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shapes", [((30, 40), (30, 40)), ((30, 40), (24, 20)), ((40, 10), (10, 40))])
@pytest.mark.parametrize("distance", [0.0, 2.0])
def test_pictures_bear_any_sizes_and_views_of_nothing(
    tmp_path: Path, shapes: tuple[tuple[int, int], tuple[int, int]], distance: float
) -> None:
    from rsgen.figures import save
    from rsgen.pictures.frames import comparison, preview

    color = [np.full((*shapes[0], 3), 90, np.uint8)] * 2
    depth = [np.full(shapes[1], distance, np.float32)] * 2
    save(preview(color, depth, "preview"), tmp_path / "p.png")
    save(comparison((color[0], color[1]), (depth[0], depth[1]), "comparison"), tmp_path / "c.png")
    assert all(cv2.imread(str(tmp_path / name)).std() > 10 for name in ("p.png", "c.png"))
