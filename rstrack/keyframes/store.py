"""The keyframes that a tracker remembers, and which of them it aligns to."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.archive import Archive
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.keyframes.surface_model import SurfaceModel
from rstrack.options import Options

# Keyframes that stay on the device; all others are archived.
_RECENT = 8
# Keyframes that a model keeps there at most, as far as the options' memory goes: what a camera can come back to.
_MODEL_KEYFRAMES = 256
# Of the distance and angle at which a keyframe is left behind: an older one that is nearer becomes the reference again.
_RETURN = 0.7
# Within so many times these a keyframe may show what a camera sees that an IMU has led there.
_NEAR = 1.5
# Within so many times these, frames are aligned to the oldest keyframe too: fewer hops, less drift.
_ANCHOR = 2.0


class KeyframeStore:
    """Rectified keyframes in the order in which they were last the reference. made: how many there have been.

    archive: where all but the newest are kept too. anchor: a second, older reference for the frames that are aligned to
    the newest; only a model has one.
    """

    def __init__(self, maker: KeyframeMaker, options: Options) -> None:
        self._maker, self._options = maker, options
        self._bytes = 1e9 * options.memory_gb
        self._model = self._no_model()
        self._kept: deque[Reference] = deque(maxlen=_RECENT if self._model is None else _MODEL_KEYFRAMES)
        self.archive = Archive(maker, self._bytes)
        self.anchor: Reference | None = None
        self.made = 0

    def __len__(self) -> int:
        return len(self._kept)

    def _no_model(self) -> SurfaceModel | None:
        return SurfaceModel(self._maker, self._options.voxel_m, self._bytes) if self._options.models else None

    def forget_first(self) -> None:
        """The first keyframe, and only one so far, is none."""
        self._kept.clear()
        self._model, self.anchor, self.made = self._no_model(), None, 0

    @property
    def newest(self) -> Reference:
        """The one that was the reference last."""
        return self._kept[-1]

    def put_away(self) -> None:
        """The newest into the archive too, as it is now."""
        if self._kept:
            self.archive.add(self.newest)

    def candidates(self, frame: DeviceFrame, skip: int, most: int) -> list[Reference]:
        """Keyframes, ever made, whose view resembles a frame's: `most` of them after the first `skip`, round and round.

        The newest is not among them.
        """
        indices = self.archive.alike(frame, {self.newest.index})
        return self._found([indices[(skip + i) % len(indices)] for i in range(min(most, len(indices)))])

    def near(self, T_world_cam: FloatArray, most: int) -> list[Reference]:
        """The `most` keyframes, ever made, nearest to a camera (4, 4) of those that it has not left far behind.

        The newest is not among them.
        """
        indices = [k for k in self.archive.indices if k != self.newest.index]
        far = {k: self._remoteness(self.archive.pose(k), T_world_cam) for k in indices}
        return self._found([k for k in sorted(indices, key=far.__getitem__) if far[k] < _NEAR][:most])

    def _found(self, indices: list[int]) -> list[Reference]:
        on_device = {ref.index: ref for ref in self._kept}
        return [on_device[k] if k in on_device else self.archive.get(k) for k in indices]

    def use(self, ref: Reference) -> None:
        """A keyframe found again is the newest from now on."""
        self._kept = deque((k for k in self._kept if k.index != ref.index), maxlen=self._kept.maxlen)
        self._use(ref)
        self.anchor = None

    def make(
        self, frame: DeviceFrame, spline: Spline, older: Reference | None, brightness: FloatArray,
        as_now: tuple[float, float] = (1.0, 0.0),
    ) -> Reference:  # fmt: skip
        """A keyframe of a frame whose poses no longer change; inherits from `older`. It is the newest.

        brightness (2,): gain and offset of its colour image, see `Reference`. as_now: see `KeyframeMaker.rectified`.
        """
        make = self._maker.rectified if self._model is None else self._model.keyframe
        ref = replace(make(frame.index, frame.depth, frame.colors, spline, older, as_now), brightness=brightness)
        if self._model is not None:
            self._model.add(frame.depth, spline)
        self.made += 1
        return self._use(ref)

    def fuse(self, frame: DeviceFrame, spline: Spline) -> Reference:
        """The newest keyframe with the depth of a later frame averaged in, as far as the options want that."""
        if frame.index > self.newest.index:
            if self._model is not None:
                self._model.add(frame.depth, spline)
            if self._options.fuse:
                self._kept[-1] = self._maker.fused(self.newest, frame.depth, spline)
        return self.newest

    def improve(self, ref: Reference) -> None:
        """Another version of the newest keyframe."""
        self._kept[-1] = ref

    def return_to(self, T_world_cam: FloatArray, left: Reference) -> Reference | None:
        """The oldest of a model's keyframes but `left` that is near a camera: it has drifted least. Now the newest."""
        if self._model is None:
            return None
        near = [
            ref for ref in self._kept if ref is not left and self._remoteness(ref.T_world_base, T_world_cam) < _RETURN
        ]
        if not near:
            return None
        oldest = min(near, key=lambda ref: ref.index)
        self._kept = deque((ref for ref in self._kept if ref is not oldest), maxlen=self._kept.maxlen)
        return self._use(oldest)

    def _use(self, ref: Reference) -> Reference:
        if self._kept:
            self.archive.add(self.newest)  # it changes no more
        self._kept.append(ref)
        while len(self._kept) > max(_RECENT, self._bytes / ref.device_bytes):
            self._kept.popleft()
        if self._model is not None:
            near = [k for k in self._kept if self._remoteness(ref.T_world_base, k.T_world_base) < _ANCHOR]
            oldest = min(near, key=lambda k: k.index)
            self.anchor = None if oldest is ref else oldest
        return ref

    def _remoteness(self, T_world_a: FloatArray, T_world_b: FloatArray) -> float:
        return self._options.remoteness(se3.inverse(T_world_a) @ T_world_b)
