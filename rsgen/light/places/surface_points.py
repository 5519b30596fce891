"""The points of a scene's surfaces that light is baked at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, IntArray
from rsgen.device.arrays import vectors

OFFSET_M = 2e-4  # ray origins above their surface

_NORMAL_SCALE = 0.35  # normals this far apart count as much as one spacing
_APART = 1e4  # spacings between different pieces of surface


@dataclass(frozen=True)
class SurfacePoints:
    """Unique sample points: position on the surface, shading normal, geometric normal, (n, 3) float32 each, and (n,)
    the number of the piece of surface that each lies on: one side of a connected part of a mesh that
    nothing parts (see `walls`).
    """

    position: Float32Array
    normal: Float32Array
    geometric: Float32Array
    piece: IntArray

    def coordinates(self, spacing: float, which: IntArray) -> NDArray:
        """(len(which), 7): two points are near where positions, in units of `spacing` metres, and normals are, on one
        piece.
        """
        position, normal, piece = self.position[which], self.normal[which], self.piece[which]
        return np.concatenate([position / spacing, normal / _NORMAL_SCALE, _APART * piece[:, None]], axis=1)

    @cached_property
    def on_device(self) -> tuple[Any, Any]:
        """Ray origins (Point3f) and normals (Vector3f) of all points."""
        origin = self.position + np.float32(OFFSET_M) * self.geometric
        return vectors(mi.Point3f, origin), vectors(mi.Vector3f, self.normal)
