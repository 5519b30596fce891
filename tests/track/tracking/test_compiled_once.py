"""Kernels are handed cameras' numbers and sizes: another camera has nothing compiled for it."""

from __future__ import annotations

import drjit as dr
import synthetic

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.data.rig import Frame, Image, Rig
from rstrack.options import Options
from rstrack.tracking.spline_tracker import Tracker

TRUTH = synthetic.make_spline(0.8)
FIRST = Camera(160, 120, 120.0, 121.0, 79.5, 59.5, "radtan", (0.1, -0.05, 0.001, -0.002, 0.01))
OTHER = Camera(316, 242, 241.0, 240.0, 160.0, 118.0, "radtan", (-0.04, 0.02, 0.002, 0.001, -0.01))


def kernels_of(camera: Camera, shutter: Shutter) -> set[int]:
    """Hashes of all kernels that tracking with such cameras launches, a keyframe or two included."""
    tracker = Tracker(Rig(camera, shutter, camera, shutter, synthetic.T_COLOR_DEPTH), Options(method="rs-pg"))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for k in range(14):
            stamp = k / 15.0
            depth = synthetic.render_depth(TRUTH, camera, shutter, stamp)
            color = synthetic.render_color(TRUTH, camera, shutter, stamp, synthetic.T_COLOR_DEPTH)
            assert not tracker.feed(Frame(Image(stamp, depth), (Image(stamp, color),))).lost
        found = {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}
    assert tracker.keyframes > 1
    return found


def test_a_camera_of_another_size_has_nothing_compiled_for_it() -> None:
    first = kernels_of(FIRST, Shutter(readout_s=0.028))
    assert 10 < len(first) < 25
    assert kernels_of(OTHER, Shutter(readout_s=0.015, exposure_s=0.004)) <= first
