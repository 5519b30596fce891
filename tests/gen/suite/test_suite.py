"""Suites: what a definition stands for, whole sequences after a kill, manifests against sha256sum, truth held back."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from tiny import digests, write_config

from rsgen.cli.main import main
from rsgen.config.config import load_config
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_png
from rsgen.produce.generate import render_sequence
from rsgen.suite.definition import Definition, estimate, read_definition, suites_folder
from rsgen.suite.manifest import compare, record_files

ROOT = Path(__file__).parents[3]
HEAD: dict[str, Any] = {"format": "rsgen-suite/1", "name": "Tiny", "version": "1.0", "license": "CC-BY-4.0",
                        "about": "Of a tiny room"}  # fmt: skip
BOTH = ["color.readout_s", "depth.readout_s"]


def write_suite(folder: Path, *entries: dict[str, Any], **head: Any) -> Path:
    """suite definition s.yaml of entries of one tiny config, with that config beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    config = write_config(folder, frames=40)
    path = folder / "s.yaml"
    path.write_text(
        yaml.safe_dump({**HEAD, **head, "entries": [{"config": str(config), **entry} for entry in entries]})
    )
    return path


ENTRIES = (
    {"name": "piece", "tier": "small", "frames": 3, "start_s": 0.2, "set": {"imu": {}}},
    {"name": "row", "tier": "small", "role": "test", "group": "readout", "frames": 2, "width": 32,
     "ladder": {"fields": BOTH, "values_s": [0.0, 0.02]}},
    {"name": "lot", "tier": "lot", "frames": 2, "draw": {"count": 2, "seed": 3}},
)  # fmt: skip


@pytest.fixture(scope="module")
def definition(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_suite(tmp_path_factory.mktemp("suite"), *ENTRIES)


@pytest.fixture(scope="module")
def made(definition: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("suites") / "tiny"
    assert main(["suite", "render", str(definition), "--out", str(out), "--quiet"]) == 0
    return out


# --- definitions


def test_the_suites_that_ship_load_and_every_config_they_name_does() -> None:
    for path in suites_folder().glob("*.yaml"):
        suite = read_definition(path.stem)
        planned, skipped = suite.planned("small", (), None, None)
        names = {one.name for one in planned}
        assert not skipped and {"small_readout_0ms", "small_office"} <= names
        assert {one.entry.role for one in planned} == {"train", "test"}
        full, lacking = suite.planned("full", (), None, None)
        assert {line.partition(":")[0] for line in lacking} >= {f"lr_kt{k}" for k in range(4)}
        assert len({one.config.scene.file.resolve().parent for one in full}) == 3  # rooms


def test_a_ladder_sets_its_fields_and_a_lot_depends_on_seed_and_number_alone(definition: Path) -> None:
    suite = read_definition(str(definition))
    rows, _ = suite.planned(None, ["readout"], None, None)
    assert [one.name for one in rows] == ["row_0ms", "row_20ms"]
    assert [one.config.color.readout_s for one in rows] == [one.config.depth.readout_s for one in rows] == [0.0, 0.02]
    assert rows[0].config.color.width == 32 and rows[0].config.color.height == 24
    few, _ = suite.planned("lot", (), None, None)
    draw = suite.entries[2].draw
    assert draw is not None
    entry = suite.entries[2].model_copy(update={"draw": draw.model_copy(update={"count": 5})})
    many, _ = suite.model_copy(update={"entries": (entry,)}).planned("lot", (), None, None)
    assert [one.config for one in many[:2]] == [one.config for one in few]
    assert len({one.config.color.readout_s for one in many}) == 5


def test_test_seeds_change_test_sequences_alone(definition: Path) -> None:
    suite = read_definition(str(definition))
    own, secret, other = ({p.name: p.config.seed for p in suite.planned("small", (), None, s)[0]} for s in (None, 7, 8))
    assert own["piece"] == secret["piece"] and len({own["row_0ms"], secret["row_0ms"], other["row_0ms"]}) == 3


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ({"name": "a/b"}, "name"), ({"name": "a", "role": "val"}, "role"), ({"name": "a", "frames": 1}, "frames"),
        ({"name": "a", "draw": {"count": 1, "seed": 0}}, "draw: needs frames"), ({"name": "a", "speed": 2}, "speed"),
    ],
)  # fmt: skip
def test_entries_that_are_none_are_refused_in_one_line(tmp_path: Path, entry: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError, match=told) as error:
        read_definition(str(write_suite(tmp_path, entry)))
    assert "\n" not in str(error.value)


def test_what_is_not_there_is_named(definition: Path, tmp_path: Path) -> None:
    suite = read_definition(str(definition))
    with pytest.raises(UserError, match="has small, lot"):
        suite.planned("huge", (), None, None)
    with pytest.raises(UserError, match="no sequence of Tiny"):
        suite.planned(None, ["nothing*"], None, None)
    with pytest.raises(UserError, match="neither a file nor a suite that ships: rollingrooms"):
        read_definition("rollingroom")
    kt = write_suite(tmp_path, {"name": "kt", "data": {"trajectory.file": "kt.txt"}}, {"name": "b", "frames": 2})
    planned, skipped = read_definition(str(kt)).planned(None, (), tmp_path, None)
    assert [one.name for one in planned] == ["b"] and skipped[0].startswith(
        "kt: skipped: needs kt.txt, and it is not in"
    )
    shutil.copy(tmp_path / "motion.txt", tmp_path / "kt.txt")
    planned, skipped = read_definition(str(kt)).planned(None, (), tmp_path, None)
    assert planned[0].config.trajectory.file == (tmp_path / "kt.txt").resolve() and not skipped


# --- rendered


def test_a_stretch_is_the_motion_from_there_on(tmp_path: Path, made: Path) -> None:
    whole = render_sequence(
        load_config(write_config(tmp_path, frames=40)), tmp_path / "whole", slice(0, 1), no_progress
    )
    truth, piece = Spline.load(whole / "spline.npz"), Spline.load(made / "piece/spline.npz")
    t = np.linspace(0.0, 2 / 30, 9)
    np.testing.assert_allclose(piece.pose(t), truth.pose(0.2 + t), atol=1e-5)  # fitted with other ends
    assert len((made / "piece/rgb.txt").read_text().splitlines()) == 2 + 3  # two lines of head
    assert piece.t_end - piece.t_begin < 0.4


def test_sequences_of_a_suite_are_those_that_render_makes(definition: Path, made: Path, tmp_path: Path) -> None:
    planned, _ = read_definition(str(definition)).planned(None, (), None, None)
    for one in planned[1:4]:  # not the first of the scene: scene and light were loaded for another
        alone = render_sequence(one.config, tmp_path / one.name, slice(None), no_progress)
        assert digests(alone) == digests(made / one.name)


def test_the_manifest_agrees_with_sha256sum(made: Path) -> None:
    manifest = json.loads((made / "manifest.json").read_text())
    files = {path.relative_to(made).as_posix() for path in made.rglob("*") if path.is_file()}
    assert files == set(manifest["files"]) | {"manifest.json"}
    listed = "".join(f"{record['sha256']}  {name}\n" for name, record in manifest["files"].items())
    subprocess.run(["sha256sum", "--check", "--strict", "--quiet"], input=listed.encode(), cwd=made, check=True)
    assert all((made / name).stat().st_size == record["size"] for name, record in manifest["files"].items())
    kinds = {name.removeprefix("piece/"): r["match"] for name, r in manifest["files"].items() if name[:5] == "piece"}
    assert kinds["rgb/000000.png"] == "image" and kinds["depth/000000.png"] == "sensor"
    assert kinds["truth/depth/000000.exr"] == "depth" and kinds["rgb.txt"] == kinds["associations.txt"] == "exact"
    assert kinds["spline.npz"] == kinds["truth/rows_color.npy"] == kinds["imu.csv"] == "numbers"
    assert set(kinds.values()) <= set(manifest["rules"])


def test_suite_yaml_names_every_sequence_with_tier_and_role(made: Path) -> None:
    suite = yaml.safe_load((made / "suite.yaml").read_text())
    entries = {entry["name"]: entry for entry in suite["entries"]}
    folders = {path.name for path in made.iterdir() if path.is_dir()}
    assert set(entries) == folders == {"piece", "row_0ms", "row_20ms", "lot_000000", "lot_000001"}
    assert (entries["row_20ms"]["tier"], entries["row_20ms"]["role"]) == ("small", "test")
    assert entries["row_20ms"]["readout_ms"] == {"color": 20.0, "depth": 20.0} and suite["version"] == "1.0"


@pytest.mark.nightly
def test_killed_at_any_moment_the_same_command_makes_the_same_bytes(
    definition: Path, made: Path, tmp_path: Path
) -> None:
    out = tmp_path / "killed"
    words = [sys.executable, "-m", "rsgen", "suite", "render", str(definition), "--out", str(out), "--quiet"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    kills = 0
    for after in (1, 12, 25):  # files, counted from the start
        child = subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL)
        before = len(list(out.rglob("*")))
        while child.poll() is None and len(list(out.rglob("*"))) < before + after:
            time.sleep(0.002)
        if child.poll() is None:
            child.send_signal(signal.SIGKILL)
            kills += 1
        child.wait()
    assert kills >= 2
    subprocess.run(words, env=environment, check=True, capture_output=True)
    assert digests(out) == digests(made)


def test_a_second_run_makes_nothing_and_a_deleted_sequence_comes_back(
    definition: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = shutil.copytree(made, tmp_path / "copy")
    words = ["suite", "render", str(definition), "--out", str(out), "--quiet"]
    stamps = {path: path.stat().st_mtime_ns for path in out.glob("*/*")}
    assert main(words) == 0 and "0 of them new" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/*")} == stamps
    shutil.rmtree(out / "row_0ms")
    assert main(words) == 0 and "1 of them new" in capsys.readouterr().out
    assert digests(out) == digests(made)
    assert main([*words[:2], str(write_suite(tmp_path / "o", *ENTRIES, version="1.1")), *words[3:]]) == 2
    assert "holds another suite (Tiny 1.0)" in capsys.readouterr().err


def test_a_part_and_then_the_rest_is_the_whole(definition: Path, made: Path, tmp_path: Path) -> None:
    words = ["suite", "render", str(definition), "--out", str(tmp_path / "parts"), "--quiet"]
    assert main([*words, "--only", "row*"]) == 0
    assert {path.name for path in (tmp_path / "parts").iterdir() if path.is_dir()} == {"row_0ms", "row_20ms"}
    assert main(words) == 0
    assert digests(tmp_path / "parts") == digests(made)


# --- checked


def test_every_fault_of_a_copy_is_a_line(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = shutil.copytree(made, tmp_path / "copy")
    assert main(["suite", "verify", str(copy)]) == 0
    (copy / "piece/rgb/000000.png").unlink()
    with (copy / "piece/rgb.txt").open("a") as file:
        file.write("\n")
    data = bytearray((copy / "row_0ms/spline.npz").read_bytes())
    data[-100] ^= 1
    (copy / "row_0ms/spline.npz").write_bytes(data)
    capsys.readouterr()
    assert main(["suite", "verify", str(copy)]) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "piece/rgb.txt: has {} bytes, not {}".format(*(
        (folder / "piece/rgb.txt").stat().st_size for folder in (copy, made)
    ))  # fmt: skip
    assert told[1:3] == ["piece/rgb/000000.png: is missing", "row_0ms/spline.npz: has the right size and other bytes"]
    assert len(told) == 4 and "3 faults" in told[3]


def test_another_rendering_matches_within_its_rules(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = shutil.copytree(made, tmp_path / "other")
    rng = np.random.default_rng(0)
    image = other / "piece/rgb/000000.png"
    pixels = cv2.imread(str(image))
    assert pixels is not None
    cv2.imwrite(str(image), (pixels.astype(int) + rng.integers(-1, 2, pixels.shape)).clip(0, 255).astype(np.uint8))
    described = other / "piece/sequence.yaml"
    described.write_text(described.read_text().replace("numpy: ", "numpy: 9"))
    shown = made / "piece/truth/rows_color.npy"
    np.save(other / "piece/truth/rows_color.npy", np.load(shown) + 1e-10)
    assert main(["suite", "verify", str(made), "--against", str(other)]) == 0
    cv2.imwrite(str(image), pixels // 2)
    np.save(other / "piece/truth/rows_color.npy", np.load(shown) + 1e-4)
    described.write_text(described.read_text().replace("seed: 0", "seed: 1"))
    listing = other / "piece/rgb.txt"
    listing.write_text(listing.read_text().replace("0.000000000", "0.000000001"))
    (other / "row_0ms/scene.ply").write_bytes(b"ply")
    shutil.copy(made / "row_0ms/depth/000000.png", other / "piece/depth/000000.png")
    shutil.copy(made / "row_20ms/truth/depth/000001.exr", other / "row_20ms/truth/depth/000000.exr")
    capsys.readouterr()
    assert main(["suite", "verify", str(made), "--against", str(other)]) == 1
    told = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines()[:-1])
    assert set(told) == {
        "piece/rgb/000000.png", "piece/truth/rows_color.npy", "piece/sequence.yaml", "piece/rgb.txt",
        "piece/depth/000000.png", "row_20ms/truth/depth/000000.exr", "row_0ms/scene.ply",
    }  # fmt: skip
    assert "PSNR" in told["piece/rgb/000000.png"] and told["piece/truth/rows_color.npy"] == "differs by 0.0001"


def test_truth_that_is_held_back_is_elsewhere_and_whole(definition: Path, tmp_path: Path) -> None:
    out, truth = tmp_path / "out", tmp_path / "truth"
    words = ["suite", "render", str(definition), "--out", str(out), "--quiet", "--only", "row*", "piece",
             "--hold-back-truth", str(truth), "--test-seed", "99"]  # fmt: skip
    assert main(words) == 0
    left = {path.name for path in (out / "row_20ms").iterdir()}
    assert left == {"rgb", "depth", "rgb.txt", "depth.txt", "associations.txt", "camera.yaml"}
    camera = yaml.safe_load((out / "row_20ms/camera.yaml").read_text())
    assert camera["color"]["readout_s"] == 0.02 and camera["depth"]["width"] == 48 * 32 // 48
    assert (truth / "row_20ms/spline.npz").is_file() and (truth / "row_20ms/truth/depth/000000.exr").is_file()
    assert (out / "piece/spline.npz").is_file() and not (truth / "piece").exists()
    assert main(["suite", "verify", str(out)]) == 0 and main(["suite", "verify", str(truth)]) == 0
    before = digests(out)
    assert main(words) == 0 and digests(out) == before
    published = b"".join(path.read_bytes() for path in out.rglob("*.yaml"))
    assert b"fingerprint" in published and b"99" not in (out / "suite.yaml").read_bytes().split(b"fingerprint")[0]


# --- described


def test_the_card_has_front_matter_and_croissant_metadata(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = shutil.copytree(made, tmp_path / "copy")
    assert main(["suite", "card", str(copy)]) == 0
    head, _, text = (copy / "README.md").read_text().removeprefix("---\n").partition("\n---\n")
    front = yaml.safe_load(head)
    assert front["license"] == "cc-by-4.0" and front["size_categories"] == ["n<1K"]
    assert {c["config_name"] for c in front["configs"]} == {"small", "lot"}
    for config in front["configs"]:
        for split in config["data_files"]:
            assert all(any(copy.glob(pattern)) for pattern in split["path"])
    for name in ("piece", "row_0ms", "lot_000001"):
        picture = cv2.imread(str(copy / "thumbnails" / f"{name}.jpg"))
        assert picture is not None and picture.shape[1] == 240 and f"thumbnails/{name}.jpg" in text
    croissant = json.loads((copy / "croissant.json").read_text())
    assert croissant["conformsTo"] == "http://mlcommons.org/croissant/1.0" and croissant["@type"] == "sc:Dataset"
    assert {"name", "description", "license", "url", "version", "distribution", "recordSet"} <= set(croissant)
    ids = [item["@id"] for item in croissant["distribution"]]
    for item in croissant["distribution"]:
        assert {"@type", "@id", "encodingFormat"} <= set(item)
        if item["@type"] == "cr:FileObject":
            found = subprocess.run(["sha256sum", copy / item["contentUrl"]], capture_output=True, text=True, check=True)
            assert found.stdout.split()[0] == item["sha256"]
        else:
            assert any(copy.glob(item["includes"]))
    for records in croissant["recordSet"]:
        names = {field["@id"] for field in records["field"]}
        assert all(name.startswith(records["@id"] + "/") for name in names)
        assert all(set(row) == names for row in records.get("data", []))
        sources = {field["source"]["fileSet"]["@id"] for field in records["field"] if "source" in field}
        assert sources <= set(ids) and all(f["dataType"].startswith("sc:") for f in records["field"])
    assert len(croissant["recordSet"][0]["data"]) == 5


def test_an_estimate_counts_the_images_that_will_be_there(definition: Path, made: Path) -> None:
    suite = Definition.model_validate(yaml.safe_load(definition.read_text()))
    planned, _ = suite.planned(None, (), None, None)
    guess = estimate(one.config for one in planned)
    images = [path for path in made.rglob("*.png") if "truth" not in path.parts]
    assert guess.frames == len(images) and guess.seconds > 0


def test_labels_match_by_the_thing_not_by_its_number(tmp_path: Path) -> None:
    """A neighbouring id is another thing, though 16-bit depth would call two units alike."""
    labels = np.full((20, 30), 7, np.uint16)
    for name, image in (("a", labels), ("b", labels + np.uint16(1)), ("c", np.where(np.eye(20, 30) > 0, 8, 7))):
        path = tmp_path / name / "truth/depth_labels/000000.png"
        path.parent.mkdir(parents=True)
        path.write_bytes(encode_png(image.astype(np.uint16)))
    files = record_files(tmp_path / "a")
    assert [record.match for record in files.values()] == ["labels"]
    assert compare(tmp_path / "a", tmp_path / "a", files) == []
    for other, share in (("b", "0.00 %"), ("c", "96.67 %")):
        (fault,) = compare(tmp_path / "a", tmp_path / other, files)
        assert share in fault and "the same thing" in fault
