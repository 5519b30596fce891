"""Light by way of what mirrors faintly or blurred, against Fresnel's formula and quadrature; and bounces that go on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from lit import FLOOR, bake, floor_grid, floor_light, lookup, scene_of, silent
from rendering import constant_twist, dr, mi

from rsgen.device.arrays import rows_of, vectors
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.light.indirect import gathering
from rsgen.light.specular import gathered_caustics
from rsgen.light.surface_points import SamplePoints
from rsgen.render.baked import BakedIntegrator
from rsgen.render.images import ColorRenderer
from rsgen.render.irradiance import IrradianceField, make_lattice

WALL_X, LAMP_X = -0.9, -0.6
RADIANCE = np.array([1.0, 2.0, 3.0])
# Faces the wall, so that the floor beyond it has its light by way of that alone.
RECTANGLE = f"""<shape type="rectangle"><transform name="to_world"><scale x="0.1" y="0.2"/>
    <rotate y="1" angle="-90"/><translate x="{LAMP_X}" z="0.6"/></transform>"""
BLACK = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
LAMP = f'{RECTANGLE}{BLACK}<emitter type="area"><rgb name="radiance" value="1,2,3"/></emitter></shape>'
BOARD = f'{RECTANGLE}<bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>'
BLACK_LACQUER = '<bsdf type="plastic"><rgb name="diffuse_reflectance" value="0"/></bsdf>'
SATIN = '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0"/><float name="alpha" value="0.2"/></bsdf>'


def wall(bsdf: str) -> str:
    """At x = -0.9, facing the middle, from the floor to 0.7."""
    return f"""<shape type="rectangle"><transform name="to_world"><scale x="0.35" y="0.99"/><rotate y="1" angle="90"/>
        <translate x="{WALL_X}" z="0.35"/></transform>{bsdf}</shape>"""


def beyond_the_lamp(count: int) -> np.ndarray:
    """Points (count², 3) of the floor."""
    return floor_grid(0.55, count) + np.array([0.2, 0.0, 0.0])


def on_lamp(count: int) -> tuple[np.ndarray, float]:
    """Points (count², 3) evenly spread over the lamp, and the area of each, m²."""
    u = (np.arange(count) + 0.5) / count * 2 - 1
    y, z = np.meshgrid(0.2 * u, 0.6 + 0.1 * u)
    return np.stack([np.full(y.size, LAMP_X), y.ravel(), z.ravel()], axis=-1), 0.4 * 0.2 / count**2


def repeated(xyz: np.ndarray, times: int) -> SamplePoints:
    """Points of the floor, each so many times, side by side, to be drawn at with other random numbers."""
    position = np.repeat(xyz, times, axis=0).astype(np.float32)
    up = np.tile(np.array([0, 0, 1], np.float32), (len(position), 1))
    return SamplePoints(position, up, up, np.zeros(len(position), np.int64))


def fresnel(cosine: np.ndarray, ior: float) -> np.ndarray:
    """Unpolarised reflectance of a dielectric from outside."""
    inside = np.sqrt(1 - (1 - cosine**2) / ior**2)
    s, p = (cosine - ior * inside) / (cosine + ior * inside), (ior * cosine - inside) / (ior * cosine + inside)
    return np.asarray((s**2 + p**2) / 2)


def off_lacquer(xyz: np.ndarray) -> np.ndarray:
    """Irradiance (n,) by radiance of the lamp in lacquer: of its mirror image, dimmed by Fresnel's formula."""
    q, area = on_lamp(60)
    image = q * (-1, 1, 1) + (2 * WALL_X, 0, 0)
    way = image[None] - xyz[:, None]
    d2 = (way**2).sum(axis=-1)
    reflected = fresnel(np.abs(way[..., 0]) / np.sqrt(d2), 1.49 / 1.000277)
    return np.asarray((reflected * way[..., 2] * np.abs(way[..., 0]) / d2**2).sum(axis=1) * area)


def off_satin(scene: Any, xyz: np.ndarray) -> np.ndarray:
    """The same off a wall that blurs, by quadrature over it and the lamp of what its BSDF says of each pair."""
    q, area = on_lamp(10)
    y, z = np.meshgrid((np.arange(140) + 0.5) / 140 * 1.98 - 0.99, (np.arange(50) + 0.5) / 50 * 0.7)
    w = np.stack([np.full(y.size, WALL_X), y.ravel(), z.ravel()], axis=-1)
    bsdf = next(s.bsdf() for s in scene.shapes() if int(s.bsdf().flags()) & int(mi.BSDFFlags.Glossy))
    out = []
    for p in xyz:
        to_q, to_p = q[None] - w[:, None], p[None] - w
        d2q, d2p = (to_q**2).sum(axis=-1), (to_p**2).sum(axis=-1)
        wo = (to_q / np.sqrt(d2q)[..., None]).reshape(-1, 3)
        wi = np.repeat(to_p / np.sqrt(d2p)[:, None], len(q), axis=0)
        si = dr.zeros(mi.SurfaceInteraction3f, len(wo))
        local = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], float)  # the wall's normal is its z
        si.wi = vectors(mi.Vector3f, wi @ local.T)
        f = rows_of(mi.Vector3f(bsdf.eval(mi.BSDFContext(), si, vectors(mi.Vector3f, wo @ local.T))))[:, 0]
        lit = to_q[..., 0] / np.sqrt(d2q) / d2q * area  # of the wall, perpendicular to the light
        throws = (f.reshape(lit.shape) * lit).sum(axis=1)
        geometry = (p[0] - WALL_X) / np.sqrt(d2p) * w[:, 2] / np.sqrt(d2p) / d2p
        passes = p + (w - p) * ((LAMP_X - p[0]) / (WALL_X - p[0]))  # the lamp, behind which the wall is not seen
        seen = (np.abs(passes[:, 1]) > 0.2) | (np.abs(passes[:, 2] - 0.6) > 0.1)
        out.append((seen * throws * geometry).sum() * (1.98 / 140) * (0.7 / 50))
    return np.array(out)


def test_a_lamp_in_lacquer_lights_the_floor_by_fresnels_formula(tmp_path: Path) -> None:
    xyz = beyond_the_lamp(12)
    scene = scene_of(tmp_path, FLOOR, LAMP, wall(BLACK_LACQUER))
    got = floor_light(scene, xyz, texel_m=0.02, direct_samples=1024, target_db=60)
    ratio = (got / RADIANCE).mean(axis=1) / off_lacquer(xyz)
    assert abs(ratio.mean() - 1) < 0.02
    assert np.quantile(np.abs(ratio - 1), 0.9) < 0.12


@pytest.mark.nightly
def test_what_stands_behind_a_board_takes_no_light_from_it(tmp_path: Path) -> None:
    """Of light that lands a board's own surface gets it all, not one of the same facing that it hides."""
    board = """<shape type="rectangle"><transform name="to_world"><scale x="0.3" y="0.3"/><translate x="0.3" z="0.015"/>
        </transform><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></shape>"""
    xyz = floor_grid(0.2, 5) + np.array([0.3, 0.0, 0.02])
    got = []
    for elements in ((FLOOR, board), (board,)):
        scene = scene_of(tmp_path, LAMP, wall(BLACK_LACQUER), *elements)
        lattice, front, back = bake(scene, texel_m=0.02, direct_samples=256)
        got.append(lookup(scene, IrradianceField(lattice, front, back), xyz, (0, 0, -1))[1].sum())
    assert got[0] == pytest.approx(got[1], rel=0.06)


@pytest.mark.parametrize("bsdf", [BLACK_LACQUER, SATIN])
def test_looked_for_from_the_floor_it_is_the_same(tmp_path: Path, bsdf: str) -> None:
    """What the estimate compares with: no photons, and no blur."""
    xyz = beyond_the_lamp(3)
    scene = scene_of(tmp_path, FLOOR, LAMP, wall(bsdf))
    points = repeated(xyz, 256)
    halves = gathered_caustics(scene, points, np.arange(len(points.position)), 1 << 13)[..., :3] / RADIANCE
    expected = off_lacquer(xyz) if bsdf is BLACK_LACQUER else off_satin(scene, xyz)
    ratio = halves.mean(axis=(0, 2)).reshape(len(xyz), -1).mean(axis=1) / expected
    assert np.abs(ratio - 1).max() < 0.03


@pytest.mark.nightly
def test_a_lamp_in_satin_lights_the_floor_as_its_lobe_says(tmp_path: Path) -> None:
    xyz = beyond_the_lamp(3)
    scene = scene_of(tmp_path, FLOOR, LAMP, wall(SATIN))
    got = floor_light(scene, xyz, texel_m=0.02, direct_samples=1024, target_db=60)
    ratio = (got / RADIANCE).mean(axis=1) / off_satin(scene, xyz)
    assert abs(ratio.mean() - 1) < 0.02
    assert np.abs(ratio - 1).max() < 0.08


@pytest.mark.parametrize("bsdf", [BLACK_LACQUER, SATIN])
def test_a_matte_board_in_lacquer_is_seen_in_it_as_a_lamp_is(tmp_path: Path, bsdf: str) -> None:
    """The board, half white, has the lamp's place and is lit by π, so that it sends a half."""
    scene = scene_of(tmp_path, FLOOR, BOARD, wall(bsdf))
    lattice = make_lattice(scene, 0.1)
    lit = np.full((lattice.points, 4), [np.pi, np.pi, np.pi, 1], np.float32)
    xyz = beyond_the_lamp(3)
    points = repeated(xyz, 32)
    rays, every = 1 << 14, np.arange(len(points.position))
    drawn = gathering(scene, IrradianceField(lattice, lit, lit), points, every)(every, 0, rays, silent)
    got = drawn.sum(axis=0)[:, 0].reshape(len(xyz), -1).mean(axis=1) / rays
    mirrored = off_lacquer(xyz) if bsdf is BLACK_LACQUER else off_satin(scene, xyz)
    ratio = got / (0.5 * mirrored)
    assert abs(ratio.mean() - 1) < 0.02
    assert np.abs(ratio - 1).max() < 0.1


def test_bounces_go_on_in_a_white_room_beside_a_bright_street(tmp_path: Path) -> None:
    """A furnace as in `test_light`, and apart from it two grey plates with a lamp ten thousand times as bright: of all
    the light that there is, a bounce soon adds nothing; of the furnace's own it adds six sevenths each time.
    """
    glow, albedo = np.array([1.0, 2.0, 0.5]), 6 / 7
    ball = trimesh.creation.icosphere(3)
    ball.invert()
    ball.apply_translation([0, 0, 5])
    ball.export(tmp_path / "ball.ply")
    furnace = f"""<shape type="ply"><string name="filename" value="ball.ply"/>
        <boolean name="face_normals" value="true"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="{albedo}"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="{",".join(map(str, glow))}"/></emitter></shape>"""
    plates = [
        f"""<shape type="rectangle"><transform name="to_world">{turn}</transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.3"/></bsdf></shape>"""
        for turn in ("", '<rotate x="1" angle="180"/><translate z="0.8"/>')
    ]
    lamp = """<emitter type="point"><point name="position" x="0" y="0" z="0.4"/>
        <rgb name="intensity" value="1e4,1e4,1e4"/></emitter>"""
    scene = scene_of(tmp_path, *plates, furnace, lamp)
    lattice, front, back = bake(scene, texel_m=0.2, bounces=12, gather_rays=256, direct_samples=256)
    ways = ball.triangles_center[::20] - [0, 0, 5]
    got = lookup(scene, IrradianceField(lattice, front, back), np.tile([0.0, 0.0, 5.0], (len(ways), 1)), ways)[1]
    assert np.abs(got.mean(axis=0) / (np.pi * glow / (1 - albedo)) - 1).max() < 0.01


@pytest.mark.nightly
def test_a_lacquered_floor_in_brushed_metal_shows_what_it_mirrors(tmp_path: Path) -> None:
    """The path tracer's picture of it: the floor, dark, in a lamp's light, mirrors a dark wall, not the lamp."""
    floor = f'<shape type="rectangle">{SATIN.replace("0.2", "0.1")}</shape>'
    metal = '<bsdf type="roughconductor"><string name="material" value="none"/><float name="alpha" value="0.1"/></bsdf>'
    lamp = f"""<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="180"/><scale value="0.2"/>
        <translate x="-0.3" z="1"/></transform>{BLACK}
        <emitter type="area"><rgb name="radiance" value="20,20,20"/></emitter></shape>"""
    scene = scene_of(tmp_path, floor, wall(metal), lamp)
    lattice, front, back = bake(scene, texel_m=0.05, bounces=4, gather_rays=256, direct_samples=256)
    T_world_cam = np.eye(4)  # looks along -x, low above the floor
    T_world_cam[:3, :3] = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]]).T
    T_world_cam[:3, 3] = 0.8, 0, 0.15
    view = constant_twist(np.zeros(6), T_world_cam)
    camera = Camera(24, 8, 40.0, 40.0, 11.5, 8.0)
    baked = BakedIntegrator(IrradianceField(lattice, front, back), glossy_spp=512)
    ours = ColorRenderer(scene, baked, camera, Shutter(), 512).render(view, 0.0, 1)
    path = mi.load_dict({"type": "path", "max_depth": 12})
    traced = ColorRenderer(scene, path, camera, Shutter(), 4096).render(view, 0.0, 2)
    rows, expected = ours.mean(axis=(1, 2)), traced.mean(axis=(1, 2))
    assert rows.sum() == pytest.approx(expected.sum(), rel=0.03)
    assert np.abs(rows - expected).max() < 0.03 * expected.max()
