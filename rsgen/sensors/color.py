"""Model of a colour camera: linear light at the lens to the 8-bit image, in the order in which a real one does it.

Linear values are such that 1 is white: light times the config's exposure gain. Also its tone curves, and the controller
of automatic exposure, gain and white balance: one setting a frame, from the frames before it (grey-world balance:
Buchsbaum, A Spatial Processor Model for Object Colour Perception, J. Franklin Inst. 310, 1980).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from rsgen import srgb
from rsgen.array_types import ByteArray, Float32Array
from rsgen.config.cameras import AutoExposureConfig, AutoWhiteBalanceConfig, ColorNoiseConfig


def to_srgb8(linear: Float32Array, gain: float = 1.0) -> ByteArray:
    """8-bit sRGB (IEC 61966-2-1) of linear values times `gain`, clipped to [0, 1]; any shape."""
    return quantise8(srgb.encode(np.clip(linear * np.float32(gain), 0, 1)))


def power_law(x: Float32Array, gamma: float) -> Float32Array:
    """x^(1/gamma) of linear values in [0, 1]; any shape."""
    return np.power(x, np.float32(1 / gamma))


def s_curve(y: Float32Array, contrast: float) -> Float32Array:
    """(1 − c) y + c (3y² − 2y³) of encoded values in [0, 1]; any shape.

    Keeps black, white and the middle; its slope in the middle is 1 + c/2. A stand-in for the contrast that cameras add
    to their response (Grossberg, Nayar, Modeling the Space of Camera Response Functions, PAMI 2004, shows real ones).
    """
    c = np.float32(contrast)
    return y * ((1 - c) + c * y * (3 - 2 * y))


def quantise8(y: Float32Array) -> ByteArray:
    """8-bit code of encoded values in [0, 1], rounded to the nearest; any shape."""
    return np.rint(255 * y).astype(np.uint8)


# Codes of black and white in the 16-bit raw image. As in real raw files black is not 0, so that noise is not cut off
# there, which would brighten the dark.
_BLACK, _WHITE = 4096, 65535
_DEMOSAIC = {"bilinear": cv2.COLOR_BayerRGGB2RGB, "edge-aware": cv2.COLOR_BayerRGGB2RGB_EA}


def apply_setting(
    linear: Float32Array, config: ColorNoiseConfig, setting: Setting
) -> tuple[Float32Array, ColorNoiseConfig]:
    """Light (h, w, 3) and camera as an automatic camera has set them: what `apply_color_noise` takes.

    `linear`: at the reference exposure and gain. The balance acts after the noise, as the camera's own error of it
    does; without noise it acts on the light.
    """
    linear = linear * np.float32(setting.brightness)
    if config.model == "none":
        return linear * np.array(setting.balance, np.float32), config
    balance = tuple(own * factor for own, factor in zip(config.white_balance, setting.balance, strict=True))
    gain = setting.gain if config.gain > 0 else 0.0
    return linear, config.model_copy(update={"white_balance": balance, "gain": gain})


def apply_color_noise(linear: Float32Array, config: ColorNoiseConfig, rng: np.random.Generator) -> ByteArray:
    """8-bit RGB (h, w, 3) that the camera makes of linear RGB (h, w, 3), 1 = white; `rng` decides all of its noise.

    Exposure error and vignetting act on the light, then come the mosaic, shot and read noise, saturation, demosaicking,
    the white balance's error, the response curve, and 8 bits. Model 'none' is `to_srgb8`.
    """
    if config.model == "none":
        return to_srgb8(linear)
    height, width = linear.shape[:2]
    light = linear * (vignetting(width, height, config.corner_loss)[..., None] * np.float32(2.0**config.exposure_ev))
    raw = light if config.bayer == "off" else mosaic(light)
    if config.gain > 0:
        raw = add_sensor_noise(raw, config.full_well_e, config.read_noise_e, config.gain, rng)
    rgb = np.minimum(raw, 1) if config.bayer == "off" else demosaic(raw, config.bayer)
    rgb = np.clip(rgb * np.array(config.white_balance, np.float32), 0, 1)
    encoded = srgb.encode(rgb) if config.response == "srgb" else power_law(rgb, config.gamma)
    return quantise8(s_curve(encoded, config.contrast) if config.contrast > 0 else encoded)


@lru_cache(maxsize=4)
def vignetting(width: int, height: int, corner_loss: float) -> Float32Array:
    """Fraction (h, w) of the light that reaches each pixel: 1 in the centre, 1 − corner_loss at the corner pixels.

    The cos⁴ law of a lens, cos⁴ θ = 1 / (1 + tan² θ)² with tan θ ∝ radius, scaled to the given loss: real lenses lose
    more or less than their field of view alone would take.
    """
    u, v = np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2
    r2 = u**2 + v[:, None] ** 2
    corner = (1.0 - corner_loss) ** -0.5 - 1.0  # tan² θ there
    share = ((1.0 + corner * r2 / r2[0, 0]) ** -2).astype(np.float32)
    share.flags.writeable = False
    return share


def add_sensor_noise(
    signal: Float32Array, full_well_e: float, read_noise_e: float, gain: float, rng: np.random.Generator
) -> Float32Array:
    """`signal` (any shape, 1 = white) with shot and read noise; not clipped.

    White is N = full_well_e / gain electrons. Of x N electrons the shot noise has the variance x N (Poisson) and the
    read noise read_noise_e², so var = x / N + (read_noise_e / N)² in units of white. Both are drawn as one normal
    variable: the Poissonian-Gaussian model of Foi, Trimeche, Katkovnik, Egiazarian (IEEE TIP 2008), eq. 2-4.
    """
    white_e = full_well_e / gain
    sigma = np.maximum(signal, 0)
    sigma *= np.float32(1 / white_e)
    sigma += np.float32((read_noise_e / white_e) ** 2)
    np.sqrt(sigma, out=sigma)
    sigma *= rng.standard_normal(signal.shape, np.float32)
    sigma += signal
    return sigma


def mosaic(rgb: Float32Array) -> Float32Array:
    """What a sensor under an RGGB colour filter array keeps (h, w) of RGB (h, w, 3): red at even row, even column."""
    raw = np.array(rgb[..., 1])
    raw[0::2, 0::2] = rgb[0::2, 0::2, 0]
    raw[1::2, 1::2] = rgb[1::2, 1::2, 2]
    return raw


def demosaic(raw: Float32Array, method: str) -> Float32Array:
    """RGB (h, w, 3) in about [0, 1] from an RGGB mosaic (h, w), 1 = white; through 16 bits, as a raw file would.

    `method`: 'bilinear' or 'edge-aware' (OpenCV's `demosaicing`). The zippers and false colours at edges are the point.
    """
    codes = np.clip(np.rint(raw * np.float32(_WHITE - _BLACK) + _BLACK), 0, _WHITE).astype(np.uint16)
    rgb = cv2.demosaicing(codes, _DEMOSAIC[method]).astype(np.float32)
    return (rgb - np.float32(_BLACK)) * np.float32(1 / (_WHITE - _BLACK))


# Intensity rises with about this power of the light: an error of the intensity in stops, times it, is one of the light.
_GAMMA = 2.2
_LEAST_LEVEL = 1e-3  # of a black picture


@dataclass(frozen=True)
class Setting:
    """How a colour frame is taken. exposure_s: of each line; gain: ISO / base ISO; balance: factors on R, G, B.

    brightness: factor on the light against the reference's exposure and gain.
    """

    exposure_s: float
    gain: float
    brightness: float = 1.0
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Reading:
    """What the camera's meter sees of a frame.

    level: mean intensity of the picture, 0..1. rgb: mean light where it is not saturated, before any balance.
    """

    level: float
    rgb: tuple[float, float, float]


Meter = Callable[[int, Setting], Reading]


def reading(picture: ByteArray, linear: Float32Array) -> Reading:
    """Of an 8-bit picture (h, w, 3) and the light (h, w, 3), 1 = white, from which it was made."""
    usable = linear[(linear < 1).all(axis=-1)]
    red, green, blue = np.maximum(usable.mean(axis=0, dtype=np.float64), 1e-6) if len(usable) else np.ones(3)
    return Reading(float(picture.mean(dtype=np.float64)) / 255.0, (float(red), float(green), float(blue)))


def adapt(
    meter: Meter, frames: int, reference: Setting, exposure: AutoExposureConfig | None,
    balance: AutoWhiteBalanceConfig | None,
) -> list[Setting]:  # fmt: skip
    """Settings of frames 0, 1, ...; `meter` is asked for each frame once, in order, as it is taken.

    reference: exposure and gain at which the light has the config's brightness; the first frame is taken with the
    nearest setting that the limits allow. The exposure looks at a frame only once its last change shows.
    """
    stops = 0.0 if exposure is None else _within(0.0, reference, exposure)
    cast = np.zeros(2)  # log2 of the factors on red and blue
    settings: list[Setting] = []
    coming: dict[int, float] = {}
    coming_cast: dict[int, np.ndarray] = {}
    looks_at = 0
    for k in range(frames):
        stops, cast = coming.pop(k, stops), coming_cast.pop(k, cast)
        setting = reference if exposure is None else _split(stops, reference, exposure)
        red, blue = (2.0**cast).tolist()
        settings.append(replace(setting, balance=(red, 1.0, blue)))
        seen = meter(k, settings[-1])
        if exposure is not None and k >= looks_at:
            wanted = _within(_wanted(stops, seen.level, exposure), reference, exposure)
            if wanted != stops:
                looks_at = k + exposure.lag_frames
                coming[looks_at] = wanted
        if balance is not None:
            goal = balance.strength * np.log2(seen.rgb[1] / np.array([seen.rgb[0], seen.rgb[2]]))
            goal = np.clip(goal, -balance.limit_ev, balance.limit_ev)
            coming_cast[k + balance.lag_frames] = cast + balance.speed * (goal - cast)
    return settings


def _wanted(stops: float, level: float, config: AutoExposureConfig) -> float:
    """Stops against the reference that a picture of mean intensity `level`, taken at `stops`, asks for: whole steps."""
    error = _GAMMA * math.log2(config.target / max(level, _LEAST_LEVEL))
    if abs(error) <= config.dead_band_ev:
        return stops
    steps = max(1, round(config.speed * abs(error) / config.step_ev))
    return stops + math.copysign(steps * config.step_ev, error)


def _within(stops: float, reference: Setting, config: AutoExposureConfig) -> float:
    """The nearest stops that exposure and gain can reach."""
    least, most = (
        math.log2(config.exposure_s[i] * config.gain[i] / (reference.exposure_s * reference.gain)) for i in (0, 1)
    )
    return min(max(stops, least), most)


def _split(stops: float, reference: Setting, config: AutoExposureConfig) -> Setting:
    """Exposure as long as it may be, gain for the rest."""
    total = reference.exposure_s * reference.gain * 2.0**stops
    exposure_s = min(max(total / config.gain[0], config.exposure_s[0]), config.exposure_s[1])
    gain = min(max(total / exposure_s, config.gain[0]), config.gain[1])
    return Setting(exposure_s, gain, 2.0**stops)
