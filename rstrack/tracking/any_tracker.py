"""Which tracker a method has, and what all trackers have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Protocol

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.data.imu.recording import ImuRecording
from rstrack.data.moving_masks import MovingMasks
from rstrack.data.rig import Frame, Rig
from rstrack.inertial.band import with_knots
from rstrack.options import Options

if TYPE_CHECKING:
    from rstrack.images.device_frame import Timer
    from rstrack.inertial.inertia import Inertia
    from rstrack.tracking.frame_report import FrameReport


class AnyTracker(Protocol):
    """What all trackers have in common."""

    @property
    def reports(self) -> list[FrameReport]:
        """Of all frames so far."""

    @property
    def options(self) -> Options:
        """With all that depends on the rig."""

    @property
    def uncorrected(self) -> FrameTracker:
        """What tracks frame by frame, before loops are closed: often the same."""

    @property
    def keyframes(self) -> int:
        """How many there have been."""

    @property
    def reference(self) -> int | None:
        """Number of the frame whose keyframe new ones are aligned to."""

    @property
    def spline(self) -> Spline | None:
        """T_world_depth(t) so far, None where there is none."""

    @property
    def spline_valid(self) -> Sequence[tuple[float, float]]:
        """Times (begin, end) in s within which the spline is an estimate."""

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) in s of the frames that were not lost and T_world_depth (n, 4, 4) there."""

    def feed(self, frame: Frame) -> FrameReport:
        """Track one frame."""


class FrameTracker(AnyTracker, Protocol):
    """A tracker that closes no loops."""

    @property
    def inertia(self) -> Inertia | None:
        """What has been found of an IMU, where the method uses one."""

    @property
    def color_late(self) -> tuple[float, float]:
        """Seconds that colour was found to be later than its stamps, and σ of that; 0 where it is not estimated."""

    @property
    def left_out(self) -> MovingMasks:
        """Pixels of frames, by their numbers, that were left out since they move by themselves."""


def make_tracker(
    rig: Rig, options: Options, timer: Timer | None = None, load: Callable[[int], Frame] | None = None,
    interval_s: float | None = None, imu: ImuRecording | None = None, after: AnyTracker | None = None,
) -> AnyTracker:  # fmt: skip
    """The tracker of options.method; `timer` watches the parts of its work. load: as in `LoopTracker`.

    interval_s: the median time between frames, where that is known; else that of the first two. imu: of a unit
    on the cameras; methods that use none take no notice. after: a tracker of the same recording; what it has learnt of
    the cameras is known from the start, where the method's tracker learns that.

    Raises UserError if its backend cannot work on this machine, or the method needs an IMU and there is none.
    """
    from rsgen.device.arrays import engine

    # Before anything else imports Dr.Jit, which then would choose a libLLVM itself.
    engine(options.backend)
    from rstrack.images.device_frame import untimed

    options = with_knots(options, imu, rig.depth_camera.fx).decided(rig.depth_shutter, interval_s)
    timer = timer or untimed
    if options.method == "baseline":
        from rstrack.tracking.pose_tracker import BaselineTracker

        return BaselineTracker(rig, options, timer)
    from rstrack.tracking.loop_tracker import LoopTracker
    from rstrack.tracking.spline_tracker import Tracker

    if options.loops == "online":
        return LoopTracker(rig, options, timer, load, imu)
    made, first = Tracker(rig, options, timer, imu), None if after is None else after.uncorrected
    if isinstance(first, Tracker):
        # Before the first frame: what is known of the cameras.
        made.track.covariances.uncertainty = first.track.covariances.uncertainty.begun_anew()
        made.track.scales, made.track.independence = deepcopy((first.track.scales, first.track.independence))
    return made
