"""Sequence folders: written whole or resumed to the same bytes, read strictly, one line of text for every fault."""

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
import yaml
from scipy.spatial.transform import Rotation

from rsgen.config.config import Config, StreamConfig
from rsgen.errors import UserError
from rsgen.files import encode_yaml
from rsgen.geometry.spline import Spline
from rsgen.produce.identity import fingerprint
from rsgen.produce.writer import SequenceWriter, quantise
from rsgen.sequence.format import FORMAT, associate, pose_rows, poses_of_rows, stream_stamps
from rsgen.sequence.reader import read_sequence, sequence_info

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


def refused(root: Path, *parts: str) -> None:
    with pytest.raises(UserError) as error:
        read_sequence(root)
    text = str(error.value)
    assert "\n" not in text
    for part in parts:
        assert part in text


# ---------------------------------------------------------------------------------------------------------------------
# writing


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
    SequenceWriter.open(seq, config, spline, stamps, stamps, **good)
    for change, name in (({"versions": {"synthetic": "2"}}, "versions.synthetic"), ({"inputs": {}}, "inputs.scene")):
        with pytest.raises(UserError, match=name):
            SequenceWriter.open(seq, config, spline, stamps, stamps, **(good | change))
    with pytest.raises(UserError, match=r"streams\.depth\.frames is 4 there and 3 now"):
        SequenceWriter.open(seq, config, spline, stamps, stamps[:-1], **good)


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
        SequenceWriter.open(
            tmp_path / "seq", config, synthetic.make_spline(), np.array([0.0, 5.0]), np.array([0.0]), {}, {}
        )
    assert not (tmp_path / "seq").exists()


def test_part_of_a_sequence_lists_only_what_is_there(tmp_path: Path) -> None:
    writer = synthetic.open_writer(tmp_path / "seq", synthetic.make_config(), 6)
    synthetic.write_frames(writer, range(2, 4))
    writer.finish()
    sequence = read_sequence(tmp_path / "seq")
    for name, stream in sequence.streams.items():
        assert stream.frames == 6 and stream.indices.tolist() == [2, 3]
        np.testing.assert_array_equal(stream.stamps, writer.stamps(name)[2:4])
        assert np.load(tmp_path / f"seq/truth/rows_{name}.npy").shape == (6, 48, 7)
        assert sequence.rows(name).shape == (2, 48, 7)
        np.testing.assert_array_equal(sequence.rows(name), np.load(tmp_path / f"seq/truth/rows_{name}.npy")[2:4])
    assert len((tmp_path / "seq/associations.txt").read_text().splitlines()) == 2


def test_depth_is_exact_in_exr_and_rounded_or_nothing_in_png(tmp_path: Path) -> None:
    config = synthetic.make_config(width=8, height=8)
    writer = synthetic.open_writer(tmp_path / "seq", config, 1)
    z = np.full((8, 8), 1.23456789, np.float32)
    special = [0.0, np.inf, np.nan, -1.0, 13.107, 13.1072, 0.00009, 0.00011]
    z[0] = special
    writer.write_depth(0, z)
    synthetic.write_frames(writer, range(0))
    writer.write_color(0, np.zeros((8, 8, 3), np.uint8))
    writer.finish()
    sequence = read_sequence(tmp_path / "seq")
    np.testing.assert_array_equal(
        sequence.truth_depth(0)[0], np.array([0, 0, 0, 0, 13.107, 13.1072, 0.00009, 0.00011], np.float32)
    )
    np.testing.assert_array_equal(sequence.depth_units(0)[0], [0, 0, 0, 0, 65535, 0, 0, 1])
    assert sequence.depth_units(0)[1, 1] == 6173
    np.testing.assert_array_equal(sequence.depth(0)[1:], np.float32(6173 / 5000))
    assert sequence.depth(0).dtype == np.float32
    assert quantise(np.array([[65535.4]], np.float32), 1.0)[0, 0] == 65535


def test_images_of_the_wrong_shape_or_type_are_a_programming_error(tmp_path: Path) -> None:
    writer = synthetic.open_writer(tmp_path / "seq", synthetic.make_config(), 1)
    with pytest.raises(ValueError, match="expected an image"):
        writer.write_color(0, np.zeros((64, 48, 3), np.uint8))
    with pytest.raises(ValueError, match="expected an image"):
        writer.write_depth(0, np.zeros((48, 64)))  # type: ignore[arg-type]
    with pytest.raises(IndexError):
        writer.write_color(1, np.zeros((48, 64, 3), np.uint8))


def test_sequence_yaml_states_everything(finished: Path) -> None:
    data = yaml.safe_load((finished / "sequence.yaml").read_text())
    assert data["format"] == FORMAT == "rsgen-sequence/1"
    assert set(data["streams"]) == {"color", "depth"}
    for stream in data["streams"].values():
        assert stream["size"] == [64, 48] and stream["intrinsics"] == [48.0, 48.0, 31.5, 23.5]
        assert (stream["rate_hz"], stream["readout_s"], stream["scan"]) == (30.0, 0.028, "top-bottom")
    assert data["streams"]["depth"]["depth_scale"] == 5000.0
    np.testing.assert_array_equal(data["T_color_depth"], synthetic.T_COLOR_DEPTH)
    assert data["config"] == synthetic.make_config().content()
    assert data["noise"] is None and data["seed"] == 0 and data["spline"]["knot_spacing_s"] == 0.05
    content = {key: data[key] for key in ("config", "inputs", "versions")}
    assert data["fingerprint"] == fingerprint(content)


def test_the_fingerprint_sees_values_not_spelling() -> None:
    assert fingerprint({"a": 1, "b": [2.0]}) == fingerprint({"b": (2,), "a": 1.0})
    assert len({fingerprint({"a": value}) for value in (1, 1.0000001, True, "1", None, [1])}) == 6


# ---------------------------------------------------------------------------------------------------------------------
# times and poses


@pytest.mark.parametrize(
    ("rate", "offset", "count"), [(30.0, 0.0, 31), (30.0, 0.01, 30), (25.0, 0.5, 13), (0.5, 0.0, 1)]
)
def test_stream_stamps(rate: float, offset: float, count: int) -> None:
    stamps = stream_stamps(10.0, 11.0, StreamConfig(rate_hz=rate, offset_s=offset))
    assert len(stamps) == count
    np.testing.assert_allclose(stamps, 10 + offset + np.arange(count) / rate, atol=6e-10, rtol=0)
    assert [float(f"{stamp:.9f}") for stamp in stamps] == stamps.tolist()


def test_the_last_stamp_survives_rounding() -> None:
    """881 / 30 is not a binary number: the 882 poses of lr kt2 have to give 882 frames."""
    last = float("29.366667")
    assert len(stream_stamps(0.0, last, StreamConfig(rate_hz=30.0))) == 882


def test_streams_without_a_frame_or_with_too_many_are_refused() -> None:
    for last, stream in ((1.0, StreamConfig(offset_s=2.0)), (1e5, StreamConfig(rate_hz=1e5))):
        with pytest.raises(UserError):
            stream_stamps(0.0, last, stream)


def test_listings_pairs_and_stamps(finished: Path) -> None:
    for listing, folder in (("rgb.txt", "rgb"), ("depth.txt", "depth")):
        lines = (finished / listing).read_text().splitlines()
        assert lines[0].startswith("#")
        assert lines[-1] == f"0.100000000 {folder}/000003.png" and len(lines) == 2 + FRAMES
    pairs = (finished / "associations.txt").read_text().splitlines()
    assert pairs[1] == "0.033333333 rgb/000001.png 0.033333333 depth/000001.png" and len(pairs) == FRAMES


def test_association_is_nearest_one_to_one_and_steady_at_ties() -> None:
    assert associate([0.0, 1.0, 2.0], [0.1, 0.9, 2.6], 0.5) == [(0, 0), (1, 1)]
    assert associate([0.0, 0.1, 0.2, 0.3], [0.0, 0.2], 0.1) == [(0, 0), (2, 1)]
    a = np.arange(200) / 30
    assert associate(a + 1 / 60, a, 1 / 60) == [(i, i) for i in range(200)]
    assert associate(a, a[100:], 1 / 60) == [(i + 100, i) for i in range(100)]
    assert associate([], [1.0], 1.0) == []


def test_ground_truth_against_scipy(finished: Path) -> None:
    rows = np.loadtxt(finished / "groundtruth.txt")
    spline = Spline.load(finished / "spline.npz")
    T = spline.pose(rows[:, 0])
    np.testing.assert_allclose(rows[:, 1:4], T[:, :3, 3], atol=1e-9, rtol=0)
    np.testing.assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), T[:, :3, :3], atol=1e-9, rtol=0)
    assert (np.diff(rows[:, 0]) > 0).all() and (np.sum(rows[1:, 4:] * rows[:-1, 4:], axis=1) > 0.9).all()
    stamps = np.concatenate([stream.stamps for stream in read_sequence(finished).streams.values()])
    assert np.isin(stamps, rows[:, 0]).all()
    grid = np.arange(-40, 261) / 200
    assert np.isin(np.round(grid, 9), rows[:, 0]).mean() > 0.99


@pytest.mark.parametrize(
    ("scan", "lines", "first_read"),
    [("top-bottom", 48, 0), ("bottom-top", 48, 47), ("left-right", 64, 0), ("right-left", 64, 63)],
)
def test_rows_are_each_lines_camera_at_mid_exposure(tmp_path: Path, scan: str, lines: int, first_read: int) -> None:
    """Entry i belongs to image row or column i, which is read |i - first_read| line delays after the stamp."""
    stream = {"scan": scan, "readout_s": 0.02, "exposure_s": 0.01}
    config = synthetic.make_config(color=stream, depth=stream | {"exposure_s": 0.004})
    writer = synthetic.open_writer(tmp_path / "seq", config, 2)
    writer.write_color(0, np.zeros((48, 64, 3), np.uint8))
    writer.write_depth(0, np.ones((48, 64), np.float32))
    writer.finish()
    sequence, spline = read_sequence(tmp_path / "seq"), synthetic.make_spline()
    for name, exposure, T_cam_body in (("color", 0.01, synthetic.T_COLOR_DEPTH), ("depth", 0.004, np.eye(4))):
        rows = sequence.rows(name)[0]  # type: ignore[arg-type]
        assert rows.shape == (lines, 7)
        for i in (0, 1, lines // 2, lines - 1):
            T_world_cam = spline.pose(abs(i - first_read) * 0.02 / lines - exposure / 2) @ np.linalg.inv(T_cam_body)
            np.testing.assert_allclose(rows[i, :3], T_world_cam[:3, 3], atol=1e-12)
            np.testing.assert_allclose(Rotation.from_quat(rows[i, 3:]).as_matrix(), T_world_cam[:3, :3], atol=1e-12)


def test_pose_rows_round_trip_without_sign_flips() -> None:
    angles = np.linspace(0, 4 * np.pi, 200)
    T = np.tile(np.eye(4), (200, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * [0.6, 0.0, 0.8]).as_matrix()
    T[:, 0, 3] = angles
    rows = pose_rows(T)
    assert (np.sum(rows[1:, 3:] * rows[:-1, 3:], axis=1) > 0.99).all()
    assert rows[100, 6] < 0  # followed through half a turn
    np.testing.assert_allclose(poses_of_rows(rows), T, atol=1e-12)
    assert pose_rows(T[:0]).shape == (0, 7)


# ---------------------------------------------------------------------------------------------------------------------
# reading


def test_everything_written_reads_back(finished: Path) -> None:
    sequence, config, spline = read_sequence(finished), synthetic.make_config(), synthetic.make_spline()
    assert sequence.streams["color"].camera == config.color.camera
    assert sequence.streams["depth"].shutter == config.depth.shutter
    np.testing.assert_array_equal(sequence.T_color_depth, synthetic.T_COLOR_DEPTH)
    np.testing.assert_array_equal(sequence.spline.control_points, spline.control_points)
    stamp = float(sequence.streams["depth"].stamps[2])
    z = synthetic.render_depth(spline, config.depth.camera, config.depth.shutter, stamp)
    np.testing.assert_array_equal(sequence.truth_depth(2), z)
    assert np.abs(sequence.depth(2) - z).max() <= 0.5 / 5000 + 1e-6
    rgb = synthetic.render_color(spline, config.color.camera, config.color.shutter, stamp, synthetic.T_COLOR_DEPTH)
    np.testing.assert_array_equal(sequence.color(2), rgb)


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
        (lambda y: y.update(format="rsgen-sequence/2"), ["rsgen-sequence/2", "rsgen-sequence/1", "install a newer"]),
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


def test_config_of_the_synthetic_sequence_is_valid() -> None:
    assert isinstance(synthetic.make_config(), Config)
