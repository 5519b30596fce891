"""Model of a colour camera: linear light at the lens to the 8-bit image, in the order in which a real one does it.

Linear values are such that 1 is white: light times the config's exposure gain.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from rsgen import srgb
from rsgen.array_types import ByteArray, Float32Array
from rsgen.config.cameras import ColorNoiseConfig
from rsgen.sensors.adaptation import Setting
from rsgen.sensors.response import power_law, quantise8, s_curve, to_srgb8

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
    falloff = ((1.0 + corner * r2 / r2[0, 0]) ** -2).astype(np.float32)
    falloff.flags.writeable = False
    return falloff


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
