"""What a sequence folder holds: stamps, listings, poses, depth and its description, against SciPy and closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic
import yaml
from scipy.spatial.transform import Rotation

from rsgen.config.config import Config, StreamConfig
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rsgen.produce.records import fingerprint
from rsgen.produce.writer import quantise
from rsgen.sequence.format import FORMAT, associate, pose_rows, poses_of_rows, stream_stamps
from rsgen.sequence.reader import read_sequence

FRAMES = 4


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.make_sequence(tmp_path_factory.mktemp("finished") / "seq", frames=FRAMES)


# ---------------------------------------------------------------------------------------------------------------------
# writing


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


def test_config_of_the_synthetic_sequence_is_valid() -> None:
    assert isinstance(synthetic.make_config(), Config)
