"""The surface in a signed distance volume as triangles: marching cubes chunk by chunk, seams welded; PLY files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rstrack.volume.kernels import BLOCK
from rstrack.volume.volume import Blocks

# Blocks along a chunk's edge.
_CHUNK = 8
# Weight from which on a lattice point has been seen.
_LEAST_WEIGHT = 1e-3
# Vertices of neighbouring chunks that are so near (voxels) are one.
_WELD = 1e-3
_NOTHING = np.zeros(0, np.int64)
# Of a cell of vertices' places, by which they are packed into 64 bits wherever they are.
_CELL_BITS = 14


@dataclass(frozen=True)
class TriangleSurface:
    """Triangles: vertices (n, 3) in m, faces (m, 3), counter-clockwise as the camera saw them, colors (n, 3) uint8."""

    vertices: FloatArray
    faces: IntArray
    colors: npt.NDArray[np.uint8] | None


def extract_surface(blocks: Blocks, voxel_m: float) -> TriangleSurface:
    """Triangles where the distance is zero, between lattice points that have been seen.

    Marching cubes after Lewiner et al. (Journal of Graphics Tools 8(2), 2003), scikit-image's. Raises UserError if
    there is no surface.
    """
    vertices, faces, colors, count = [], [], [], 0
    for origin, tsdf, weight, color in _chunks(blocks):
        found = _march(tsdf, weight >= _LEAST_WEIGHT)
        if found is None:
            continue
        zyx, triangles = found
        if color is not None:
            colors.append(_colors_at(color, zyx))
        vertices.append(zyx[:, ::-1].astype(np.float64) + origin)
        faces.append(triangles + count)
        count += len(zyx)
    if not count:
        raise UserError("map: no surface was found: is there depth, and are the poses those of this sequence?")
    lattice, mesh = np.concatenate(vertices), np.concatenate(faces)
    keys = np.rint(lattice / _WELD).astype(np.int64)
    _, first, same = np.unique(_packed(keys), return_index=True, return_inverse=True)
    mesh = same.reshape(-1)[mesh]
    whole = (mesh[:, 0] != mesh[:, 1]) & (mesh[:, 1] != mesh[:, 2]) & (mesh[:, 2] != mesh[:, 0])
    return TriangleSurface(lattice[first] * voxel_m, mesh[whole], np.concatenate(colors)[first] if colors else None)


def write_ply(path: Path, surface: TriangleSurface, comment: str = "", cloud: bool = False) -> None:
    """Write a binary PLY, a mesh or only its vertices, whole or not at all. Raises UserError."""
    import trimesh

    if cloud:
        thing = trimesh.PointCloud(surface.vertices, colors=surface.colors)
    else:
        thing = trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=surface.colors, process=False)
    data = thing.export(file_type="ply")
    head = b"format binary_little_endian 1.0\n"
    if comment:
        data = data.replace(head, head + b"comment " + comment.encode("ascii", "replace") + b"\n", 1)
    atomic_write(path, data)


# ---------------------------------------------------------------------------------------------------------------------


def _chunks(blocks: Blocks) -> Iterator[tuple[IntArray, Float32Array, Float32Array, Float32Array | None]]:
    """First lattice point (x y z), distance and weight (axes z y x) and colour (..., 4) of each chunk with blocks.

    A chunk ends with the lattice points with which the next begins.
    """
    if not len(blocks.at):
        return
    chunk = blocks.at // _CHUNK
    names, members = np.unique(chunk, axis=0, return_inverse=True)
    order = np.argsort(members.reshape(-1), kind="stable")
    of_chunk = np.split(order, np.flatnonzero(np.diff(members.reshape(-1)[order])) + 1)
    found = {tuple(name.tolist()): rows for name, rows in zip(names, of_chunk, strict=True)}
    for name in names:
        first = name * _CHUNK
        rows = np.full((_CHUNK + 1,) * 3, -1, np.int64)
        for step in product((0, 1), repeat=3):
            there = found.get(tuple((name + step).tolist()), _NOTHING)
            x, y, z = (blocks.at[there] - first).T
            near = np.maximum(np.maximum(x, y), z) <= _CHUNK
            rows[z[near], y[near], x[near]] = there[near]
        color = None if blocks.color is None else _dense(blocks.color, rows)
        yield first * BLOCK, _dense(blocks.tsdf, rows), _dense(blocks.weight, rows), color


def _dense(values: Float32Array, rows: IntArray) -> Float32Array:
    """Values (n, 8, 8, 8, ...) of the blocks `rows` (9, 9, 9) at a chunk's lattice points (65, 65, 65, ...)."""
    picked = values[np.maximum(rows, 0)]
    picked[rows < 0] = 0
    spread = picked.transpose(0, 3, 1, 4, 2, 5, *range(6, picked.ndim))
    edge = _CHUNK * BLOCK + 1
    return spread.reshape(*(n * BLOCK for n in rows.shape), *picked.shape[6:])[:edge, :edge, :edge]


def _march(tsdf: Float32Array, known: npt.NDArray[np.bool_]) -> tuple[Float32Array, IntArray] | None:
    """Vertices (n, 3) z y x and triangles (m, 3) of a chunk; None where there are none."""
    from skimage.measure import marching_cubes

    cells = np.ones(tuple(n - 1 for n in known.shape), bool)
    front, behind = np.zeros_like(cells), np.zeros_like(cells)
    for corner in product((slice(None, -1), slice(1, None)), repeat=3):
        cells &= known[corner]
        front |= tsdf[corner] > 0
        behind |= tsdf[corner] <= 0
    cells &= front & behind
    if not cells.any():
        return None
    # scikit-image asks a cell's last corner.
    mask = np.zeros(known.shape, bool)
    mask[1:, 1:, 1:] = cells
    try:
        vertices, faces, _, _ = marching_cubes(tsdf, 0.0, mask=mask, gradient_direction="ascent")
    except (RuntimeError, ValueError):
        return None  # raised where the level is only touched
    return vertices, np.asarray(faces, np.int64)


def _colors_at(color: Float32Array, zyx: Float32Array) -> npt.NDArray[np.uint8]:
    """Colours (n, 3), trilinear among those lattice points that have one; grey where none has."""
    weight = color[..., 3]
    planes = *(color[..., i] * weight for i in range(3)), weight
    *at, total = (ndimage.map_coordinates(plane, zyx.T, order=1) for plane in planes)
    rgb = np.stack([np.divide(a, total, out=np.full_like(a, 0.5), where=total > 1e-6) for a in at], axis=-1)
    return np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)


def _packed(keys: IntArray) -> IntArray:
    """One integer for each row (n, 3): cells of 2^14 a side, numbered, and the place in the cell."""
    cell = keys >> _CELL_BITS
    cell -= cell.min(axis=0)
    _, number = np.unique((cell[:, 2] << 42) | (cell[:, 1] << 21) | cell[:, 0], return_inverse=True)
    if max(cell.max(), number.max()) >= 2**21:
        raise UserError("map: the surface spreads too far for the voxel size: use larger voxels")
    x, y, z = (keys & (2**_CELL_BITS - 1)).T
    return np.asarray((number.reshape(-1) << 3 * _CELL_BITS) | (z << 2 * _CELL_BITS) | (y << _CELL_BITS) | x)
