"""Lenses and depth as unknowns: cameras whose values are no part of what is compiled, and what these move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.device.lens import Lens, TracedCamera, camera_numbers
from rsgen.device.projection import Projection, Vector
from rsgen.geometry.camera import Camera
from rstrack.calibration.parameters import DEPTH, LENS, NAMES

# Coefficients of distortion at most.
_BENDS = 8
# About how far a change of one moves points at the image's edge, m at 1 m, and of depth 1/m² more; a fifth of it is the
# unit of its column, since two images that nearly agree show little of it.
_MOVES = {
    "fx": 0.6, "fy": 0.6, "cx": 1.0, "cy": 1.0, "k1": 0.3, "k2": 0.15, "p1": 0.7, "p2": 0.7, "k3": 0.08,
    "offset_m": 1.0, "inverse_offset": 1.0, "radial": 0.5,
}  # fmt: skip
_SHOWN = 0.2


@dataclass(frozen=True)
class Asked:
    """Which of LENS are unknown of the depth camera (DEPTH then too) and of the colour camera.

    corrects: whether depth has an error at all. is_one_lens: depth is registered, so that both are the colour camera's.
    """

    depth: tuple[str, ...] = ()
    color: tuple[str, ...] = ()
    corrects: bool = False
    is_one_lens: bool = False

    @property
    def at(self) -> tuple[list[int], list[int]]:
        """Where, among NAMES, the columns of the depth term and those of the colour term belong."""
        depth = "color" if self.is_one_lens else "depth"
        names = [f"{depth}.{name}" if name in LENS else f"depth.error.{name}" for name in self.depth]
        return [NAMES.index(name) for name in names], [NAMES.index(f"color.{name}") for name in self.color]


@dataclass(frozen=True)
class Optics:
    """On the device: normalised coordinates of depth's pixels, `camera_table` of both, error (3,): see DEPTH."""

    rays_x: Any
    rays_y: Any
    depth_camera: Any
    color_camera: Any
    error: Any


def camera_table(camera: Camera) -> FloatArray:
    """What `traced` takes (13,)."""
    table = np.zeros(5 + _BENDS)
    numbers = camera_numbers(camera)
    table[: len(numbers)] = numbers
    return table


def traced(e: Engine, lens: Lens, table: Any) -> Lens:
    """The lens with a camera whose focal lengths, principal point and distortion a kernel reads from `camera_table`."""
    values = [dr.gather(e.Float, table, e.UInt(i)) for i in range(5 + len(lens.camera.distortion))]
    return Lens(TracedCamera(lens.camera, values), lens.shutter)


def without_error(e: Engine, asked: Asked, z: Any, xn: Any, yn: Any, table: Any) -> Any:
    """Depth on the device, along rays (xn, yn), as `DepthError.corrected` has it; table: `Optics.error`."""
    if not asked.corrects:
        return z
    offset, inverse_offset, radial = (dr.gather(e.Float, table, e.UInt(i)) for i in range(len(DEPTH)))
    return dr.rcp(dr.rcp(z) + dr.fma(radial, xn * xn + yn * yn, inverse_offset)) + offset


def moves(names: Sequence[str], camera: Camera, at: Projection) -> list[Vector]:
    """How a point in the camera's frame would have to move, for each unknown of LENS or DEPTH, to look as if that grew.

    By a larger unknown the pixel of a point moves, and a pixel's point the other way. Per unit of the unknown.
    """
    x, y, z = at.xn, at.yn, at.q[2]
    r2 = x * x + y * y

    def pixel(x: Any, y: Any) -> Vector:
        return at.shift_of(camera.fx * x, camera.fy * y)

    def along(by: Any) -> Vector:
        return -by * x, -by * y, -by

    zero = type(z)(0.0)
    bent = (at.x - camera.cx) / camera.fx, (at.y - camera.cy) / camera.fy
    found = {
        "fx": lambda: pixel(bent[0], zero), "fy": lambda: pixel(zero, bent[1]),
        "cx": lambda: pixel(zero + 1.0, zero), "cy": lambda: pixel(zero, zero + 1.0),
        "k1": lambda: pixel(x * r2, y * r2), "k2": lambda: pixel(x * r2 * r2, y * r2 * r2),
        "k3": lambda: pixel(x * r2 * r2 * r2, y * r2 * r2 * r2),
        "p1": lambda: pixel(2.0 * x * y, r2 + 2.0 * y * y), "p2": lambda: pixel(r2 + 2.0 * x * x, 2.0 * x * y),
        "offset_m": lambda: along(zero + 1.0), "inverse_offset": lambda: along(-z * z),
        "radial": lambda: along(-z * z * r2),
    }  # fmt: skip
    return [found[name]() for name in names]


def unknown_columns(
    e: Engine, names: Sequence[str], camera: Camera, g: Vector, seen: tuple[Projection, list[Any]],
    other: tuple[Projection, list[Any]], constants: Any,
) -> list[Any]:  # fmt: skip
    """Columns of unknowns of a camera, at most 1, from g, the derivative by a shift in the base frame.

    seen: where the image that sees the point has it, and its R_cam_base, as `gather` has it; other: likewise of the
    other image, but R_base_cam. constants: `units` from the ninth on.
    """
    bound, found = dr.gather(e.Float, constants, e.UInt(3)), []
    back, shifts = turned_round(seen[1]), (moves(names, camera, at) for at, _ in (seen, other))
    for k, (there, here) in enumerate(zip(*shifts, strict=True)):
        a, b = turn(back, there), turn(other[1], here)
        c = g[0] * (a[0] - b[0]) + g[1] * (a[1] - b[1]) + g[2] * (a[2] - b[2])
        unit = dr.gather(e.Float, constants, e.UInt(9 + k)) * bound
        found.append(dr.clip(c / unit, -1.0, 1.0))
    return found


def turned_round(R: list[Any]) -> list[Any]:
    """Rᵀ, row-major."""
    return [R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]]


def turn(R: list[Any], v: Vector) -> Vector:
    """R v."""
    x, y, z = (R[3 * i] * v[0] + R[3 * i + 1] * v[1] + R[3 * i + 2] * v[2] for i in range(3))
    return x, y, z


def units(names: Sequence[str], median_depth: float) -> FloatArray:
    """Units (n,) of the columns of such unknowns: what they then come to is like that of a twist."""
    power = np.array([1.0 if name in LENS else 2.0 * (name != DEPTH[0]) for name in names])
    return np.array([_SHOWN * _MOVES[name] for name in names]) * median_depth**power
