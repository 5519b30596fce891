"""Depth of a sequence against an independent ray caster: trimesh with Embree on scene.ply, float64 rows' poses.

What moves by itself is cast in its own frame, with each ray moved to where the object is at its line's time.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError, how_to_install
from rsgen.geometry import se3
from rsgen.sequence.images import COLOR_DEPTH, ImageStream, Rig

TOLERANCE_M = 1e-4
REQUIRED_SHARE = 0.999


def check_raycast(sequence: Rig, name: str, count: int) -> tuple[bool, str]:
    """Cast every pixel of `count` frames of a camera, spread over the sequence, again on scene.ply and compare.

    Of a depth camera, or of another one that has exact depth beside its images (`truth.color_depth`).

    True if in every frame at least REQUIRED_SHARE of the pixels are within TOLERANCE_M and of the right object. Raises
    UserError if embreex is not installed, or scene.ply or a frame cannot be read.
    """
    casters = [_caster(path) for path in (sequence.root / "scene.ply", *(o.mesh for o in sequence.objects))]
    stream = sequence.streams[name]
    total = len(stream.stamps)
    if count < 1 or total == 0:
        raise UserError(f"{sequence.root}: no {name} frames to cast: ask for at least one")
    frames = np.unique(np.linspace(0, total - 1, count).round().astype(int)).tolist()
    differences, shares = [], []
    for k in frames:
        z, number = _cast(casters, sequence, stream, k)
        exact = sequence.exact_depth(name, k) if stream.is_depth else sequence.exact_image(name, COLOR_DEPTH, k)
        differences.append(np.abs(z - exact))
        right = (differences[-1] <= TOLERANCE_M) & (number == sequence.object_ids(name, k))
        shares.append(float(np.mean(right)))
    return min(shares) >= REQUIRED_SHARE, (
        f"{len(frames)} frames, worst: {100 * min(shares):.4f} % of pixels within {1000 * TOLERANCE_M:g} mm, "
        f"median difference {1e6 * float(np.median(differences)):.2f} um"
    )


def _caster(path: Path) -> Any:
    try:
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        raise UserError(f"ray casting needs embreex: {how_to_install('raycast')}") from None
    try:
        return RayMeshIntersector(trimesh.load(path, process=False, force="mesh"))
    except Exception as error:
        raise UserError(f"{path}: cannot be read ({type(error).__name__})") from None


def _cast(casters: list[Any], sequence: Rig, stream: ImageStream, k: int) -> tuple[FloatArray, IntArray]:
    """Planar z (h, w) of listed frame k, 0 where a ray hits nothing, and the number of the object hit (h, w)."""
    camera = stream.camera
    uv = camera.pixel_grid().reshape(-1, 2)
    T_world_cam = sequence.pixel_poses(stream.name, k, uv)
    exposure_s = stream.shutter.exposure_s if stream.table is None else float(stream.table.exposure_s[k])
    middle = float(stream.stamps[k]) - 0.5 * (exposure_s - stream.shutter.exposure_s)
    t = stream.shutter.line_mid_time(middle, stream.shutter.line_of_pixel(uv, camera), camera)
    z, number = np.full(len(uv), np.inf), np.zeros(len(uv), np.int64)
    for which, caster in enumerate(casters):
        T = T_world_cam
        if which:
            T = se3.inverse(sequence.objects[which - 1].spline.pose(t)) @ T_world_cam
        direction = np.einsum("nij,nj->ni", T[:, :3, :3], camera.unproject(uv))
        _, ray, p = caster.intersects_id(T[:, :3, 3], direction, multiple_hits=False, return_locations=True)
        there = se3.transform(se3.inverse(T[ray]), p)[:, 2]
        nearer = there < z[ray]
        z[ray[nearer]], number[ray[nearer]] = there[nearer], which
    shape = camera.height, camera.width
    return np.where(np.isfinite(z), z, 0.0).reshape(shape), number.reshape(shape)
