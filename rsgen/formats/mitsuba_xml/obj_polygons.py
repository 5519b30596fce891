"""OBJ files with polygons that are not convex, as files of triangles: Mitsuba would make fans of them, without a word.

All else in a file stays as it is: texture coordinates, normals, and the order of what it holds.
"""

from __future__ import annotations

import re

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.formats.mitsuba_xml.polygons import is_convex, triangulated

METHOD = b"obj-polygons/1"
"""Raise when files come out differently: light baked on their surfaces is kept under it."""

_POLYGON = re.compile(rb"(?:^|(?<=\n))[ \t]*f((?:[ \t]+\S+){5,})[ \t]*\r?(?=\n|$)")
_VERTEX = re.compile(rb"(?:^|(?<=\n))[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)")
_MOST_CHARACTERS = 1000  # of a line; Mitsuba takes some more


def with_triangles(data: bytes) -> bytes | None:
    """The OBJ file with triangles for polygons where one of five corners or more is not convex, or its line too long.

    None if there is no such polygon, or if it names vertices that are not there or are no numbers.
    """
    polygons = list(_POLYGON.finditer(data))
    if not polygons:
        return None
    places, vertices = [], []
    for found in _VERTEX.finditer(data):
        places.append(found.start())
        vertices.append(found.groups())
    pieces, end, needed = [], 0, False
    try:
        positions = np.array(vertices).astype(float).reshape(-1, 3)
        for polygon in polygons:
            words = polygon[1].split()
            corners = positions[_indices(words, int(np.searchsorted(places, polygon.start())), len(positions))]
            needed |= len(polygon[0]) > _MOST_CHARACTERS or not is_convex(corners)
            pieces += [data[end : polygon.start()], _face_lines(words, corners)]
            end = polygon.end()
    except (ValueError, IndexError):
        return None
    return b"".join([*pieces, data[end:]]) if needed else None


def _indices(words: list[bytes], before: int, count: int) -> list[int]:
    """Numbers of vertices, from 0, that a face's corners name, `before` of `count` above it. Raises IndexError."""
    numbers = [int(word.partition(b"/")[0]) for word in words]
    found = [number - 1 if number > 0 else before + number for number in numbers]
    if min(found) < 0 or max(found) >= count:
        raise IndexError
    return found


def _face_lines(words: list[bytes], corners: FloatArray) -> bytes:
    return b"\n".join(b"f " + b" ".join(words[k] for k in triangle) for triangle in triangulated(corners))
