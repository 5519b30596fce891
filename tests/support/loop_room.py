"""A camera that goes to and fro in the ray-cast room, so that it comes back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import synthetic

from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.options import Options
from rstrack.tracking.runs.record import Noise

FRAMES = 30
OPTIONS = Options(method="rs-pg", keyframe_distance=0.04, bootstrap_frames=3, backend="llvm", loops="end")
# So noisy that it drifts.
NOISE = Noise(4e-3, 0.02, 1)


def to_and_fro() -> Spline:
    """Twice there and back within a second."""
    dt, t0 = 0.05, -0.2
    t = t0 + dt * (np.arange(33) - 1.0)
    swing = np.sin(2.0 * np.pi * 2.0 * t)
    xi = np.stack([0.09 * swing, 0.02 * swing, 0.02 * np.cos(9 * t), 0.03 * swing, 0.08 * swing, 0 * t], axis=-1)
    return Spline(se3.exp(xi), t0, dt)


def make_dataset(root: Path) -> Dataset:
    """80×60, with a rolling shutter, by a lens that is known to be even: looking for that takes longer than a track."""
    stream = {"readout_s": 0.02}
    config = synthetic.make_config(width=80, height=60, color=stream, depth=stream)
    writer = synthetic.open_writer(root, config, FRAMES, to_and_fro())
    synthetic.write_frames(writer)
    synthetic.write_scene(root)
    writer.finish()
    return open_dataset(root).with_color_falloff(0.0)
