"""Sensor noise on frames: as in the paper's experiments, reproducible frame by frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from rsgen.array_types import ByteArray, Float32Array
from rsgen.errors import UserError
from rstrack.data.rig import Frame, Image


class ImageReader(Protocol):
    """Decodes the k-th image of a stream. Raises UserError naming the file."""

    def color(self, k: int) -> ByteArray:
        """RGB (h, w, 3)."""

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) in metres, 0 = missing."""


def with_noise(frame: Frame, k: int, sigma_depth: float, sigma_intensity: float, seed: int) -> Frame:
    """Frame k of a dataset with Gaussian noise, which depends on (seed, k) alone, not on what was read before.

    sigma_depth: 1/m; the standard deviation of a depth z is sigma_depth · z² metres (structured light; 1.2e-3 is a
      Kinect's). Missing depth stays missing.
    sigma_intensity: standard deviation of the grey image in [0, 1]. One noise field is added to all three channels, so
      that the grey value has that deviation whatever its weights. The sum is rounded (another 1/12 of a squared grey
      level of variance) and clipped to uint8.
    Raises UserError for deviations that are negative or not finite, and for a negative seed.
    """
    for name, sigma in (("depth", sigma_depth), ("intensity", sigma_intensity)):
        if not (math.isfinite(sigma) and sigma >= 0):
            raise UserError(f"noise: sigma_{name} = {sigma!r} must be a finite number, 0 or more")
    if seed < 0:
        raise UserError(f"noise: seed = {seed} must be 0 or more")
    depth = _noisy_depth(frame.depth, sigma_depth, np.random.default_rng([seed, k, 0])) if sigma_depth else frame.depth
    colors = frame.colors
    if sigma_intensity:
        generators = (np.random.default_rng([seed, k, stream]) for stream in range(1, 1 + len(colors)))
        colors = tuple(_noisy_color(*pair, sigma_intensity) for pair in zip(colors, generators, strict=True))
    return Frame(depth, colors)


@dataclass(frozen=True)
class NoisyImages:
    """The images of a dataset with such noise, the k-th of each stream as in frame k."""

    images: ImageReader
    sigma_depth: float
    sigma_intensity: float
    seed: int

    def color(self, k: int) -> ByteArray:
        """RGB (h, w, 3)."""
        image = Image(0.0, self.images.color(k))
        frame = Frame(Image(0.0, np.zeros((1, 1), np.float32)), (image,))
        return np.asarray(with_noise(frame, k, 0.0, self.sigma_intensity, self.seed).colors[0].pixels, np.uint8)

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) in metres, 0 = missing."""
        frame = Frame(Image(0.0, self.images.depth(k)), ())
        return np.asarray(with_noise(frame, k, self.sigma_depth, 0.0, self.seed).depth.pixels, np.float32)


def _noisy_depth(image: Image, sigma: float, rng: np.random.Generator) -> Image:
    z = image.pixels
    noise = rng.standard_normal(z.shape, np.float32)
    return Image(image.stamp, np.maximum(z + np.float32(sigma) * z * z * noise, np.float32(0.0)))


def _noisy_color(image: Image, rng: np.random.Generator, sigma: float) -> Image:
    levels = np.rint(np.float32(255.0 * sigma) * rng.standard_normal(image.pixels.shape[:2], np.float32))
    field = np.clip(levels, -255, 255).astype(np.int16)  # beyond these everything clips anyway
    return Image(image.stamp, np.asarray(cv2.add(image.pixels, cv2.merge([field] * 3), dtype=cv2.CV_8U), np.uint8))
