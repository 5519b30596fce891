"""A consistent model of what was seen, from which reference depth is synthesised (paper, section 3.5)."""

from __future__ import annotations

import drjit as dr

from rsgen.geometry.spline import Spline
from rstrack.frames import ColorImage, DepthImage
from rstrack.keyframe import KeyframeMaker
from rstrack.mapping.volume import Volume
from rstrack.reference import Reference

# Metres at one metre by which model and frame may differ before the frame is believed.
_AGREE = 0.03
_KNOWN = 30.0


class SurfaceModel:
    """A signed distance volume of all frames that have converged."""

    def __init__(self, maker: KeyframeMaker, voxel_m: float) -> None:
        self._maker = maker
        self.volume = Volume(maker.e, voxel_m)

    def add(self, depth: DepthImage, spline: Spline) -> None:
        """Integrate a frame whose poses no longer change."""
        T_world_base, base, rho = self._maker.rectify(depth, spline)
        self.volume.integrate(rho, T_world_base, base)

    def keyframe(self, index: int, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline) -> Reference:
        """The model as seen from a frame at mid readout, and what the frame alone knows."""
        T_world_base, base, own = self._maker.rectify(depth, spline)
        model, _ = self.volume.raycast(T_world_base, base)
        agree = (model > 0.0) & ((own <= 0.0) | (dr.abs(model - own) < _AGREE * dr.maximum(own, own * own)))
        rho = dr.select(agree, model, own)
        shape = base.camera.height, base.camera.width
        e = self._maker.e
        known = e.download(dr.select(agree, e.Float(_KNOWN), dr.select(own > 0.0, e.Float(1.0), 0.0)), shape)
        return self._maker.synthesised(index, depth, colors, spline, T_world_base, base, rho, known)
