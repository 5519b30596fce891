"""Random generators: the noise has one a frame, so that a frame does not depend on which others were rendered."""

from __future__ import annotations

import zlib
from typing import Literal

import numpy as np

# "nois": keeps these seeds apart from the renderer's, which are made of the config's seed and the frame only.
_NOISE = 0x6E6F6973
_STREAMS = {"color": 0, "depth": 1}  # those of a sequence of two cameras
_DRIVER, _DEVICE = 0x64726976, 0x64657663  # "driv", "devc"
_MOCAP = 0x6D6F6361  # "moca"
_PARTS = {"jitter": 0, "fate": 1}


def camera_number(name: str) -> int:
    """What distinguishes a camera's random numbers from another's: by its name, whichever others there are."""
    return _STREAMS[name] if name in _STREAMS else zlib.crc32(name.encode())


def noise_generator(seed: int, stream: str, frame: int) -> np.random.Generator:
    """The generator of the noise of frame `frame` (0, 1, ...) of `stream` in a sequence with the config's `seed`."""
    return np.random.default_rng([_NOISE, seed, camera_number(stream), frame])


def driver_generator(seed: int, stream: str, part: Literal["jitter", "fate"]) -> np.random.Generator:
    """The generator of the delays, or of the losses, of all frames of `stream`, drawn in their order."""
    return np.random.default_rng([_DRIVER, seed, camera_number(stream), _PARTS[part]])


def device_generator(seed: int) -> np.random.Generator:
    """The generator of the faults that a depth camera has once and for all."""
    return np.random.default_rng([_DEVICE, seed])


def frame_seed(seed: int, stream: str, frame: int) -> int:
    """The seed of all samples of a frame of a camera of the config's `seed`."""
    of_camera = [] if stream in _STREAMS else [camera_number(stream)]
    return int(np.random.SeedSequence([seed, frame, *of_camera]).generate_state(1)[0])


def mocap_generator(seed: int) -> np.random.Generator:
    """The generator of the noise of a motion capture's poses, drawn in their order."""
    return np.random.default_rng([_MOCAP, seed])


def device_seed(seed: int, stream: str) -> int:
    """The seed of the faults that a camera has once and for all: of a rig each its own."""
    return seed if stream in _STREAMS else frame_seed(seed, stream, 0)
