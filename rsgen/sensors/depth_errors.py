"""Faults that a depth camera has once and for all: a wrong scale, a bent disparity, a fixed pattern; blur by exposure.

Calibrations of real sensors find depth that is off by a factor that varies slowly over the image and grows with the
distance (Teichman, Miller, Thrun, Unsupervised Intrinsic Calibration of Depth Sensors via SLAM, RSS 2013), as an error
of the disparity makes it: z' - z ≈ -z² δ / (b f). Beside it each pixel has a small offset of its own that stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np

from rsgen.array_types import Float32Array
from rsgen.config.cameras import DepthNoiseConfig
from rsgen.geometry.camera import Camera
from rsgen.sensors.seed import device_generator

# Relative change of 1/z within an exposure beyond which a pixel has seen two surfaces, not one that moves.
_ONE_SURFACE = 0.03


def with_fixed_errors(z: Float32Array, camera: Camera, config: DepthNoiseConfig, seed: int) -> Float32Array:
    """Depth (h, w) in m of the faulty camera that the sequence's `seed` makes, before any noise; 0 stays 0.

    z' = (1 + scale_error) b f / (b f / z + δ), δ the fixed error of each pixel's disparity in px. What would lie
    beyond infinity is 0.
    """
    if config.scale_error == 0 and config.distortion_px == 0 and config.pattern_px == 0:
        return z
    focal_baseline = np.float32(config.projector_baseline_m * camera.fx)
    delta = disparity_error(
        camera.width, camera.height, config.distortion_px, config.distortion_period_px, config.pattern_px, seed
    )
    d = np.where(z > 0, focal_baseline / np.where(z > 0, z, 1) + delta, np.float32(0))
    return np.where(d > 0, np.float32(1 + config.scale_error) * focal_baseline / np.where(d > 0, d, 1), np.float32(0))


@lru_cache(maxsize=2)
def disparity_error(
    width: int, height: int, distortion_px: float, period_px: float, pattern_px: float, seed: int
) -> Float32Array:
    """Fixed error (h, w) of the disparity in px: smooth bends and a pattern, each of zero mean and the given RMS.

    Bends are bicubic between normal values on a grid of half a period; the pattern is white.
    """
    rng = device_generator(seed)
    shape = [max(2, int(np.ceil(2 * n / period_px)) + 1) for n in (height, width)]
    knots, white = rng.standard_normal(shape, np.float32), rng.standard_normal((height, width), np.float32)
    bends = cv2.resize(knots, (width, height), interpolation=cv2.INTER_CUBIC)
    error = np.float32(distortion_px) * _unit(np.asarray(bends)) + np.float32(pattern_px) * _unit(white)
    error.flags.writeable = False
    return error


def _unit(field: Float32Array) -> Float32Array:
    centred = field - field.mean()
    return centred / np.sqrt(np.mean(centred**2))


def mixed_depth(samples: Sequence[Float32Array], flying: bool) -> Float32Array:
    """Depth (h, w) in m that an exposure gives of the depths (h, w) at n instants of it; 0 = nothing.

    Time of flight (`flying`) mixes what returns from all of them. Structured light matches one pattern: where a pixel
    sees one surface, moving, its mean disparity; where surfaces change, that of the longer time (the median).
    """
    z = np.stack(samples)
    seen = z > 0
    if flying:
        return np.where(seen.any(0), z.sum(0) / np.maximum(seen.sum(0), 1), np.float32(0)).astype(np.float32)
    inverse = np.where(seen, 1 / np.where(seen, z, 1), np.float32(0))
    middle = np.sort(inverse, axis=0)[len(samples) // 2]
    one_surface = (inverse.max(0) - inverse.min(0)) < np.float32(_ONE_SURFACE) * middle
    found = np.where(one_surface, inverse.mean(0), middle)
    return np.where(found > 0, 1 / np.where(found > 0, found, 1), np.float32(0)).astype(np.float32)
