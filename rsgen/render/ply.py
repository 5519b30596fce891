"""Triangles as PLY files that Mitsuba reads, and several meshes as one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def ply_bytes(
    vertices: NDArray, faces: NDArray, normals: NDArray | None = None, uv: NDArray | None = None,
    vertex_colors: NDArray | None = None, face_colors: NDArray | None = None,
) -> bytes:  # fmt: skip
    """Binary PLY of triangles: vertices (n, 3), faces (m, 3), unit normals (n, 3) and texture coordinates (n, 2).

    Colours (n, 3), (m, 3) become Mitsuba's attributes `vertex_color` and `face_color`, as they are.
    """
    names = ["x", "y", "z"]
    parts = [vertices]
    if normals is not None:
        names += ["nx", "ny", "nz"]
        parts.append(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
    if uv is not None:
        names += ["u", "v"]
        parts.append(uv)
    if vertex_colors is not None:
        names += ["r", "g", "b"]
        parts.append(vertex_colors)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    columns: list[tuple[Any, ...]] = [("n", "u1"), ("v", "<i4", 3)]
    if face_colors is not None:
        header += [f"property float {name}" for name in "rgb"]
        columns.append(("c", "<f4", 3))
    header += ["end_header", ""]
    face_rows = np.empty(len(faces), dtype=columns)
    face_rows["n"], face_rows["v"] = 3, faces
    if face_colors is not None:
        face_rows["c"] = face_colors
    data = np.concatenate(parts, axis=1).astype("<f4")
    return "\n".join(header).encode() + data.tobytes() + face_rows.tobytes()


def joined_triangles(vertices: Sequence[NDArray], faces: Sequence[NDArray]) -> tuple[NDArray, NDArray]:
    """Vertices (n, 3) and faces (m, 3) of several meshes as those of one."""
    first = np.cumsum([0, *(len(v) for v in vertices)])
    moved = [f + f.dtype.type(k) for f, k in zip(faces, first[:-1], strict=True)]
    return np.concatenate(vertices), np.concatenate(moved)
