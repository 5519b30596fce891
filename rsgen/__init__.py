"""rsgen: rolling-shutter RGB-D benchmark sequences with exact continuous-time ground truth.

from rsgen import Camera, RollingShutterSensor, Shutter, Spline, read_sequence

Each name is loaded when it is first asked for; of these only `RollingShutterSensor` loads Mitsuba.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rsgen.geometry.camera import Camera
    from rsgen.geometry.shutter import Shutter
    from rsgen.geometry.spline import Spline
    from rsgen.render.sensor import RollingShutterSensor
    from rsgen.sequence.reader import read_rig, read_sequence

__all__ = ["Camera", "RollingShutterSensor", "Shutter", "Spline", "read_rig", "read_sequence"]

_HOME = {
    "Camera": "geometry.camera", "RollingShutterSensor": "render.sensor", "Shutter": "geometry.shutter",
    "Spline": "geometry.spline", "read_rig": "sequence.reader", "read_sequence": "sequence.reader",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """The class or function; a variant of Mitsuba is chosen for the sensor, if none is active yet (UserError)."""
    if name not in _HOME:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    if name == "RollingShutterSensor":
        import_module("rsgen.device.backend").mitsuba()
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
