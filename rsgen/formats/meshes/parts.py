"""Parts of a scene file: triangles of one material in the world, of its polygons, without what cannot be seen.

Mitsuba and trimesh take every polygon for convex, and a wall with a niche loses the niche. Depth, truth and baked light
know triangles only, so what an alpha mask hides is cut out of the triangles.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.limits import MOST_M
from rsgen.scene.material import Material
from rsgen.scene.meshes import has_area

log = logging.getLogger("rsgen")

WHITE = Material(color=np.ones(3))
"""Of parts that have colours of their own."""

_TEXTURES = ("color_texture", "metal_texture", "normal_texture", "emission_texture")
_STRAIGHT = 1e-9  # of a polygon's area: corners that turn less go straight on
_USUAL_M = (0.02, 300.0)  # sizes outside are rather wrong units
_FINE_TEXELS = 2.0  # triangles this small are cut along a straight line
_MOST = 400_000  # triangles of one part; beyond, the outline gets coarser


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material in the world frame, m: vertices (n, 3), faces (m, 3).

    normals (n, 3) unit, None: flat; uv (n, 2), v down; colors: linear, (n, 3) of vertices or (m, 3) of faces.
    """

    vertices: FloatArray
    faces: IntArray
    material: Material
    normals: FloatArray | None = None
    uv: FloatArray | None = None
    vertex_colors: FloatArray | None = None
    face_colors: FloatArray | None = None


def v_down(uv: FloatArray) -> FloatArray:
    """Texture coordinates (..., 2) whose v runs down, as Mitsuba's does, of those whose v runs up; finite."""
    return np.clip(np.nan_to_num(uv * [1, -1] + [0, 1]), -1e5, 1e5)


def without_textures(material: Material) -> Material:
    """The material of a part without coordinates; itself where it has no textures."""
    given = {name: None for name in _TEXTURES if getattr(material, name) is not None}
    return replace(material, **given) if given else material  # type: ignore[arg-type]


def joined(parts: Sequence[Part]) -> Part:
    """One part of several that have one material and carry the same."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + k for part, k in zip(parts, first[:-1], strict=True)])
    columns = [
        None if getattr(parts[0], name) is None else np.concatenate([getattr(part, name) for part in parts])
        for name in ("normals", "uv", "vertex_colors", "face_colors")
    ]
    return Part(np.concatenate([part.vertices for part in parts]), faces, parts[0].material, *columns)


def placed(path: Path, name: str, part: Part, T_world_part: FloatArray) -> Part:
    """A part of `path`, called `name` there, moved into the world by any affine map. Raises UserError."""
    if not (np.isfinite(part.vertices).all() and np.isfinite(T_world_part).all()):
        raise UserError(f"scene {path}: '{name}' has vertices that are not finite: mend it and export it again")
    return _moved(part, T_world_part)


def finished(path: Path, parts: Sequence[Part]) -> list[Part]:
    """Parts in the world, those alike as one, without triangles of no area and what masks hide. Raises UserError."""
    left, dropped = [], 0
    for part in parts:
        part, without_area = _solid(part)
        dropped += without_area
        if len(part.faces):
            left.append(_cut(part))
    if dropped:
        log.info("scene %s: %d triangles without area left out", path, dropped)
    left = _merged([part for part in left if len(part.faces)])
    if not left:
        raise UserError(f"scene {path}: holds no triangles that could be seen: export a mesh, with faces of some area")
    _check_size(path, left)
    return left


def _moved(part: Part, T: FloatArray) -> Part:
    A = T[:3, :3]
    normals, faces = part.normals, part.faces
    if normals is not None:
        # The cofactors: what the inverse's transpose is but for its length, and defined where there is no inverse.
        cofactors = np.stack([np.cross(A[1], A[2]), np.cross(A[2], A[0]), np.cross(A[0], A[1])])
        normals = normals @ cofactors.T * np.sign(np.linalg.det(A))
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / length if np.isfinite(length).all() and length.all() else None
    if np.linalg.det(A) < 0:
        faces = faces[:, ::-1]
    return replace(part, vertices=part.vertices @ A.T + T[:3, 3], normals=normals, faces=faces)


def _solid(part: Part) -> tuple[Part, int]:
    """The part without triangles of no area, as float32 has them, and how many those were."""
    keep = has_area(part.vertices.astype(np.float32), part.faces)
    colors = None if part.face_colors is None else part.face_colors[keep]
    return replace(part, faces=part.faces[keep], face_colors=colors), int((~keep).sum())


def _cut(part: Part) -> Part:
    """What a mask leaves of a part."""
    material = part.material
    if material.cutoff is None:
        return part
    texture = material.color_texture
    if texture is None or part.uv is None:
        return part if material.opacity >= material.cutoff else replace(part, faces=part.faces[:0])
    alpha = texture.pixels[..., 3] / 255 * material.opacity
    if texture.wrap == "mirror":
        alpha = np.block([[alpha, alpha[:, ::-1]], [alpha[::-1], alpha[::-1, ::-1]]])
    uv = part.uv @ texture.transform[:, :2].T + texture.transform[:, 2]
    xy = uv * texture.pixels.shape[1::-1] - 0.5
    carried = [part.vertices, part.uv] + [v for v in (part.normals, part.vertex_colors) if v is not None]
    mask = Mask(alpha, material.cutoff, texture.wrap != "clamp")
    rows, faces, source = cut_away(np.concatenate(carried, axis=1), part.faces, xy, mask)
    columns = np.split(rows, np.cumsum([v.shape[1] for v in carried])[:-1], axis=1)
    normals = None if part.normals is None else columns[2]
    colors = None if part.vertex_colors is None else columns[-1]
    of_faces = None if part.face_colors is None else part.face_colors[source]
    return _solid(Part(columns[0], faces, material, normals, columns[1], colors, of_faces))[0]


def _merged(parts: list[Part]) -> list[Part]:
    """Parts of the same material as one: light is baked, and kernels are compiled, shape by shape."""
    alike: dict[tuple[Any, ...], list[Part]] = {}
    for part in parts:
        carries = (part.normals, part.uv, part.vertex_colors, part.face_colors)
        alike.setdefault((id(part.material), *(v is not None for v in carries)), []).append(part)
    return [joined(same) for same in alike.values()]


def _check_size(path: Path, parts: list[Part]) -> None:
    corners = np.concatenate(
        [[p.vertices[p.faces].min(axis=(0, 1)), p.vertices[p.faces].max(axis=(0, 1))] for p in parts]
    )
    size = float(np.ptp(corners, axis=0).max())
    if not np.abs(corners).max() <= MOST_M:
        raise UserError(f"scene {path}: reaches beyond {MOST_M:g} m: set scene.scale to metres per unit of the file")
    if not _USUAL_M[0] <= size <= _USUAL_M[1]:
        log.warning("scene %s: is %.3g m across: is scene.scale right, metres per unit of the file?", path, size)


@dataclass(frozen=True)
class Mask:
    """Where a surface is: alpha (h, w) in [0, 1], there at `cutoff` and above, repeated or else held at its rim."""

    alpha: FloatArray
    cutoff: float
    repeat: bool

    def at(self, xy: FloatArray) -> FloatArray:
        """Bilinear alpha (...,) less the cutoff at texel positions (..., 2), texel centres integer, row 0 on top."""
        h, w = self.alpha.shape
        low = np.floor(xy).astype(np.int64)
        fx, fy = (xy[..., k] - low[..., k] for k in (0, 1))
        columns, rows = ([self._inside(low[..., k] + step, size) for step in (0, 1)] for k, size in ((0, w), (1, h)))
        top = self.alpha[rows[0], columns[0]] * (1 - fx) + self.alpha[rows[0], columns[1]] * fx
        bottom = self.alpha[rows[1], columns[0]] * (1 - fx) + self.alpha[rows[1], columns[1]] * fx
        return top * (1 - fy) + bottom * fy - self.cutoff

    def _inside(self, index: IntArray, size: int) -> IntArray:
        return index % size if self.repeat else np.clip(index, 0, size - 1)


def cut_away(rows: FloatArray, faces: IntArray, xy: FloatArray, mask: Mask) -> tuple[FloatArray, IntArray, IntArray]:
    """What is left of triangles where `mask` is there.

    rows: (n, k), whatever vertices carry, interpolated linearly; faces (m, 3); xy (n, 2): texel position of each
    vertex. Returns new rows, faces and, per new face, the number of the old one.
    """
    solid = mask.alpha >= mask.cutoff
    if solid.all():
        return rows, faces, np.arange(len(faces))
    table = _counts(solid)
    corners = np.concatenate([rows, xy], axis=1)[faces]
    source = np.arange(len(faces))
    left, left_source = [], []
    while len(corners):
        there, nowhere = _uniform(corners[..., -2:], table, mask)
        left.append(corners[there])
        left_source.append(source[there])
        mixed = ~there & ~nowhere
        corners, source = corners[mixed], source[mixed]
        edge = np.linalg.norm(corners[..., -2:] - np.roll(corners[..., -2:], 1, axis=1), axis=-1).max(axis=1)
        fine = edge <= _FINE_TEXELS
        if sum(map(len, left)) + 4 * len(corners) > _MOST:
            fine[:] = True
        clipped, of = _clip(corners[fine], mask.at(corners[fine][..., -2:]))
        left.append(clipped)
        left_source.append(source[fine][of])
        corners, source = _quartered(corners[~fine]), np.repeat(source[~fine], 4)
    whole = np.concatenate(left)
    return (
        whole[..., :-2].reshape(-1, rows.shape[1]),
        np.arange(3 * len(whole)).reshape(-1, 3),
        np.concatenate(left_source),
    )


def _counts(solid: BoolArray) -> NDArray[np.int64]:
    """Summed-area table (2h + 1, 2w + 1) of two by two copies, so that no box of at most a copy's size wraps around."""
    table = np.zeros((2 * solid.shape[0] + 1, 2 * solid.shape[1] + 1), np.int64)
    table[1:, 1:] = np.tile(solid, (2, 2)).cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
    return table


def _uniform(xy: FloatArray, table: NDArray[np.int64], mask: Mask) -> tuple[BoolArray, BoolArray]:
    """Whether the mask is there, and whether it is nowhere, in all texels around triangles (m, 3, 2)."""
    size = np.array(mask.alpha.shape[::-1])
    low, high = np.floor(xy.min(axis=1)).astype(np.int64), np.ceil(xy.max(axis=1)).astype(np.int64)
    if mask.repeat:
        span = np.minimum(high - low + 1, size)
        low = low % size
    else:
        low = np.clip(low, 0, size - 1)
        span = np.clip(high, 0, size - 1) - low + 1
    (x0, y0), (x1, y1) = low.T, (low + span).T
    count = table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0]
    return count == span.prod(axis=1), count == 0


def _quartered(corners: FloatArray) -> FloatArray:
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.stack([np.stack(part, axis=1) for part in parts], axis=1).reshape(-1, 3, corners.shape[-1])


def _clip(corners: FloatArray, level: FloatArray) -> tuple[FloatArray, IntArray]:
    """The parts of triangles (m, 3, k) where a value, given at their corners (m, 3), is not negative; and of which."""
    inside = level >= 0
    count = inside.sum(axis=1)
    out, of = [corners[count == 3]], [np.flatnonzero(count == 3)]
    for ends in (1, 2):  # the odd corner first: the one inside, or the one outside
        which = np.flatnonzero(count == ends)
        odd = np.argmax(inside[which] == (ends == 1), axis=1)
        order = (odd[:, None] + np.arange(3)) % 3
        p = np.take_along_axis(corners[which], order[..., None], axis=1)
        s = np.take_along_axis(level[which], order, axis=1)
        q, r = (p[:, 0] + (s[:, 0] / (s[:, 0] - s[:, k]))[:, None] * (p[:, k] - p[:, 0]) for k in (1, 2))
        new = [(p[:, 0], q, r)] if ends == 1 else [(q, p[:, 1], p[:, 2]), (q, p[:, 2], r)]
        out += [np.stack(triangle, axis=1) for triangle in new]
        of += [which] * len(new)
    return np.concatenate(out), np.concatenate(of)


def triangulate(points: FloatArray, vertex: IntArray, counts: IntArray, kept: BoolArray) -> tuple[IntArray, IntArray]:
    """Triangles of polygons, in the polygons' order.

    points (n, 3); vertex (k,): point of each corner, polygon after polygon; counts (m,): corners of each; kept (m,):
    which are wanted. Returns corners (t, 3), numbers into `vertex`, and the polygon (t,) of each triangle.
    """
    first = np.cumsum(counts) - counts
    out, of = [], []
    for count in np.unique(counts[kept & (counts >= 3)]):
        which = np.flatnonzero(kept & (counts == count))
        ring = first[which, None] + np.arange(count)
        step = np.arange(1, count - 1)
        fan = np.stack([np.broadcast_to(ring[:, :1], (len(ring), count - 2)), ring[:, step], ring[:, step + 1]], -1)
        if count > 3:
            p = points[vertex[fan]]
            normal = np.cross(p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :])
            bent = (np.einsum("mtk,mk->mt", normal, normal.sum(axis=1)) < 0).any(axis=1)
            for k in np.flatnonzero(bent):
                fan[k] = ring[k][triangulated(points[vertex[ring[k]]])]
        out.append(fan.reshape(-1, 3))
        of.append(np.repeat(which, count - 2))
    if not out:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    corners, polygon = np.concatenate(out), np.concatenate(of)
    order = np.argsort(polygon, kind="stable")
    return corners[order], polygon[order]


def triangulated(corners: FloatArray) -> IntArray:
    """Triangles (n - 2, 3), numbers of corners, of a planar polygon that does not cross itself, corners (n, 3).

    They turn as the polygon does. It may touch itself, as those do that have a hole, with a cut that leads to it. A
    convex one is a fan from its first corner, as Mitsuba has it; so is what cannot be cut into n - 2 triangles, as a
    polygon that crosses itself.
    """
    n = len(corners)
    if not is_convex(corners):
        xy, _ = _flattened(corners)
        cut = mapbox_earcut.triangulate_float64(np.ascontiguousarray(xy), np.array([n], np.uint32))
        if len(cut) == 3 * (n - 2):
            return cut.reshape(-1, 3).astype(np.int64)
    k = np.arange(1, n - 1)
    return np.stack([np.zeros_like(k), k, k + 1], axis=1)


def is_convex(corners: FloatArray) -> bool:
    """Whether the planar polygon with these corners (n, 3) is convex, so that a fan from any corner fills it."""
    xy, area = _flattened(corners)
    edge = np.roll(xy, -1, axis=0) - xy
    before = np.roll(edge, 1, axis=0)
    turn = before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0]  # twice the area of the triangle at each corner
    if (turn < -_STRAIGHT * area).any():
        return False
    angle = np.arctan2(turn, np.einsum("ij,ij->i", edge, before))
    return bool(area == 0 or angle.sum() < 3 * np.pi)  # once round, not twice


def _flattened(corners: FloatArray) -> tuple[FloatArray, float]:
    """The polygon (n, 2) in its own plane, counter-clockwise, and its area (Newell's normal)."""
    p = corners - corners.mean(axis=0)
    normal = 0.5 * np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0)
    area = float(np.linalg.norm(normal))
    if not area > 0:
        return p[:, :2], 0.0
    side = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(side, normal / area)
    x /= np.linalg.norm(x)
    return p @ np.stack([x, np.cross(normal / area, x)], axis=1), area
