"""A consistent model of what was seen, from which reference depth is synthesised (paper, section 3.5)."""

from __future__ import annotations

import numpy as np

from rsgen.geometry.spline import Spline
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.volume.volume import Volume

# Metres at one metre by which model and frame may differ before the frame is believed.
_AGREE = 0.03
# Error of a surface in the volume, in voxels: where it bends or ends within one, trilinear interpolation cuts it.
_EXACT_VOXELS = 0.05
# Weight of a pixel in measurements at most; more would let its first errors live for ever.
_MOST = 30.0
_MEDIAN_TO_SIGMA = 1.4826


class SurfaceModel:
    """A signed distance volume of all frames that have converged."""

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
        part of a voxel: where frames are more exact than that, they are believed.
        """
        made = self._maker.rectified(index, depth, colors, spline, older, as_now)
        if not self.volume.blocks:
            return made
        seen, _ = self.volume.raycast(made.T_world_base, made.lens)
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
