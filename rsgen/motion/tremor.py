"""The hand's physiological tremor of about 8 to 12 Hz, added to a smooth motion.

Its band is that of Gavant, Alacoque, Dupret, David, A Physiological Camera Shake Model for Image Stabilization Systems
(IEEE Sensors 2011); amplitudes are the config's.
"""

from __future__ import annotations

import math

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.motion import TremorConfig
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.motion.shake import band_noise
from rsgen.sequence.trajectory import Trajectory

_STREAM = 0x7E30  # tells its random numbers from others of the same seed
_KNOTS_A_WAVE = 8  # of the band's fastest: a least-squares cubic B-spline then misses a thousandth of it
_SAMPLES_A_KNOT = 4


def with_tremor(spline: Spline, config: TremorConfig, seed: int, span: FloatArray) -> tuple[Trajectory, float]:
    """Poses T_world_cam of T(t) exp(tremor) over span (2,), s, and the knot spacing, s, that a spline of them needs.

    The spacing is a whole fraction of the spline's own. seed: where the config names no other. Raises UserError if the
    span is too short for the band.
    """
    begin, end = map(float, span)
    fraction = max(1, math.ceil(spline.dt * config.band_hz[1] * _KNOTS_A_WAVE))
    spacing = spline.dt / fraction
    count = math.ceil((end - begin) / spacing * _SAMPLES_A_KNOT)
    t = np.linspace(begin, end, count + 1)
    rng = np.random.default_rng([seed if config.seed is None else config.seed, _STREAM])
    noise = band_noise(rng, count, count / (end - begin), config.band_hz, 0.0)
    size = np.repeat([config.position_m, math.radians(config.rotation_deg)], 3)
    twist = np.concatenate([noise, noise[:1]]) * size
    return Trajectory(t, spline.pose(t) @ se3.exp(twist)), spacing
