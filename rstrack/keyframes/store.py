"""The keyframes that a tracker remembers, which of them it aligns to, and the model that their depth may come from."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.keyframes.archive import Archive
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker, Making
from rstrack.options import Options
from rstrack.volume.volume import Volume

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
# Metres at one metre by which model and frame may differ before the frame's depth is used.
_AGREE = 0.03
# Error of a surface in the volume, in voxels: where it bends or ends within one, trilinear interpolation cuts it.
_EXACT_VOXELS = 0.05
# Weight of a pixel in measurements at most; more would let its first errors live for ever.
_MOST = 30.0
_MEDIAN_TO_SIGMA = 1.4826


class KeyframeStore:
    """Rectified keyframes in the order in which they were last the reference. made: how many there have been.

    archive: where all but the newest are stored too. anchor: a second, older reference for the frames that are aligned
    to the newest; only a model has one.
    """

    def __init__(self, maker: KeyframeMaker, options: Options) -> None:
        self._maker, self._options = maker, options
        self._bytes = 1e9 * options.memory_gb
        self._model = self._no_model()
        self._recent: deque[Reference] = deque(maxlen=_RECENT if self._model is None else _MODEL_KEYFRAMES)
        self.archive = Archive(maker, self._bytes)
        self.anchor: Reference | None = None
        self.made = 0

    def __len__(self) -> int:
        return len(self._recent)

    def _no_model(self) -> SurfaceModel | None:
        return SurfaceModel(self._maker, self._options.voxel_m, self._bytes) if self._options.models else None

    def drop_first(self) -> None:
        """The first keyframe, and only one so far, is none."""
        self._recent.clear()
        self._model, self.anchor, self.made = self._no_model(), None, 0

    @property
    def newest(self) -> Reference:
        """The one that was the reference last."""
        return self._recent[-1]

    def archive_newest(self) -> None:
        """The newest into the archive too, as it is now."""
        if self._recent:
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
        on_device = {ref.index: ref for ref in self._recent}
        return [on_device[k] if k in on_device else self.archive.get(k) for k in indices]

    def use(self, ref: Reference) -> None:
        """A keyframe found again is the newest from now on."""
        self._recent = deque((k for k in self._recent if k.index != ref.index), maxlen=self._recent.maxlen)
        self._use(ref)
        self.anchor = None

    def making(
        self, frame: DeviceFrame, spline: Spline, older: Reference | None, brightness: FloatArray,
        as_now: tuple[float, float] = (1.0, 0.0),
    ) -> Making:  # fmt: skip
        """A keyframe of a frame whose poses no longer change; inherits from `older`. Not in the store yet: `add`.

        brightness (2,): gain and offset of its colour image, see `Reference`. as_now: see `KeyframeMaker.rectifying`.
        """
        made_of = frame.index, frame.depth, frame.colors, spline, older, as_now
        if self._model is None:
            made = yield from self._maker.rectifying(*made_of)
        else:
            made = self._model.keyframe(*made_of)
        return replace(made, brightness=brightness)

    def add(self, made: Reference, frame: DeviceFrame, spline: Spline) -> Reference:
        """What `making` has made of a frame: the newest keyframe from now on."""
        if self._model is not None:
            self._model.add(frame.depth, spline)
        self.made += 1
        return self._use(made)

    def fuse(self, frame: DeviceFrame, spline: Spline) -> Reference:
        """The newest keyframe with the depth of a later frame averaged in, as far as the options want that."""
        if frame.index > self.newest.index:
            if self._model is not None:
                self._model.add(frame.depth, spline)
            if self._options.fuse:
                self._recent[-1] = self._maker.fused(self.newest, frame.depth, spline)
        return self.newest

    def improve(self, ref: Reference) -> None:
        """Another version of the newest keyframe."""
        self._recent[-1] = ref

    def return_to(self, T_world_cam: FloatArray, left: Reference) -> Reference | None:
        """The oldest of a model's keyframes but `left` that is near a camera: it has drifted least. Now the newest."""
        if self._model is None:
            return None
        near = [
            ref for ref in self._recent if ref is not left and self._remoteness(ref.T_world_base, T_world_cam) < _RETURN
        ]
        if not near:
            return None
        oldest = min(near, key=lambda ref: ref.index)
        self._recent = deque((ref for ref in self._recent if ref is not oldest), maxlen=self._recent.maxlen)
        return self._use(oldest)

    def _use(self, ref: Reference) -> Reference:
        if self._recent:
            self.archive.add(self.newest)  # it changes no more
        self._recent.append(ref)
        while len(self._recent) > max(_RECENT, self._bytes / ref.device_bytes):
            self._recent.popleft()
        if self._model is not None:
            near = [k for k in self._recent if self._remoteness(ref.T_world_base, k.T_world_base) < _ANCHOR]
            oldest = min(near, key=lambda k: k.index)
            self.anchor = None if oldest is ref else oldest
        return ref

    def _remoteness(self, T_world_a: FloatArray, T_world_b: FloatArray) -> float:
        return self._options.remoteness(se3.inverse(T_world_a) @ T_world_b)


class SurfaceModel:
    """A signed distance volume of all frames that have converged, from which reference depth is synthesised.

    (Paper, section 3.5.)
    """

    def __init__(self, maker: KeyframeMaker, voxel_m: float, most_bytes: float = float("inf")) -> None:
        self._maker = maker
        self.volume = Volume(maker.e, voxel_m, most_bytes=most_bytes)

    def add(self, depth: DepthImage, spline: Spline) -> None:
        """Integrate a frame whose poses no longer change."""
        T_world_base, base, rho = self._maker.rectify(depth, spline)
        self.volume.integrate(rho, T_world_base, base)

    def keyframe(
        self, index: int, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline, older: Reference | None,
        as_now: tuple[float, float] = (1.0, 0.0),
    ) -> Reference:  # fmt: skip
        """A keyframe as `KeyframeMaker.rectified` makes it, averaged with the model by variance, holes filled by it.

        What its depth scatters about the model's is taken as its noise, which grows with z². The model's own error is a
        part of a voxel: where frames are more exact than that, their depth is used.
        """
        made = self._maker.rectified(index, depth, colors, spline, older, as_now)
        if not self.volume.blocks:
            return made
        seen = self.volume.raycast(made.T_world_base, made.lens)
        e, shape = self._maker.e, (made.lens.camera.height, made.lens.camera.width)
        frame, model, weight = (e.download(a, shape) for a in (made.inverse_depth, seen, made.weight))
        z = np.divide(1.0, frame, out=np.zeros_like(frame), where=frame > 0)
        off = np.abs(np.divide(1.0, model, out=np.zeros_like(model), where=model > 0) - z)
        agree = (frame > 0) & (model > 0) & (off < _AGREE * np.maximum(z, 1.0))
        if not agree.any():
            return made
        scatter = _MEDIAN_TO_SIGMA * float(np.median(off[agree] * np.sqrt(weight[agree]) / z[agree] ** 2))
        worth = np.clip((scatter * z**2 / (_EXACT_VOXELS * self.volume.voxel_m)) ** 2, 0.0, _MOST)
        mean = frame + worth / np.maximum(weight + worth, 1e-6) * (model - frame)
        rho = np.where(agree, mean, np.where(frame > 0, frame, model)).astype(np.float32)
        weight = np.where(agree, np.minimum(weight + worth, _MOST), np.where(frame > 0, weight, rho > 0))
        return self._maker.with_depth(made, depth, colors, spline, rho, weight)
