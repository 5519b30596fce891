"""A camera that moves through the glowing room, frames of it, and how far two sets of noisy frames are apart."""

from __future__ import annotations

from typing import Any

import numpy as np
from rendering import CAMERA, constant_twist, emission_integrator

from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.images import ColorRenderer

STAMP = 0.31
MOTION = constant_twist((0.7, -0.5, 0.6, 0.6, -1.1, 0.9), se3.exp(np.array([0.1, 0.2, -0.3, 0.2, -0.4, 0.3])))


def color(scene: Any, shutter: Shutter, spp: int = 16, camera: Camera = CAMERA) -> ColorRenderer:
    return ColorRenderer(scene, emission_integrator(), camera, shutter, spp)


def z_spread(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square z-score of the difference of two sets of renders (n, h, w, 3) of one mean: 1 if it is one.

    The difference of the means is compared with the sets' own spread, pooled over the picture by the ratio of sums
    (single pixels' variances are too uncertain to divide by).
    """
    difference = a.mean(0, dtype=float) - b.mean(0, dtype=float)
    variance = a.var(0, ddof=1, dtype=float) / len(a) + b.var(0, ddof=1, dtype=float) / len(b)
    return float(np.sqrt((difference**2).sum() / variance.sum()))
