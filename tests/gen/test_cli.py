"""The command line: help that teaches, overrides, and one line for everything that is wrong, with nothing lost."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny
import yaml

from rsgen.cli.main import main
from rsgen.config.config import describe_fields
from rsgen.files import encode_npz

ROOT = Path(__file__).parents[2]
COMMANDS = ("configs", "render", "fit", "info", "verify", "compare", "preview", "check-light", "bench")


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with tiny.yaml, scene.xml, paper.png, motion.txt and the rendered sequence seq/."""
    folder = tmp_path_factory.mktemp("cli")
    config = tiny.write_config(folder, 5)
    assert main(["render", str(config), "--out", str(folder / "seq"), "--quiet"]) == 0
    return folder


@pytest.fixture
def place(original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it to break, as the working directory."""
    shutil.copytree(original, tmp_path / "w")
    monkeypatch.chdir(tmp_path / "w")
    return tmp_path / "w"


def run(capfd: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    capfd.readouterr()
    status = main(words)
    return status, *capfd.readouterr()


def refused(capfd: pytest.CaptureFixture[str], words: str | list[str], *parts: str) -> str:
    """Run a command line that has to fail: status 2, nothing on stdout, one line that names the culprit."""
    status, out, error = run(capfd, *(words.split() if isinstance(words, str) else words))
    assert status == 2 and out == ""
    assert error.startswith("rsgen: ") and error.count("\n") == 1 and "Traceback" not in error, error
    for part in parts:
        assert part in error, error
    return error


# --- help ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        main([command, "--help"])
    out, error = capfd.readouterr()
    assert exit.value.code == 0 and error == ""
    assert f"example: rsgen {command}" in out


@pytest.mark.parametrize("command", ["render", "check-light", "bench"])
def test_help_lists_every_field_of_the_config(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = " ".join(capfd.readouterr().out.split())
    fields = describe_fields()
    assert len(fields) > 35
    for name, _, description in fields:
        assert f"--{name} VALUE" in text
        assert "".join(description.split()) in "".join(text.split())


def test_the_main_help_lists_every_command(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        main(["--help"])
    text = capfd.readouterr().out
    assert exit.value.code == 0 and all(f"  {command}" in text for command in COMMANDS)
    assert "rsgen render demo" in text


# --- what is given in the wrong way ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("", ["COMMAND"]),
        ("paint", ["paint"]),
        ("render", ["config"]),
        ("render tiny.yaml surplus", ["surplus"]),
        ("render tiny.yaml --out", ["--out"]),
        ("render tiny.yaml --colour.spp 3", ["--colour.spp"]),
        ("render tiny.yaml --color.sp 3", ["--color.sp"]),  # no guessing from a beginning
        ("render tiny.yaml --color.spp", ["--color.spp"]),
        ("render tiny.yaml color.spp=3", ["color.spp=3"]),
        ("render tiny.yaml --color.spp many", ["color.spp", "many"]),
        ("render tiny.yaml --color.spp=", ["color.spp"]),
        ("render tiny.yaml --color.spp [", ["color.spp", "["]),
        ("render tiny.yaml --color.spp 0", ["color.spp"]),
        ("render tiny.yaml --color.width 4", ["color.width"]),
        ("render tiny.yaml --depth.readout_s -0.01", ["depth.readout_s", "-0.01"]),
        ("render tiny.yaml --color.exposure_s .nan", ["color.exposure_s"]),
        ("render tiny.yaml --color.intrinsics [0,0,0,0]", ["color", "fx"]),
        ("render tiny.yaml --color.intrinsics [40,40]", ["color.intrinsics"]),
        ("render tiny.yaml --color.model radtan --color.distortion [0.1]", ["color", "radtan"]),
        ("render tiny.yaml --color.model radtan --color.distortion [-2,0,0,0]", ["color: distortion", "(-0.5, -0.5)"]),
        ("render tiny.yaml --depth.model fisheye --depth.distortion [0,0,0,0] --depth.intrinsics [9,9,23.5,17.5]",
         ["depth: distortion", "fisheye"]),
        ("render tiny.yaml --depth.scan sideways", ["depth.scan", "sideways"]),
        ("render tiny.yaml --light.mode dark", ["light.mode", "dark"]),
        ("render tiny.yaml --T_color_depth [[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]", ["T_color_depth", "rigid"]),
        ("render tiny.yaml --seed -1", ["seed"]),
        ("render tiny.yaml --backend metal", ["backend", "metal"]),
        ("render tiny.yaml --color.offset_s 99", ["offset_s"]),
        ("render tiny.yaml --color.offset_s -1e9", ["spline", "long"]),
        ("render tiny.yaml --color.offset_s -abc", ["--color.offset_s"]),
        ("render tiny.yaml --color.rate_hz 1e9", ["rate_hz"]),
        ("render tiny.yaml --trajectory.knot_spacing_s 1e-7", ["knot spacing"]),
        ("render tiny.yaml --frames x", ["--frames x"]),
        ("render tiny.yaml --frames 3:1", ["--frames 3:1"]),
        ("render tiny.yaml --frames 5:9", ["--frames", "no frame 5", "0 to 4"]),
        ("render nowhere.yaml", ["nowhere.yaml"]),
        ("render seq", ["seq", "cannot be read"]),
        ("render paper.png", ["paper.png", "not a text file"]),
        ("render motion.txt", ["motion.txt"]),
        ("render scene.xml", ["scene.xml"]),
        ("render tiny.yaml --trajectory.file nowhere.txt", ["nowhere.txt"]),
        ("render tiny.yaml --trajectory.file seq", ["trajectory seq"]),
        ("render tiny.yaml --trajectory.file paper.png", ["paper.png", "not a text file"]),
        ("render tiny.yaml --trajectory.file scene.xml", ["scene.xml", "web page"]),
        ("render tiny.yaml --scene.file nowhere.xml --out new", ["nowhere.xml"]),
        ("render tiny.yaml --scene.file nowhere.ply --out new", ["nowhere.ply"]),
        ("render tiny.yaml --scene.file motion.txt --out new", ["scene motion.txt"]),
        ("render tiny.yaml --scene.file seq --out new", ["scene seq"]),
        ("render tiny.yaml --out paper.png", ["paper.png", "is a file"]),
        ("render tiny.yaml --out paper.png/seq", ["paper.png/seq"]),
        ("render tiny.yaml --out .", ["holds other files"]),
        ("render tiny.yaml --out seq --color.spp 5", ["seq", "color.spp"]),
        ("compare seq --frame 1 --out c.xyz", ["c.xyz", ".png"]),
        ("fit nowhere.txt", ["nowhere.txt"]),
        ("fit paper.png", ["paper.png"]),
        ("fit motion.txt --dt 0", ["knot spacing"]),
        ("fit motion.txt --dt -1", ["knot spacing"]),
        ("fit motion.txt --dt nan", ["knot spacing"]),
        ("fit motion.txt --dt inf", ["knot spacing"]),
        ("fit motion.txt --dt 1e-9", ["knot spacing"]),
        ("fit motion.txt --dt soon", ["--dt", "soon"]),
        ("fit motion.txt --smoothing -1", ["smoothing"]),
        ("fit motion.txt --format doc", ["--format", "doc"]),
        ("fit motion.txt --format icl", ["motion.txt:3", "frame index"]),
        ("fit motion.txt --plot paper.png/fit.png", ["paper.png"]),
        ("info nowhere", ["nowhere"]),
        ("info paper.png", ["paper.png"]),
        ("info .", ["sequence.yaml"]),
        ("compare seq", ["--frame"]),
        ("compare seq --frame 5", ["no color frame 5", "0 to 4"]),
        ("compare seq --frame -1", ["frame -1"]),
        ("compare seq --frame two", ["two"]),
        ("compare seq --frame 1 --scene nowhere.xml", ["nowhere.xml"]),
        ("compare nowhere --frame 1", ["nowhere"]),
        ("preview nowhere", ["nowhere"]),
        ("preview seq --count 0", ["--count", "at least 1"]),
        ("preview seq --out seq", ["seq: "]),
        ("verify", ["sequence"]),
        ("verify seq --pairs x", ["--pairs", "x"]),
        ("verify seq --pairs -1", ["--pairs"]),
        ("check-light tiny.yaml --color.spp 0", ["color.spp"]),
        ("check-light tiny.yaml color.spp=3", ["color.spp=3"]),
        ("check-light tiny.yaml --light.mode path", ["light.mode"]),
        ("check-light tiny.yaml --width 7", ["--width 7"]),
        ("check-light tiny.yaml --width 4000", ["--width 4000"]),
        ("check-light tiny.yaml --views 0", ["--views"]),
        ("check-light tiny.yaml --spp 0", ["--spp"]),
        ("check-light nowhere.yaml", ["nowhere.yaml"]),
        ("bench tiny.yaml --nonsense 3", ["--nonsense"]),
        ("bench tiny.yaml --light.mode path", ["light.mode"]),
        ("bench tiny.yaml --trajectory.file nowhere.txt", ["nowhere.txt"]),
        ("bench tiny.yaml --frames 0", ["--frames"]),
        ("bench tiny.yaml --spp 0", ["--spp"]),
    ],
)  # fmt: skip
def test_wrong_words_give_one_line_and_change_nothing(
    place: Path, capfd: pytest.CaptureFixture[str], words: str, parts: list[str]
) -> None:
    before = tiny.digests(place / "seq")
    refused(capfd, words, *parts)
    assert tiny.digests(place / "seq") == before


# --- files that are wrong --------------------------------------------------------------------------------------------


def lines_of(path: Path) -> list[str]:
    return path.read_text().splitlines(keepends=True)


def replaced(name: str, text: str | bytes) -> Callable[[], object]:
    return lambda: Path(name).write_bytes(text if isinstance(text, bytes) else text.encode())


def edited(name: str, old: str, new: str) -> Callable[[], object]:
    def edit() -> None:
        text = Path(name).read_text()
        assert old in text
        Path(name).write_text(text.replace(old, new, 1))

    return edit


def field(section: str, **values: Any) -> Callable[[], object]:
    def edit() -> None:
        data = yaml.safe_load(Path("tiny.yaml").read_text())
        data[section].update(values)
        Path("tiny.yaml").write_text(yaml.safe_dump(data))

    return edit


def truncate_trajectory() -> None:
    text = Path("motion.txt").read_text()
    Path("motion.txt").write_text(text[: len(text) - 40])


def reverse_trajectory() -> None:
    Path("motion.txt").write_text("".join(reversed(lines_of(Path("motion.txt")))))


def unreadable(name: str) -> Callable[[], object]:
    """A link to itself: not even root can read that."""

    def make() -> None:
        Path(name).unlink()
        Path(name).symlink_to(name)

    return make


INPUTS: dict[str, tuple[Callable[[], object], list[str]]] = {
    "trajectory empty": (replaced("motion.txt", ""), ["motion.txt", "no poses"]),
    "trajectory cut off": (truncate_trajectory, ["motion.txt:6"]),
    "trajectory of a pose": (replaced("motion.txt", "0 0 0 0 0 0 0 1\n"), ["motion.txt", "1 poses"]),
    "trajectory backwards": (reverse_trajectory, ["motion.txt:2", "back in time"]),
    "trajectory of bytes": (replaced("motion.txt", b"\xff\xfe\x00\x01"), ["motion.txt"]),
    "trajectory in Latin-1": (replaced("motion.txt", b"# caf\xe9\n"), ["motion.txt:1"]),
    "trajectory unreadable": (unreadable("motion.txt"), ["motion.txt"]),
    "trajectory far away": (edited("motion.txt", "0.033333333 0.0", "0.033333333 23456.0"), ["motion.txt:3", " m:"]),
    "trajectory with NaN": (edited("motion.txt", "0.033333333 ", "0.033333333 nan "), ["motion.txt:3"]),
    "trajectory with infinity": (edited("motion.txt", "0.066666667 0.0", "0.066666667 1e999"), ["motion.txt:4"]),
    "scene not XML": (replaced("scene.xml", "<scene"), ["scene.xml"]),
    "scene empty": (replaced("scene.xml", ""), ["scene.xml"]),
    "scene of bytes": (replaced("scene.xml", b"\xff\x00\xfe"), ["scene.xml"]),
    "scene unreadable": (unreadable("scene.xml"), ["scene.xml"]),
    "scene without shapes": (replaced("scene.xml", '<scene version="3.0.0"></scene>'), ["scene.xml"]),
    "scene of an unknown plugin": (edited("scene.xml", 'type="sphere"', 'type="blob"'), ["scene.xml", "blob"]),
    "scene with an unknown property": (edited("scene.xml", 'name="radius"', 'name="radios"'), ["scene.xml", "radios"]),
    "scene with a missing texture": (lambda: Path("paper.png").unlink(), ["scene.xml", "paper.png"]),
    "scene with a broken texture": (replaced("paper.png", b"\x89PNG\r\n\x1a\n1234"), ["scene.xml"]),
    "scene with a broken reference": (edited("scene.xml", '<ref id="paper"/>', '<ref id="stone"/>'), ["stone"]),
    "mesh empty": (lambda: (replaced("m.ply", "")(), field("scene", file="m.ply")()), ["m.ply"]),
    "mesh not one": (lambda: (replaced("m.obj", "hello\n")(), field("scene", file="m.obj")()), ["m.obj"]),
    "config not YAML": (replaced("tiny.yaml", "name: [\n"), ["tiny.yaml", "YAML"]),
    "config a list": (replaced("tiny.yaml", "- 1\n"), ["tiny.yaml", "mapping"]),
    "config empty": (replaced("tiny.yaml", ""), ["tiny.yaml"]),
    "config of bytes": (replaced("tiny.yaml", b"name: \xff\xfe\n"), ["tiny.yaml", "not a text file"]),
    "config unreadable": (unreadable("tiny.yaml"), ["tiny.yaml", "cannot be read"]),
    "config without a scene": (edited("tiny.yaml", "scene:\n  file: scene.xml\n", ""), ["tiny.yaml", "scene: is req"]),
    "config with an unknown field": (field("color", colour=1), ["tiny.yaml", "color.colour: no such field"]),
    "config with a wrong type": (field("color", width="wide"), ["tiny.yaml", "color.width"]),
    "config with a negative readout": (field("depth", readout_s=-0.1), ["tiny.yaml", "depth.readout_s"]),
    "config with zero intrinsics": (field("color", intrinsics=[0, 0, 0, 0]), ["tiny.yaml", "color"]),
    "config named after a folder above": (edited("tiny.yaml", "name: tiny", "name: ../up"), ["tiny.yaml", "name"]),
}  # fmt: skip


@pytest.mark.parametrize("fault", INPUTS)
def test_wrong_inputs_give_one_line_that_names_the_file(
    place: Path, capfd: pytest.CaptureFixture[str], fault: str
) -> None:
    spoil, parts = INPUTS[fault]
    before = tiny.digests(place / "seq")
    spoil()
    refused(capfd, "render tiny.yaml --out seq --quiet")  # some of them as another scene than that of the sequence
    assert tiny.digests(place / "seq") == before
    refused(capfd, "render tiny.yaml --out new --quiet", *parts)
    assert not (place / "new").exists()
    refused(capfd, "bench tiny.yaml --frames 1 --spp 1", *parts)


def truncate(name: str) -> Callable[[], object]:
    return lambda: os.truncate(name, Path(name).stat().st_size // 2)


def remove(name: str) -> Callable[[], object]:
    return lambda: Path(name).unlink()


SEQUENCES: dict[str, tuple[Callable[[], object], str, str]] = {
    # what breaks it, what verify has to name, the commands that have to refuse it
    "no description": (remove("seq/sequence.yaml"), "sequence.yaml", "info compare preview"),
    "description cut off": (lambda: os.truncate("seq/sequence.yaml", 300), "sequence.yaml", "info compare preview"),
    "description of bytes": (replaced("seq/sequence.yaml", b"\xff\xfe"), "sequence.yaml", "info compare preview"),
    "another format": (edited("seq/sequence.yaml", "rsgen-sequence/1", "rsgen-sequence/9"), "format", "info preview"),
    "no listing": (remove("seq/rgb.txt"), "rgb.txt", "info compare preview"),
    "listing empty": (replaced("seq/depth.txt", ""), "depth.txt", "info compare preview"),
    "listing leaves the folder": (
        edited("seq/rgb.txt", "rgb/000001.png", "../paper.png"), "rgb.txt line 4", "info compare preview"
    ),
    "no spline": (remove("seq/spline.npz"), "spline.npz", "info compare preview"),
    "spline cut off": (truncate("seq/spline.npz"), "spline.npz", "info compare preview"),
    "spline of NaN": (
        lambda: Path("seq/spline.npz").write_bytes(
            encode_npz({"control_points": np.full((8, 4, 4), np.nan), "t0": np.array(0.0), "dt": np.array(0.05)})
        ),
        "spline.npz", "info compare preview",
    ),
    "colour missing": (remove("seq/rgb/000001.png"), "rgb/000001.png", "info compare preview"),
    "colour cut off": (truncate("seq/rgb/000001.png"), "rgb/000001.png", "compare preview"),
    "colour of another kind": (replaced("seq/rgb/000001.png", "<html>"), "rgb/000001.png", "compare preview"),
    "depth missing": (remove("seq/depth/000001.png"), "depth/000001.png", "info compare preview"),
    "depth cut off": (truncate("seq/depth/000001.png"), "depth/000001.png", "preview"),
    "exact depth missing": (remove("seq/truth/depth/000001.exr"), "truth/depth/000001.exr", "compare"),
    "exact depth cut off": (truncate("seq/truth/depth/000001.exr"), "truth/depth/000001.exr", "compare"),
    "rows cut off": (truncate("seq/truth/rows_depth.npy"), "rows_depth.npy", ""),
    "no scene": (remove("seq/scene.ply"), "scene.ply", ""),
    "origin of bytes": (replaced("seq/origin.yaml", b"\xff\x00"), "", "compare"),
    "origin a list": (replaced("seq/origin.yaml", "- 1\n"), "", "compare"),
    "origin elsewhere": (replaced("seq/origin.yaml", "scene: /nowhere/s.xml\n"), "", "compare"),
    "config not one": (edited("seq/sequence.yaml", "\nconfig:", "\nconfig: 3\nother:"), "config", "compare"),
    "config lost": (edited("seq/sequence.yaml", "\nconfig:", "\nother:"), "config", "compare"),
}  # fmt: skip


@pytest.mark.parametrize("fault", SEQUENCES)
def test_damaged_sequences_are_refused_by_what_needs_the_damaged_file(
    place: Path, capfd: pytest.CaptureFixture[str], fault: str
) -> None:
    spoil, culprit, commands = SEQUENCES[fault]
    spoil()
    before = tiny.digests(place / "seq")
    words = {"info": "info seq", "compare": "compare seq --frame 1", "preview": "preview seq --count 9"}
    for command in commands.split():
        refused(capfd, words[command], culprit)
    if culprit:
        status, out, error = run(capfd, "verify", "seq")
        assert status == 1 and error == "" and "FAIL" in out and "Traceback" not in out
        assert culprit in " ".join(line for line in out.splitlines() if line.startswith("FAIL"))
    assert tiny.digests(place / "seq") == before


def test_verify_of_what_is_no_sequence_fails(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for path in ("nowhere", "paper.png", "."):
        status, out, error = run(capfd, "verify", path)
        assert status == 1 and error == "" and out.startswith("FAIL")


# --- disks that say no -----------------------------------------------------------------------------------------------


def test_a_full_disk_in_the_middle_loses_nothing_and_resumes(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    replace = os.replace

    def full(source: Any, target: Any) -> None:
        if Path(target).name == "000003.png":
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        error = refused(capfd, "render tiny.yaml --out new --quiet", "000003.png", "No space left", "resume")
    assert "free space" in error
    whole, part = tiny.digests(place / "seq"), tiny.digests(place / "new")
    assert {"rgb/000000.png", "rgb/000002.png", "truth/depth/000002.exr"} <= set(part)
    assert part.items() <= whole.items() and not any(name.endswith(".tmp") for name in part)
    assert run(capfd, "render", "tiny.yaml", "--out", "new", "--quiet")[0] == 0
    assert tiny.digests(place / "new") == whole


@pytest.mark.parametrize(
    "name", ["sequence.yaml", "spline.npz", "scene.ply", "rgb.txt", "groundtruth.txt", "rows_color.npy"]
)
def test_a_full_disk_at_any_other_file_resumes_too(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    replace = os.replace

    def full(source: Any, target: Any) -> None:
        if Path(target).name == name:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        refused(capfd, "render tiny.yaml --out new --quiet", name, "No space left")
    assert run(capfd, "render", "tiny.yaml", "--out", "new", "--quiet")[0] == 0
    assert tiny.digests(place / "new") == tiny.digests(place / "seq")


def test_a_folder_that_may_not_be_written_is_named(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(*_: Any, **__: Any) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "mkdir", denied)
        refused(capfd, "render tiny.yaml --out new --quiet", "new", "Permission denied", "writable")
    before = tiny.digests(place / "seq")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", denied)
        refused(capfd, "preview seq", "preview.png", "Permission denied")
        (place / "seq/rgb/000004.png").unlink()
        refused(capfd, "render tiny.yaml --out seq --quiet", "seq", "Permission denied", "writable")
    assert run(capfd, "render", "tiny.yaml", "--out", "seq", "--quiet")[0] == 0
    assert tiny.digests(place / "seq") == before


# --- what works ------------------------------------------------------------------------------------------------------


def test_check_light_and_bench_take_the_overrides_of_render(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (place / "motion.txt").rename("moved.txt")
    overrides = ["--trajectory.file", "moved.txt", "--light.texel_m=0.3"]
    words = ["check-light", *overrides, "tiny.yaml", "--views", "1", "--spp", "64", "--width", "24", "--out", "l.png"]
    status, out, _ = run(capfd, *words)
    assert status in (0, 1) and "PSNR" in out and Path("l.png").stat().st_size > 1000
    words = ["bench", "tiny.yaml", *overrides, "--frames", "1", "--spp", "2", "--mode", "still", "--mode", "rs-blur"]
    status, out, _ = run(capfd, *words)
    assert status == 0 and "against a still" in out


def test_overrides_may_come_in_any_order_and_the_last_one_counts(
    place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["--color.spp", "9", "--depth.offset_s", "-0.01", "tiny.yaml", "--color.spp=4", "--out", "o", "--quiet"]
    words += ["--color.model", "radtan", "--color.distortion", "[-0.1,0,0,0]", "--frames", "0:1"]
    assert run(capfd, "render", *words)[0] == 0
    config = yaml.safe_load(Path("o/sequence.yaml").read_text())["config"]
    assert config["color"]["spp"] == 4 and config["depth"]["offset_s"] == -0.01
    assert config["color"]["distortion"] == [-0.1, 0.0, 0.0, 0.0]


def test_fit_prints_its_report_as_text_json_and_picture(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capfd, "fit", "motion.txt", "--plot", "fit.png")
    assert status == 0 and "mm" in out and Path("fit.png").stat().st_size > 1000
    status, out, _ = run(capfd, "fit", "motion.txt", "--json")
    assert status == 0 and isinstance(yaml.safe_load(out), dict)


def test_progress_is_on_stderr_and_quiet_is_quiet(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    status, out, error = run(capfd, "render", "tiny.yaml", "--out", "a", "--color.spp", "2")
    assert status == 0 and out.count("\n") == 1 and "rendering 100 %" in error
    status, _, error = run(capfd, "render", "tiny.yaml", "--out", "b", "--color.spp", "2", "--quiet")
    assert status == 0 and error == ""


def child(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rsgen", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ | environment)


def test_a_missing_libllvm_is_one_line(place: Path) -> None:
    done = child("render", str(place / "tiny.yaml"), "--backend", "llvm", DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("rsgen: DRJIT_LIBLLVM_PATH=/nowhere/libLLVM.so ") and done.stderr.count("\n") == 1


def test_a_reader_that_goes_away_is_no_error(place: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "rsgen", "info", str(place / "seq")]
    done = subprocess.run(command, cwd=ROOT, stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")
