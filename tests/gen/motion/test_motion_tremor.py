"""Tremor on a smooth motion: its size and band, measured on the spline that is the ground truth; the preset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny
from pydantic import ValidationError

from rsgen.cli.main import main
from rsgen.config.config import load_config, recorded_config, validate_config
from rsgen.config.motion import TremorConfig
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.motion.fit import fit_spline
from rsgen.motion.make import with_tremor
from rsgen.produce.parts import load_motion

ROOT = Path(__file__).parents[3]
SECONDS = 8.0
SMOOTH = Spline(se3.exp(np.cumsum(np.full((170, 6), 0.01), axis=0)), -0.05, 0.05)
RATE = 1000.0


def shaken(sequence_seed: int = 1, **settings: object) -> tuple[np.ndarray, float]:
    """Twists (n, 6) at 1 kHz of the fitted ground truth against the smooth motion, and its knot spacing."""
    config = TremorConfig.model_validate(settings)
    trajectory, spacing = with_tremor(SMOOTH, config, sequence_seed, np.array([0.0, SECONDS]))
    fitted = fit_spline(trajectory, dt=spacing).spline
    t = np.arange(0.2, SECONDS - 0.2, 1 / RATE)
    return se3.log(se3.inverse(SMOOTH.pose(t)) @ fitted.pose(t)), spacing


def test_the_ground_truth_has_the_tremors_size_and_band() -> None:
    twist, spacing = shaken(position_m=0.0005, rotation_deg=0.1)
    assert twist[:, :3].std(axis=0) == pytest.approx(0.0005, rel=0.1)
    assert np.rad2deg(twist[:, 3:].std(axis=0)) == pytest.approx(0.1, rel=0.1)
    power = np.abs(np.fft.rfft(twist * np.hanning(len(twist))[:, None], axis=0)) ** 2
    f = np.fft.rfftfreq(len(twist), 1 / RATE)
    inside = (f > 7.5) & (f < 12.5)
    assert (power[inside].sum(axis=0) / power.sum(axis=0) > 0.99).all()
    assert spacing == pytest.approx(0.01)


def test_seeds_decide_it() -> None:
    first, again, other = shaken(1)[0], shaken(1)[0], shaken(2)[0]
    assert np.array_equal(first, again) and not np.allclose(first, other)
    assert np.array_equal(shaken(5, seed=1)[0], first)


def test_a_recorded_and_a_made_motion_take_it(tmp_path: Path) -> None:
    config = tiny.write_config(tmp_path, 60)
    plain, shaky = (load_motion(load_config(config, o)) for o in ({}, {"tremor": "{rotation_deg: 0.2}"}))
    assert shaky.first_stamp == plain.first_stamp and shaky.last_stamp == plain.last_stamp
    t = np.linspace(0.1, 1.8, 500)
    angle = np.rad2deg(se3.log(se3.inverse(plain.spline.pose(t)) @ shaky.spline.pose(t))[:, 3:])
    assert angle.std() == pytest.approx(0.2, rel=0.2)


def test_a_band_that_falls_and_a_moment_too_short_for_it_are_refused() -> None:
    with pytest.raises(ValidationError, match="must rise"):
        TremorConfig(band_hz=(12.0, 8.0))
    with pytest.raises(UserError, match="holds no multiple"):
        with_tremor(SMOOTH, TremorConfig(), 0, np.array([0.0, 0.07]))


def test_a_recorded_path_that_meets_a_wall_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    config = tiny.write_config(tmp_path, 6)
    for least, status in (("0.5", 0), ("2", 2)):
        words = ["render", str(config), "--out", str(tmp_path / least), "--frames", "0:1", "--quiet"]
        assert main([*words, "--trajectory.clearance_m", least]) == status
    assert "clearance_m is 2:" in capfd.readouterr().err and not (tmp_path / "2").exists()


@pytest.mark.parametrize("name", ["wild1", "wild2", "wild3", "twin_fr1_rpy"])
def test_configs_of_real_motions_stand_upright_and_check_their_way(name: str) -> None:
    config = load_config(ROOT / f"configs/{name}.yaml")
    T = np.array(config.trajectory.T_world_file)
    assert T[1, :3].tolist() == [0, 0, 1] and np.linalg.det(T[:3, :3]) == pytest.approx(1)  # their z is our y
    assert config.preset == "kinect_v1" and config.trajectory.clearance_m == 0.3
    assert config.injected.color is not None and config.color.auto_exposure is not None and config.depth.registered


# --- the preset

BASE = {"name": "a", "trajectory": {"file": "x.txt"}, "scene": {"file": "y.xml"}}


def test_the_preset_fills_in_what_is_not_said() -> None:
    config = validate_config(
        BASE | {"preset": "kinect_v1", "color": {"spp": 3}, "faults": {"color": {"grid_s": 0.0}}}, "here"
    )
    color, depth, faults = config.color, config.depth, config.injected
    assert color.spp == 3 and faults.color is not None and faults.color.grid_s == 0
    assert faults.color.offset_s != 0 and color.auto_exposure and color.auto_white_balance and config.tremor
    assert depth.registered and depth.blur_samples > 1 and faults.depth and depth.noise.model == "kinect"
    assert min(depth.noise.scale_error, depth.noise.distortion_px, depth.noise.pattern_px) > 0
    assert recorded_config(config.content(), "again").content() == config.content()


def test_null_switches_a_part_of_the_preset_off_and_a_config_without_it_is_plain(tmp_path: Path) -> None:
    path = tiny.write_config(tmp_path)
    words = {"preset": "kinect_v1", "tremor": "null", "color.auto_exposure": "null", "depth.registered": "false"}
    config = load_config(path, words)
    assert config.tremor is None and config.color.auto_exposure is None and not config.depth.registered
    assert config.injected.color is not None and config.color.width == tiny.WIDTH
    plain = load_config(path)
    assert plain.faults is None and plain.tremor is None


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(UserError, match=r"preset: .*kinect_v1"):
        validate_config(BASE | {"preset": "kinect_v9"}, "here")
