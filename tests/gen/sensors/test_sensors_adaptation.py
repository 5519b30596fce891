"""Automatic exposure and white balance: the controller against a scene whose brightness is known, then in sequences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny
from pydantic import ValidationError

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.cameras import AutoExposureConfig, AutoWhiteBalanceConfig, ColorNoiseConfig
from rsgen.config.config import load_config
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rsgen.produce.camera_sources import setting_of
from rsgen.produce.generate import render_block
from rsgen.sensors.color import Reading, Setting, adapt, apply_color_noise, apply_setting, reading
from rsgen.sequence.reader import read_sequence

REFERENCE = Setting(0.010, 2.0)
FAST = {"speed": 1.0, "lag_frames": 1, "step_ev": 0.05, "dead_band_ev": 0.1}


def follow(light: np.ndarray, **settings: object) -> tuple[list[Setting], np.ndarray]:
    """Settings and mean intensities of pictures that show an even surface of this light (n,), 1 = white."""
    levels = np.zeros(len(light))

    def meter(k: int, setting: Setting) -> Reading:
        levels[k] = min(1.0, light[k] * setting.exposure_s * setting.gain / 0.02) ** (1 / 2.2)
        return Reading(float(levels[k]), (1.0, 1.0, 1.0))

    return adapt(meter, len(light), REFERENCE, AutoExposureConfig.model_validate(settings), None), levels


@pytest.mark.parametrize("light", [0.02, 0.1, 0.25, 0.8])
def test_it_settles_at_the_target_within_the_dead_band(light: float) -> None:
    settings, levels = follow(np.full(60, light), **FAST)
    assert abs(2.2 * np.log2(levels[-1] / 0.53)) <= 0.1 and len({s.brightness for s in settings[-20:]}) == 1


def test_exposure_and_gain_keep_their_limits_and_multiply_to_the_brightness() -> None:
    light = np.geomspace(1e-4, 30.0, 400)
    settings, levels = follow(light, **FAST)
    for s in settings:
        assert 0.001 <= s.exposure_s <= 0.033 and 1.0 <= s.gain <= 8.0
        assert s.exposure_s * s.gain == pytest.approx(0.02 * s.brightness)
        assert s.gain == 1.0 or s.exposure_s == pytest.approx(0.033)  # gain only where exposure ends
    assert settings[60].gain == 8.0 and settings[-1].exposure_s == 0.001 and levels[-1] == 1.0


def test_a_change_shows_after_the_lag_and_in_whole_steps() -> None:
    light = np.where(np.arange(40) < 10, 0.53**2.2, 0.53**2.2 / 4)
    settings, levels = follow(light, lag_frames=3, speed=0.5, step_ev=0.25, dead_band_ev=0.2)
    stops = np.log2([s.brightness for s in settings])
    assert (stops[:13] == 0).all() and stops[13] == pytest.approx(1.0)  # half of two stops, seen in frame 10
    changes = np.flatnonzero(np.diff(stops)) + 1
    assert (np.diff(changes) >= 3).all() and np.allclose(stops * 4, np.rint(stops * 4))
    assert abs(2.2 * np.log2(levels[-1] / 0.53)) <= 0.2 and stops[-1] > 1.5


def test_a_light_that_wanders_within_the_dead_band_is_left_alone() -> None:
    light = 0.53**2.2 * 2 ** (0.2 * np.sin(np.arange(100) / 7))
    settings, levels = follow(light, dead_band_ev=0.25)
    assert {s.brightness for s in settings} == {1.0} and np.ptp(levels) > 0.05


def test_white_balance_goes_to_grey_by_its_strength_and_no_farther_than_its_limit() -> None:
    def casts(strength: float, limit: float) -> np.ndarray:
        config = AutoWhiteBalanceConfig(strength=strength, limit_ev=limit, speed=0.2, lag_frames=2)
        settings = adapt(lambda k, s: Reading(0.5, (0.4, 0.2, 0.1)), 80, REFERENCE, None, config)
        return np.array([s.balance for s in settings])

    full = casts(1.0, 3.0)
    assert np.allclose(full[-1], [0.5, 1.0, 2.0], rtol=1e-3) and (full[:2] == 1).all() and (full[2] != 1).any()
    assert (np.diff(full[:, 2]) >= 0).all()
    assert np.allclose(casts(0.5, 3.0)[-1], [2**-0.5, 1.0, 2**0.5], rtol=1e-3)
    assert np.allclose(casts(1.0, 0.25)[-1], [2**-0.25, 1.0, 2**0.25], rtol=1e-3)


def test_the_meter_reads_the_light_of_what_is_not_saturated() -> None:
    linear = np.full((4, 6, 3), 0.2, np.float32)
    linear[0] = [3.0, 1.0, 1.0]
    linear[1, :, 0] = 0.6
    found = reading(np.full((4, 6, 3), 51, np.uint8), linear)
    assert found.level == pytest.approx(0.2) and found.rgb == pytest.approx((1.0 / 3, 0.2, 0.2))


@pytest.mark.parametrize("model", ["none", "camera"])
def test_a_setting_changes_brightness_gain_and_balance_of_a_picture(model: str) -> None:
    config = ColorNoiseConfig.model_validate({"model": model, "corner_loss": 0, "contrast": 0, "gain": 2.0})
    light = np.full((200, 300, 3), 0.1, np.float32)
    setting = Setting(0.02, 8.0, 2.0, (1.5, 1.0, 0.5))
    linear, noise = apply_setting(light, config, setting)
    rgb = apply_color_noise(linear, noise, np.random.default_rng(1)) / 255.0
    own = np.array([1.03, 1.0, 0.96]) if model == "camera" else np.ones(3)
    decoded = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    assert decoded.mean(axis=(0, 1)) == pytest.approx(0.2 * own * setting.balance, rel=0.03)
    if model == "camera":
        # Shot and read noise of 6000 / 8 electrons, the balance after it; rounding to 8 bits is below.
        sigma = np.sqrt(0.2 / 750 + (4 / 750) ** 2)
        assert decoded[..., 1].std() == pytest.approx(sigma, rel=0.03)


def test_limits_that_fall_and_an_exposure_without_reference_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="exposure_s"):
        AutoExposureConfig(exposure_s=(0.02, 0.01))
    config = tiny.write_config(tmp_path)
    with pytest.raises(UserError, match="exposure_s must be above 0"):
        load_config(config, {"color.auto_exposure": "{}"})


# --- whole sequences

DARK = {"exposure_s": 0.002, "exposure_gain": 0.2, "noise": {"model": "camera", "gain": 1.0}}
AUTO = {"auto_exposure": {"lag_frames": 1, "exposure_s": [0.001, 0.02], "target": 0.4, "speed": 1.0},
        "auto_white_balance": {"speed": 0.5}}  # fmt: skip


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("adaptation")
    truth = {"sharp": True, "blur_length": True, "flow": ["next"], "spp": 4}
    return tiny.write_config(folder, 12, color=DARK | AUTO, truth=truth)


@pytest.fixture(scope="module")
def whole(config: Path) -> Path:
    out = config.parent / "whole"
    assert main(["render", str(config), "--out", str(out), "--quiet"]) == 0
    return out


def test_an_automatic_camera_finds_its_brightness(whole: Path) -> None:
    report = verify_sequence(whole)
    assert report.ok, report.text()
    sequence = read_sequence(whole)
    table = sequence.streams["color"].table
    assert table is not None
    levels = [sequence.color(k).mean() / 255 for k in range(12)]
    assert levels[0] < 0.3 and abs(2.2 * np.log2(levels[-1] / 0.4)) < 0.35
    assert table.exposure_s[-1] == pytest.approx(0.02) and table.gain[-1] > 1.0 and table.exposure_s[0] == 0.002
    assert (table.balance[-1] != 1).any()


def test_truth_is_that_of_each_frames_own_exposure(whole: Path) -> None:
    sequence = read_sequence(whole)
    table = sequence.streams["color"].table
    assert table is not None
    # The same motion over ten times the exposure makes ten times the blur.
    ratio = np.median(sequence.truth("blur_length", 11)) / np.median(sequence.truth("blur_length", 0))
    assert 4 < ratio < 20
    assert sequence.truth("sharp", 11).mean() == pytest.approx(sequence.truth("color", 11).mean(), abs=3)
    # Rows' poses are those of mid-exposure: 9 ms of motion at about 0.3 m/s.
    stamps = table.taken_s - 0.5 * table.exposure_s
    expected = sequence.spline.pose(stamps)[:, :3, 3]
    assert np.abs(sequence.rows("color")[:, 0, :3] - expected).max() < 1e-8


def test_resuming_gives_the_same_bytes(config: Path, whole: Path, tmp_path: Path) -> None:
    for frames in ("6:", "0:6"):
        assert main(["render", str(config), "--out", str(tmp_path / "seq"), "--frames", frames, "--quiet"]) == 0
    assert tiny.digests(tmp_path / "seq") == tiny.digests(whole)


def test_a_worker_takes_frames_as_the_whole_did(config: Path, whole: Path, tmp_path: Path) -> None:
    loaded = load_config(config)
    table = read_sequence(whole).streams["color"].table
    settings = [setting_of(loaded.color, table, k) for k in range(12)]
    job = tiny.render_job(loaded, tmp_path, (10, "color"), color=[s for s in settings if s is not None])
    files = render_block(job, no_progress)
    assert len(files) == 5 and all((whole / name).read_bytes() == data for name, data in files.items())
