"""Dense tracking and mapping with rolling-shutter RGB-D cameras: the trajectory is a spline, every row has its pose.

from rstrack import Frame, Image, Options, Rig, Tracker

Each name is loaded when it is first asked for; of these only the trackers load Dr.Jit.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rstrack.data.rig import Frame, Image, Rig
    from rstrack.options import Options
    from rstrack.tracking.loop_tracker import LoopTracker
    from rstrack.tracking.spline_tracker import Tracker

__all__ = ["Frame", "Image", "LoopTracker", "Options", "Rig", "Tracker"]

_HOME = {
    "Frame": "data.rig", "Image": "data.rig", "LoopTracker": "tracking.loop_tracker", "Options": "options",
    "Rig": "data.rig", "Tracker": "tracking.spline_tracker",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """The class; for a tracker a libLLVM is chosen first, since Dr.Jit would take any (UserError)."""
    if name not in _HOME:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    if name.endswith("Tracker"):
        import_module("rsgen.device.backend").select()
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
