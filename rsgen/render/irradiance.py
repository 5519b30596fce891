"""Irradiance stored on the surfaces of a scene, and its lookup at a ray's hit, in Dr.Jit.

Every triangle carries its own small grid of samples ("mesh colours": Yuksel, Keyser, House, ACM TOG 2010), so a scene
needs no texture atlas. The grid spans the collapsed square of the triangle: u runs from the apex (opposite the shortest
edge) to that edge, v along it, so that long thin triangles get samples in proportion to their area. Both sides of a
triangle have values, since scenes are free to show either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, IntArray
from rsgen.device.arrays import aligned, vectors
from rsgen.errors import UserError
from rsgen.scene.meshes import coarser, inhabited_box, mesh_corners, meshes_of

REACH_LEVELS = 31  # how far a sample counts towards a neighbour: level / 30 of the way
FREE = REACH_LEVELS  # and this, beyond the neighbour: nothing stands between
_BLOCKED = 1e-4  # weight of a sample that something stands before: it counts where no other does
_MAX_CELLS = 4095  # cells along one grid axis: 12 bits
_POINT_BYTES = 400  # of memory that baking takes at its peak for each point, as measured
_MOST_POINTS = int(4e9 / _POINT_BYTES)


@dataclass(frozen=True)
class Lattice:
    """Where irradiance is sampled: per triangle a grid of (cells_u + 1) x (cells_v + 1) points, row by row.

    first (f,): index of each triangle's first point; cells (f, 2), 0 where there is one in its middle alone; apex (f,):
    corner 0..2; shape_first: by Dr.Jit registry id, the first triangle of each shape (-1: none); lacquered: by the
    same, whether a shape is matte beneath lacquer; points: total count.
    """

    first: IntArray
    cells: IntArray
    apex: IntArray
    shape_first: NDArray[np.int32]
    lacquered: NDArray[np.bool_]
    points: int

    @property
    def counts(self) -> IntArray:
        """(f,) points of each triangle."""
        return (self.cells + 1).prod(axis=1)

    def places(self) -> tuple[IntArray, IntArray, IntArray]:
        """Triangle of each point, and the row along u and the column along v that it is in, (points,) each."""
        face = np.repeat(np.arange(len(self.first)), self.counts)
        row, column = np.divmod(np.arange(self.points) - self.first[face], self.cells[face, 1] + 1)
        return face, row, column


def registry_id(thing: Any) -> int:
    """Dr.Jit's number of a shape or an emitter, which a pointer to it on the device holds."""
    pointer = mi.EmitterPtr if isinstance(thing, mi.Emitter) else mi.ShapePtr
    return int(dr.reinterpret_array(mi.UInt32, pointer(thing))[0])


def make_lattice(scene: Any, spacing: float) -> Lattice:
    """Lattice over all meshes of `scene` with about `spacing` metres between samples, more on terrain that is far.

    Raises UserError, before it takes the memory, if baking so many samples would need more than 4 GB.
    """
    shapes = meshes_of(scene)
    ids = [registry_id(shape) for shape in shapes]
    shape_first = np.full(max(ids) + 1, -1, np.int32)
    lacquered = np.zeros(len(shape_first), bool)
    sides, apexes, faces_before = [], [], 0
    box = inhabited_box(shapes)
    for shape, number in zip(shapes, ids, strict=True):
        corners = mesh_corners(shape)
        # edge k is opposite corner k
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=-1)
        sides.append(np.stack([edges.max(axis=1), edges.min(axis=1)], axis=1) / coarser(corners, box)[:, None])
        apexes.append(np.argmin(edges, axis=1))
        shape_first[number] = faces_before
        lacquered[number] = _lacquered(shape.bsdf())
        faces_before += len(corners)
    lengths = np.concatenate(sides)
    _check_size(lengths, spacing)
    cells = _cells(lengths, spacing)
    first = np.concatenate([[0], np.cumsum((cells + 1).prod(axis=1))])
    apex = np.concatenate(apexes).astype(np.int64)
    return Lattice(first[:-1], cells, apex, shape_first, lacquered, int(first[-1]))


def _lacquered(bsdf: Any) -> bool:
    """Whether it is one of Mitsuba's plastics, beneath whatever adapts it: these alone have light refracted in."""
    kind = str(bsdf)
    return "Plastic[" in kind and "Blend" not in kind


def _cells(lengths: NDArray[np.float64], spacing: float) -> IntArray:
    """Cells (f, 2) of triangles with edges (f, 2) of these lengths, longest and shortest.

    None in triangles smaller than the spacing, which have one point then, if four for each would be too many.
    """
    cells = np.clip(np.rint(lengths / spacing), 1, _MAX_CELLS).astype(np.int64)
    if (cells + 1).prod(axis=1).sum() > _MOST_POINTS:
        cells[lengths[:, 0] < spacing] = 0
    return cells


def _check_size(lengths: NDArray[np.float64], spacing: float) -> None:
    def count(at: float) -> int:
        return int((_cells(lengths, at) + 1).prod(axis=1).sum())

    asked = count(spacing)
    if asked <= _MOST_POINTS:
        return
    if len(lengths) > _MOST_POINTS:
        raise UserError(
            f"its {len(lengths)} triangles are too many to bake light on ({_gigabytes(len(lengths))} GB): "
            "simplify its meshes, or use light.mode path"
        )
    low, high = spacing, 2 * spacing
    while count(high) > _MOST_POINTS:
        low, high = high, 2 * high
    while high > 1.02 * low:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if count(middle) > _MOST_POINTS else (low, middle)
    digit = 10 ** (np.floor(np.log10(high)) - 1)
    fits = float(np.ceil(high / digit) * digit)
    raise UserError(
        f"light.texel_m {spacing:g} needs {_gigabytes(asked)} GB to bake, with {lengths.max():.3g} m its longest edge: "
        f"set it to {fits:.2g} or more, or scale the scene to metres"
    )


def _gigabytes(points: int) -> str:
    return f"{points * _POINT_BYTES / 1e9:.3g}"


def lattice_barycentric(lattice: Lattice) -> tuple[IntArray, Float32Array]:
    """Triangle index (points,) and Mitsuba's barycentric (b1, b2) (points, 2) of every lattice point."""
    face, row, column = lattice.places()
    u, v = (k / np.maximum(n, 1) for k, n in zip((row, column), lattice.cells[face].T, strict=True))
    alone = lattice.cells[face, 0] == 0
    u[alone], v[alone] = 2 / 3, 0.5  # the middle
    weights = np.zeros((lattice.points, 3), np.float32)
    apex = lattice.apex[face]
    points = np.arange(lattice.points)
    weights[points, apex] = 1 - u
    weights[points, (apex + 1) % 3] = u * (1 - v)
    weights[points, (apex + 2) % 3] = u * v
    return face, weights[:, 1:]


def lattice_area(scene: Any, lattice: Lattice) -> NDArray[np.float64]:
    """Area (points,) in m² that each lattice point stands for on one side: a triangle's points share out its own."""
    triangle = trimesh.triangles.area(np.concatenate([mesh_corners(shape) for shape in meshes_of(scene)]))
    face, row, column = lattice.places()
    nu, nv = lattice.cells[face].T
    # Across a grid line at u a triangle is as wide as u: the strip about it, cut off at u = 1, has so much of the area.
    strip = np.minimum(row + 0.5, nu) ** 2 - np.maximum(row - 0.5, 0) ** 2
    along = np.where((column == 0) | (column == nv), 0.5, 1.0) / np.maximum(nv, 1)
    return np.asarray(triangle[face] * np.where(nu > 0, strip / np.maximum(nu, 1) ** 2 * along, 1.0))


def at_triangles(shape: NDArray[np.uint32], face: NDArray[np.uint32], uv: Float32Array) -> tuple[Any, Any]:
    """(pi, si), as if met by rays, at barycentric uv (n, 2) of triangles of the meshes with these `registry_id`."""
    pi = dr.zeros(mi.PreliminaryIntersection3f, len(face))
    pi.t = mi.Float(1)  # else it counts as no hit
    pi.prim_index = mi.UInt32(aligned(face, np.uint32))
    pi.prim_uv = vectors(mi.Point2f, uv)
    pi.shape = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(aligned(shape, np.uint32)))
    pi.valid = mi.Bool(True)
    ray = dr.zeros(mi.Ray3f, len(face))
    ray.d = mi.Vector3f(0, 0, 1)
    return pi, pi.compute_surface_interaction(ray, mi.RayFlags.All)


def packed_reach(levels: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """(n,) code of how far samples count, `levels` (n, 4) towards +u, -u, +v and -v; 0 where nothing is in the way.

    Codes are below 2^20, so that with the 1 of a living sample they are exact in float32.
    """
    taken = (FREE - levels.astype(np.uint32)) << np.array([0, 5, 10, 15], np.uint32)
    return taken.sum(axis=1).astype(np.uint32)


class IrradianceField:
    """Device tables for `lookup`; no dataclass, which Dr.Jit's loops would take apart as their state.

    A point that no light can reach (buried in another object) is not alive and does not darken its neighbours; one
    beyond a wall, or under what lies on the surface, does not count on this side of it (see `packed_reach`).
    """

    def __init__(self, lattice: Lattice, front: Float32Array, back: Float32Array) -> None:
        """front, back: of each lattice point (points, 5): E_r, E_g, E_b (scene units); 0 for a point that is not alive,
        else 1 + its reach; and its share beneath lacquer (see `light.bake`). Without a fifth column that is 1.

        Tables: faces has pairs (first point, packed cells and apex), front sides then back sides. Unlit back sides
        share one dark cell.
        """
        counts, packed = lattice.counts, lattice.cells[:, 0] | lattice.cells[:, 1] << 12 | lattice.apex << 24
        lit = np.maximum.reduceat(back[:, 3], lattice.first) > 0
        dark = lattice.points  # four zero entries follow the front values
        of_back = np.where(lit, counts, 0)
        back_first = np.where(lit, dark + 4 + np.cumsum(of_back) - of_back, dark)
        back_packed = np.where(lit, packed, 1 | 1 << 12)
        first, both = np.concatenate([lattice.first, back_first]), np.concatenate([packed, back_packed])
        parts = front, np.zeros((4, front.shape[1]), np.float32), back[np.repeat(lit, counts)]
        # One after the other: each is copied twice on its way to the device.
        self.values = mi.Float(aligned(np.concatenate([part[:, :4] for part in parts])))
        shares = [part[:, 4] if front.shape[1] == 5 else np.ones(len(part)) for part in parts]
        self.share = mi.Float(aligned(np.concatenate(shares)))
        self.shape_first = mi.Int32(aligned(lattice.shape_first, np.int32))  # by registry id
        self.lacquered = mi.UInt32(aligned(lattice.lacquered, np.uint32))  # likewise
        self.faces = mi.UInt32(aligned(np.stack([first, both], axis=1), np.uint32))
        self.back_first = dr.opaque(mi.UInt32, len(lattice.first))  # else kernels are made for each number of triangles

    def beneath_lacquer(self, shape: Any, active: Any) -> Any:
        """Whether what is matte of a shape (ShapePtr) is lit by what gets into lacquer."""
        return dr.gather(mi.UInt32, self.lacquered, dr.reinterpret_array(mi.UInt32, shape), active) > 0

    def lookup(self, pi: Any, si: Any, wi_world: Any, active: Any = True) -> Any:
        """Irradiance (Color3f, scene units) at hits `pi`/`si`, on the side where `wi_world`, towards the viewer, is.

        On lacquer it is so much as from all sides alike would light what is beneath it as this does.
        """
        shape = dr.reinterpret_array(mi.UInt32, si.shape)
        first_face = dr.gather(mi.Int32, self.shape_first, shape, active & si.is_valid())
        lacquered = self.beneath_lacquer(si.shape, active & si.is_valid())
        active = active & si.is_valid() & (first_face >= 0)
        # Shading decides which side is lit: meshes exist whose winding and vertex normals disagree.
        back = dr.dot(si.n, wi_world) * dr.dot(si.n, si.sh_frame.n) < 0
        face = mi.UInt32(first_face) + pi.prim_index + dr.select(back, self.back_first, 0)
        entry = dr.gather(mi.Vector2u, self.faces, face, active)
        nu, nv, apex = entry.y & 0xFFF, (entry.y >> 12) & 0xFFF, entry.y >> 24
        b1, b2 = pi.prim_uv.x, pi.prim_uv.y
        b0 = 1 - b1 - b2
        w_apex = dr.select(apex == 0, b0, dr.select(apex == 1, b1, b2))
        w_last = dr.select(apex == 0, b2, dr.select(apex == 1, b0, b1))
        u = dr.clip(1 - w_apex, 0, 1)
        v = dr.clip(w_last / dr.maximum(u, 1e-12), 0, 1)
        x, y = u * mi.Float(nu), v * mi.Float(nv)
        i, j = dr.minimum(mi.UInt32(x), nu - 1), dr.minimum(mi.UInt32(y), nv - 1)
        fx, fy = x - mi.Float(i), y - mi.Float(j)
        corner = entry.x + i * (nv + 1) + j
        total = mi.Vector4f(0)
        for offset, du, dv, u_bits, v_bits in (
            (corner, fx, fy, 0, 10),
            (corner + 1, fx, 1 - fy, 0, 15),
            (corner + nv + 1, 1 - fx, fy, 5, 10),
            (corner + nv + 2, 1 - fx, 1 - fy, 5, 15),
        ):
            value = dr.gather(mi.Vector4f, self.values, offset, active)
            taken = mi.UInt32(dr.maximum(value.w - 1, 0))
            reaches = (du <= _reach(taken >> u_bits)) & (dv <= _reach(taken >> v_bits))
            weight = (1 - du) * (1 - dv) * dr.select(value.w > 0, dr.select(reaches, 1, _BLOCKED), 0)
            share = dr.select(lacquered, dr.gather(mi.Float, self.share, offset, active & lacquered), 1)
            total += mi.Vector4f(value.x * share, value.y * share, value.z * share, 1) * weight
        return mi.Color3f(total.xyz) * dr.select(total.w > 0, dr.rcp(dr.maximum(total.w, 1e-12)), 0)


def _reach(code: Any) -> Any:
    """Part of the way to the neighbour, above 1 where it is free."""
    return mi.Float(FREE - (code & 31)) / (REACH_LEVELS - 1)
