"""Walls with openings, and what is fixed to them: a wall's own frame, its surface, reveals and skirting boards.

Everything of a wall is modelled in its frame: x to the right as seen from inside, y up (the world's height), z out of
the wall into the room. Going round a room to the right, each wall's right end is the next one's left end.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from scenes.kit.shapes import Array, Mesh, Parts, box, merge, move, move_parts, quad, rounded_box

GAP = 0.001  # kept between things that touch, so that no two faces coincide


@dataclass(frozen=True)
class Opening:
    """A niche in a wall for a door or a window: `x0` to `x1` along it, `y0` to `y1` high, `depth` deep, all in metres.

    `luminous`: its back is left to a pane that shines.
    """

    x0: float
    x1: float
    y0: float
    y1: float
    depth: float
    luminous: bool = False


@dataclass(frozen=True)
class Wall:
    """Plane wall from `left` to `right` = (x, z) as seen from inside, `bottom` to `top` high, with openings."""

    left: tuple[float, float]
    right: tuple[float, float]
    bottom: float
    top: float
    openings: tuple[Opening, ...] = ()

    @property
    def length(self) -> float:
        """Metres from left to right."""
        return float(np.hypot(self.right[0] - self.left[0], self.right[1] - self.left[1]))

    @property
    def axes(self) -> Array:
        """(3, 3) rotation whose columns are the wall's right, up and out."""
        along = np.array([self.right[0] - self.left[0], 0.0, self.right[1] - self.left[1]]) / self.length
        along = np.round(along, 12) + 0.0  # walls along the axes stay on them to the last bit
        return np.stack([along, [0.0, 1.0, 0.0], np.cross(along, [0.0, 1.0, 0.0])], axis=1)

    def world(self, mesh: Mesh) -> Mesh:
        """A mesh of the wall's frame in the world."""
        return move(mesh, (self.left[0], 0.0, self.left[1]), self.axes)

    def hang(self, parts: Parts, at: tuple[float, float], out: float = GAP) -> Parts:
        """A piece modelled on z = 0 and facing +z, placed with its origin at (along, height), `out` off the wall."""
        shifted = move_parts(parts, (at[0], at[1], out))
        return [(name, self.world(mesh)) for name, mesh in shifted]

    def surface(self, low: float | None = None, high: float | None = None) -> Mesh:
        """The wall between two heights (by default all of it) without its openings; v runs down from its top."""
        y0, y1 = self.bottom if low is None else low, self.top if high is None else high
        xs = sorted({0.0, self.length, *(x for o in self.openings for x in (o.x0, o.x1))})
        ys = sorted({y0, y1, *(y for o in self.openings for y in (o.y0, o.y1) if y0 < y < y1)})
        cells = []
        for a, b in pairwise(xs):
            for c, d in pairwise(ys):
                x, y = (a + b) / 2, (c + d) / 2
                if not any(o.x0 < x < o.x1 and o.y0 < y < o.y1 for o in self.openings):
                    cells.append(quad([a, d, 0], [b - a, 0, 0], [0, c - d, 0], (a, self.top - d)))
        return self.world(merge(cells))

    def reveals(self) -> Parts:
        """Sides of the openings, and the backs of those that are dark, as surfaces named 'reveal'."""
        meshes = []
        for o in self.openings:
            w, h, d = o.x1 - o.x0, o.y1 - o.y0, o.depth
            meshes += [
                quad([o.x0, o.y0, 0], [w, 0, 0], [0, 0, -d]),
                quad([o.x1, o.y1, 0], [-w, 0, 0], [0, 0, -d]),
                quad([o.x0, o.y1, 0], [0, -h, 0], [0, 0, -d]),
                quad([o.x1, o.y0, 0], [0, h, 0], [0, 0, -d]),
            ]
            meshes = [*meshes[:-4], *(_facing(m, ((o.x0 + o.x1) / 2, (o.y0 + o.y1) / 2, -d / 2)) for m in meshes[-4:])]
            if not o.luminous:
                meshes.append(quad([o.x0, o.y1, -d], [w, 0, 0], [0, -h, 0]))
        return [("reveal", self.world(merge(meshes)))] if meshes else []

    def pane(self, o: Opening) -> Mesh:
        """The back of a luminous opening; its texture covers it once."""
        q = quad([o.x0, o.y1, -o.depth], [o.x1 - o.x0, 0, 0], [0, o.y0 - o.y1, 0])
        return self.world(Mesh(q.v, q.n, q.uv / (o.x1 - o.x0, o.y1 - o.y0), q.f))

    def skirting(
        self,
        material: str,
        height: float,
        thickness: float,
        casing: float,
        start: float | None = None,
        stop: float | None = None,
    ) -> Parts:
        """Boards along the floor between the doors, `casing` clear of them, from `start` to `stop` along the wall.

        By default they stop short of the neighbour's boards at the left end and run on to the wall at the right.
        """
        doors = sorted((o.x0, o.x1) for o in self.openings if o.y0 <= self.bottom)
        a = [thickness + 2 * GAP if start is None else start, *(x1 + casing + GAP for _, x1 in doors)]
        b = [*(x0 - casing - GAP for x0, _ in doors), self.length - GAP if stop is None else stop]
        y = self.bottom + GAP
        boards = [
            rounded_box([x0, y, GAP], [x1, y + height, thickness], 0.004, 2, edge=2)
            for x0, x1 in zip(a, b, strict=True)
            if x1 - x0 > 0.02
        ]
        return [(material, self.world(merge(boards)))]


def _facing(q: Mesh, target: ArrayLike) -> Mesh:
    """The rectangle turned, if need be, so that it faces `target`."""
    front = float((np.asarray(target, float) - q.v.mean(0)) @ q.n[0]) > 0
    return q if front else Mesh(q.v, -q.n, q.uv, q.f[:, ::-1])


def floor(lo: tuple[float, float], hi: tuple[float, float], y: float) -> Mesh:
    """Rectangle at height `y`, facing up, from (x, z) to (x, z)."""
    return quad([lo[0], y, lo[1]], [hi[0] - lo[0], 0, 0], [0, 0, hi[1] - lo[1]])


def ceiling(lo: tuple[float, float], hi: tuple[float, float], y: float) -> Mesh:
    """Rectangle at height `y`, facing down, from (x, z) to (x, z)."""
    return quad([lo[0], y, hi[1]], [hi[0] - lo[0], 0, 0], [0, 0, lo[1] - hi[1]])


def frame(x0: float, x1: float, y0: float, y1: float, width: float, z0: float, z1: float, sill: bool = True) -> Mesh:
    """Four bars (three without `sill`) of `width` inside a rectangle of a wall's frame, from z0 to z1."""
    bars = [
        box([x0, y0, z0], [x0 + width, y1, z1]),
        box([x1 - width, y0, z0], [x1, y1, z1]),
        box([x0 + width + GAP, y1 - width, z0], [x1 - width - GAP, y1, z1]),
    ]
    if sill:
        bars.append(box([x0 + width + GAP, y0, z0], [x1 - width - GAP, y0 + width, z1]))
    return merge(bars)
