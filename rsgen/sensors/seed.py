"""Random generators: the noise has one a frame, so that a frame does not depend on which others were rendered."""

from __future__ import annotations

from typing import Literal

import numpy as np

# "nois": keeps these seeds apart from the renderer's, which are made of the config's seed and the frame only.
_NOISE = 0x6E6F6973
_STREAMS = {"color": 0, "depth": 1}
_DRIVER, _DEVICE = 0x64726976, 0x64657663  # "driv", "devc"
_MOCAP = 0x6D6F6361  # "moca"
_PARTS = {"jitter": 0, "fate": 1}


def noise_generator(seed: int, stream: Literal["color", "depth"], frame: int) -> np.random.Generator:
    """The generator of the noise of frame `frame` (0, 1, ...) of `stream` in a sequence with the config's `seed`."""
    return np.random.default_rng([_NOISE, seed, _STREAMS[stream], frame])


def driver_generator(
    seed: int, stream: Literal["color", "depth"], part: Literal["jitter", "fate"]
) -> np.random.Generator:
    """The generator of the delays, or of the losses, of all frames of `stream`, drawn in their order."""
    return np.random.default_rng([_DRIVER, seed, _STREAMS[stream], _PARTS[part]])


def device_generator(seed: int) -> np.random.Generator:
    """The generator of the faults that a depth camera has once and for all."""
    return np.random.default_rng([_DEVICE, seed])


def mocap_generator(seed: int) -> np.random.Generator:
    """The generator of the noise of a motion capture's poses, drawn in their order."""
    return np.random.default_rng([_MOCAP, seed])
