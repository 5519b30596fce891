"""Light for mesh files, which bring none: a sky around objects, lamps under the ceiling of rooms.

A room is what encloses most points between its outer walls: from them, nearly all rays meet surfaces, more of them from
in front than from behind (real rooms have some walls turned over). An object is open there, or solid: rays that begin
inside it meet its surfaces from behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.config.sections import SceneLight
from rsgen.device.arrays import aligned
from rsgen.errors import UserError
from rsgen.formats.meshes.parts import Part
from rsgen.scene.meshes import joined_triangles, ply_bytes

SKY = 0.8  # radiance
_IRRADIANCE = 2.5  # of lamps on a floor, were all their light to reach it: about what the sky gives in the open
_DIRECTIONS = 64
_ENCLOSED = 0.9  # share of rays; windows and doors let some out
_CELL_M = 2.5  # a lamp for each square of this size or larger
_MOST_CELLS = 4  # along a side
_LAMP = 0.12  # half a lamp's side, of its cell's shorter one
_MOST_LAMP_M = 0.3
_GAP = 0.02  # below the ceiling, of a lamp's height over the middle


class Probe:
    """Rays into triangles, on the device."""

    def __init__(self, mi: Any, vertices: FloatArray, faces: IntArray) -> None:
        """vertices (n, 3), world frame, m; faces (m, 3)."""
        self._mi = mi
        self.low, self.high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
        mesh = mi.Mesh("probe", len(vertices), len(faces))
        arrays = mi.traverse(mesh)
        arrays["vertex_positions"] = mi.Float(aligned(vertices))
        arrays["faces"] = mi.UInt32(aligned(faces, np.uint32))
        arrays.update()
        self._scene = mi.load_dict({"type": "scene", "mesh": mesh})

    def encloses(self) -> bool:
        """Whether the triangles are a room."""
        steps = np.stack(np.meshgrid(*[[0.25, 0.5, 0.75]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        origins = self.low + steps * (self.high - self.low)
        k = np.arange(_DIRECTIONS) + 0.5  # a Fibonacci spiral: evenly all around
        z, phi = 1 - 2 * k / _DIRECTIONS, k * np.pi * (1 + 5**0.5)
        around = np.stack([np.cos(phi) * np.sqrt(1 - z * z), np.sin(phi) * np.sqrt(1 - z * z), z], axis=-1)
        distance, front = self._cast(np.repeat(origins, len(around), axis=0), np.tile(around, (len(origins), 1)))
        met, from_front = (v.reshape(len(origins), -1).mean(axis=1) for v in (np.isfinite(distance), front))
        return bool(((met >= _ENCLOSED) & (from_front > met / 2)).mean() > 0.5)

    def lamps(self) -> tuple[FloatArray, float] | None:
        """Square lamps under the ceilings above the middle of the room's height; None if there is no ceiling.

        Corners (n, 4, 3), facing down, and the lamps' radiance.
        """
        size, ground = self.high - self.low, [0, 2]
        count = np.clip((size[ground] / _CELL_M).astype(int), 1, _MOST_CELLS)
        cells = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, 2)
        middle = np.tile(self.low + size / 2, (len(cells), 1))
        middle[:, ground] = self.low[ground] + (cells + 0.5) / count * size[ground]
        half = min(_LAMP * float((size[ground] / count).min()), _MOST_LAMP_M)
        square = half * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])  # seen from below, counter-clockwise
        starts = middle[:, None] + np.concatenate([square, np.zeros((1, 3))])
        up = np.tile([0.0, 1.0, 0.0], (starts.size // 3, 1))
        above = self._cast(starts.reshape(-1, 3), up)[0].reshape(starts.shape[:2])
        inside = np.isfinite(above).all(axis=1)
        if not inside.any():
            return None
        corners = starts[inside, :4]
        corners[..., 1] += (1 - _GAP) * above[inside].min(axis=1, keepdims=True)
        area = len(corners) * (2 * half) ** 2
        floor = size[ground].prod() * inside.mean()
        return corners, float(_IRRADIANCE * floor / (np.pi * area))

    def _cast(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Distance (n,) to what rays (n, 3) meet, inf for nothing, and whether they meet it from in front."""
        from rsgen.scene.rays import cast_rays

        distance, normal = cast_rays(self._scene, origins, directions)
        return distance, np.isfinite(distance) & (np.einsum("ij,ij->i", normal, directions) < 0)


def light_shapes(mi: Any, path: Path, parts: Sequence[Part], light: SceneLight, folder: Path) -> dict[str, Any]:
    """Entries of a scene dictionary for the light that parts get, whose lamps' meshes go into `folder`.

    Raises UserError if lamps are asked for where there is no ceiling.
    """
    if light == "none":
        return {}
    probe = Probe(mi, *joined_triangles([part.vertices for part in parts], [part.faces for part in parts]))
    is_room = light == "ceiling" or (light == "auto" and probe.encloses())
    lamps = probe.lamps() if is_room else None
    if lamps is None and light == "ceiling":
        raise UserError(f"scene {path}: has no ceiling over its middle to put lamps under: set scene.light to sky")
    if lamps is None:
        return {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}}}
    shapes: dict[str, Any] = {}
    for number, corners in enumerate(lamps[0]):
        file = folder / f"lamp{number}.ply"
        file.write_bytes(ply_bytes(corners, np.array([[0, 1, 2], [0, 2, 3]])))
        radiance = {"type": "rgb", "value": lamps[1]}
        shapes[f"lamp{number:05}"] = {
            "type": "ply", "filename": str(file), "face_normals": True, "bsdf": {"type": "diffuse"},
            "emitter": {"type": "area", "radiance": radiance},
        }  # fmt: skip
    return shapes
