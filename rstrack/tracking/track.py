"""What a tracker has found so far, and what it has found it with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.adjustment.chain import Chain
from rstrack.alignment.free_space import FreeSpace
from rstrack.alignment.linearise import Terms
from rstrack.alignment.observation import Observation, observe
from rstrack.alignment.optimizer import Solved
from rstrack.alignment.priors import ACCELERATION
from rstrack.alignment.spline_state import SplineState
from rstrack.alignment.weights import Independence
from rstrack.data.imu.recording import ImuRecording
from rstrack.data.moving_masks import MovingMasks
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, DeviceRig, Timer, frame_without
from rstrack.images.pyramid import DepthImage
from rstrack.inertial.band import with_knots
from rstrack.inertial.estimate import ALIKE
from rstrack.inertial.inertia import Inertia
from rstrack.keyframes.archive import Archive
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.keyframes.store import KeyframeStore
from rstrack.options import Options
from rstrack.tracking.frame_report import Fault, FrameReport, frame_report
from rstrack.tracking.judgement.consider import Calibration
from rstrack.tracking.judgement.lost_track import GROWTH, RunningScales
from rstrack.tracking.judgement.uncertainty import PoseCovariances
from rstrack.tracking.moving.leave_out import LeftOut, leave_out
from rstrack.tracking.succession import Gains, Succession
from rstrack.tracking.window import FoundPoses, Window

# What a track of the same rig and options would make in the same way.
_MADE_ANEW = "rig", "options", "device", "terms", "maker", "space"


@dataclass(eq=False)
class Match:
    """A frame aligned to `ref`.

    window: with its pose; predicted: T_world_depth(t) before any image. fresh: what took part; whole: nothing had to be
    left out for it. left: what moves by itself.
    """

    frame: DeviceFrame
    ref: Reference
    window: Window
    predicted: Spline
    fresh: list[Observation]
    solved: Solved
    left: LeftOut
    whole: bool = True

    @property
    def on_reference(self) -> list[Observation]:
        """What the frame's images say against `ref`, not against other keyframes."""
        return [o for o in self.fresh if o.ref.index == self.ref.index]

    def again(self) -> None:
        """Align at full size from where it is: its observations count otherwise now, or its steps went to and fro.

        Not where there is no time left.
        """
        if not self.window.has_time:
            self.solved.is_cut = True
            return
        self.solved = self.window.solve(
            self.fresh, (0,), gauge_of(self.window, self.frame, self.ref), is_rolling(self.ref)
        )


def is_rolling(ref: Reference) -> bool:
    """Whether a reference has not been rectified."""
    return ref.rolling is not None


def gauge_of(window: Window, new: DeviceFrame, ref: Reference) -> Reference | None:
    """The first keyframe of a global shutter: no other frame tells where it was taken."""
    return ref if not window.is_frozen(ref.t) and new.depth.exposure.lens.lines == 1 else None


class TrackState:
    """The spline as far as it has grown, the frames found on it, and what they said of the cameras.

    window: None until there is a first frame. age: frames of the current segment of the spline. independence: of depth
    pixels, and of colour pixels. chain: what all frames said of the spline. reports: one of every frame fed.
    inertia: what an IMU says beside them, or None. left_out: of frames, since it moves by itself. is_modelled: whether
    the times of the lines are. scales: how well frames fit.
    """

    def __init__(self, rig: Rig, options: Options, timer: Timer, imu: ImuRecording | None = None) -> None:
        self.rig = rig
        self.options = with_knots(options, imu, rig.depth_camera.fx).decided(rig.depth_shutter)
        self.device = DeviceRig(rig, self.options, timer)
        self.terms = Terms.of(self.device, self.options)
        self.maker = KeyframeMaker.of(self.device)
        self.space = FreeSpace(self.device)
        self.keyframes = KeyframeStore(self.maker, self.options)
        # Taken for a global one, a rolling shutter makes both terms fit worse whenever the camera moves fast.
        self.is_modelled = self.options.rolling or rig.depth_shutter.readout_s == 0.0
        self.scales = RunningScales()
        self.independence = Independence(), Independence()
        self.gains = Gains()
        self._finds_moving = self.options.moving and self.is_modelled
        self.age = 0
        self.reports: list[FrameReport] = []
        self.inertia = None if imu is None else Inertia(imu)
        calibration = Calibration.of(rig, self.device.depth_lens, self.device.color_lens)
        self.covariances = PoseCovariances(rig.depth_camera.fx, calibration)
        self.begin_anew()

    def begin_anew(self) -> None:
        """Nothing has been found of what was fed, and no scale is known: at rest depth repeats its steps."""
        self.scales.reset()
        self.window: Window | None = None
        self._keyframe = -1
        if self.inertia is not None:
            self.inertia.begin_world()
        self.found, self.chain, self.left_out = FoundPoses(), Chain(), MovingMasks()
        self.covariances = self.covariances.begun_anew()
        self.succession = Succession(self.maker, self.keyframes, self.options, self.gains, self.covariances)

    @property
    def shared(self) -> dict[str, object]:
        """What another track of the same rig and options has as well, by name."""
        own = {name: getattr(self, name) for name in _MADE_ANEW}
        if self.inertia is not None:
            own |= {"imu": self.inertia.recording, "imu_samples": self.inertia.samples}
        return own | {"engine": self.device.e, "timer": self.device.timer}

    @property
    def state(self) -> dict[str, Any]:
        """All that feeding frames has changed."""
        own = {name: value for name, value in vars(self).items() if name not in _MADE_ANEW}
        return own | {"resolution": self.device.resolution}

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        own = dict(state)
        self.device.resolution = own.pop("resolution")
        vars(self).update(own)

    def all_keyframes(self) -> Archive:
        """All rectified keyframes, the newest put away with them."""
        self.keyframes.archive_newest()
        return self.keyframes.archive

    @property
    def inflations(self) -> tuple[float, float]:
        """By how much the covariances that depth's pixels give are too small, and colour's."""
        depth, color = self.independence
        return depth.inflation, color.inflation

    @property
    def has_gyro(self) -> bool:
        """Whether a gyroscope tells the motion beside the images."""
        return self.inertia is not None and self.inertia.recording.gyro is not None

    def last_two(self, new: DeviceFrame) -> tuple[float, float] | None:
        """When the last two frames were taken (s), where a new one is exposed at once and there are two."""
        recent = self.succession.recent
        if new.depth.exposure.lens.lines > 1 or len(recent) < 2:
            return None
        return recent[-2].depth.exposure.mid_time, recent[-1].depth.exposure.mid_time

    def known(self) -> tuple[Window, Reference]:
        """The window and what new frames are aligned to, which there must be."""
        ref = self.succession.reference
        assert self.window is not None and ref is not None
        return self.window, ref

    def upload(self, index: int, frame: Frame) -> DeviceFrame:
        """Frame `index` on the device, its colour taken when it is known to have been by now."""
        return self.device.upload(index, frame, self.covariances.color_late[0])

    def upload_again(self, index: int, frame: Frame) -> DeviceFrame:
        """Frame `index` once more, without what has been found to move in it."""
        new, mask = self.upload(index, frame), self.left_out.grid(index)
        return new if mask is None else frame_without(self.device.e, new, mask, self.left_out.stride)

    def observe(self, frame: DeviceFrame, ref: Reference, expected: FloatArray | None = None) -> list[Observation]:
        """What the frame's images say against a reference, as far as their pixels are independent.

        expected (2,): gain and offset of its colours; by default about as before.
        """
        if expected is None:
            expected = self.gains.expected(frame, ref)
        observations = observe(frame, ref, self.options, expected)
        self.count(observations)
        return observations

    def count(self, observations: Sequence[Observation]) -> None:
        """Let the pixels of observations count as far as they are independent by what is known now."""
        for o in observations:
            o.count_as(1.0 / self.independence[not o.is_depth].inflation)

    def scatters(self, o: Observation) -> bool:
        """Whether the gradients of an image's rows scatter about the spline `GROWTH` times as much as usual."""
        return o.inflation > GROWTH**2 * self.independence[not o.is_depth].inflation

    def learn(self, found: Match, excess: float, new: DeviceFrame) -> None:
        """What frame `new`, found where the motion led, says of the spline, the IMU and its own pixels.

        excess: see `Scores`.
        """
        self.age += 1
        self.succession.recent.append(new)
        self.learn_motion(found.ref, found.on_reference, found.window, excess, new.last_time)
        self.learn_independence(found.on_reference)

    def learn_independence(self, fresh: Sequence[Observation]) -> None:
        """How far the pixels of a frame that was found are independent, by its observations."""
        for is_color, term in enumerate(self.independence):
            term.learn(o.inflation for o in fresh if o.is_depth != is_color)

    def learn_motion(
        self, ref: Reference, seen: Sequence[Observation], window: Window, excess: float, end: float
    ) -> None:  # fmt: skip
        """What a frame's observations of `ref` say of the spline, and of an IMU's biases and gravity."""
        self.chain.add(ref, seen, window.state, excess)
        if self.inertia is not None:
            self._shift_inertia(seen)
            models = [o.model(window.state).scaled(1.0 / (ALIKE * excess**2)) for o in seen if o.is_linearised]
            self.inertia.learn(window.state, window.segment_start, models, end)

    def begin_segment(self, found: Match, excess: float, new: DeviceFrame) -> None:
        """A lost frame `new` was found at a keyframe: the spline goes on with a segment of its own."""
        self.age = 1
        self.chain.cut(found.window.segment_start)
        self.succession.use(found.ref, new)
        if self.inertia is not None:
            self.inertia.begin_segment()
        self.learn_motion(found.ref, found.fresh, found.window, excess, new.last_time)

    def leave_out(
        self, frames: Sequence[DeviceFrame], ref: Reference, fresh: Sequence[Observation], state: SplineState,
        before: DepthImage | None = None,
    ) -> list[LeftOut]:  # fmt: skip
        """What moves in frames; their observations `fresh` do without it, see `moving.leave_out`.

        before: of the frame before them.
        """
        depths = [frame.depth for frame in frames]
        if not self._finds_moving:
            return [LeftOut(depth) for depth in depths]
        own = [[o for o in fresh if o.frame == frame.index] for frame in frames]
        return leave_out(self.space, depths, ref, own, state, before)

    def remember(self, frame: DeviceFrame) -> None:
        """What was left out of a frame since it moves by itself."""
        if frame.depth.left_out is not None:
            self.left_out.put(frame.index, frame.depth.left_out, frame.depth.left_out_stride)

    def accelerations(self, window: Window, seconds: float, R_world_depth: FloatArray) -> tuple[FloatArray, float]:
        """σ (6,) of accelerations over so many seconds, beyond what is known, m/s² and rad/s², and of the angular rate,
        rad/s: an IMU tells most. R_world_depth (3, 3): about how the camera is turned."""
        if self.inertia is None or seconds <= 0.0 or not window.is_led(self.found.end, self.found.end + seconds):
            return ACCELERATION, np.inf
        sigmas, rate = self.inertia.sigmas_over(seconds, self.inertia.recording.T_imu_depth[:3, :3] @ R_world_depth.T)
        return np.minimum(ACCELERATION, sigmas), rate

    def _shift_inertia(self, fresh: Sequence[Observation]) -> None:
        """An IMU knows nothing of keyframes: that another one lies a little off is no motion."""
        index = next((o.ref.index for o in fresh if o.ref.rolling is None), self._keyframe)
        drift = self.covariances.uncertainty.drift
        if self.inertia is not None and self._keyframe in drift and index in drift and index != self._keyframe:
            older, newer = sorted((index, self._keyframe))
            self.inertia.shift(drift[newer] - drift[older])
        self._keyframe = index

    def placed(self, new: DeviceFrame, fresh: Sequence[Observation] = (), joined: bool = True) -> None:
        """A frame has been found: its stamp, its brightness, and until when the spline is known."""
        self.found.add(new, joined)
        window, ref = self.known()
        oldest = self.succession.recent[0].index if self.succession.recent else new.index
        self.gains.learn(new, fresh, window.state, oldest)
        if ref.rolling is None:
            self.covariances.add(new, ref, window.spline, oldest)

    def report(
        self, new: DeviceFrame, fresh: Sequence[Observation] = (), solved: Solved | None = None, *,
        keyframe: bool = False, fault: Fault = Fault.NONE, overlap: float = 1.0,
    ) -> FrameReport:  # fmt: skip
        """What became of a frame."""
        report = frame_report(new.stamp, fresh, solved, keyframe=keyframe, fault=fault, overlap=overlap)
        report = replace(report, moving=new.depth.moving, is_cut=solved is not None and solved.is_cut)
        return report if fault else self.covariances.report(report, new, fresh, self.known()[0].spline)
