"""A short recording of a room by a camera that is shaken, and wrong cameras to calibrate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import synthetic

from rsgen.array_types import ByteArray, Float32Array
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.geometry.spline import Spline
from rstrack.calibration.figures import ResidualScales
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.image_files import ImageReader
from rstrack.data.rig import DepthError
from rstrack.options import Options

READOUT_S, RATE_HZ, FRAMES = 0.014, 60.0, 60
CORNER = se3.exp(np.array([-0.3, -0.1, 0.2, -0.4, 0.65, 0.1]))
# As few as will do.
SHORT = slice(0, 42)
OPTIONS = Options(backend="llvm")
RESIDUALS = ResidualScales(2e-3, 0.02), ResidualScales(1e-3, 0.01)
PACE = {name: [1.0, 1.0] for name in ("time_s", "m_s", "rad_s")}


def shaking() -> Spline:
    """T_world_depth over [-0.2, 1.3] s: turned and moved to and fro about all axes, before a corner of the room."""
    dt, t0 = 0.05, -0.2
    t = t0 + dt * (np.arange(33) - 1.0)
    turns = [0.07 * np.sin(9.0 * t), 0.08 * np.cos(11.0 * t), 0.06 * np.sin(13.0 * t)]
    moves = [0.05 * np.sin(7.0 * t), 0.05 * np.cos(5.0 * t), 0.04 * np.sin(6.0 * t)]
    return Spline(CORNER @ se3.exp(np.stack([*moves, *turns], axis=-1)), t0, dt)


def recording(
    root: Path, spline: Spline, readout_s: float = READOUT_S, scan: Scan = "top-bottom", frames: int = SHORT.stop
) -> Dataset:
    stream = {"rate_hz": RATE_HZ, "readout_s": readout_s, "scan": scan}
    config = synthetic.make_config(width=160, height=120, color=stream, depth=stream)
    writer = synthetic.open_writer(root, config, frames, spline)
    synthetic.write_frames(writer)
    writer.finish()
    return open_dataset(root)


@dataclass(frozen=True)
class FaultyDepth:
    """Images of which depth is what such an error makes of it."""

    images: ImageReader
    error: DepthError
    camera: Camera

    def color(self, k: int) -> ByteArray:
        return self.images.color(k)

    def depth(self, k: int) -> Float32Array:
        return self.error.corrected(self.images.depth(k), self.camera)


def bent(dataset: Dataset) -> Dataset:
    """With cameras that have a distortion, of nothing."""
    flat = [replace(c, model="radtan", distortion=(0.0,) * 5) for c in (dataset.rig.depth_camera,
                                                                       dataset.rig.color_camera)]  # fmt: skip
    return replace(dataset, rig=replace(dataset.rig, depth_camera=flat[0], color_camera=flat[1]))


def told(dataset: Dataset, readout_s: float, late_s: float, moved: np.ndarray, scan: Scan = "top-bottom") -> Dataset:
    """The dataset with cameras of which these are wrong."""
    rig = dataset.rig
    rig = replace(
        rig, depth_shutter=Shutter(readout_s, 0.0, scan), color_shutter=Shutter(readout_s, 0.0, scan),
        T_color_depth=se3.exp(moved) @ rig.T_color_depth,
    )  # fmt: skip
    return replace(dataset, rig=rig, color_stamps=dataset.color_stamps + late_s)
