"""The keyframe that new frames are aligned to, and how another one succeeds it (paper, sections 3.2 and 3.5)."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment import brightness
from rstrack.alignment.brightness import factor_and_offset, relative
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.data.moving_masks import Mask
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker, Making
from rstrack.keyframes.store import KeyframeStore
from rstrack.options import Options
from rstrack.tracking.judgement.uncertainty import PoseCovariances
from rstrack.tracking.moving.leave_out import without
from rstrack.tracking.window import Window

# Part of the pixels that must have depth for a frame to become a keyframe.
LEAST_DEPTH = 0.02
# Frames in a row whose colours do not fit the keyframe's after which it is the keyframe's that are wrong.
_COLORLESS = 5
# Parts that a keyframe is made in (`Making`), all within this share of the frames for which the one before has served:
# six frames each time and fr1_rpy, where one serves for seven, loses frames. Small images have more parts a frame.
_PARTS, _LATE, _PART_PX = 6, 0.2, 2 * 320 * 240
# Frames that have to see through a keyframe's pixel, or find it elsewhere, for it to be gone.
_SEEN_THROUGH = 3


@dataclass
class Gains:
    """Of the recent frames, by their numbers; moments: of the newest colour image."""

    found: dict[int, FloatArray] = field(default_factory=dict)
    moments: FloatArray | None = None

    def of(self, frame: DeviceFrame) -> FloatArray:
        """Gain and offset (2,) of a frame; of one that is not known those of the track's first."""
        return self.found.get(frame.index, brightness.SAME)

    def expected(self, frame: DeviceFrame, ref: Reference) -> FloatArray:
        """Gain and offset (2,) that a frame may have against a reference: as found, or about as the newest's."""
        own = self.found.get(frame.index)
        if own is None and frame.colors and self.found and self.moments is not None:
            own = brightness.expected(self.found[max(self.found)], frame.colors[0].moments, self.moments)
        return brightness.SAME if own is None else brightness.relative(own, ref.brightness)

    def learn(self, frame: DeviceFrame, fresh: Sequence[Observation], state: SplineState, oldest: int) -> None:
        """What a frame's colours were found to be; frames before number `oldest` are forgotten."""
        if not frame.colors:
            return
        color = next((o for o in fresh if not o.is_depth), None)
        own = brightness.SAME
        if color is not None:
            own = brightness.absolute(color.nuisance(state), color.ref.brightness)
        self.found = {k: b for k, b in self.found.items() if k >= oldest} | {frame.index: own}
        self.moments = frame.colors[0].moments


@dataclass
class _Making:
    """A keyframe in the making, of a frame whose poses T_world_depth(t) no longer change: parts with every new frame.

    per_frame: parts done with each. left: those until `made` takes over, where all are done since it was stored.
    """

    frame: DeviceFrame
    spline: Spline
    parts: Making | None
    per_frame: int
    made: Reference | None = None
    left: int = 0

    def goes_on(self) -> bool:
        """Do the next part; whether that was the last one."""
        if self.parts is None:
            self.left -= 1
            return self.left == 0
        try:
            next(self.parts)
        except StopIteration as end:
            self.made, self.parts = end.value, None
        return self.made is not None

    def __getstate__(self) -> dict[str, Any]:
        """All parts are done, but it takes over when it would have: what is stored goes on as what is not."""
        while self.parts is not None:
            self.goes_on()
            self.left += 1
        return vars(self)


class Succession:
    """reference: what new frames are aligned to, a keyframe or, where it cannot be rectified yet, a rolling frame.

    recent: frames whose control points still move, and the newest one whose do not.
    """

    def __init__(
        self, maker: KeyframeMaker, store: KeyframeStore, options: Options, gains: Gains, covariances: PoseCovariances
    ) -> None:
        self._maker, self._store, self._options = maker, store, options
        self._gains, self._covariances = gains, covariances
        self.reference: Reference | None = None
        self.recent: deque[DeviceFrame] = deque()
        # The newest frame, while it is the reference and cannot be rectified yet.
        self._unconverged: DeviceFrame | None = None
        # The next reference, while it is worked on, and the newest frame when the one before became it.
        self._making: _Making | None = None
        self._since = 0
        # The most pixels that a frame saw of each reference, since it was made.
        self._pixels: dict[int, int] = {}
        # Frames in a row whose colours did not fit the reference's own.
        self._colorless = 0
        # How often pixels of the reference's grid have been seen through.
        self._gone: npt.NDArray[np.uint8] | None = None

    def is_unfit(self, frame: DeviceFrame) -> bool:
        """Whether a frame shows too little to align others to it."""
        return frame.depth_share < LEAST_DEPTH or (self._options.photometric and not frame.colors)

    def overlap(self, fresh: Sequence[Observation]) -> float:
        """Part of the reference that a frame sees, of the most that any has seen."""
        seen = next((o for o in fresh if o.is_linearised and o.lin.count), None)
        if seen is None:
            return 0.0
        most = self._pixels[seen.ref.index] = max(self._pixels.get(seen.ref.index, 0), seen.pixels)
        return seen.pixels / most

    def view(self, frame: DeviceFrame, ref: Reference, fresh: Sequence[Observation], gone: Mask | None) -> float:
        """How the newest frame sees the reference: with which colours, and through which pixels; returns `overlap`."""
        is_colorless = bool(frame.colors and ref.points) and all(o.is_depth for o in fresh)
        self._colorless = self._colorless + 1 if is_colorless else 0
        overlap = self.overlap(fresh)
        self.saw_through(gone)
        return overlap

    def saw_through(self, gone: Mask | None) -> None:
        """Pixels (gh, gw) of the reference's grid that the newest frame has found to be gone, if there are any.

        Those that several have are no longer part of it.
        """
        ref = self.reference
        if gone is None or ref is None:
            return
        before = np.zeros(gone.shape, np.uint8) if self._gone is None else self._gone
        self._gone = np.where(gone & (before < 255), before + 1, before).astype(np.uint8)
        surely = self._gone == _SEEN_THROUGH
        if not (surely & gone).any():
            return
        self.reference = without(self._maker.e, ref, self._gone >= _SEEN_THROUGH)
        if self._store and self._store.newest is ref:
            self._store.improve(self.reference)

    def use(self, found: Reference, frame: DeviceFrame) -> None:
        """Go on with a keyframe that a lost frame has been found by."""
        self._store.use(found)
        self.recent = deque([frame])
        self._refer_to(found, is_found=True)

    def make(self, frame: DeviceFrame, spline: Spline, older: Reference | None) -> Reference:
        """A keyframe, rectified with T_world_depth(t) and joined with what an older one saw, at once."""
        making = self._begun(frame, spline, older, 0)
        while not self._goes_on(making):
            pass
        return self._succeeded(making)

    def _goes_on(self, making: _Making) -> bool:
        """Do what a frame has time for; whether the keyframe is done."""
        with self._maker.timer("keyframes: make"):
            return any(making.goes_on() for _ in range(making.per_frame))

    def _begun(self, frame: DeviceFrame, spline: Spline, older: Reference | None, served: int) -> _Making:
        """served: frames for which the one before has, or 0."""
        camera = frame.depth.exposure.lens.camera
        per_frame = ceil(_PARTS / max(1, int(_LATE * served))) * max(1, _PART_PX // (camera.width * camera.height))
        own = self._gains.of(frame)
        as_now = (1.0, 0.0) if older is None else factor_and_offset(relative(own, older.brightness))
        return _Making(frame, spline, self._store.making(frame, spline, older, own, as_now), per_frame)

    def _succeeded(self, making: _Making) -> Reference:
        assert making.made is not None
        made = self._store.add(making.made, making.frame, making.spline)
        self._covariances.keyframe(made)
        self._refer_to(made)
        return made

    def fuse_frozen(self, window: Window) -> DeviceFrame | None:
        """Fuse the frames whose control points are frozen but the newest of them, which is returned.

        Not yet while a keyframe is in the making that they may be fused into.
        """
        frozen = [f for f in self.recent if window.is_frozen(f.last_time)]
        for done in frozen[:-1] if self._making is None else ():
            self.recent.popleft()
            before = self._store.newest
            after = self._store.fuse(done, window.spline)
            if self.reference is before:
                self.reference = after
        return frozen[-1] if frozen else None

    def renew(self, window: Window, new: DeviceFrame, frozen: DeviceFrame | None, overlap: float) -> bool:
        """Make another frame the reference once it is left behind: a frozen one, or by strategy the newest.

        Says whether it has become a keyframe.
        """
        if self._making is not None:
            return self._take_over()
        if self._unconverged is not None:
            if not window.is_frozen(self._unconverged.last_time):
                return False
            self.make(self._unconverged, window.spline, self._store.newest if self._options.fuse else None)
            return True
        ref = self.reference
        assert ref is not None
        T_base_cam = se3.inverse(ref.T_world_base) @ window.spline.pose(new.depth.exposure.mid_time)
        is_behind = self._options.left_behind(T_base_cam, overlap) or self._colorless >= _COLORLESS
        if frozen is None or frozen.index <= ref.index:
            return False
        is_behind |= self._options.photometric and not ref.points and bool(frozen.colors)
        if not is_behind:
            return False
        if self._options.keyframe_strategy == "newest" and new.depth.exposure.lens.lines > 1:
            if not self.is_unfit(new):
                rolling = self._maker.rolling(new.index, new.depth, new.colors, window.spline)
                self.reference = replace(rolling, brightness=self._gains.of(new))
                self._unconverged, self._gone = new, None
            return False
        old = self._store.return_to(window.spline.pose(frozen.depth.exposure.mid_time), ref)
        if old is not None:
            self._refer_to(old)
            return True
        if self.is_unfit(frozen):
            return False
        older = ref if self._options.fuse else None
        self._making = self._begun(frozen, window.spline, older, new.index - self._since)
        return self._take_over()

    def _take_over(self) -> bool:
        """Go on with the keyframe in the making; whether it is the reference now."""
        making = self._making
        if making is None or not self._goes_on(making):
            return False
        self._succeeded(making)
        return True

    def _refer_to(self, ref: Reference, is_found: bool = False) -> None:
        """is_found: by a lost frame, which may see half of it."""
        if not is_found:
            self._pixels.pop(ref.index, None)
        self.reference, self._since = ref, self.recent[-1].index if self.recent else ref.index
        self._unconverged, self._making, self._colorless = None, None, 0
        self._gone = None
