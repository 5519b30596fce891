"""A shutter as `rsgen export` writes it into others' files, read back."""

from __future__ import annotations

from typing import Any, get_args

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan
from rstrack.formats.recording import StreamCamera


def with_shutter(where: str, camera: Camera, facts: dict[str, Any]) -> StreamCamera:
    """A camera with the shutter of an entry `rolling_shutter` as `rsgen export` writes it.

    Raises UserError naming `where`: times that are none, or an unknown scan.
    """
    times = [facts.get(name, 0.0) for name in ("readout_s", "exposure_s")]
    scan: Scan = facts.get("scan", "top-bottom")
    if not all(isinstance(t, int | float) and 0 <= t < 10 for t in times) or scan not in get_args(Scan):
        raise UserError(f"{where}: rolling_shutter needs readout_s and exposure_s in seconds, and a scan")
    return StreamCamera(camera, float(times[0]), float(times[1]), scan)
