"""The command line: overrides, and one line for everything that is wrong, with nothing lost."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import tiny
import yaml
from cli_faults import INPUTS, SEQUENCES

from rsgen.cli.main import main

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with tiny.yaml, scene.xml, paper.png, motion.txt and the rendered sequence seq/."""
    folder = tmp_path_factory.mktemp("cli")
    config = tiny.write_config(folder, 5)
    assert main(["render", str(config), "--out", str(folder / "seq"), "--quiet"]) == 0
    return folder


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
        ("preview seq --frame 1 --out c.xyz", ["c.xyz", ".png"]),
        ("motion fit nowhere.txt", ["nowhere.txt"]),
        ("motion fit paper.png", ["paper.png"]),
        ("motion fit motion.txt --dt 0", ["knot spacing"]),
        ("motion fit motion.txt --dt -1", ["knot spacing"]),
        ("motion fit motion.txt --dt nan", ["knot spacing"]),
        ("motion fit motion.txt --dt inf", ["knot spacing"]),
        ("motion fit motion.txt --dt 1e-9", ["knot spacing"]),
        ("motion fit motion.txt --dt soon", ["--dt", "soon"]),
        ("motion fit motion.txt --smoothing -1", ["smoothing"]),
        ("motion fit motion.txt --format doc", ["--format", "doc"]),
        ("motion fit motion.txt --format icl", ["motion.txt:3", "frame index"]),
        ("motion fit motion.txt --plot paper.png/fit.png", ["paper.png"]),
        ("info nowhere", ["nowhere"]),
        ("info paper.png", ["paper.png"]),
        ("info .", ["sequence.yaml"]),
        ("preview seq --frame 5", ["no color frame 5", "0 to 4"]),
        ("preview seq --frame -1", ["frame -1"]),
        ("preview seq --frame two", ["two"]),
        ("preview seq --frame 1 --scene nowhere.xml", ["nowhere.xml"]),
        ("preview nowhere --frame 1", ["nowhere"]),
        ("preview nowhere", ["nowhere"]),
        ("preview seq --count 0", ["--count", "at least 1"]),
        ("preview seq --out seq", ["seq: "]),
        ("preview", ["SEQ|MESH"]),
        ("preview seq seq", ["more than one sequence"]),
        ("preview seq --grey", ["--grey", "a sequence"]),
        ("preview seq --from 0,1,2", ["--from", "a sequence"]),
        ("preview seq --scene scene.xml", ["--scene", "without --frame"]),
        ("preview seq --frame 1 --count 3", ["--count", "one --frame"]),
        ("preview seq/scene.ply", ["--out"]),
        ("preview seq/scene.ply --out p.png --frame 0", ["--frame", "meshes"]),
        ("preview seq/scene.ply --out p.png --from here", ["'here' is no point"]),
        ("preview seq nowhere.ply --out p.png", ["seq"]),
        ("preview paper.png --out p.png", ["paper.png", "no mesh"]),
        ("verify", ["sequence"]),
        ("verify seq --pairs x", ["--pairs", "x"]),
        ("verify seq --pairs -1", ["--pairs"]),
        ("verify seq --light 0", ["--light"]),
        ("verify seq --light-width 24", ["--light-width", "without --light"]),
        ("verify seq --scene scene.xml", ["--scene", "without --light"]),
        ("compare seq --frame 1", ["compare: is now 'rsgen preview SEQ --frame N'"]),
        ("picture --help", ["picture: is now 'rsgen preview MESH ... --out PNG'"]),
        ("configs", ["configs: is now 'rsgen scenes'"]),
        ("fit motion.txt", ["fit: is now 'rsgen motion fit FILE'"]),
        ("import-scene a.blend b", ["import-scene: is now 'rsgen import FILE OUT'"]),
        ("check-light tiny.yaml", ["check-light: is now 'rsgen verify SEQ --light N'"]),
    ],
)  # fmt: skip
def test_wrong_words_give_one_line_and_change_nothing(
    place: Path, capfd: pytest.CaptureFixture[str], words: str, parts: list[str]
) -> None:
    before = tiny.digests(place / "seq")
    refused(capfd, words, *parts)
    assert tiny.digests(place / "seq") == before


# --- files that are wrong --------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("fault", SEQUENCES)
def test_damaged_sequences_are_refused_by_what_needs_the_damaged_file(
    place: Path, capfd: pytest.CaptureFixture[str], fault: str
) -> None:
    spoil, culprit, commands = SEQUENCES[fault]
    spoil()
    before = tiny.digests(place / "seq")
    words = {"info": "info seq", "compare": "preview seq --frame 1", "preview": "preview seq --count 9"}
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


def test_verify_compares_baked_light_with_path_tracing(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["verify", "seq", "--light", "1", "--light-spp", "64", "--light-width", "24", "--light-picture", "l.png"]
    status, out, _ = run(capfd, *words)
    assert status in (0, 1) and "all checks passed" in out and "PSNR" in out
    assert status == (1 if "unsure" in out or "no\n" in out else 0) and Path("l.png").stat().st_size > 1000
    for wrong in ("7", "4000"):
        assert run(capfd, "verify", "seq", "--light", "1", "--light-width", wrong)[0] == 2
    Path("seq/origin.yaml").unlink()
    status, _, error = run(capfd, *words)
    assert status == 2 and "--scene" in error
    assert run(capfd, *words, "--scene", "scene.xml")[0] in (0, 1)


def test_light_of_one_frame_can_be_checked(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert (
        run(capfd, "render", "tiny.yaml", "--out", "one", "--frames", "0:1", "--light.texel_m=0.3", "--quiet")[0] == 0
    )
    status, out, _ = run(capfd, "verify", "one", "--light", "1", "--light-spp", "64", "--light-width", "24")
    assert status in (0, 1) and "PSNR" in out
    assert run(capfd, "render", "tiny.yaml", "--out", "path", "--frames", "0:1", "--light.mode=path", "--quiet")[0] == 0
    status, _, error = run(capfd, "verify", "path", "--light", "1")
    assert status == 2 and "light.mode" in error


def test_meshes_are_drawn(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = "preview seq/scene.ply seq/scene.ply --out m.png --label one --label two --width 64 --height 48 --quiet"
    status, out, error = run(capfd, *words.split())
    assert (status, out, error) == (0, "m.png\n", "") and Path("m.png").stat().st_size > 1000


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
    status, out, _ = run(capfd, "motion", "fit", "motion.txt", "--plot", "fit.png")
    assert status == 0 and "mm" in out and Path("fit.png").stat().st_size > 1000
    status, out, _ = run(capfd, "motion", "fit", "motion.txt", "--json")
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
