"""How a depth camera errs, alike in every image: what calibration finds of it and a camera file holds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rsgen.array_types import Float32Array
from rsgen.geometry.camera import Camera


@dataclass(frozen=True)
class DepthError:
    """True depth is 1 / (1 / z + inverse_offset + radial r²) + offset_m.

    z: as measured, m; r: of the pixel's ray, in normalised coordinates. inverse_offset and radial in 1/m: an error of
    the disparity of structured light, whose effect grows with z² (Teichman et al., RSS 2013); offset_m: of time of
    flight.
    """

    offset_m: float = 0.0
    inverse_offset: float = 0.0
    radial: float = 0.0

    def corrected(self, z: Float32Array, camera: Camera) -> Float32Array:
        """True planar z (h, w) in m of what the camera measured; 0, and what would lie beyond infinity, is 0."""
        if self == NONE:
            return z
        bent = np.float32(self.inverse_offset) + np.float32(self.radial) * _squared_radius(camera)
        inverse = np.divide(np.float32(1), z, out=np.zeros_like(z), where=z > 0) + bent
        found = (z > 0) & (inverse > 0)
        true = np.divide(np.float32(1), inverse, out=np.zeros_like(z), where=found) + np.float32(self.offset_m)
        return np.where(found & (true > 0), true, np.float32(0))


NONE = DepthError()


@lru_cache(maxsize=4)
def _squared_radius(camera: Camera) -> Float32Array:
    x, y = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rays = camera.unproject(np.stack([x, y], axis=-1))
    return np.nan_to_num((rays[..., :2] ** 2).sum(axis=-1)).astype(np.float32)
