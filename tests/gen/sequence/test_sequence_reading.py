"""Sequence folders are read strictly: one line of text for every fault, with the file and the field."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import yaml

from rsgen.errors import UserError
from rsgen.files import encode_yaml
from rsgen.sequence.reader import read_sequence, sequence_info

FRAMES = 4


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.make_sequence(tmp_path_factory.mktemp("finished") / "seq", frames=FRAMES)


@pytest.fixture
def seq(finished: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(finished, tmp_path / "seq"))


def refused(root: Path, *parts: str) -> None:
    with pytest.raises(UserError) as error:
        read_sequence(root)
    text = str(error.value)
    assert "\n" not in text
    for part in parts:
        assert part in text


def test_what_is_missing_is_named(seq: Path) -> None:
    refused(seq.parent / "nowhere", "no such folder")
    refused(seq.parent, "no sequence.yaml")
    for name in ("rgb.txt", "depth.txt", "spline.npz", "rgb/000002.png", "depth/000001.png"):
        (seq / name).rename(seq / "away")
        refused(seq, name)
        (seq / "away").rename(seq / name)
    sequence = read_sequence(seq)
    for name, read in (
        ("truth/depth/000001.exr", lambda: sequence.truth_depth(1)),
        ("truth/rows_depth.npy", lambda: sequence.rows("depth")),
    ):
        (seq / name).unlink()
        with pytest.raises(UserError, match=name):
            read()


@pytest.mark.parametrize(
    ("edit", "parts"),
    [
        (lambda y: y.update(format="rsgen-sequence/3"), ["rsgen-sequence/3", "rsgen-sequence/1", "install a newer"]),
        (lambda y: y.update(format=3), ["format is 3", "rsgen-sequence/1", "is this a sequence"]),
        (lambda y: y.pop("streams"), ["streams"]),
        (lambda y: y["streams"].pop("depth"), ["streams.depth"]),
        (lambda y: y["streams"]["depth"].pop("depth_scale"), ["depth_scale"]),
        (lambda y: y["streams"]["depth"].update(depth_scale=0), ["streams.depth.depth_scale"]),
        (lambda y: y["streams"]["color"].update(rate_hz="fast"), ["streams.color.rate_hz"]),
        (lambda y: y["streams"]["color"].update(readout_s=-1.0), ["streams.color", "readout_s"]),
        (lambda y: y["streams"]["color"].update(intrinsics=[0.0, 1.0, 2.0, 3.0]), ["streams.color"]),
        (lambda y: y["streams"]["color"].update(distortion=[0.1]), ["streams.color"]),
        (lambda y: y["streams"]["color"].update(frames=2), ["rgb.txt line 5", "2 frames"]),
        (lambda y: y["streams"]["color"].update(first_stamp_s=1.0), ["rgb.txt line 3", "stamp"]),
        (lambda y: y["T_color_depth"].pop(), ["T_color_depth"]),
        (lambda y: y["T_color_depth"].__setitem__(0, [2.0, 0.0, 0.0, 0.0]), ["T_color_depth", "rigid"]),
    ],
)
def test_a_damaged_description_is_refused_and_the_field_named(seq: Path, edit: Any, parts: list[str]) -> None:
    data = yaml.safe_load((seq / "sequence.yaml").read_text())
    edit(data)
    (seq / "sequence.yaml").write_bytes(encode_yaml(data))
    refused(seq, "sequence.yaml" if "line" not in parts[0] else "", *parts)


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ("0.033333333", ["line 4", "stamp path"]),
        ("0.033333333 rgb/000001.png extra", ["line 4", "stamp path"]),
        ("soon rgb/000001.png", ["line 4", "soon"]),
        ("nan rgb/000001.png", ["line 4", "nan"]),
        ("0.000000000 rgb/000001.png", ["line 4", "does not come after"]),
        ("0.040000000 rgb/000001.png", ["line 4", "not that of frame 1"]),
        ("0.033333333 rgb/000002.png", ["line 4", "not that of frame 2"]),
        ("0.033333333 rgb/one.png", ["line 4", "not one of"]),
        ("0.033333333 ../outside/000001.png", ["line 4", "leaves"]),
        ("0.033333333 rgb/../../outside/000001.png", ["line 4", "leaves"]),
        ("0.033333333 OUTSIDE/000001.png", ["line 4", "leaves"]),
        ("0.033333333 link/000001.png", ["line 4", "leaves"]),
        ("0.033333333 rgb/\0.png", ["line 4"]),
    ],
)
def test_a_bad_listing_line_is_refused_and_named(seq: Path, line: str, parts: list[str]) -> None:
    outside = seq.parent / "outside"
    shutil.copytree(seq / "rgb", outside)
    (seq / "link").symlink_to(outside)
    shutil.copy(seq / "rgb/000001.png", seq / "rgb/one.png")
    lines = (seq / "rgb.txt").read_text().splitlines()
    lines[3] = line.replace("OUTSIDE", str(outside))
    (seq / "rgb.txt").write_text("\n".join(lines))
    refused(seq, "rgb.txt", *parts)


def test_a_sequence_behind_a_symbolic_link_is_fine(seq: Path) -> None:
    (seq.parent / "link").symlink_to(seq)
    assert len(read_sequence(seq.parent / "link").streams["color"].paths) == FRAMES


@pytest.mark.parametrize("name", ["sequence.yaml", "rgb.txt", "depth.txt", "spline.npz"])
def test_truncated_or_foreign_files_give_one_line(seq: Path, name: str) -> None:
    data = (seq / name).read_bytes()
    for broken in (b"", b"\0\xff\xfe" + data, data[: len(data) // 3], np.random.default_rng(0).bytes(2000)):
        (seq / name).write_bytes(broken)
        try:
            read_sequence(seq)  # a third of a listing is still a listing, of fewer frames
        except UserError as error:
            assert "\n" not in str(error) and name in str(error)
        else:
            assert name.endswith(".txt") and broken == data[: len(data) // 3]


def test_info(finished: Path) -> None:
    text = sequence_info(finished)
    for part in ("synthetic", "4 frames at 30 Hz", "64x48", "readout 28 ms", "583.333 us", "33 control points", "MB"):
        assert part in text


def test_neither_reading_nor_verifying_loads_mitsuba() -> None:
    code = "import sys, rsgen.sequence.reader, rsgen.check.verify\n"
    code += "print([m for m in sys.modules if m in ('mitsuba', 'drjit')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
