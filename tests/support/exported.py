"""A short sequence to export, with an IMU and without, and changes to it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import synthetic
import yaml

from rsgen.geometry import se3
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence

T_IMU_DEPTH = se3.exp(np.array([0.12, -0.05, 0.07, 0.4, -1.1, 0.6]))
IMU: dict[str, Any] = {
    "rate_hz": 100.0,
    "T_imu_depth": T_IMU_DEPTH.tolist(),
    "gyroscope_bias": [0.01, -0.02, 0.03],
    "accelerometer_bias": [0.1, 0.2, -0.3],
}
RADTAN = {"model": "radtan", "distortion": [-0.05, 0.02, 0.001, -0.002], "exposure_s": 0.01}
EPOCH_NS = 1_000_000_000_000_000_000


def make_plain(folder: Path) -> Sequence:
    """Six frames, distorted and blurred colour, sensors that differ; no IMU."""
    config = synthetic.make_config(color=RADTAN, depth={"readout_s": 0.02, "offset_s": 0.004, "rate_hz": 15.0})
    return read_sequence(synthetic.make_sequence(folder / "seq", config))


def with_imu(sequence: Sequence, imu: Any) -> Sequence:
    return replace(sequence, meta=sequence.meta | {"config": {**sequence.meta["config"], "imu": imu}})


def with_color(sequence: Sequence, **changes: Any) -> Sequence:
    color = replace(sequence.streams["color"], **changes)
    return replace(sequence, streams={**sequence.streams, "color": color})


def load(path: Path) -> Any:
    return yaml.safe_load(path.read_text())
