"""Sequence folders are written whole, or resumed to the same bytes, and nothing of another one is touched."""

from __future__ import annotations

import errno
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic

from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rsgen.produce.writer import SequenceWriter
from rsgen.sequence.format import stream_stamps

FRAMES = 4


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.make_sequence(tmp_path_factory.mktemp("finished") / "seq", frames=FRAMES)


@pytest.fixture
def seq(finished: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(finished, tmp_path / "seq"))


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_a_resumed_sequence_equals_an_uninterrupted_one_byte_for_byte(finished: Path, tmp_path: Path) -> None:
    """Frames in any order over several runs, listings written in between, a killed writer's leftovers."""
    root, order = tmp_path / "seq", list(range(FRAMES))
    random.Random(3).shuffle(order)
    for run, k in enumerate(order):
        writer = synthetic.open_writer(root, synthetic.make_config(), FRAMES)
        assert writer.missing("color") == sorted(order[run:]) == writer.missing("depth")
        synthetic.write_frames(writer, range(k, k + 1))
        if run % 2:
            writer.finish()
        (root / "rgb" / f".{k:06d}.png.{2**22 + 1}.tmp").write_bytes(b"half a file")
    synthetic.write_scene(root)
    synthetic.open_writer(root, synthetic.make_config(), FRAMES).finish()
    assert contents(root) == contents(finished)


def test_a_killed_process_leaves_a_sequence_that_resumes(finished: Path, tmp_path: Path) -> None:
    """SIGKILL at any moment once the first frames are there; the child writes them over and over to be hit at work."""
    root = tmp_path / "seq"
    code = (
        "import sys, pathlib, synthetic\n"
        f"writer = synthetic.open_writer(pathlib.Path(sys.argv[1]), synthetic.make_config(), {FRAMES})\n"
        "while True: synthetic.write_frames(writer, range(2)); print('written', flush=True)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "-c", code, str(root)], stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "written\n"
        process.kill()
    writer = synthetic.open_writer(root, synthetic.make_config(), FRAMES)
    assert writer.missing("color") == list(range(2, FRAMES)) == writer.missing("depth")
    synthetic.write_frames(writer)
    synthetic.write_scene(root)
    writer.finish()
    assert contents(root) == contents(finished)


def test_writing_again_changes_nothing(seq: Path) -> None:
    before = contents(seq)
    writer = synthetic.open_writer(seq, synthetic.make_config(), FRAMES)
    assert writer.missing("color") == [] == writer.missing("depth")
    writer.finish()
    assert contents(seq) == before


def test_an_empty_file_or_half_a_depth_frame_counts_as_missing(seq: Path) -> None:
    (seq / "rgb/000001.png").write_bytes(b"")
    (seq / "depth/000000.png").unlink()
    (seq / "truth/depth/000002.exr").unlink()
    writer = synthetic.open_writer(seq, synthetic.make_config(), FRAMES)
    assert (writer.missing("color"), writer.missing("depth")) == ([1], [0, 2])


def test_a_spline_that_differs_in_its_last_bits_is_replaced_by_the_stored_one(seq: Path) -> None:
    spline = synthetic.make_spline()
    points = np.array(spline.control_points)
    points[3, 0, 3] += 1e-13
    writer = synthetic.open_writer(seq, synthetic.make_config(), FRAMES, Spline(points, spline.t0, spline.dt))
    np.testing.assert_array_equal(writer.spline.control_points, spline.control_points)
    points[3, 0, 3] += 1e-6
    with pytest.raises(UserError, match="another trajectory"):
        synthetic.open_writer(seq, synthetic.make_config(), FRAMES, Spline(points, spline.t0, spline.dt))


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"depth": {"readout_s": 0.0}}, ["depth.readout_s", "0.028", "0.0"]),
        ({"color": {"spp": 64}}, ["color.spp", "16", "64"]),
        ({"width": 80}, ["color.width", "64", "80"]),
    ],
)
def test_another_config_is_refused_and_the_field_named(seq: Path, change: dict[str, Any], parts: list[str]) -> None:
    before = contents(seq)
    with pytest.raises(UserError) as error:
        synthetic.open_writer(seq, synthetic.make_config(**change), FRAMES)
    assert all(part in str(error.value) for part in [*parts, "--out", "delete"]) and "\n" not in str(error.value)
    assert contents(seq) == before


def test_other_inputs_versions_or_frame_counts_are_refused(seq: Path) -> None:
    config, spline = synthetic.make_config(), synthetic.make_spline()
    stamps = stream_stamps(0.0, synthetic.DURATION_S, config.color)[:FRAMES]
    good: dict[str, Any] = {"versions": {"synthetic": "1"}, "inputs": {"scene": "box"}}
    both = {"color": stamps, "depth": stamps}
    SequenceWriter.open(seq, config, spline, both, **good)
    for change, name in (({"versions": {"synthetic": "2"}}, "versions.synthetic"), ({"inputs": {}}, "inputs.scene")):
        with pytest.raises(UserError, match=name):
            SequenceWriter.open(seq, config, spline, both, **(good | change))
    with pytest.raises(UserError, match=r"streams\.depth\.frames is 4 there and 3 now"):
        SequenceWriter.open(seq, config, spline, both | {"depth": stamps[:-1]}, **good)


def test_folders_that_cannot_be_used_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = synthetic.make_config()
    (tmp_path / "file").write_text("x")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign/thesis.tex").write_text("years of work")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/sequence.yaml").write_text("format: [")
    for name, part in (
        ("file", "is a file"),
        ("file/below", "cannot be written"),
        ("foreign", "thesis.tex"),
        ("broken", "not valid YAML"),
        ("x" * 300, "name too long"),
    ):
        with pytest.raises(UserError, match=part) as error:
            synthetic.open_writer(tmp_path / name, config, 2)
        assert "\n" not in str(error.value)
    assert contents(tmp_path / "foreign") == {"thesis.tex": b"years of work"}

    def forbidden(*_: Any, **__: Any) -> None:  # the tests may run as root, whom no mode stops
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "mkdir", forbidden)
    with pytest.raises(UserError, match=r"Permission denied.*writable"):
        synthetic.open_writer(tmp_path / "new", config, 2)


def test_a_full_disk_loses_nothing_and_the_run_resumes(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full at each write in turn; every time the next run goes on where it stopped."""
    root, replace = tmp_path / "seq", os.replace
    budget = 3

    def full(source: Any, target: Any) -> None:
        nonlocal budget
        budget -= 1
        if budget < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    failures = 0
    for _ in range(30):
        before, budget = (contents(root) if root.exists() else {}), 3
        try:
            writer = synthetic.open_writer(root, synthetic.make_config(), FRAMES)
            synthetic.write_frames(writer)
            budget += 10
            synthetic.write_scene(root)
            writer.finish()
            break
        except UserError as error:
            assert "No space left" in str(error) and "resume" in str(error) and "\n" not in str(error)
            failures += 1
        after = contents(root)
        assert {name: after[name] for name in before} == before and not any(".tmp" in name for name in after)
    assert failures >= 3
    assert contents(root) == contents(finished)


def test_a_frame_outside_the_spline_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    config = synthetic.make_config()
    with pytest.raises(UserError, match="outside"):
        stamps = {"color": np.array([0.0, 5.0]), "depth": np.array([0.0])}
        SequenceWriter.open(tmp_path / "seq", config, synthetic.make_spline(), stamps, {}, {})
    assert not (tmp_path / "seq").exists()


def test_images_of_the_wrong_shape_or_type_are_a_programming_error(tmp_path: Path) -> None:
    writer = synthetic.open_writer(tmp_path / "seq", synthetic.make_config(), 1)
    with pytest.raises(ValueError, match="expected an image"):
        writer.write_color(0, np.zeros((64, 48, 3), np.uint8))
    with pytest.raises(ValueError, match="expected an image"):
        writer.write_depth(0, np.zeros((48, 64)))  # type: ignore[arg-type]
    with pytest.raises(IndexError):
        writer.write_color(1, np.zeros((48, 64, 3), np.uint8))
