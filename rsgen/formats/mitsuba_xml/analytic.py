"""Mitsuba's analytic shapes as triangles: rectangles, disks, spheres, cylinders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from rsgen.render.ply import ply_bytes

ANALYTIC = ("rectangle", "disk", "sphere", "cylinder")
_SEGMENTS = 96


def tessellated(mi: Any, props: Any, file: Path) -> Any:
    """Properties of a `ply` shape that stands for an analytic one: same id, BSDF and emitter, triangles in `file`."""
    to_world = np.asarray(props["to_world"].matrix, float).reshape(4, 4) if "to_world" in props else np.eye(4)
    plugin = props.plugin_name()
    if plugin in ("sphere", "cylinder"):
        radius = float(props.get("radius", 1.0))
        local = np.diag([radius, radius, radius, 1.0])
        if plugin == "sphere":
            local[:3, 3] = np.asarray(props.get("center", [0, 0, 0]), float).ravel()
        else:
            p0, p1 = (np.asarray(props.get(k, d), float).ravel() for k, d in (("p0", [0, 0, 0]), ("p1", [0, 0, 1])))
            local[:3, :3] = trimesh.geometry.align_vectors([0, 0, 1], p1 - p0)[:3, :3] @ np.diag(
                [radius, radius, float(np.linalg.norm(p1 - p0))]
            )
            local[:3, 3] = p0
        to_world = to_world @ local
    uv_grid = {
        "rectangle": (1, 1),
        "disk": (8, _SEGMENTS),
        "sphere": (_SEGMENTS // 2, _SEGMENTS),
        "cylinder": (1, _SEGMENTS),
    }
    position, normal, uv, faces = _parametric(plugin, *uv_grid[plugin])
    normal_matrix = np.linalg.inv(to_world[:3, :3]).T
    mirrored = np.linalg.det(to_world[:3, :3]) < 0
    # As Mitsuba does: mirroring turns its spheres inside out, the other shapes not.
    turned = bool(props.get("flip_normals", False)) != (mirrored and plugin == "sphere")
    flip = -1.0 if turned else 1.0
    normal = flip * normal @ normal_matrix.T
    if mirrored != turned:
        faces = faces[:, ::-1]
    file.write_bytes(ply_bytes(position @ to_world[:3, :3].T + to_world[:3, 3], faces, normal, uv))
    out = mi.Properties("ply")
    out.set_id(props.id())
    out["filename"] = str(file)
    for key in props.keys():  # noqa: SIM118 (Mitsuba's Properties is no dict)
        if key not in ("to_world", "center", "radius", "p0", "p1", "flip_normals"):
            out[key] = props[key]
    return out


def _parametric(plugin: str, nu: int, nv: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Vertices, unit normals, texture coordinates and faces of Mitsuba's unit shapes on a (nu + 1) x (nv + 1) grid."""
    grid = np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1), indexing="ij")
    a, b = (axis.ravel() for axis in grid)
    phi = 2 * np.pi * b
    zero, one = np.zeros_like(a), np.ones_like(a)
    if plugin == "rectangle":
        position, normal, uv = (
            np.stack([2 * a - 1, 2 * b - 1, zero], -1),
            np.stack([zero, zero, one], -1),
            np.stack([a, b], -1),
        )
    elif plugin == "disk":
        position, normal = np.stack([a * np.cos(phi), a * np.sin(phi), zero], -1), np.stack([zero, zero, one], -1)
        uv = np.stack([a, b], -1)
    elif plugin == "sphere":
        theta = np.pi * a
        position = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
        normal, uv = position, np.stack([b, a], -1)
    else:  # cylinder
        normal = np.stack([np.cos(phi), np.sin(phi), zero], -1)
        position, uv = normal + np.stack([zero, zero, a], -1), np.stack([b, a], -1)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij"))
    p = i * (nv + 1) + j
    q = p + nv + 1
    faces = np.concatenate([np.stack([p, q, q + 1], -1), np.stack([p, q + 1, p + 1], -1)])
    corners = position[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    faces = faces[area > 1e-12]  # the poles' and the disk centre's degenerate halves
    corners = position[faces]
    outward = np.einsum(
        "ij,ij->i", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), normal[faces].sum(1)
    )
    faces[outward < 0] = faces[outward < 0][:, ::-1]
    return position, normal, uv, faces
