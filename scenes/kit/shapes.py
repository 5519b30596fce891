"""Closed, outward oriented triangle shapes with normals and texture coordinates: the solids that rooms are made of.

Lengths are metres in the world frame (right-handed, y up). Texture coordinates are metres too, measured on the surface,
v downwards in the image, unless `atlas_uv` has put a shape into a part of a picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mesh:
    """Triangles: `v` (n, 3) positions, `n` (n, 3) unit normals, `uv` (n, 2), `f` (m, 3), seen from outside ccw."""

    v: Array
    n: Array
    uv: Array
    f: NDArray[np.int64]


Parts = list[tuple[str, Mesh]]  # (name of the material, shape)


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh with the triangles of all (order kept)."""
    starts = np.cumsum([0, *[len(m.v) for m in meshes]])
    return Mesh(
        np.concatenate([m.v for m in meshes]),
        np.concatenate([m.n for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
        np.concatenate([m.f + s for m, s in zip(meshes, starts[:-1], strict=True)]),
    )


def rotation(axis: str, degrees: float) -> Array:
    """(3, 3) right-handed rotation about 'x', 'y' or 'z'."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    r = np.eye(3)
    r[i, i] = r[j, j] = c
    r[i, j], r[j, i] = -s, s
    return r


def move(mesh: Mesh, t: ArrayLike = (0.0, 0.0, 0.0), r: Array | None = None) -> Mesh:
    """The mesh turned by `r` (3, 3) about the origin, then shifted by `t` (3,)."""
    r = np.eye(3) if r is None else r
    return replace(mesh, v=mesh.v @ r.T + np.asarray(t, float), n=mesh.n @ r.T)


def move_parts(parts: Parts, t: ArrayLike = (0.0, 0.0, 0.0), r: Array | None = None) -> Parts:
    """`move` for a whole piece of furniture."""
    return [(name, move(mesh, t, r)) for name, mesh in parts]


def shift_uv(mesh: Mesh, du: float, dv: float) -> Mesh:
    """The mesh with its texture slid by (du, dv), so that equal things do not look equal."""
    return replace(mesh, uv=mesh.uv + np.array([du, dv]))


def atlas_uv(mesh: Mesh, rect: tuple[float, float, float, float]) -> Mesh:
    """The mesh with its uv range stretched over `rect` = (u0, v0, u1, v1) of a picture."""
    lo, hi = mesh.uv.min(0), mesh.uv.max(0)
    unit = (mesh.uv - lo) / np.maximum(hi - lo, 1e-9)
    return replace(mesh, uv=np.array(rect[:2]) + unit * (np.array(rect[2:]) - rect[:2]))


def _face_cross(v: Array, f: NDArray[np.int64]) -> Array:
    return np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])


def smooth(v: Array, uv: Array, f: NDArray[np.int64]) -> Mesh:
    """Mesh with area-weighted vertex normals; vertices at one place (texture seams) share theirs."""
    f = f[np.linalg.norm(_face_cross(v, f), axis=1) > 1e-13]
    _, same = np.unique(np.round(v, 6) + 0.0, axis=0, return_inverse=True)
    same = same.reshape(-1)
    total = np.zeros((same.max() + 1, 3))
    np.add.at(total, same[f].reshape(-1), np.repeat(_face_cross(v, f), 3, axis=0))
    used, f_used = np.unique(f, return_inverse=True)
    n = total[same[used]]
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
    return Mesh(v[used], n, uv[used], f_used.reshape(-1, 3))


def grid_faces(rows: int, cols: int, start: int = 0) -> NDArray[np.int64]:
    """Triangles of a (rows, cols) vertex grid; front side is where d(row) × d(col) points."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(cols - 1), indexing="ij")
    a = (i * cols + j).reshape(-1) + start
    return np.concatenate([np.stack([a, a + cols, a + cols + 1], 1), np.stack([a, a + cols + 1, a + 1], 1)])


def quad(origin: ArrayLike, du: ArrayLike, dv: ArrayLike, uv0: tuple[float, float] = (0.0, 0.0)) -> Mesh:
    """One flat rectangle facing dv × du: seen from its front, u runs along `du` and v along `dv`, as in an image."""
    o, a, b = (np.asarray(x, float) for x in (origin, du, dv))
    n = np.cross(b, a)
    n /= np.linalg.norm(n)
    lu, lv = np.linalg.norm(a), np.linalg.norm(b)
    uv = np.array([[0, 0], [lu, 0], [lu, lv], [0, lv]]) + uv0
    return Mesh(np.array([o, o + a, o + a + b, o + b]), np.tile(n, (4, 1)), uv, np.array([[0, 2, 1], [0, 3, 2]]))


def box(lo: ArrayLike, hi: ArrayLike) -> Mesh:
    """Flat shaded box; on every face u runs along the longer side (the way of the wood's grain)."""
    lo, hi = np.asarray(lo, float), np.asarray(hi, float)
    d = hi - lo
    faces = []
    for axis in range(3):
        for sign in (-1, 1):
            b, c = (axis + 1) % 3, (axis + 2) % 3
            if d[b] < d[c]:
                b, c = c, b
            eu, ev = np.eye(3)[b] * d[b], np.eye(3)[c] * d[c]
            o = lo.copy() if sign < 0 else np.where(np.arange(3) == axis, hi, lo)
            if np.cross(ev, eu)[axis] * sign < 0:  # turn the image upside down rather than inside out
                o, ev = o + ev, -ev
            faces.append(quad(o, eu, ev, (1.37 * (axis + 2 * sign) + lo[b], 0.71 * axis + lo[c] + 0.31 * sign)))
    return merge(faces)


def rounded_box(lo: ArrayLike, hi: ArrayLike, radius: float, n: int = 10, bulge: float = 0.0, edge: int = 4) -> Mesh:
    """Smooth box with edges of `radius`; `bulge` swells each face's middle outwards by that much (upholstery)."""
    lo, hi = np.asarray(lo, float), np.asarray(hi, float)
    half, centre = (hi - lo) / 2, (hi + lo) / 2
    r = min(radius, 0.999 * float(half.min()))

    def line(h: float) -> Array:
        corner = h - r + r * np.tan(np.linspace(0, np.pi / 4, edge + 1))
        return np.concatenate([-corner[::-1], np.linspace(-(h - r), h - r, n + 1)[1:-1], corner])

    vs, uvs, fs, count = [], [], [], 0
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        gb, gc = np.meshgrid(line(half[b]), line(half[c]), indexing="ij")
        for sign in (-1.0, 1.0):
            q = np.empty((gb.size, 3))
            q[:, axis], q[:, b], q[:, c] = sign * half[axis], gb.reshape(-1), gc.reshape(-1)
            core = np.clip(q, -(half - r), half - r)
            d = q - core
            p = core + r * d / np.linalg.norm(d, axis=1, keepdims=True)
            if bulge:
                w = np.maximum(1 - (p / half) ** 2, 0)
                p = p + bulge * np.sign(p) * np.stack([w[:, 1] * w[:, 2], w[:, 2] * w[:, 0], w[:, 0] * w[:, 1]], 1) * (
                    np.abs(p) / half
                )
            f = grid_faces(*gb.shape, count)
            fs.append(f if sign > 0 else f[:, ::-1])
            vs.append(p)
            uv = q[:, [b, c]] if half[b] >= half[c] else q[:, [c, b]]
            uvs.append(uv + centre[[b, c]] + (1.37 * (axis + 2 * sign), 0.71 * axis))
            count += len(q)
    return smooth(np.concatenate(vs) + centre, np.concatenate(uvs), np.concatenate(fs))


def superellipsoid(radii: ArrayLike, e1: float = 1.0, e2: float = 1.0, nu: int = 48, nv: int = 24) -> Mesh:
    """Superellipsoid about the origin, poles on y: e < 1 squares it (e1 in elevation, e2 in plan)."""
    radii = np.asarray(radii, float)

    def power(x: Array, e: float) -> Array:
        return np.sign(x) * np.abs(x) ** e

    el, az = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, nv + 1), np.linspace(0, 2 * np.pi, nu + 1), indexing="ij")
    c, s = power(np.cos(el), e1), power(np.sin(el), e1)
    c[0] = c[-1] = 0.0
    v = np.stack([c * power(np.cos(az), e2), s, c * power(np.sin(az), e2)], -1) * radii
    v[:, -1] = v[:, 0]
    uv = np.stack([az * radii[[0, 2]].mean(), -el * radii.mean()], -1)
    return smooth(v.reshape(-1, 3), uv.reshape(-1, 2), grid_faces(nv + 1, nu + 1))


def pillow(width: float, height: float, depth: float, n: int = 28) -> Mesh:
    """Throw pillow standing in the x-y plane about the origin: thin seams, drawn-in sides, pointed corners."""
    t = np.sin(np.linspace(-np.pi / 2, np.pi / 2, n + 1))
    a, b = np.meshgrid(t, t, indexing="ij")
    x = a * width / 2 * (1 - 0.10 * (1 - b**2) * a**2)
    y = b * height / 2 * (1 - 0.10 * (1 - a**2) * b**2)
    z = 0.003 + depth / 2 * ((1 - a**2) * (1 - b**2)) ** 0.42
    uv = np.stack([a * width / 2, -b * height / 2], -1).reshape(-1, 2)
    top, bottom = (np.stack([x, y, s * z], -1).reshape(-1, 3) for s in (1.0, -1.0))
    f = grid_faces(n + 1, n + 1)
    f = np.concatenate([f, f[:, ::-1] + len(top), _rim_faces(n + 1, n + 1)])
    return smooth(np.concatenate([top, bottom]), np.concatenate([uv, uv + 0.53]), f)


def lathe(profile: Sequence[Sequence[float]] | Array, segments: int = 48) -> Mesh:
    """Surface of revolution about y of `profile` (k, 2) = (radius, y), outside to the right when walking along it.

    Walking upwards gives an outward surface. Corners above 35° stay sharp. A closed solid starts and ends at radius 0.
    """
    p = np.asarray(profile, float)
    d = np.diff(p, axis=0)
    length = np.linalg.norm(d, axis=1)
    d = d / length[:, None]
    breaks = np.flatnonzero((d[1:] * d[:-1]).sum(1) < np.cos(np.radians(35))) + 1
    az = np.linspace(0, 2 * np.pi, segments + 1)
    along = np.concatenate([[0], np.cumsum(length)])
    meshes = []
    for a, b in zip([0, *breaks], [*breaks, len(p) - 1], strict=True):
        run, dr = p[a : b + 1], d[a:b]
        mid = (dr[1:] + dr[:-1]) / 2
        tangent = np.concatenate([dr[:1], mid, dr[-1:]])
        normal = np.stack([tangent[:, 1], -tangent[:, 0]], 1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        cos, sin = np.cos(az), np.sin(az)
        cos[-1], sin[-1] = 1.0, 0.0
        v, n = (
            np.stack([q[:, :1] * cos, np.broadcast_to(q[:, 1:], (len(q), len(az))), q[:, :1] * sin], -1).reshape(-1, 3)
            for q in (run, normal)
        )
        radius = max(float(p[:, 0].max()), 1e-3)
        uv = np.stack(np.broadcast_arrays(az * radius, -along[a : b + 1, None]), -1).reshape(-1, 2)
        f = grid_faces(len(run), len(az))
        f = f[np.linalg.norm(_face_cross(v, f), axis=1) > 1e-13]
        meshes.append(Mesh(v, n, uv, f))
    return merge(meshes)


def tube(path: ArrayLike, radius: ArrayLike, segments: int = 12) -> Mesh:
    """Round tube along `path` (k, 3) with end caps; `radius` is a number or (k,)."""
    p = np.asarray(path, float)
    r = np.broadcast_to(np.asarray(radius, float), len(p))
    t = np.gradient(p, axis=0)
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    side = np.cross(t[0], np.eye(3)[np.argmin(np.abs(t[0]))])
    sides = []
    for tangent in t:  # parallel transport along the path's few points
        side = side - tangent * (side @ tangent)
        side = side / np.linalg.norm(side)
        sides.append(side)
    a = np.array(sides)
    b = np.cross(t, a)
    az = np.linspace(0, 2 * np.pi, segments + 1)
    n = a[:, None] * np.cos(az)[:, None] + b[:, None] * np.sin(az)[:, None]
    n[:, -1] = n[:, 0]
    v = p[:, None] + r[:, None, None] * n
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(along[:, None], az * r.mean()), -1)
    caps = []
    for end, sign in ((0, -1.0), (-1, 1.0)):
        ring = np.concatenate([p[end][None], v[end]])
        k = np.arange(1, segments + 1)
        f = np.stack([0 * k, k, k + 1], 1)
        caps.append(Mesh(ring, np.tile(sign * t[end], (len(ring), 1)), ring[:, :2], f if sign > 0 else f[:, ::-1]))
    faces = grid_faces(len(p), segments + 1)[:, ::-1]
    return merge([Mesh(v.reshape(-1, 3), n.reshape(-1, 3), uv.reshape(-1, 2), faces), *caps])


def slab(grid: Array, thickness: float, uv: Array) -> Mesh:
    """Closed sheet of `thickness` about the surface `grid` (rows, cols, 3) with `uv` (rows, cols, 2): curtain, leaf."""
    n = np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1))
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-12)
    rows, cols = grid.shape[:2]
    top, bottom = ((grid + s * thickness / 2 * n).reshape(-1, 3) for s in (1.0, -1.0))
    n, uv, f = n.reshape(-1, 3), uv.reshape(-1, 2), grid_faces(rows, cols)
    rim = smooth(np.concatenate([top, bottom]), np.concatenate([uv, uv]), _rim_faces(rows, cols))
    return merge([Mesh(top, n, uv, f), Mesh(bottom, -n, uv, f[:, ::-1]), rim])


def _rim_faces(rows: int, cols: int) -> NDArray[np.int64]:
    """Triangles that join the borders of a (rows, cols) front grid and of the back grid stored right after it."""
    i = np.arange(rows * cols).reshape(rows, cols)
    rim = np.concatenate([i[0, :-1], i[:-1, -1], i[-1, :0:-1], i[:0:-1, 0]])
    nxt, k = np.roll(rim, -1), rows * cols
    return np.concatenate([np.stack([rim, nxt, nxt + k], 1), np.stack([rim, nxt + k, rim + k], 1)])
