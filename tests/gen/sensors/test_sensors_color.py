"""The colour camera's model against closed forms and the statistics that its formulas promise."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from rendering import mi
from scipy import stats

from rsgen import srgb
from rsgen.config.cameras import ColorNoiseConfig
from rsgen.sensors import color
from rsgen.sensors.color import power_law, quantise8, s_curve, to_srgb8
from rsgen.sensors.seed import noise_generator

assert mi
NEUTRAL = {
    "model": "camera", "exposure_ev": 0.0, "corner_loss": 0.0, "gain": 0.0, "white_balance": (1.0, 1.0, 1.0),
    "contrast": 0.0,
}  # fmt: skip


def settings(**changes: object) -> ColorNoiseConfig:
    return ColorNoiseConfig.model_validate(NEUTRAL | changes)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def flat(level: float, height: int = 120, width: int = 160) -> np.ndarray:
    return np.full((height, width, 3), level, np.float32)


def scene() -> np.ndarray:
    """Linear RGB (60, 81, 3) from below black to above white."""
    image = rng(5).random((60, 81, 3), dtype=np.float32) ** 2 * 1.4 - 0.05
    return image.astype(np.float32)


@pytest.mark.parametrize("config", [ColorNoiseConfig(), settings()], ids=["none", "all off"])
def test_with_everything_off_it_is_plain_srgb(config: ColorNoiseConfig) -> None:
    out = color.apply_color_noise(scene(), config, rng())
    assert out.dtype == np.uint8
    x = np.clip(scene().astype(float), 0.0, 1.0)
    srgb_iec = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
    # float32 against float64: only values half-way between two steps may differ, by one.
    assert np.abs(out - 255.0 * srgb_iec).max() < 0.5 + 1e-3


def test_srgb_is_iec_61966() -> None:
    x = np.linspace(0, 1, 20001)
    exact = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    assert np.abs(srgb.encode(x.astype(np.float32)) - exact).max() < 1e-6
    # 0.5 in linear light is the well-known code 188; gain acts before the curve.
    assert to_srgb8(np.float32([0, 0.25, 1, 7]), gain=2).tolist() == [0, 188, 255, 255]


def test_response_curves() -> None:
    x = np.linspace(0, 1, 1001, dtype=np.float32)
    assert np.allclose(power_law(x, 2.2) ** 2.2, x, atol=1e-6)
    assert np.array_equal(s_curve(x, 0.0), x)
    curve = s_curve(x, 0.6)
    assert np.allclose(curve[[0, 500, 1000]], [0, 0.5, 1], atol=1e-6) and (np.diff(curve) > 0).all()
    assert curve[501] - curve[499] == pytest.approx(0.002 * 1.3, rel=1e-3)
    expected = quantise8(s_curve(power_law(np.clip(scene(), 0, 1), 1.8), 0.6))
    out = color.apply_color_noise(scene(), settings(response="gamma", gamma=1.8, contrast=0.6), rng())
    assert np.array_equal(out, expected)


# --- light


def test_vignetting_is_the_cos4_law_of_a_lens_with_that_corner() -> None:
    falloff = color.vignetting(64, 48, 0.4)
    assert falloff.shape == (48, 64) and falloff[[0, 0, -1, -1], [0, -1, 0, -1]] == pytest.approx([0.6] * 4)
    tan_corner = np.tan(np.arccos(0.6**0.25))
    u, v = np.meshgrid(np.arange(64) - 31.5, np.arange(48) - 23.5)
    theta = np.arctan(tan_corner * np.hypot(u, v) / np.hypot(31.5, 23.5))
    assert np.abs(falloff - np.cos(theta) ** 4).max() < 1e-6
    assert (color.vignetting(64, 48, 0.0) == 1).all()


def test_exposure_and_white_balance_are_factors_on_the_light() -> None:
    config = settings(exposure_ev=-1.0, white_balance=(1.2, 1.0, 0.5))
    expected = to_srgb8(np.clip(scene() * 0.5, None, 1) * np.float32([1.2, 1.0, 0.5]))
    assert np.abs(color.apply_color_noise(scene(), config, rng()).astype(int) - expected).max() <= 1


def test_a_saturated_sensor_stays_so_whatever_the_balance() -> None:
    out = color.apply_color_noise(flat(3.0), settings(white_balance=(0.5, 1.0, 1.0)), rng())
    assert (out == to_srgb8(np.float32([0.5, 1, 1]))).all()


# --- noise


@pytest.mark.parametrize("gain", [1.0, 4.0])
def test_variance_is_linear_in_the_signal_with_slope_and_floor_of_the_settings(gain: float) -> None:
    full_well, read = 5000.0, 12.0
    levels = np.linspace(0, 0.9, 10)
    noise = [color.add_sensor_noise(flat(x), full_well, read, gain, rng(k)) - x for k, x in enumerate(levels)]
    variance = np.array([n.var(dtype=np.float64) for n in noise])
    expected = levels * gain / full_well + (read * gain / full_well) ** 2
    count = noise[0].size
    # A variance of n normal samples has the relative standard error sqrt(2 / n): 0.6 %.
    assert np.abs(variance / expected - 1).max() < 5 * np.sqrt(2 / count)
    assert np.abs([n.mean(dtype=np.float64) for n in noise] / np.sqrt(expected / count)).max() < 5
    slope, floor = np.polyfit(levels, variance, 1)
    assert slope == pytest.approx(gain / full_well, rel=0.03)
    assert floor == pytest.approx((read * gain / full_well) ** 2, rel=0.1)


def test_shot_noise_is_poissons_at_ordinary_light() -> None:
    electrons = 400.0
    x = electrons / 2000
    ours = color.add_sensor_noise(flat(x), 2000.0, 0.0, 1.0, rng()).ravel() * 2000
    ours = np.rint(ours[:20000])
    # 400 electrons: the normal approximation differs from Poisson by less than 0.004 of cumulative probability.
    edges = stats.poisson.ppf([0.1, 0.3, 0.5, 0.7, 0.9], electrons)
    share = [(ours <= edge).mean() for edge in edges]
    assert np.abs(np.array(share) - stats.poisson.cdf(edges, electrons)).max() < 0.004 + 5 * 0.5 / np.sqrt(len(ours))


def test_noise_reaches_the_image_with_the_slope_of_the_response() -> None:
    x, gain = 0.2, 8.0
    out = color.apply_color_noise(flat(x), settings(gain=gain, full_well_e=6000, read_noise_e=4), rng())
    slope = 255 * 1.055 / 2.4 * x ** (1 / 2.4 - 1)
    sigma = slope * np.sqrt(x * gain / 6000 + (4 * gain / 6000) ** 2)
    # Rounding adds 1/12; the curve's bend moves sigma by about 1 %.
    assert out.std() == pytest.approx(np.sqrt(sigma**2 + 1 / 12), rel=0.02)


def test_pixels_and_channels_are_independent() -> None:
    noise = color.add_sensor_noise(flat(0.5), 6000, 4, 1, rng()) - 0.5
    noise /= noise.std()
    for other in (np.roll(noise, 1, 0), np.roll(noise, 1, 1), np.roll(noise, 1, 2)):
        assert abs((noise * other).mean(dtype=np.float64)) < 5 / np.sqrt(noise.size)


@pytest.mark.parametrize("bayer", ["off", "bilinear"])
def test_a_frame_depends_on_seed_stream_and_frame_only(bayer: str) -> None:
    config = settings(gain=2.0, bayer=bayer)

    def frame(*key: object) -> np.ndarray:
        return color.apply_color_noise(scene(), config, noise_generator(*key))

    first = frame(7, "color", 3)
    assert np.array_equal(first, frame(7, "color", 3))
    for key in ((7, "color", 4), (8, "color", 3), (7, "depth", 3)):
        assert (first != frame(*key)).mean() > 0.3
    light = scene()
    color.apply_color_noise(light, config, rng())
    assert np.array_equal(light, scene())


# --- mosaic


@pytest.mark.parametrize("method", ["bilinear", "edge-aware"])
def test_a_flat_colour_survives_the_mosaic(method: str) -> None:
    x = np.broadcast_to(np.float32([0.7, 0.3, 0.1]), (31, 44, 3))
    assert np.abs(color.demosaic(color.mosaic(x), method) - x).max() < 1e-4


def test_the_mosaic_is_rggb() -> None:
    x = scene()
    raw = color.mosaic(x)
    assert np.array_equal(raw[0::2, 0::2], x[0::2, 0::2, 0]) and np.array_equal(raw[1::2, 1::2], x[1::2, 1::2, 2])
    assert np.array_equal(raw[0::2, 1::2], x[0::2, 1::2, 1]) and np.array_equal(raw[1::2, 0::2], x[1::2, 0::2, 1])


@pytest.mark.parametrize("method", ["bilinear", "edge-aware"])
def test_noise_in_the_dark_is_unbiased_after_demosaicking(method: str) -> None:
    config = settings(gain=2.0, read_noise_e=20.0, bayer=method)
    x = flat(0.004)
    raw = color.add_sensor_noise(color.mosaic(x), config.full_well_e, config.read_noise_e, config.gain, rng())
    assert (raw < 0).mean() > 0.2
    rgb = color.demosaic(raw, method)
    # Green, at half of the pixels, is the most, red and blue at a quarter are the least averaged.
    error = np.abs(rgb.mean((0, 1), dtype=np.float64) - 0.004)
    assert (error < 5 * raw.std() / np.sqrt(raw.size / 4)).all()


def test_edges_get_false_colour_and_smooth_parts_do_not() -> None:
    ramp = np.broadcast_to(np.linspace(0.1, 0.6, 64, dtype=np.float32)[:, None], (48, 64, 3))
    edge = np.where(np.arange(64)[:, None] < 31, np.float32(0.1), np.float32(0.8)) * np.ones((48, 1, 3), np.float32)
    for image, low, high in ((ramp, 0.0, 2.0), (edge, 20.0, 255.0)):
        out = color.apply_color_noise(np.ascontiguousarray(image), settings(bayer="bilinear"), rng())
        chroma = np.ptp(out[4:-4, 4:-4].astype(int), axis=-1).max()
        assert low <= chroma <= high
    grey = cv2.cvtColor(out, cv2.COLOR_RGB2GRAY)
    assert grey[24, 8] == to_srgb8(np.float32(0.1)) and grey[24, 56] == to_srgb8(np.float32(0.8))


@pytest.mark.parametrize(
    "wrong",
    [{"corner_loss": 1.0}, {"gain": -1}, {"full_well_e": 0}, {"white_balance": (1, 0, 1)}, {"exposure_ev": 1e9},
     {"bayer": "grbg"}, {"gamma": float("nan")}, {"iso": 100}],
    ids=str,
)  # fmt: skip
def test_settings_out_of_range_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        settings(**wrong)
