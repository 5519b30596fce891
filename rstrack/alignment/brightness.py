"""What is unknown of every colour image beside its pose: gain and offset against its reference, and its lateness.

Cameras expose as they like: I_image = I_ref + gain (I_ref − ½) + offset. And where stamps are arrival times, an image
may be `late` seconds later than its stamp says: its lines' poses move by their velocity times that. These three are
eliminated from the image's normal equations (Schur complement), so that the control points are solved for jointly with
them: alternation converges slowly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.geometry.so3 import FloatArray
from rstrack.alignment.block_sums import BlockSums
from rstrack.alignment.normal_equations import Quadratic
from rstrack.images.device_frame import MOST_LATE_S

MID_GREY = 0.5
"""Intensity about which the gain turns: gain and offset are then told apart best."""

# What gain and offset may change from one frame to the next without any reason, as σ; it holds them where an image is
# too plain to tell them apart.
_SIGMA = 0.3, 0.15
# σ of lateness where it is known to be none (s).
_NEVER = 1e-9
# Gains and offsets that no camera shows, and lateness that a first estimate does not leave: it is another place.
_LEAST, _MOST = np.array([-0.7, -0.6, -MOST_LATE_S]), np.array([2.0, 0.6, MOST_LATE_S])
# Change of an image's mean or standard deviation that its moving view explains from one frame to the next.
_STEADY = 0.03
SAME = np.zeros(3)
"""As bright as the reference, and not late."""


@dataclass(frozen=True)
class Eliminated:
    """Gain, offset and lateness that were eliminated from a model.

    at (3,): where it was made; the best ones are `at` + step + follow δ after increments δ (6k,) of its control points.
    """

    at: FloatArray
    step: FloatArray
    follow: FloatArray

    def best(self, increments: FloatArray) -> FloatArray:
        """Gain, offset and lateness (3,) after increments (6k,)."""
        return np.clip(self.at + self.step + self.follow @ increments, _LEAST, _MOST)


def eliminate(
    model: Quadratic, coupling: FloatArray, H: FloatArray, g: FloatArray, at: FloatArray, expected: FloatArray,
    late_sigma_s: float,
) -> tuple[Quadratic, Eliminated, float]:  # fmt: skip
    """The model without gain, offset and lateness; what was eliminated; and the cost of the prior.

    coupling (6k, 3), H (3, 3), g (3,): theirs with the control points and among themselves, over σ² as the model is.
    at, expected (3,): their values here, and their prior's mean. late_sigma_s: σ of that for lateness, 0: it is known.
    """
    prior = np.array([*_SIGMA, max(late_sigma_s, _NEVER)])
    off = (at - expected) / prior
    solved = -np.linalg.solve(H + np.diag(1.0 / prior**2), np.column_stack([g + off / prior, coupling.T]))
    step, follow = solved[:, 0], solved[:, 1:]
    reduced = model.H + coupling @ follow
    left = Quadratic(model.first, 0.5 * (reduced + reduced.T), model.g + coupling @ step)
    return left, Eliminated(at, step, follow), 0.5 * float(off @ off)


def with_lateness(sums: BlockSums, velocity: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coupling of each block's twist (nc, nr, 6, 3), H (3, 3) and g (3,) of gain, offset and lateness.

    velocity (nc, 6): twist of each block of lines per second, in the base frame: what being late moves it by.
    """
    assert sums.brightness is not None
    pull = sums.H @ velocity[:, None, :, None]
    coupling = np.concatenate([sums.brightness.coupling, pull], axis=-1)
    H, g = np.empty((3, 3)), np.append(sums.brightness.g, np.einsum("crk,ck->", sums.g, velocity))
    H[:2, :2] = sums.brightness.H
    H[2] = H[:, 2] = np.einsum("crkm,ck->m", coupling, velocity)
    return coupling, H, g


def relative(image: FloatArray, reference: FloatArray) -> FloatArray:
    """Gain and offset (2,) of an image against a reference, from those of both against a third."""
    gain = (1.0 + image[0]) / (1.0 + reference[0])
    return np.array([gain - 1.0, image[1] - gain * reference[1]])


def absolute(image: FloatArray, reference: FloatArray) -> FloatArray:
    """Those (2,) of an image against a third, from its own against a reference and that one's against the third."""
    gain = (1.0 + image[0]) * (1.0 + reference[0])
    return np.array([gain - 1.0, image[1] + (1.0 + image[0]) * reference[1]])


def expected(before: FloatArray, moments: FloatArray, moments_before: FloatArray) -> FloatArray:
    """Gain and offset (2,) of an image against a third, from those of the one before and the moments (2,) of both.

    The same as before, unless the images as a whole say otherwise.
    """
    if np.abs(moments - moments_before).max() < _STEADY:
        return before
    return absolute(matched(moments, moments_before), before)


def matched(image: FloatArray, reference: FloatArray) -> FloatArray:
    """Gain and offset (2,) that give a reference the mean and spread (2,) of an image of about the same view."""
    gain = image[1] / max(reference[1], 1e-3)
    found = np.array([gain - 1.0, image[0] - MID_GREY - gain * (reference[0] - MID_GREY)])
    return np.clip(found, _LEAST[:2], _MOST[:2])
