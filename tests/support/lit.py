"""Small lit scenes, and baked light looked up in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rendering import dr, mi

from rsgen.config.config import LightConfig
from rsgen.device.arrays import rows_of
from rsgen.light import bake as lighting
from rsgen.render.irradiance import IrradianceField, make_lattice
from rsgen.scene.loading import load_scene
from rsgen.scene.rays import rays_from

UP = np.array([0.0, 0.0, 1.0])
FLOOR = """<shape type="rectangle" id="floor">
    <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
</shape>"""  # z = 0, [-1, 1]², black: what it gets is direct light alone
POINT = """<emitter type="point"><point name="position" x="0.3" y="-0.2" z="0.8"/>
    <rgb name="intensity" value="1,2,4"/></emitter>"""
DISK = """<shape type="disk"><transform name="to_world"><rotate x="1" angle="180"/><scale value="0.25"/>
    <translate x="-0.2" y="0.1" z="0.6"/></transform><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
    <emitter type="area"><rgb name="radiance" value="3,2,1"/></emitter></shape>"""
QUAD = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="180"/><scale x="0.4" y="0.2"/>
    <translate x="0.1" y="0.3" z="0.7"/></transform><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
    <emitter type="area"><rgb name="radiance" value="1,2,3"/></emitter></shape>"""
BLACK = '<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></bsdf>'


def silent(*_: Any) -> None:
    pass


def scene_of(folder: Path, *elements: str) -> Any:
    return load_scene(write_scene(folder, *elements))


def write_scene(folder: Path, *elements: str) -> Path:
    path = folder / "scene.xml"
    path.write_text('<scene version="3.0.0">' + "\n".join(elements) + "</scene>")
    return path


def bake(scene: Any, **settings: Any) -> tuple[Any, np.ndarray, np.ndarray]:
    """Lattice and both sides (points, 4)."""
    light = LightConfig(**{"texel_m": 0.05, "bounces": 0, "gather_rays": 64, **settings})
    lattice = make_lattice(scene, light.texel_m)
    return lattice, *lighting.bake(scene, lattice, light, silent)


def lookup(
    scene: Any, field: IrradianceField, origin: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points hit (n, 3) and the irradiance (n, 3) found there by rays."""
    return lookup_side(scene, field, origin, direction)[:2]


def lookup_side(
    scene: Any, field: IrradianceField, origin: Any, direction: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `lookup`, and whether each ray met the front of its triangle (n,)."""
    origin, direction = np.broadcast_arrays(np.asarray(origin, np.float32), np.asarray(direction, np.float32))
    ray = rays_from(origin, direction)
    pi = scene.ray_intersect_preliminary(ray, coherent=True)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    light = field.lookup(pi, si, -ray.d)
    dr.eval(si.is_valid(), si.n, si.p, light)
    assert np.all(np.array(si.is_valid()))
    front = np.einsum("ij,ij->i", rows_of(si.n), direction) < 0
    return rows_of(si.p), rows_of(light), front


def floor_grid(extent: float = 0.9, count: int = 25) -> np.ndarray:
    x, y = np.meshgrid(*2 * [np.linspace(-extent, extent, count)])
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)


def floor_light(scene: Any, xyz: np.ndarray, **settings: Any) -> np.ndarray:
    """Baked irradiance (n, 3) of the floor at points, looked up from just above."""
    lattice, front, back = bake(scene, **settings)
    return lookup(scene, IrradianceField(lattice, front, back), xyz + 0.005 * UP, -UP)[1]


CORNELL = [
    f"""<shape type="rectangle"><transform name="to_world">{turn}<translate {move}/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="{color}"/></bsdf></shape>"""
    for turn, move, color in (
        ('<rotate x="1" angle="-90"/>', 'y="-1"', "0.7"),
        ('<rotate x="1" angle="90"/>', 'y="1"', "0.7"),
        ('<rotate y="1" angle="180"/>', 'z="1"', "0.7"),
        ('<rotate y="1" angle="90"/>', 'x="-1"', "0.6,0.1,0.1"),
        ('<rotate y="1" angle="-90"/>', 'x="1"', "0.1,0.5,0.1"),
    )
] + [
    """<shape type="sphere"><float name="radius" value="0.35"/><point name="center" x="0.35" y="-0.65" z="0.2"/>
    <bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.2,0.4,0.7"/>
    <float name="alpha" value="0.15"/></bsdf></shape>""",
    """<shape type="cube"><transform name="to_world"><scale x="0.3" y="0.5" z="0.3"/><rotate y="1" angle="20"/>
    <translate x="-0.4" y="-0.5" z="0.4"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7"/></bsdf></shape>""",
    """<shape type="rectangle"><transform name="to_world"><scale value="0.3"/><rotate x="1" angle="90"/>
    <translate y="0.99"/></transform><bsdf type="diffuse"/>
    <emitter type="area"><rgb name="radiance" value="8,7,5"/></emitter></shape>""",
]


def quad_factor(xyz: np.ndarray) -> np.ndarray:
    """Of QUAD, or of a hole in its place, seen from points (n, 3) of the floor."""
    h = 0.7

    def corner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        A, B = a / h, b / h
        ra, rb = np.sqrt(1 + A**2), np.sqrt(1 + B**2)
        return (A / ra * np.arctan(B / ra) + B / rb * np.arctan(A / rb)) / (2 * np.pi)

    x0, x1, y0, y1 = (0.1 - 0.4 - xyz[:, 0], 0.1 + 0.4 - xyz[:, 0], 0.3 - 0.2 - xyz[:, 1], 0.3 + 0.2 - xyz[:, 1])
    return corner(x1, y1) - corner(x0, y1) - corner(x1, y0) + corner(x0, y0)
