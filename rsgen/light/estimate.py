"""How right baked light is: looked up at random places of the surfaces, against light computed for these alone.

Places lie anywhere between the samples, so that what the texel blurs counts as well as what scatters. What light a
bounce finds on other surfaces is taken as baked.
"""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen import srgb
from rsgen.array_types import Float32Array
from rsgen.device.arrays import rows_of, vectors
from rsgen.light.drawing.gather import gathering
from rsgen.light.drawing.lamps import lamp_light
from rsgen.light.drawing.rounds import typical
from rsgen.light.drawing.sky import has_sky_light, sky_light
from rsgen.light.drawing.specular import passes_light_on
from rsgen.light.places.bake_points import surface_at
from rsgen.light.places.surface_points import SurfacePoints
from rsgen.light.places.walls import find_covered
from rsgen.render.irradiance import IrradianceField, at_triangles, registry_id
from rsgen.render.scene import mesh_arrays

_PLACES = 4096
_GREY = 0.18  # reflectance of the surface that is looked at, where light is typical
_LIT = 0.01  # of the typical light: with less, a place is inside of something, where nobody looks
_SAMPLES, _SKY_SAMPLES, _RAYS = 64, 1024, 512  # of each lamp, the sky and surfaces
_LEAST_ERROR = 1e-6
_SEED = 20


def estimated_db(scene: Any, field: IrradianceField, texel_m: float) -> float:
    """PSNR, dB, in sRGB, of mid-grey surfaces all over the scene, by area, as far as they are lit.

    Exposed so that `rounds.typical` light makes mid-grey. Infinite where there is no light.
    """
    numbers, faces, uv, back = _places(scene)
    position, normal, geometric = surface_at(numbers, faces, uv)
    geometric *= np.where(np.einsum("ij,ij->i", geometric, normal) < 0, -1, 1)[:, None]
    side = np.where(back, -1, 1).astype(np.float32)[:, None]
    normal, geometric = normal * side, geometric * side
    open_ = ~find_covered(scene, position, geometric, texel_m)
    piece = np.zeros(int(open_.sum()), np.int64)
    points = SurfacePoints(position[open_], normal[open_], geometric[open_], piece)
    pi, si = at_triangles(numbers[open_], faces[open_], uv[open_])
    baked = rows_of(field.lookup(pi, si, vectors(mi.Vector3f, points.normal))).astype(np.float64)
    halves = _computed(scene, field, points, texel_m)
    grey = halves.mean(axis=(0, 2))
    exposed = typical(grey)
    if exposed <= 0:
        return math.inf
    lit, exposure = grey >= _LIT * exposed, _GREY / exposed
    one, other, ours = (srgb.encode(np.clip(exposure * e[lit], 0, 1)) for e in (*halves, baked))
    error = float(np.mean((ours - one) * (ours - other)))
    return -10 * math.log10(max(error, _LEAST_ERROR))


def _places(scene: Any) -> tuple[NDArray, NDArray, Float32Array, NDArray[np.bool_]]:
    """Number of the mesh, triangle, barycentric (b1, b2) and whether on the back, of places drawn by area."""
    meshes = [shape for shape in scene.shapes() if shape.is_mesh()]
    area, number, triangle = [], [], []
    for mesh in meshes:
        vertices, faces = mesh_arrays(mesh)
        a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
        area.append(np.linalg.norm(np.cross(b - a, c - a), axis=1))
        number.append(np.full(len(faces), registry_id(mesh), np.uint32))
        triangle.append(np.arange(len(faces), dtype=np.uint32))
    until = np.cumsum(np.concatenate(area))
    rng = np.random.default_rng(_SEED)
    face = np.minimum(np.searchsorted(until, rng.random(_PLACES) * until[-1]), len(until) - 1)
    uv = rng.random((_PLACES, 2))
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    return (
        np.concatenate(number)[face],
        np.concatenate(triangle)[face],
        uv.astype(np.float32),
        rng.random(_PLACES) < 0.5,
    )


def _computed(scene: Any, field: IrradianceField, points: SurfacePoints, texel_m: float) -> NDArray[np.float64]:
    """Irradiance (2, n, 3) at each of the points for itself, by two halves of many samples."""
    everywhere = np.arange(len(points.position))
    dark = np.zeros(len(everywhere))
    follow = passes_light_on(scene)

    def silent(_: float) -> None:
        pass

    halves = lamp_light(scene, points, everywhere, everywhere, 8 * _SAMPLES, follow, dark, 1.0, silent)[0]
    if has_sky_light(scene):
        halves += sky_light(
            scene, points, everywhere, everywhere, texel_m, _SKY_SAMPLES, follow, dark, math.inf, silent
        )[0]
    draw = gathering(scene, field, points, everywhere, follow)
    return halves + draw(everywhere, 0, _RAYS, silent) / (_RAYS / 2)
