"""Random generators of the noise: one a frame, so that a frame does not depend on which others were rendered."""

from __future__ import annotations

from typing import Literal

import numpy as np

# "nois": keeps these seeds apart from the renderer's, which are made of the config's seed and the frame only.
_NOISE = 0x6E6F6973
_STREAMS = {"color": 0, "depth": 1}


def noise_generator(seed: int, stream: Literal["color", "depth"], frame: int) -> np.random.Generator:
    """The generator of the noise of frame `frame` (0, 1, ...) of `stream` in a sequence with the config's `seed`."""
    return np.random.default_rng([_NOISE, seed, _STREAMS[stream], frame])
