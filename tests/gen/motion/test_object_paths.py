"""Things that move by themselves: which configs make one, and splines against their closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import tiny
from moving_things import BOX, CIRCLE, SWING, spline_of, thing
from scipy.spatial.transform import Rotation

from rsgen.check.reprojection import RelativeMotion
from rsgen.config.config import Config, load_config
from rsgen.config.faults import from_recorded
from rsgen.errors import UserError
from rsgen.geometry import se3

# --- configs


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"motion": {"kind": "circle"}}, "kind circle needs position and radius_m and period_s"),
        ({"motion": CIRCLE | {"speed_m_s": 1.0}}, "speed_m_s: not for kind circle: remove"),
        ({"motion": {"kind": "waypoints", "waypoints": [{"time_s": 1, "position": [0, 0, 0]}] * 2}}, "times must rise"),
        ({"motion": {"kind": "drive", "points": [[0, 0, 0], [1, 0, 0]], "speed_m_s": 1}}, "points: give 3 at least"),
        ({"mesh": "thing.ply"}, "give one of mesh, a file, and shape"),
        ({"name": "a/b"}, "name"),
    ],
)
def test_a_config_that_makes_no_thing_is_refused_in_one_line(tmp_path: Path, change: Any, complaint: str) -> None:
    one = {"name": "thing", "shape": BOX, "motion": CIRCLE} | change
    with pytest.raises(UserError, match=complaint) as error:
        load_config(tiny.write_config(tmp_path, objects=[one]))
    assert "\n" not in str(error.value) and "objects.0" in str(error.value)


def test_names_differ_and_light_is_baked(tmp_path: Path) -> None:
    one = {"name": "thing", "shape": BOX, "motion": CIRCLE}
    with pytest.raises(UserError, match="two are named 'thing'"):
        load_config(tiny.write_config(tmp_path, objects=[one, one]))
    with pytest.raises(UserError, match=r"set light\.mode baked"):
        load_config(tiny.write_config(tmp_path, objects=[one], light={"mode": "path"}))


def test_a_config_without_things_is_what_it_was(tmp_path: Path) -> None:
    path = tiny.write_config(tmp_path, objects=[{"name": "thing", "shape": BOX, "motion": CIRCLE}])
    with_it, without = load_config(path), load_config(path, {"objects": "[]"})
    assert "objects" not in without.content()
    assert with_it.content()["objects"] == [{"name": "thing", "shape": BOX, "motion": CIRCLE}]
    again = Config.model_validate(
        from_recorded(with_it.content()) | {"trajectory": {"file": "a"}, "scene": {"file": "b"}}
    )
    assert again.objects == with_it.objects


# --- splines


def test_splines_follow_their_closed_forms() -> None:
    t = np.linspace(0.0, 2.0, 57)
    T = spline_of(thing(**CIRCLE)).pose(t)
    angle = 2 * np.pi * t
    p = np.array(CIRCLE["position"]) + 0.4 * np.stack([np.cos(angle), 0 * t, -np.sin(angle)], axis=-1)
    ahead = np.stack([-np.sin(angle), 0 * t, -np.cos(angle)], axis=-1)
    np.testing.assert_allclose(T[:, :3, 3], p, atol=2e-4)  # what 50 ms knots leave of a turn a second
    np.testing.assert_allclose(T[:, :3, 2], ahead, atol=5e-4)
    T = spline_of(thing(**SWING, axis=[1, 0, 0], rotation_deg=[0, 90, 0])).pose(t)
    phi = np.radians(20) * np.sin(2 * np.pi * t / 0.7)
    np.testing.assert_allclose(T[:, :3, 3], np.array([-0.3, -0.5, 1.3]) + 0.8 * np.stack(
        [0 * t, np.cos(phi), np.sin(phi)], axis=-1), atol=3e-4)  # fmt: skip
    R = Rotation.from_rotvec(phi[:, None] * [1, 0, 0]) * Rotation.from_rotvec([0, np.pi / 2, 0])
    np.testing.assert_allclose(T[:, :3, :3], R.as_matrix(), atol=2e-3)


def test_a_drive_passes_its_points_and_heads_along_them() -> None:
    points = [[0, 0, 0], [1, 0, 0], [1, 0.1, 1], [0, 0, 1]]
    spline = spline_of(thing(kind="drive", points=points, speed_m_s=1.3), 0.0, 4.0)
    T = spline.pose(np.linspace(0, 4, 4001))
    gaps = np.linalg.norm(T[:, None, :3, 3] - np.array(points, float), axis=-1).min(axis=0)
    assert gaps.max() < 2e-3
    step = np.diff(T[:, :3, 3], axis=0)
    assert abs(np.linalg.norm(step, axis=1).sum() / 4.0 - 1.3) < 0.01
    level = step[:, [0, 2]] / np.linalg.norm(step[:, [0, 2]], axis=1, keepdims=True)
    assert (T[1:, [0, 2], [2, 2]] * level).sum(axis=1).min() > 0.999
    np.testing.assert_allclose(T[:, 1, 1], 1, atol=1e-4)


def test_waypoints_and_files_are_followed_and_have_to_last(tmp_path: Path) -> None:
    poses = [{"time_s": s, "position": [s, s * s, 0], "rotation_deg": [0, 40 * s, 0]} for s in (0, 0.7, 1.3, 2)]
    T = spline_of(thing(kind="waypoints", waypoints=poses)).pose(np.array([0.7, 1.3]))
    np.testing.assert_allclose(T[:, :3, 3], [[0.7, 0.49, 0], [1.3, 1.69, 0]], atol=1e-3)
    np.testing.assert_allclose(Rotation.from_matrix(T[:, :3, :3]).as_rotvec()[:, 1], np.radians([28, 52]), atol=1e-3)
    with pytest.raises(UserError, match=r"objects\.thing\.motion: its waypoints last from 0 to 2 s, the sequence from"):
        spline_of(thing(kind="waypoints", waypoints=poses), 0.0, 2.1)
    file = tiny.write_trajectory(tmp_path / "t.txt", 61)
    rows = np.loadtxt(file)
    T = spline_of(thing(kind="file", file=str(file))).pose(rows[5:50, 0])
    np.testing.assert_allclose(T[:, :3, 3], rows[5:50, 1:4], atol=1e-4)
    with pytest.raises(UserError, match=r"its file .* last from 0 to 2 s"):
        spline_of(thing(kind="file", file=str(file)), 0.0, 2.5)


def test_velocity_relative_to_a_thing_is_the_derivative() -> None:
    motion = RelativeMotion(synthetic.make_spline(), spline_of(thing(**CIRCLE)))
    t, h = np.linspace(0.3, 0.5, 7), 1e-5
    T, w = motion.pose_and_velocity(t)
    np.testing.assert_allclose(T, motion.pose(t), atol=1e-12)
    ahead = se3.log(se3.inverse(motion.pose(t - h)) @ motion.pose(t + h)) / (2 * h)
    np.testing.assert_allclose(w, ahead, atol=1e-5)
