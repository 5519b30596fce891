"""How close an image is to another where both are known: PSNR, SSIM, gradient energy."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rsgen.array_types import BoolArray, ByteArray

_WINDOW = 11


def psnr_db(image: ByteArray, truth: ByteArray, known: BoolArray) -> float:
    """Peak signal-to-noise ratio in dB of sRGB code values (h, w, 3) over the known pixels (h, w); inf if equal."""
    if not known.any() or (image[known] == truth[known]).all():
        return math.inf if known.any() else math.nan
    return float(peak_signal_noise_ratio(truth[known], image[known]))


def ssim(image: ByteArray, truth: ByteArray, known: BoolArray) -> float:
    """Mean structural similarity of the grey images over pixels whose whole window is known; NaN if there are none.

    Wang, Bovik, Sheikh, Simoncelli, IEEE TIP 13(4), 2004: window of 11 px with σ = 1.5 px, constants for 8 bit.
    """
    _, likeness = structural_similarity(
        _grey(image), _grey(truth), gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255.0,
        full=True,
    )  # fmt: skip
    return _mean(likeness, _eroded(known, _WINDOW // 2))


def gradient_energy(image: ByteArray, known: BoolArray) -> float:
    """Mean squared gradient of the grey image, (code values / px)², where both neighbours on each axis are known."""
    grey = _grey(image)
    energy = np.zeros_like(grey)
    energy[:, 1:-1] += (0.5 * (grey[:, 2:] - grey[:, :-2])) ** 2
    energy[1:-1] += (0.5 * (grey[2:] - grey[:-2])) ** 2
    return _mean(energy, _eroded(known, 1))


def _grey(image: ByteArray) -> npt.NDArray[np.float64]:
    return np.asarray(image.astype(np.float64) @ (0.299, 0.587, 0.114))


def _eroded(known: BoolArray, reach: int) -> BoolArray:
    """Pixels (h, w) whose square neighbourhood lies within the image and is known."""
    padded = cv2.copyMakeBorder(known.astype(np.uint8), *(reach,) * 4, cv2.BORDER_CONSTANT, value=0)
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.erode(padded, kernel)[reach:-reach, reach:-reach] > 0)


def _mean(values: npt.NDArray[np.float64], where: BoolArray) -> float:
    return float(values[where].mean()) if where.any() else math.nan
