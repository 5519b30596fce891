"""Readers of TUM, ICL-NUIM and EuRoC files: values, conventions, one clear line for each thing that is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsgen.errors import UserError
from rsgen.sequence.trajectory import Trajectory, read_trajectory

ICL = Path(__file__).resolve().parents[4] / "shared" / "data" / "icl_nuim_livingroom"
needs_icl = pytest.mark.skipif(not ICL.is_dir(), reason="ICL-NUIM data (../shared/data/icl_nuim_livingroom) not here")

TUM = """# timestamp tx ty tz qx qy qz qw
0.00 1.0 2.0 3.0 0 0 0 1
0.05 1.1 2.0 3.0 0 0 0.6 0.8

0.10 1.2 2.0 3.0 0.5 0.5 0.5 0.5   # the comment's end
0.15 1.3 2.0 3.0 1 0 0 0
0.20 1.4 2.0 3.0 0 1 0 0
"""

EUROC = """#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x
1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152,-0.027876
1403636580843555328,4.688177,-1.786770,0.783350,0.534640,-0.152990,-0.826976,-0.082863,-0.026986
1403636580848555520,4.688028,-1.786598,0.783363,0.535178,-0.152945,-0.826562,-0.083605,-0.025930
1403636580853555456,4.687878,-1.786421,0.783377,0.535715,-0.152884,-0.826146,-0.084391,-0.024997
"""


def write(tmp_path: Path, text: str | bytes, name: str = "poses.txt") -> Path:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_tum_values(tmp_path: Path) -> None:
    trajectory = read_trajectory(write(tmp_path, TUM))
    np.testing.assert_array_equal(trajectory.stamps, [0.0, 0.05, 0.10, 0.15, 0.20])
    np.testing.assert_allclose(trajectory.positions[:, 0], [1.0, 1.1, 1.2, 1.3, 1.4])
    # Written out by hand: about z by 2 atan(0.6 / 0.8), cos = 0.28, sin = 0.96; and the cyclic permutation of the axes.
    np.testing.assert_allclose(
        trajectory.T_world_cam[1, :3, :3], [[0.28, -0.96, 0.0], [0.96, 0.28, 0.0], [0.0, 0.0, 1.0]], atol=1e-15
    )
    np.testing.assert_allclose(
        trajectory.T_world_cam[2, :3, :3], [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], atol=1e-15
    )
    np.testing.assert_array_equal(trajectory.T_world_cam[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (5, 1)))


def test_commas_windows_line_ends_and_byte_order_mark_are_fine(tmp_path: Path) -> None:
    plain = read_trajectory(write(tmp_path, TUM))
    lines = [
        line if line.startswith("#") else line.split("#")[0].strip().replace(" ", ", ") for line in TUM.splitlines()
    ]
    odd = read_trajectory(write(tmp_path, b"\xef\xbb\xbf" + "\r\n".join(lines).encode(), "odd.csv"))
    np.testing.assert_array_equal(odd.T_world_cam, plain.T_world_cam)


def test_quaternion_signs_do_not_matter(tmp_path: Path) -> None:
    plain = read_trajectory(write(tmp_path, TUM))
    flipped = read_trajectory(write(tmp_path, TUM.replace("0.5 0.5 0.5 0.5", "-0.5 -0.5 -0.5 -0.5")))
    np.testing.assert_allclose(flipped.T_world_cam, plain.T_world_cam, atol=1e-15)


def test_rounded_quaternions_are_normalised(tmp_path: Path) -> None:
    trajectory = read_trajectory(write(tmp_path, TUM.replace("0 0 0.6 0.8", "0 0 0.602 0.805")))
    R = trajectory.T_world_cam[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (5, 1, 1)), atol=1e-14)


@pytest.mark.parametrize("format", ["auto", "euroc"])
def test_euroc_has_nanoseconds_and_w_first(tmp_path: Path, format: str) -> None:
    trajectory = read_trajectory(write(tmp_path, EUROC, "data.csv"), format=format)  # type: ignore[arg-type]
    # Steps of 4.99968, 5.000192 and 4.999936 ms; a stamp of 1.4e9 s resolves 0.24 µs.
    np.testing.assert_allclose(np.diff(trajectory.stamps), [4.99968e-3, 5.000192e-3, 4.999936e-3], atol=3e-7)
    expected = Rotation.from_quat([-0.153029, -0.827383, -0.082152, 0.534108]).as_matrix()
    np.testing.assert_allclose(trajectory.T_world_cam[0, :3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(trajectory.positions[0], [4.688319, -1.786938, 0.783338])


def test_moved_and_rebased(tmp_path: Path) -> None:
    trajectory = read_trajectory(write(tmp_path, TUM))
    T_scene_world, T_body_cam = np.eye(4), np.eye(4)
    T_scene_world[:3, 3] = [10.0, 0.0, 0.0]
    T_body_cam[:3, 3] = [0.0, 0.0, 1.0]
    moved = trajectory.moved(T_scene_world, T_body_cam).rebased(2.0)
    np.testing.assert_allclose(moved.positions[0], [11.0, 2.0, 4.0])
    np.testing.assert_allclose(moved.positions[2], [12.2, 2.0, 3.0], atol=1e-15)  # camera z is world x at pose 2
    np.testing.assert_allclose(moved.stamps, [2.0, 2.05, 2.10, 2.15, 2.20])


# --- ICL-NUIM --------------------------------------------------------------------------------------------------------


def pov_poses(count: int) -> np.ndarray:
    """(count, 4, 4) poses as a POV-Ray renderer has them; what the published files and ours derive from."""
    k = np.arange(count)
    T = np.tile(np.eye(4), (count, 1, 1))
    angles = np.stack([0.1 + 0.02 * k, 2.0 - 0.03 * k, 0.3 * np.sin(k)], axis=1)
    T[:, :3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    T[:, :3, 3] = np.stack([1.0 + 0.01 * k, 1.3 + 0.02 * k, -0.5 + 0.03 * k], axis=1)
    return T


def published(T_pov: np.ndarray, tmp_path: Path) -> Path:
    """What ICL-NUIM publishes: poses relative to frame 1, z shifted by -2.25, frame index first (SOURCE.md)."""
    relative = np.linalg.inv(T_pov[1]) @ T_pov[1:]
    rows = np.column_stack(
        [
            np.arange(1, len(T_pov)),
            relative[:, :3, 3] + [0.0, 0.0, -2.25],
            Rotation.from_matrix(relative[:, :3, :3]).as_quat(),
        ]
    )
    path = tmp_path / "livingRoom9.gt.freiburg"
    np.savetxt(path, rows, fmt=["%d"] + ["%.12g"] * 7)
    return path


def test_icl_file_lands_in_the_room(tmp_path: Path) -> None:
    T_pov = pov_poses(12)
    trajectory = read_trajectory(published(T_pov, tmp_path), icl_start=T_pov[1, :3].tolist())
    np.testing.assert_allclose(trajectory.stamps, np.arange(1, 12) / 30.0, rtol=1e-15)
    # A point seen by the left-handed camera at (X right, Y up, Z ahead) is our camera's (X, -Y, Z), and the same spot
    # of the room has x mirrored: said with points, not with the reader's matrices.
    seen_pov = np.array([0.4, 0.7, 2.0])
    seen_ours = np.array([0.4, -0.7, 2.0])
    spot_pov = T_pov[1:, :3, :3] @ seen_pov + T_pov[1:, :3, 3]
    spot_ours = trajectory.T_world_cam[:, :3, :3] @ seen_ours + trajectory.positions
    np.testing.assert_allclose(spot_ours, spot_pov * [-1.0, 1.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(trajectory.T_world_cam[:, :3, :3]), 1.0)


def test_icl_file_without_start_begins_at_the_origin(tmp_path: Path) -> None:
    trajectory = read_trajectory(published(pov_poses(12), tmp_path))
    np.testing.assert_allclose(trajectory.T_world_cam[0], np.diag([-1.0, -1.0, 1.0, 1.0]), atol=1e-9)


def test_icl_start_leaves_other_formats_alone(tmp_path: Path) -> None:
    path = write(tmp_path, TUM)
    start = pov_poses(2)[1, :3]
    np.testing.assert_array_equal(read_trajectory(path, icl_start=start).T_world_cam, read_trajectory(path).T_world_cam)


@pytest.mark.parametrize("start", [np.eye(3), np.full((3, 4), np.nan), np.ones((3, 4)), "pose", np.diag([1, 1, -1, 1])])
def test_bad_icl_start(tmp_path: Path, start: object) -> None:
    with pytest.raises(UserError, match="icl_start"):
        read_trajectory(published(pov_poses(9), tmp_path), icl_start=start)  # type: ignore[arg-type]


def test_icl_wants_frame_indices(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"poses\.txt:3: .*frame index"):
        read_trajectory(write(tmp_path, TUM), format="icl")


def icl_start_from_pov_pose(line: str) -> list[list[float]]:
    """The 3x4 ``icl_start`` in a line of a POV-Ray pose list: ``frame r00 r01 r02 tx r10 ... tz`` (frame 1's line)."""
    values = [float(field) for field in line.split()]
    return [values[1:5], values[5:9], values[9:13]]


@needs_icl
@pytest.mark.parametrize("k", range(4))
def test_published_icl_files_equal_the_poses_that_rendered_the_images(k: int) -> None:
    pose_list = (ICL / f"livingRoom{k}.pov_poses.txt").read_text().splitlines()
    start = icl_start_from_pov_pose(next(line for line in pose_list if line.startswith("1 ")))
    from_published = read_trajectory(ICL / f"livingRoom{k}.gt.freiburg", icl_start=start)
    ready = read_trajectory(ICL / f"livingRoom{k}.rh_tum.txt")
    assert len(from_published) == len(ready) - 1
    np.testing.assert_allclose(from_published.stamps, ready.stamps[1:], atol=1e-6)
    np.testing.assert_allclose(from_published.T_world_cam, ready.T_world_cam[1:], atol=1e-5)


# --- what can be wrong -----------------------------------------------------------------------------------------------


def with_line(number: int, line: str) -> str:
    lines = TUM.splitlines()
    lines[number - 1] = line
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "holds no poses"),
        ("# only a comment\n\n", "holds no poses"),
        ("\n".join(TUM.splitlines()[:4]), "holds 2 poses.*at least 4"),
        (b"\x89PNG\r\n\x1a\n\0\0\0", "not a text file"),
        (TUM.encode() + b"0.25 1 2 3 \xff\xfe 0 0 1\n", ":8: not plain text"),
        ("<!DOCTYPE html>\n<html></html>", "web page.*download"),
        (with_line(6, "0.15 1.3 2.0 3.0 1 0 0"), ":6: 7 columns instead of 8"),
        (with_line(6, "1 0 0 1 0 1 0 2 0 0 1 3"), ":6: 12 columns instead of 8"),
        (with_line(5, "0.10 1.2 two 3.0 0 0 0 1"), ":5: 'two' is not a number"),
        (with_line(5, "0.10 1.2 nan 3.0 0 0 0 1"), ":5: .*NaN or infinite"),
        (with_line(3, "0.05 1.2 2.0 3.0 0 0 0 inf"), ":3: .*NaN or infinite"),
        (with_line(5, "0.10 1.2 2.0 3.0 0 0 0 0"), ":5: .*zero quaternion"),
        (with_line(5, "0.10 1.2 2.0 3.0 0 0 0 0.98"), r":5: .*norm 0\.98"),
        (with_line(5, "0.05 1.2 2.0 3.0 0 0 0 1"), ":5: repeats the stamp"),
        (with_line(5, "0.04 1.2 2.0 3.0 0 0 0 1"), ":5: goes back in time"),
        (with_line(5, "0.10 1.2 20001 3.0 0 0 0 1"), ":5: .*beyond 10000 m"),
        (with_line(7, "0.70 1.4 2.0 3.0 0 1 0 0"), r":7: comes 0\.55 s after.*max_gap_s"),
        (with_line(2, "1403636580838555648 1 2 3 0 0 0 1"), ":2: .*absurd in seconds.*nanoseconds"),
    ],
)
def test_each_error_names_file_and_line(tmp_path: Path, text: str | bytes, complaint: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(UserError, match=complaint) as caught:
        read_trajectory(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_gap_limit_can_be_raised_and_follows_slow_recordings(tmp_path: Path) -> None:
    gap = write(tmp_path, with_line(7, "0.70 1.4 2.0 3.0 0 1 0 0"))
    assert len(read_trajectory(gap, max_gap_s=0.6)) == 5
    slow = "\n".join(f"{k} 0 0 {k} 0 0 0 1" for k in range(6))
    assert len(read_trajectory(write(tmp_path, slow))) == 6


def test_unreadable_paths(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.txt", tmp_path):
        with pytest.raises(UserError, match="cannot read trajectory"):
            read_trajectory(path)


def test_euroc_errors(tmp_path: Path) -> None:
    path = write(tmp_path, EUROC.replace("1403636580848555520", "0.5"), "data.csv")
    with pytest.raises(UserError, match=r"data\.csv:4: .*whole nanoseconds"):
        read_trajectory(path)
    with pytest.raises(UserError, match=r"data\.csv:2: 9 columns"):
        read_trajectory(path, format="tum")


def test_unknown_format_and_mismatched_arrays(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="unknown trajectory format 'kitti'"):
        read_trajectory(write(tmp_path, TUM), format="kitti")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="do not match"):
        Trajectory(np.arange(3.0), np.eye(4)[None])
