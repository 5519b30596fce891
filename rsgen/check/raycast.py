"""Depth of a sequence against an independent ray caster: trimesh with Embree on scene.ply, float64 rows' poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.sequence.reader import Sequence

TOLERANCE_M = 1e-4
REQUIRED_SHARE = 0.999


@dataclass(frozen=True)
class RaycastErrors:
    """Share of pixels within TOLERANCE_M per frame, and the median difference of all, metres."""

    frames: tuple[int, ...]
    shares: tuple[float, ...]
    median_m: float

    @property
    def ok(self) -> bool:
        """True if every frame has at least REQUIRED_SHARE of its pixels within TOLERANCE_M."""
        return min(self.shares) >= REQUIRED_SHARE

    def text(self) -> str:
        """The figures in one line."""
        return (
            f"{len(self.frames)} frames, worst: {100 * min(self.shares):.4f} % of pixels within "
            f"{1000 * TOLERANCE_M:g} mm, median difference {1e6 * self.median_m:.2f} um"
        )


def raycast_sequence(sequence: Sequence, count: int) -> RaycastErrors:
    """Cast every pixel of `count` depth frames, spread over the sequence, again on scene.ply and compare.

    Raises UserError if embreex is not installed, or scene.ply or a frame cannot be read.
    """
    try:
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        raise UserError("ray casting needs embreex: pip install embreex") from None
    try:
        mesh = trimesh.load(sequence.root / "scene.ply", process=False, force="mesh")
        caster = RayMeshIntersector(mesh)
    except Exception as error:
        raise UserError(f"{sequence.root / 'scene.ply'}: cannot be read ({type(error).__name__})") from None
    total = len(sequence.streams["depth"].stamps)
    if count < 1 or total == 0:
        raise UserError(f"{sequence.root}: no depth frames to cast: ask for at least one")
    frames = tuple(int(k) for k in np.unique(np.linspace(0, total - 1, count).round().astype(int)))
    differences = [np.abs(_cast(caster, sequence, k) - sequence.truth_depth(k)) for k in frames]
    shares = tuple(float(np.mean(d <= TOLERANCE_M)) for d in differences)
    return RaycastErrors(frames, shares, float(np.median(differences)))


def _cast(caster: object, sequence: Sequence, k: int) -> FloatArray:
    """Planar z (h, w) of listed depth frame k, 0 where a ray hits nothing."""
    camera = sequence.streams["depth"].camera
    uv = camera.pixel_grid().reshape(-1, 2)
    T_world_depth = sequence.pixel_poses("depth", k, uv)
    origin = T_world_depth[:, :3, 3]
    direction = np.einsum("nij,nj->ni", T_world_depth[:, :3, :3], camera.unproject(uv))
    _, ray, p_world = caster.intersects_id(  # type: ignore[attr-defined]
        origin, direction, multiple_hits=False, return_locations=True
    )
    z = np.zeros(len(uv))
    z[ray] = se3.transform(se3.inverse(T_world_depth[ray]), p_world)[:, 2]
    return z.reshape(camera.height, camera.width)
