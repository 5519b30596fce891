"""The rolling shutter in words and numbers, as JSON: what formats without lines have no words for.

With it and the spline's control points, every line's pose follows from the export alone.
"""

from __future__ import annotations

from typing import Any

from rsgen.formats.export.poses.approximation import Loss, exposures
from rsgen.sensors.imu import nanoseconds
from rsgen.sequence.reader import Sequence, Stream

FORMAT = "rsgen-rolling-shutter/1"


def shutter_facts(sequence: Sequence, losses: dict[str, Loss]) -> dict[str, Any]:
    """Shutters of both streams, their images' stamps, and what a format's poses lose against the spline, for JSON."""
    return {
        "format": FORMAT,
        "sequence": sequence.name,
        "stamp": "end of the exposure of line 0, the line that is read first",
        "line_window": "line i of n: [stamp + i readout_s / n - exposure_s, stamp + i readout_s / n], seconds",
        "pose_of_line": "at the middle of its window",
        "line_of_pixel": "top-bottom: i = v; bottom-top: i = n - 1 - v; left-right: i = u; right-left: i = n - 1 - u",
        "streams": {name: _stream(stream) for name, stream in sequence.streams.items()},
        "T_color_depth": sequence.T_color_depth.tolist(),
        "loss_px": {name: loss.as_dict() for name, loss in losses.items()},
    }


def _stream(stream: Stream) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "readout_s": stream.shutter.readout_s,
        "exposure_s": stream.shutter.exposure_s,
        "scan": stream.shutter.scan,
        "lines": stream.line_count,
        "line_delay_s": stream.shutter.line_delay(stream.camera),
        "rate_hz": stream.rate_hz,
        "offset_s": stream.offset_s,
        "size": [stream.camera.width, stream.camera.height],
        "intrinsics": [stream.camera.fx, stream.camera.fy, stream.camera.cx, stream.camera.cy],
        "model": stream.camera.model,
        "distortion": list(stream.camera.distortion),
    }
    if stream.registered:
        facts["registered"] = "images are warped into the colour camera; size, intrinsics and lines are the sensor's"
    if stream.depth_scale:
        facts["depth_scale"] = stream.depth_scale
    if stream.table is not None:
        facts["listed_ns"] = nanoseconds(stream.listed)
        facts["true_ns"] = nanoseconds(stream.stamps)
        facts["exposures_s"] = exposures(stream).tolist()
    return facts


def loss_words(losses: dict[str, Loss]) -> str:
    """The losses as the end of the line that an export prints."""
    return "against the spline: " + "; ".join(f"{name} {loss}" for name, loss in losses.items())
