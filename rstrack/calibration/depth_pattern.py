"""The fixed pattern of depth's error, by the splines of a calibration's windows and the cameras found.

It is found last: a wrong lens, and in few images a wrong readout, look like a pattern, and a lens that is found with
such a pattern taken off stays wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rsgen.console.progress import Progress
from rstrack.calibration.pairs.window import RecordingWindow
from rstrack.calibration.parameters import Parameters, changed
from rstrack.calibration.result import OPPOSITE
from rstrack.data.dataset import Dataset
from rstrack.tracking.first_look.depth_pattern import FoundPattern, estimate_depth_pattern
from rstrack.tracking.first_look.rough_track import GeometricTrack


def pattern_by(
    dataset: Dataset, parts: Sequence[range], windows: Sequence[RecordingWindow], p: Parameters, progress: Progress
) -> FoundPattern:  # fmt: skip
    """parts: the frames of each window. Raises UserError: an image that cannot be read."""
    tracks = [
        GeometricTrack(part, window.spline, window.spline.t_begin, window.spline.t_end)
        for part, window in zip(parts, windows, strict=True)
    ]
    return estimate_depth_pattern(_depth_seen(dataset, p), tracks, progress)


def _depth_seen(dataset: Dataset, p: Parameters) -> Dataset:
    """The dataset with a depth camera of these values. A negative readout is the opposite scan, begun earlier."""
    rig, shutter, readout_s = dataset.rig, dataset.rig.depth_shutter, p.depth_readout_s
    camera = changed(rig.depth_camera, p.color_lens if rig.is_registered else p.depth_lens)
    first_s = min(0.0, readout_s) * (1.0 - 1.0 / shutter.line_count(camera))
    scan = shutter.scan if readout_s >= 0.0 else OPPOSITE[shutter.scan]
    rig = replace(rig, depth_camera=camera, depth_shutter=replace(shutter, readout_s=abs(readout_s), scan=scan))
    return replace(dataset, rig=rig, stamps=dataset.stamps + first_s, depth_error=replace(p.error, pattern=()))
