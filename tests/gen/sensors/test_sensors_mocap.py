"""A motion capture's poses in groundtruth.txt: offset, noise and clock as asked for, and nothing else touched."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.config import load_config
from rsgen.config.sections import MocapConfig
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sensors.reports import T_camera_body, reported_poses
from rsgen.sequence.format import poses_of_rows

SPLINE = Spline(se3.exp(np.cumsum(np.full((170, 6), 0.01), axis=0)), -0.05, 0.05)
OFFSET = {"translation_m": [0.035, -0.031, 0.009], "rotation_deg": [0.0, 90.0, 0.0]}


def reported(seed: int = 0, **settings: object) -> tuple[np.ndarray, np.ndarray]:
    """Listed stamps (n,) and poses (n, 4, 4)."""
    rows = reported_poses(SPLINE, MocapConfig.model_validate(settings), seed)
    return rows[:, 0], poses_of_rows(rows[:, 1:])


def test_without_errors_it_is_the_truth_at_its_rate() -> None:
    t, T = reported(rate_hz=50.0)
    assert np.diff(t) == pytest.approx(0.02) and t[0] >= SPLINE.t_begin and t[-1] <= SPLINE.t_end
    np.testing.assert_allclose(T, SPLINE.pose(t), atol=1e-12)


def test_the_body_lies_where_it_was_put_and_the_clock_is_late() -> None:
    t, T = reported(offset_s=0.04, **OFFSET)
    T_camera = SPLINE.pose(t - 0.04)
    body = se3.inverse(T_camera) @ T
    np.testing.assert_allclose(body[:, :3, 3], np.tile(OFFSET["translation_m"], (len(t), 1)), atol=1e-8)
    # A quarter turn about y: the body's x axis points along the camera's -z.
    np.testing.assert_allclose(body[:, :3, 0], np.tile([0.0, 0.0, -1.0], (len(t), 1)), atol=1e-8)


def test_noise_has_its_size_about_the_body_and_follows_the_seed() -> None:
    settings = OFFSET | {"position_sigma_m": 0.002, "rotation_sigma_deg": 0.1, "rate_hz": 500.0}
    (t, T), (_, again), (_, other) = reported(3, **settings), reported(3, **settings), reported(4, **settings)
    exact = SPLINE.pose(t) @ T_camera_body(MocapConfig.model_validate(settings))
    twist = se3.log(se3.inverse(exact) @ T)
    assert twist[:, :3].std(axis=0) == pytest.approx(0.002, rel=0.1)
    assert np.rad2deg(twist[:, 3:].std(axis=0)) == pytest.approx(0.1, rel=0.1)
    assert np.array_equal(T, again) and not np.allclose(T, other)


def test_only_the_ground_truths_file_knows_of_it(tmp_path: Path) -> None:
    config = tiny.write_config(tmp_path, 6)
    words = ["--mocap.translation_m", "[0.1,0,0]", "--mocap.position_sigma_m", "0.001", "--mocap.offset_s", "0.02"]
    for name, extra in (("plain", []), ("mocap", words)):
        assert main(["render", str(config), "--out", str(tmp_path / name), "--quiet", *extra]) == 0
        assert verify_sequence(tmp_path / name).ok
    plain = {path.relative_to(tmp_path / "plain") for path in (tmp_path / "plain").rglob("*") if path.is_file()}
    differ = {str(p) for p in plain if (tmp_path / "plain" / p).read_bytes() != (tmp_path / "mocap" / p).read_bytes()}
    assert differ == {"groundtruth.txt", "sequence.yaml"}
    text = (tmp_path / "mocap" / "groundtruth.txt").read_text()
    assert "as a motion capture reports it" in text

    assert main(["export", "registered", str(tmp_path / "mocap"), "--out", str(tmp_path / "tum"), "--quiet"]) == 0
    exported = (tmp_path / "tum" / "groundtruth.txt").read_text().splitlines()
    assert "T_world_color, as a motion capture reports it" in exported[0]
    assert len(exported) == len(text.splitlines())

    (tmp_path / "mocap" / "groundtruth.txt").write_text(text.replace("0.0", "0.1", 40))
    assert not verify_sequence(tmp_path / "mocap").ok


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rate_hz", "0"),
        ("position_sigma_m", "-1"),
        ("rotation_deg", "[0,0,200]"),
        ("translation_m", "[1,2]"),
        ("x", "1"),
    ],
)
def test_wrong_settings_are_named(tmp_path: Path, field: str, value: str) -> None:
    with pytest.raises(UserError, match=rf"mocap\.{field}") as error:
        load_config(tiny.write_config(tmp_path), {f"mocap.{field}": value})
    assert "\n" not in str(error.value)
