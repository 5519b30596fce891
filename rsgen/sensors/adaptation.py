"""A colour camera's automatic exposure, gain and white balance: one setting a frame, from the frames before it.

Grey-world balance: Buchsbaum, A Spatial Processor Model for Object Colour Perception (J. Franklin Inst. 310, 1980).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import ByteArray, Float32Array
from rsgen.config.cameras import AutoExposureConfig, AutoWhiteBalanceConfig

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
