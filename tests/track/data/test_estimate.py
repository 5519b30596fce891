"""Run folders and foreign trajectories, written and read back; one line for each fault."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from estimates import FRAMES, SPLINE, one_line, rows_of, walk

from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rstrack.data.estimate import Estimate, read_estimate, read_info, write_estimate, write_info


def test_a_run_folder_comes_back_as_it_was(tmp_path: Path) -> None:
    stamps = 1_305_031_102.175304 + np.arange(40) / 30.0
    T = walk(11, 40)
    spline = Spline(SPLINE.control_points, stamps[0] - 0.1, 0.05)
    info = {"method": "rs_pg", "sigma": np.float64(np.nan), "frames": [{"stamp": stamps[0], "keyframe": np.True_}]}
    write_estimate(tmp_path / "run", stamps, T, spline, info)
    back = read_estimate(tmp_path / "run")
    np.testing.assert_allclose(back.stamps, stamps, atol=1e-9, rtol=0)
    np.testing.assert_allclose(back.T_world_depth[:, :3, 3], T[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(back.T_world_depth[:, :3, :3], T[:, :3, :3], atol=1e-11)
    assert back.spline is not None
    np.testing.assert_array_equal(back.spline.control_points, spline.control_points)
    assert (back.spline.t0, back.spline.dt) == (spline.t0, spline.dt)
    assert back.info == {"method": "rs_pg", "sigma": None, "frames": [{"stamp": stamps[0], "keyframe": True}]}
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == ["run.json", "spline.npz", "trajectory.txt"]


def test_run_json_has_a_line_for_each_frame_and_null_for_what_is_not_finite(tmp_path: Path) -> None:
    frames = [
        {"covariance": np.float32([0.5, bad]), "pixels": np.arange(2), "fit": (0.25, bad)} for bad in (1.0, np.inf)
    ]
    write_info(tmp_path, {"frames": frames, "empty": [], "pairs": np.array([[1.0, np.nan]])})
    lines = (tmp_path / "run.json").read_text().splitlines()
    assert len(lines) == 8 and sum("pixels" in line for line in lines) == 2
    assert read_info(tmp_path / "run.json") == {
        "frames": [
            {"covariance": [0.5, 1.0], "pixels": [0, 1], "fit": [0.25, 1.0]},
            {"covariance": [0.5, None], "pixels": [0, 1], "fit": [0.25, None]},
        ],
        "empty": [],
        "pairs": [[1.0, None]],
    }


def test_a_run_without_spline_leaves_none_of_the_run_before(tmp_path: Path) -> None:
    write_estimate(tmp_path, FRAMES, walk(1, 39), SPLINE, {"a": 1})
    write_estimate(tmp_path, FRAMES[:9], walk(2, 9), None, {})
    back = read_estimate(tmp_path)
    assert back.spline is None and back.info == {} and len(back.stamps) == 9


def test_a_foreign_tum_file_with_a_gap_is_read(tmp_path: Path) -> None:
    file = tmp_path / "other.txt"
    file.write_text("# x\n" + "".join(f"{t} {t},2,3 0 0 0.6 0.8\n" for t in (0.0, 0.1, 0.2, 9.0, 9.1)))
    estimate = read_estimate(file)
    assert estimate.stamps.tolist() == [0.0, 0.1, 0.2, 9.0, 9.1] and estimate.spline is None
    np.testing.assert_allclose(estimate.T_world_depth[3, :3, 3], [9.0, 2.0, 3.0])
    np.testing.assert_allclose(estimate.T_world_depth[0, :2, 0], [0.28, 0.96])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (rows_of([0.3, 0.2, 0.1, 0.0]), "other.txt:2: goes back"),
        (rows_of([0.0, 0.2, 0.1, 0.3]), "other.txt:3: goes back"),
        (rows_of([0.0, 0.1, 0.1, 0.3]), "other.txt:3: repeats"),
        (rows_of([0.0, 0.1]), "needs at least 4"),
        (rows_of([0.0, 0.1, 0.2]) + "0.3 nan 0 0 0 0 0 1\n", "other.txt:4: has a NaN"),
        (rows_of([0.0, 0.1, 0.2]) + "0.3 1 0 0\n", "other.txt:4: 4 columns"),
        (rows_of([0.0, 0.1, 0.2]) + "0.3 1 0 0 0 0 0 0\n", "other.txt:4: has a zero quaternion"),
        ("", "holds no poses"),
        ("stamp x y\n", "holds 1 poses"),
    ],
)
def test_a_bad_tum_file_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "other.txt").write_text(text)
    with pytest.raises(UserError) as error:
        read_estimate(tmp_path / "other.txt")
    assert says in one_line(error)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("run.json", "{", "run.json: is not valid JSON"),
        ("run.json", "[1]", "run.json: expected a JSON object"),
        ("run.json", '{"spline_valid": [1, 2, 3]}', "spline_valid"),
        ("run.json", '{"spline_valid": [[2, 1]]}', "spline_valid"),
        ("run.json", '{"spline_valid": "all"}', "spline_valid"),
        ("spline.npz", "no zip", "spline.npz: not a readable spline"),
        ("trajectory.txt", None, "has no trajectory.txt"),
    ],
)
def test_a_bad_run_folder_is_one_line(tmp_path: Path, name: str, text: str | None, says: str) -> None:
    write_estimate(tmp_path, FRAMES, walk(1, 39), SPLINE, {})
    (tmp_path / name).unlink()
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(UserError) as error:
        read_estimate(tmp_path)
    assert says in one_line(error)


def test_what_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError) as error:
        read_estimate(tmp_path / "nowhere")
    assert "cannot read" in one_line(error)
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError) as error:
        write_estimate(tmp_path / "file" / "run", FRAMES, walk(1, 39), None, {})
    one_line(error)


@pytest.mark.parametrize(
    ("stamps", "poses", "says"),
    [
        (FRAMES[::-1], walk(1, 39), "pose 1 is stamped"),
        (np.r_[FRAMES[:5], FRAMES[4:38]], walk(1, 39), "pose 5 is stamped"),
        (np.r_[FRAMES[:-1], np.nan], walk(1, 39), "pose 38 has a NaN"),
        (FRAMES, np.where(np.arange(39)[:, None, None] == 7, np.inf, walk(1, 39)), "pose 7 has a NaN"),
        (FRAMES, 1.1 * walk(1, 39), "pose 0 is not a rigid"),
        (FRAMES, walk(1, 38), "give (n,) stamps"),
        (FRAMES, walk(1, 39)[:, :3], "give (n,) stamps"),
    ],
)
def test_bad_arrays_are_one_line(stamps: np.ndarray, poses: np.ndarray, says: str) -> None:
    with pytest.raises(UserError) as error:
        Estimate(stamps, poses)
    assert says in one_line(error)
