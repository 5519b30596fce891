"""A consistent model of what was seen, from which reference depth is synthesised (paper, section 3.5)."""

from __future__ import annotations

import numpy as np

from rsgen.geometry.spline import Spline
from rstrack.frames import ColorImage, DepthImage
from rstrack.keyframe import KeyframeMaker
from rstrack.mapping.volume import Volume
from rstrack.reference import Reference

# Metres at one metre by which model and frame may differ before the frame is believed.
_AGREE = 0.03
# Error of a surface in the volume, in voxels: where it bends or ends within one, trilinear interpolation cuts it.
_EXACT_VOXELS = 0.05
# Weight of the model in measurements at most; more would let its first errors live for ever.
_MOST = 29.0
_MEDIAN_TO_SIGMA = 1.4826


class SurfaceModel:
    """A signed distance volume of all frames that have converged."""

    def __init__(self, maker: KeyframeMaker, voxel_m: float) -> None:
        self._maker = maker
        self.volume = Volume(maker.e, voxel_m)

    @property
    def is_empty(self) -> bool:
        """Whether it knows nothing yet."""
        return self.volume.blocks == 0

    def add(self, depth: DepthImage, spline: Spline) -> None:
        """Integrate a frame whose poses no longer change."""
        T_world_base, base, rho = self._maker.rectify(depth, spline)
        self.volume.integrate(rho, T_world_base, base)

    def keyframe(self, index: int, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline) -> Reference:
        """A frame at mid readout, its depth averaged with the model's by their variances, holes filled by the model.

        What a frame's depth scatters about the model's is taken as its noise, which grows with z². The model's own
        error is a part of a voxel: where a frame is more exact than that, it is believed.
        """
        T_world_base, base, own = self._maker.rectify(depth, spline)
        seen, _ = self.volume.raycast(T_world_base, base)
        e, shape = self._maker.e, (base.camera.height, base.camera.width)
        frame, model = e.download(own, shape), e.download(seen, shape)
        z = np.divide(1.0, frame, out=np.zeros_like(frame), where=frame > 0)
        off = np.abs(np.divide(1.0, model, out=np.zeros_like(model), where=model > 0) - z)
        agree = (frame > 0) & (model > 0) & (off < _AGREE * np.maximum(z, 1.0))
        noise = _MEDIAN_TO_SIGMA * float(np.median(off[agree] / z[agree] ** 2)) * z**2 if agree.any() else z * 0.0
        worth = np.clip((noise / (_EXACT_VOXELS * self.volume.voxel_m)) ** 2, 0.0, _MOST).astype(np.float32)
        rho = np.where(agree, frame + worth / (1.0 + worth) * (model - frame), np.where(frame > 0, frame, model))
        weight = np.where(agree, 1.0 + worth, np.where(rho > 0, 1.0, 0.0))
        return self._maker.synthesised(index, depth, colors, spline, T_world_base, base, e.upload(rho), weight)
