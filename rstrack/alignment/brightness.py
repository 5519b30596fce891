"""What is unknown of every colour image beside its pose: gain and offset against its reference, in equation (8).

Cameras expose as they like: I_image = I_ref + gain (I_ref − ½) + offset. The two are eliminated from the image's normal
equations (Schur complement), so that the control points are solved for jointly with them: alternation converges slowly.
"""

from __future__ import annotations

import numpy as np

from rsgen.array_types import FloatArray

MID_GREY = 0.5
"""Intensity about which the gain turns: gain and offset are then least correlated."""

SIGMA = np.array([0.3, 0.15])
"""σ by which gain and offset change from one frame to the next without any reason: it holds them where an image is too
plain to separate them."""
# Gains and offsets that no camera shows: it is another place.
_LEAST, _MOST = np.array([-0.7, -0.6]), np.array([2.0, 0.6])
# Change of an image's mean or standard deviation that its moving view explains from one frame to the next.
_STEADY = 0.03
SAME = np.zeros(2)
"""As bright as the reference."""


def credible(found: FloatArray) -> FloatArray:
    """Gain and offset (2,), no further from none than a camera's can be."""
    return np.clip(found, _LEAST, _MOST)


def contrast(H: FloatArray, at: FloatArray) -> float:
    """Standard deviation of the reference's intensities, made as bright as the image by its gain and offset `at` (2,).

    H (2, 2): of gain and offset, over no σ: Σ w c cᵀ with c = −(I_ref − ½), −1.
    """
    count = max(float(H[1, 1]), 1e-12)
    variance = float(H[0, 0]) / count - (float(H[0, 1]) / count) ** 2
    return float((1.0 + at[0]) * np.sqrt(max(variance, 0.0)))


def relative(image: FloatArray, reference: FloatArray) -> FloatArray:
    """Gain and offset (2,) of an image against a reference, from those of both against a third."""
    gain = (1.0 + image[0]) / (1.0 + reference[0])
    return np.array([gain - 1.0, image[1] - gain * reference[1]])


def factor_and_offset(found: FloatArray) -> tuple[float, float]:
    """What makes intensities of a reference those of an image with such a gain and offset (2,) against it: times the
    first, plus the second."""
    return 1.0 + float(found[0]), float(found[1] - found[0] * MID_GREY)


def absolute(image: FloatArray, reference: FloatArray) -> FloatArray:
    """Those (2,) of an image against a third, from its own against a reference and that one's against the third."""
    gain = (1.0 + image[0]) * (1.0 + reference[0])
    return np.array([gain - 1.0, image[1] + (1.0 + image[0]) * reference[1]])


def expected(before: FloatArray, moments: FloatArray, moments_before: FloatArray) -> FloatArray:
    """Gain and offset (2,) of an image against a third, from those of the one before and the moments (2,) of both.

    The same as before, unless the means and spreads of the images differ.
    """
    if np.abs(moments - moments_before).max() < _STEADY:
        return before
    return absolute(matched(moments, moments_before), before)


def matched(image: FloatArray, reference: FloatArray) -> FloatArray:
    """Gain and offset (2,) that give a reference the mean and spread (2,) of an image of about the same view."""
    gain = image[1] / max(reference[1], 1e-3)
    found = np.array([gain - 1.0, image[0] - MID_GREY - gain * (reference[0] - MID_GREY)])
    return np.clip(found, _LEAST, _MOST)
