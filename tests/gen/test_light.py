"""Baked light: white furnace, closed forms, the path tracer, the lattice's interpolation, the cache."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from rendering import constant_twist, mi

from rsgen import srgb
from rsgen.config.config import LightConfig
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.light import cache as lighting
from rsgen.light.drawing.guide import Guide, bin_of
from rsgen.light.drawing.rounds import PATCH, in_rounds, scatter_of
from rsgen.light.estimate import estimated_db
from rsgen.light.places.bake_points import thin
from rsgen.light.places.denoise import denoised
from rsgen.light.places.surface_points import SurfacePoints
from rsgen.light.places.walls import find_covered
from rsgen.render.baked import BakedIntegrator
from rsgen.render.images import ColorRenderer
from rsgen.render.irradiance import IrradianceField, lattice_barycentric, make_field, make_lattice
from rsgen.render.scene import load_scene, surface
from rsgen.sensors.response import to_srgb8

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
    ray = mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(direction.T))
    pi = scene.ray_intersect_preliminary(ray, coherent=True)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    assert np.all(np.array(si.is_valid()))
    front = np.einsum("ij,ij->i", np.array(si.n).reshape(3, -1).T, direction) < 0
    return np.array(si.p).T, np.array(field.lookup(pi, si, -ray.d)).reshape(3, -1).T, front


def floor_grid(extent: float = 0.9, count: int = 25) -> np.ndarray:
    x, y = np.meshgrid(*2 * [np.linspace(-extent, extent, count)])
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)


def floor_light(scene: Any, xyz: np.ndarray, **settings: Any) -> np.ndarray:
    """Baked irradiance (n, 3) of the floor at points, looked up from just above."""
    lattice, front, back = bake(scene, **settings)
    return lookup(scene, make_field(lattice, front, back), xyz + 0.005 * UP, -UP)[1]


# --- closed forms


def agree(got: np.ndarray, expected: np.ndarray) -> None:
    """Within about a percent (what is left is the thinned samples' interpolation and light sampling), unbiased."""
    error = got / expected - 1
    assert np.quantile(np.abs(error), 0.9) < 0.012
    assert np.abs(error).max() < 0.03
    assert abs(error.mean()) < 0.005


def test_point_light(tmp_path: Path) -> None:
    """E = I cos θ / d²."""
    xyz = floor_grid()
    got = floor_light(scene_of(tmp_path, FLOOR, POINT), xyz, texel_m=0.02)
    d = np.array([0.3, -0.2, 0.8]) - xyz
    expected = (0.8 / np.linalg.norm(d, axis=-1) ** 3)[:, None] * [1, 2, 4]
    agree(got, expected)


def test_disk_emitter(tmp_path: Path) -> None:
    """Form factor of a parallel disk: ½ [1 − (x² + h² − a²) / √((x² + h² + a²)² − 4 a² x²)]."""
    xyz = floor_grid()
    got = floor_light(scene_of(tmp_path, FLOOR, DISK), xyz, texel_m=0.02, direct_samples=256, target_db=55)
    a, h = 0.25, 0.6
    x2 = ((xyz[:, :2] - (-0.2, 0.1)) ** 2).sum(-1)
    factor = 0.5 * (1 - (x2 + h**2 - a**2) / np.sqrt((x2 + h**2 + a**2) ** 2 - 4 * a**2 * x2))
    agree(got, np.pi * factor[:, None] * [3, 2, 1])


def test_rectangle_emitter(tmp_path: Path) -> None:
    """Form factor of a parallel rectangle from a corner, summed with signs over its four corners."""
    xyz = floor_grid()
    got = floor_light(scene_of(tmp_path, FLOOR, QUAD), xyz, texel_m=0.02, direct_samples=256, target_db=55)
    agree(got, np.pi * quad_factor(xyz)[:, None] * [1, 2, 3])


def quad_factor(xyz: np.ndarray) -> np.ndarray:
    """Of QUAD, or of a hole in its place, seen from points (n, 3) of the floor."""
    h = 0.7

    def corner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        A, B = a / h, b / h
        ra, rb = np.sqrt(1 + A**2), np.sqrt(1 + B**2)
        return (A / ra * np.arctan(B / ra) + B / rb * np.arctan(A / rb)) / (2 * np.pi)

    x0, x1, y0, y1 = (0.1 - 0.4 - xyz[:, 0], 0.1 + 0.4 - xyz[:, 0], 0.3 - 0.2 - xyz[:, 1], 0.3 + 0.2 - xyz[:, 1])
    return corner(x1, y1) - corner(x0, y1) - corner(x1, y0) + corner(x0, y0)


BLACK = '<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></bsdf>'
SKY = '<emitter type="constant"><rgb name="radiance" value="1,2,3"/></emitter>'


def dark_room_with_a_skylight(folder: Path) -> list[str]:
    """Black walls about the floor and a black ceiling with a hole in QUAD's place."""
    x, y, h, s = (-0.3, 0.5), (0.1, 0.5), 0.7, 1.0
    corners = [(-s, -s), (s, -s), (s, s), (-s, s), (x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    vertices = [(*c, h) for c in corners] + [(*c, 0.0) for c in corners[:4]]
    faces = []
    for k in range(4):
        n = (k + 1) % 4
        faces += [(k, n, 4 + n), (k, 4 + n, 4 + k), (k, n, 8 + n), (k, 8 + n, 8 + k)]
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "room.ply")
    room = f"""<shape type="ply"><string name="filename" value="room.ply"/><boolean name="face_normals" value="true"/>
        {BLACK}</shape>"""
    return [FLOOR, room, SKY]


@pytest.mark.parametrize(("pane", "transmits"), [("", 1.0), ("mask", 0.6), ("mirror", 1.0)])
def test_a_sky_seen_through_a_hole_is_a_lamp_of_that_shape(tmp_path: Path, pane: str, transmits: float) -> None:
    """With a half-transparent pane in it, it is a dimmer one; with one in a mirror there are two."""
    elements = dark_room_with_a_skylight(tmp_path)
    xyz = floor_grid(0.75, 20)
    factor = transmits * quad_factor(xyz)
    if pane == "mask":
        elements.append(
            f"""<shape type="rectangle"><transform name="to_world"><scale x="0.5" y="0.3"/>
            <translate x="0.1" y="0.3" z="0.702"/></transform><bsdf type="mask"><float name="opacity" value="0.4"/>
            {BLACK}</bsdf></shape>"""
        )
    if pane == "mirror":
        elements.append(
            """<shape type="rectangle"><transform name="to_world"><scale x="0.35" y="0.99"/>
            <rotate y="1" angle="90"/><translate x="-0.9" z="0.35"/></transform>
            <bsdf type="conductor"><string name="material" value="none"/></bsdf></shape>"""
        )
        factor = factor + quad_factor(xyz * (-1, 1, 1) - (1.8, 0, 0))
    got = floor_light(scene_of(tmp_path, *elements), xyz, texel_m=0.04, direct_samples=256, target_db=42)
    error = got / (np.pi * factor[:, None] * [1, 2, 3]) - 1
    # Noise of few samples, no bias. A sky drawn from evenly: a tenth off in the median, and one place in ten black.
    assert np.quantile(np.abs(error), 0.9) < 0.04 and np.abs(error).max() < 0.12
    assert abs(error.mean()) < 0.008


def test_a_lamp_shines_straight_through_a_thin_pane(tmp_path: Path) -> None:
    """Without scatter: it is sampled as if nothing were there, and dimmed."""
    pane = f"""<shape type="rectangle"><transform name="to_world"><scale value="1.1"/><translate z="0.5"/></transform>
        <bsdf type="mask"><float name="opacity" value="0.4"/>{BLACK}</bsdf></shape>"""
    xyz = floor_grid(0.7, 15)
    got = floor_light(scene_of(tmp_path, FLOOR, QUAD, pane), xyz, texel_m=0.08, target_db=46)
    error = got / (0.6 * np.pi * quad_factor(xyz)[:, None] * [1, 2, 3]) - 1
    assert np.quantile(np.abs(error), 0.9) < 0.035 and abs(error.mean()) < 0.008


def test_samples_go_where_light_scatters_and_shows() -> None:
    """Three patches alike but in noise (none, much, much) and in light (the last is dim)."""
    rng = np.random.default_rng(1)
    patch = np.repeat([0, 1, 2], 500)
    true, noise = np.array([1.0, 1.0, 1e-3])[patch], np.array([0.0, 0.5, 0.5])[patch]
    drawn = np.zeros(1500, int)

    def draw(todo: np.ndarray, begin: int, count: int, _: Any) -> np.ndarray:
        assert (drawn[todo] == begin).all()
        drawn[todo] += count
        one = true[todo] * (1 + noise[todo] / np.sqrt(count / 2) * rng.normal(size=(2, len(todo))))
        return np.repeat((count / 2 * one)[..., None], 3, axis=2)

    means, left = in_rounds(draw, patch, lambda own: own, 0.04, 8, 7, np.inf, silent)
    assert drawn[:500].max() == 8 and 128 <= drawn[500:1000].min() <= 256 and drawn[1000:].max() <= 32
    assert left.max() <= 0.04 and left[500:1000].mean() == pytest.approx(0.5 / np.sqrt(drawn[600]), rel=0.1)
    assert np.abs(means.mean(axis=(0, 2)) / true - 1)[500:1000].std() < 0.04


def test_a_guide_draws_what_it_says() -> None:
    """Two cells: all that is learned of one is where its light comes from, of the other nothing."""
    rng = np.random.default_rng(3)
    toward = np.array([0.6, -0.48, 0.64])
    seen = toward + 0.1 * rng.normal(size=(4000, 3))
    bins = np.array(bin_of(mi.Vector3f((seen / np.linalg.norm(seen, axis=1, keepdims=True)).T))).astype(np.int64)
    guide = Guide.learned(np.zeros(4000, np.int64), bins, np.ones(4000), 2)
    n = 1 << 18
    even = rng.normal(size=(n, 3)).astype(np.float32)
    even /= np.linalg.norm(even, axis=1, keepdims=True)
    for cell, least in ((0, 0.75), (1, None)):
        numbers = mi.UInt32(np.full(n, cell, np.uint32))
        d = guide.sample(numbers, mi.Point2f(rng.random((2, n), np.float32)))
        density = np.array(guide.density(numbers, mi.Vector3f(even.T)))
        assert 4 * np.pi * density.mean() == pytest.approx(1.0, abs=0.02)
        share = (np.array(d).reshape(3, -1).T @ toward > 0.9).mean()
        assert share == pytest.approx(4 * np.pi * (density * (even @ toward > 0.9)).mean(), abs=0.02)
        if least is None:
            np.testing.assert_allclose(4 * np.pi * density, 1.0, rtol=1e-4)
        else:
            assert share > least


def test_noise_is_smoothed_and_edges_of_shadows_are_not() -> None:
    rng = np.random.default_rng(4)
    x, y = (k.ravel() for k in np.meshgrid(*2 * [0.01 * np.arange(80)], indexing="ij"))
    position = np.column_stack([x, y, np.zeros_like(x)]).astype(np.float32)
    normal = np.tile(np.float32([0, 0, 1]), (len(x), 1))
    points = SurfacePoints(position, normal, normal, np.zeros(len(x), np.int64))
    true = np.where(x < 0.405, 1.0, 0.2)
    halves = true[None, :, None] * (1 + rng.normal(scale=0.05, size=(2, len(x), 1))) * np.ones(3)
    which = np.arange(len(x))
    sigma = scatter_of(thin(points, PATCH * 0.01)[1], halves)
    error = denoised(points, which, halves, sigma, 0.01, which)[:, 0] / true - 1
    away = np.abs(x - 0.405) > 0.08
    noise = 0.05 / np.sqrt(2)
    assert (sigma / true)[away].mean() == pytest.approx(noise, rel=0.1)
    assert error[away].std() < noise / 3
    assert np.sqrt(np.mean(error[~away] ** 2)) < noise  # smoothed across, it would be 0.5 and more


def test_white_furnace(tmp_path: Path) -> None:
    """Inside a closed sphere that glows with L_e and reflects ρ, radiance is L_e / (1 − ρ) everywhere."""
    glow, albedo = np.array([1.0, 2.0, 0.5]), np.array([0.3, 0.5, 0.7])
    ball = trimesh.creation.icosphere(4)
    ball.invert()
    ball.export(tmp_path / "ball.ply")
    scene = scene_of(
        tmp_path,
        f"""<shape type="ply"><string name="filename" value="ball.ply"/><boolean name="face_normals" value="true"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="{",".join(map(str, albedo))}"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="{",".join(map(str, glow))}"/></emitter></shape>""",
    )
    light = LightConfig(texel_m=0.2, bounces=5, gather_rays=256, direct_samples=256)  # 0.7^6 is left: extrapolated
    lattice = make_lattice(scene, light.texel_m)
    front, back = lighting.bake(scene, lattice, light, silent)
    assert (front[:, 3] == 1).all() and not back.any()
    field = make_field(lattice, front, back)
    camera = Camera(32, 24, 14.0, 14.0, 15.5, 11.5)
    renderer = ColorRenderer(scene, BakedIntegrator(field), camera, Shutter(), 16)
    ratio = renderer.render(constant_twist(np.zeros(6)), 0.0, seed=1) / (glow / (1 - albedo))
    assert np.abs(ratio.mean(axis=(0, 1)) - 1).max() < 0.005
    assert np.quantile(np.abs(ratio - 1), 0.95) < 0.01


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


def test_baked_light_agrees_with_the_path_tracer(tmp_path: Path) -> None:
    """A Cornell-like box with a block and a rough plastic ball; sRGB PSNR as the issue asks of the living room."""
    scene = scene_of(tmp_path, *CORNELL)
    light = LightConfig(texel_m=0.03, gather_rays=256)
    field = lighting.baked_field(scene, "cornell", light, tmp_path / "cache", silent)
    T_world_cam = np.diag([-1.0, -1.0, 1.0, 1.0])
    T_world_cam[:3, 3] = 0, 0, -3.2
    view = constant_twist(np.zeros(6), T_world_cam)
    camera = Camera(64, 64, 70, 70, 31.5, 31.5)
    renderer = ColorRenderer(scene, BakedIntegrator(field), camera, Shutter(), 64)
    baked = renderer.render(view, 0.0, 1)
    np.testing.assert_array_equal(renderer.render(view, 0.0, 1), baked)
    path = mi.load_dict({"type": "path", "max_depth": 12})
    traced = ColorRenderer(scene, path, camera, Shutter(), 2048).render(view, 0.0, 2)
    a, b = to_srgb8(baked).astype(float), to_srgb8(traced).astype(float)
    assert b.mean() > 50  # a lit picture
    assert 20 * np.log10(255) - 10 * np.log10(np.mean((a - b) ** 2)) >= 36
    assert np.abs(baked.mean(axis=(0, 1)) / traced.mean(axis=(0, 1)) - 1).max() < 0.01

    # A sixth of the samples on the ball: the same on average, everything matte as before.
    every, few = (
        np.mean([ColorRenderer(scene, BakedIntegrator(field, glossy_spp=n), camera, Shutter(), 64).render(view, 0.0, k)
                 for k in range(4)], axis=0)
        for n in (64, 10)
    )  # fmt: skip
    ball = (every != few).any(axis=-1)
    assert 0.01 < ball.mean() < 0.15
    assert few[ball].mean() == pytest.approx(every[ball].mean(), rel=0.01)
    assert few[ball].mean(axis=0) == pytest.approx(every[ball].mean(axis=0), rel=0.02)


def test_a_glossy_floor_in_a_dim_mirror_is_what_stands_behind_it_dimmed(tmp_path: Path) -> None:
    """The mirror's image is the view of the mirrored camera, flipped, times the reflectance."""
    floor = """<shape type="rectangle"><transform name="to_world"><scale value="4"/></transform>
        <bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.5"/><float name="alpha" value="0.2"/></bsdf>
    </shape>"""
    mirror = """<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="-90"/><translate x="1.5"/>
        </transform><bsdf type="conductor"><string name="material" value="none"/>
        <rgb name="specular_reflectance" value="0.03,0.02,0.01"/></bsdf></shape>"""
    T_world_cam = np.eye(4)  # looks along x and a little down
    axes = np.array([[0, -1, 0], [-0.3, 0, -1], [1, 0, -0.3]])
    T_world_cam[:3, :3] = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T
    T_world_cam[:3, 3] = 0.0, 0.3, 0.5
    M = np.diag([-1.0, 1, 1, 1])
    M[0, 3] = 3.0
    T_world_virtual = M @ T_world_cam @ np.diag([-1.0, 1, 1, 1])
    images = []
    for pose, elements in ((T_world_cam, (floor, QUAD, mirror)), (T_world_virtual, (floor, QUAD))):
        scene = scene_of(tmp_path, *elements)
        light = LightConfig(texel_m=0.05, gather_rays=256)
        field = lighting.baked_field(scene, f"{len(elements)}", light, tmp_path / "cache", silent)
        camera = Camera(24, 24, 30.0, 30.0, 11.5, 11.5)
        renderer = ColorRenderer(scene, BakedIntegrator(field, glossy_spp=512), camera, Shutter(), 512)
        images.append(renderer.render(constant_twist(np.zeros(6), pose), 0.0, 1))
    seen, behind = images[0][5:11], images[1][5:11, ::-1]  # rows of the floor in the mirror
    assert behind.max() > 3 * behind.min()  # the lamp's reflection among them
    np.testing.assert_allclose(seen.mean(axis=(0, 1)), [0.03, 0.02, 0.01] * behind.mean(axis=(0, 1)), rtol=0.02)


# --- lattice and lookup


@pytest.fixture(scope="module")
def shapes(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Two meshes with triangles of many shapes: a warped grid (thin, long, right-angled ones) and a ball."""
    folder = tmp_path_factory.mktemp("shapes")
    rng = np.random.default_rng(2)
    steps = np.array([0, 0.004, 0.03, 0.2, 0.23, 0.9, 1.0])
    x, y = np.meshgrid(2 * steps - 1, 3 * steps[:5] ** 2)
    vertices = np.column_stack([x.ravel(), y.ravel(), 0.1 * rng.random(x.size)])
    i, j = (k.ravel() for k in np.meshgrid(np.arange(4), np.arange(6), indexing="ij"))
    p = i * 7 + j
    faces = np.concatenate([np.column_stack([p, p + 1, p + 8]), np.column_stack([p + 8, p + 7, p])])
    faces = np.array([np.roll(face, rng.integers(3)) for face in faces])
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "grid.ply")
    ball = trimesh.creation.icosphere(2, 0.4)
    ball.apply_translation((0, 0, 1))
    ball.export(folder / "ball.ply")
    flat = '<boolean name="face_normals" value="true"/>'
    return scene_of(
        folder,
        *(f'<shape type="ply"><string name="filename" value="{n}.ply"/>{flat}</shape>' for n in ("grid", "ball")),
    )


def lattice_positions(scene: Any, lattice: Any) -> np.ndarray:
    """World positions (points, 3), from the triangles and the barycentrics (b1, b2)."""
    vertices, faces = surface(scene)
    face, uv = lattice_barycentric(lattice)
    a, b, c = (vertices[faces[face, k]].astype(float) for k in range(3))
    return a + uv[:, :1] * (b - a) + uv[:, 1:] * (c - a)


@pytest.mark.parametrize("spacing", [0.02, 0.11, 10.0])
def test_lattice_covers_every_triangle_at_its_spacing(shapes: Any, spacing: float) -> None:
    lattice = make_lattice(shapes, spacing)
    vertices, faces = surface(shapes)
    face, uv = lattice_barycentric(lattice)
    counts = (lattice.cells + 1).prod(axis=1)
    assert lattice.points == counts.sum() == len(face)
    np.testing.assert_array_equal(np.bincount(face, minlength=len(faces)), counts)
    np.testing.assert_array_equal(lattice.first, np.concatenate([[0], np.cumsum(counts)[:-1]]))
    assert uv.min() >= 0 and uv.sum(axis=1).max() <= 1 + 1e-6
    # Every triangle's corners are lattice points, and neighbours along a grid line lie about `spacing` apart.
    positions = lattice_positions(shapes, lattice)
    for k, corners in enumerate(vertices[faces]):
        own = positions[lattice.first[k] :][: counts[k]]
        assert np.linalg.norm(own[:, None] - corners, axis=-1).min(axis=0).max() < 1e-6
        rows = own.reshape(*(lattice.cells[k] + 1), 3)
        for axis in (0, 1):
            step = np.linalg.norm(np.diff(rows, axis=axis), axis=-1).max()
            assert step <= 1.5 * spacing + 1e-9 or lattice.cells[k, axis] == 1
            assert lattice.cells[k, axis] == 1 or step >= 0.6 * spacing


def smooth(p: np.ndarray) -> np.ndarray:
    return np.stack([2 + p @ (0.3, -0.2, 0.4), 1 + p @ (-0.1, 0.2, 0.3), 3 + p @ (0.5, 0.1, -0.6)], axis=-1)


def random_hits(scene: Any, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Ray origins and directions from near random surface points, front side for even and back for odd rays."""
    vertices, faces = surface(scene)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points, face = trimesh.sample.sample_surface_even(mesh, count, seed=seed)
    side = np.where(np.arange(len(points)) % 2, -1, 1)[:, None] * mesh.face_normals[face]
    return points + 2e-5 * side, -side


@pytest.mark.parametrize("spacing", [0.02, 0.11, 10.0])
def test_lookup_reproduces_a_linear_function_on_both_sides(shapes: Any, spacing: float) -> None:
    lattice = make_lattice(shapes, spacing)
    alive = np.ones((lattice.points, 1))
    values = smooth(lattice_positions(shapes, lattice))
    field = make_field(lattice, np.hstack([values, alive]), np.hstack([-values, alive]))
    origin, direction = random_hits(shapes, 4000, seed=1)
    hit, got, front = lookup_side(shapes, field, origin, direction)
    assert np.abs(hit - origin).max() < 1e-4
    assert np.mean(front == (np.arange(len(hit)) % 2 == 0)) > 0.99  # rays near an edge may meet its other triangle
    np.testing.assert_allclose(got, np.where(front, 1, -1)[:, None] * smooth(hit), atol=1e-4)


def test_points_that_are_not_alive_do_not_count(shapes: Any) -> None:
    lattice = make_lattice(shapes, 0.02)
    values = smooth(lattice_positions(shapes, lattice))
    dead = np.random.default_rng(3).random(lattice.points) < 0.3
    front = np.where(dead[:, None], 0, np.column_stack([values, np.ones(len(values))]))
    field = make_field(lattice, front, np.zeros_like(front))
    origin, direction = random_hits(shapes, 4000, seed=2)
    hit, got, on_front = lookup_side(shapes, field, origin, direction)
    assert not got[~on_front].any()  # a back side without light is black
    lit = on_front & (got[:, 0] != 0)
    assert lit.sum() > 0.95 * on_front.sum()
    # Only the living neighbours count, at most about a cell away.
    np.testing.assert_allclose(got[lit], smooth(hit[lit]), atol=0.04)


def test_light_is_continuous_over_edges_that_triangles_share(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, *CORNELL)
    lattice, front, back = bake(scene, bounces=2, direct_samples=64)
    field = make_field(lattice, front, back)
    # The floor's diagonals, whichever the rectangle has, and lines parallel to them within one triangle.
    s = np.linspace(-0.9, 0.9, 200)
    for sign in (1, -1):
        across = np.array([1, 0, -sign]) / np.sqrt(2)
        edge = np.stack([s, np.full_like(s, -0.9), sign * s], axis=-1)
        clear = (np.abs(edge[:, 0] + 0.4) > 0.5) & (np.abs(edge[:, 0] - 0.35) > 0.1)
        left, right = (
            lookup(scene, field, edge[clear] + (0, -0.09, 0) + k * 2e-4 * across, (0, -1, 0))[1] for k in (-1, 1)
        )
        np.testing.assert_allclose(left, right, rtol=0.01)


def test_a_sheet_is_lit_on_the_side_that_faces_the_light(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, FLOOR, POINT)
    lattice, front, back = bake(scene)
    field = make_field(lattice, front, back)
    xyz = floor_grid()
    above = lookup(scene, field, xyz + 0.01 * UP, -UP)[1]
    below = lookup(scene, field, xyz - 0.01 * UP, UP)[1]
    assert above.min() > 0.1 and not below.any()


def test_what_is_buried_does_not_darken_its_neighbours(tmp_path: Path) -> None:
    """A slab sunk into the floor, too flat to throw a shadow: the floor right beside it is lit as if it were alone."""
    slab = """<shape type="cube"><transform name="to_world"><scale x="0.3" y="0.3" z="0.02"/><rotate z="1" angle="30"/>
        <translate z="-0.019"/></transform><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></shape>"""
    angle = np.radians(30)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    s = np.linspace(-0.29, 0.29, 50)
    beside = [np.stack([s, np.full_like(s, 0.3 + gap)], -1) @ R.T for gap in (0.01, 0.02, 0.04)]
    xyz = np.column_stack([np.concatenate(beside), np.zeros(150)])
    scene = scene_of(tmp_path, FLOOR, slab, POINT)
    # Beside the slab the lookup extrapolates by up to a texel: 3 cm keeps the light's own fall-off below the tolerance.
    lattice, front, back = bake(scene, texel_m=0.03)
    assert (front[:, 3] == 0).sum() > 50  # the floor below the slab
    got = lookup(scene, make_field(lattice, front, back), xyz + 0.005 * UP, -UP)[1]
    d = np.array([0.3, -0.2, 0.8]) - xyz
    np.testing.assert_allclose(got[:, 0], 0.8 / np.linalg.norm(d, axis=-1) ** 3, rtol=0.06)


def test_light_does_not_leak_under_a_wall(tmp_path: Path) -> None:
    """A wall that stands a little in the floor, between a bright and a dim room: neither light is seen in the other."""
    wall = """<shape type="cube"><transform name="to_world"><scale x="0.01" y="3" z="1.2"/>
        <translate x="0.013" z="1.1"/></transform>{BLACK}</shape>""".replace("{BLACK}", BLACK)
    lamps = [
        f"""<emitter type="point"><point name="position" x="{x}" y="0.1" z="0.5"/>
        <rgb name="intensity" value="{power},{power},{power}"/></emitter>"""
        for x, power in ((0.5, 100), (-0.5, 1))
    ]
    scene = scene_of(tmp_path, FLOOR, wall, *lamps)
    lattice, front, back = bake(scene, texel_m=0.03)
    assert (front[:, 3] > 1).sum() > 60
    field = make_field(lattice, front, back)
    y = np.linspace(-0.8, 0.8, 40)
    for x0, side, power in ((-0.5, -1, 1), (0.5, 1, 100)):
        for gap in (0.003, 0.01, 0.02):
            xyz = np.stack([np.full_like(y, 0.013 + side * (0.01 + gap)), y, np.zeros_like(y)], axis=-1)
            got = lookup(scene, field, xyz + 0.002 * UP, -UP)[1][:, 0]
            d = np.array([x0, 0.1, 0.5]) - xyz
            np.testing.assert_allclose(got, power * 0.5 / np.linalg.norm(d, axis=-1) ** 3, rtol=0.12)


def test_what_lies_right_under_a_sheet_is_covered(tmp_path: Path) -> None:
    sheet = """<shape type="rectangle"><transform name="to_world"><scale value="0.3"/><translate z="0.004"/></transform>
        <bsdf type="diffuse"/></shape>"""
    scene = scene_of(tmp_path, FLOOR, sheet)
    p = floor_grid(0.9, 24).astype(np.float32)
    up = np.tile(UP.astype(np.float32), (len(p), 1))
    under = np.abs(p[:, :2]).max(axis=1) < 0.3
    np.testing.assert_array_equal(find_covered(scene, p, up, 0.005), under)
    assert not find_covered(scene, p, up, 0.003).any() and not find_covered(scene, p, -up, 0.005).any()


def test_the_estimate_is_the_error_that_is_there(tmp_path: Path) -> None:
    """A tenth too bright everywhere on the floor, exposed so that half of it is brighter than a reflectance of 0.18."""
    scene = scene_of(tmp_path, FLOOR, QUAD)
    lattice, front, back = bake(scene, texel_m=0.04, direct_samples=256, target_db=50)
    assert estimated_db(scene, make_field(lattice, front, back), 0.04) > 44
    off = np.array([1.1, 1.1, 1.1, 1.0], np.float32)
    xy = np.random.default_rng(5).uniform(-1, 1, (4000, 2))
    light = quad_factor(np.column_stack([xy, np.zeros(len(xy))]))[:, None] * [1.0, 2.0, 3.0]
    shown = 0.18 * light / np.median(light.mean(axis=1))
    error = srgb.encode(np.clip(1.1 * shown, 0, 1)) - srgb.encode(np.clip(shown, 0, 1))
    expected = -10 * np.log10(np.mean(error**2))
    assert estimated_db(scene, make_field(lattice, front * off, back * off), 0.04) == pytest.approx(expected, abs=1.0)


# --- the same bytes again, and the cache


def test_a_bake_is_deterministic(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, *CORNELL)
    reloaded = load_scene(tmp_path / "scene.xml")
    first, again = (bake(s, texel_m=0.1, bounces=2) for s in (scene, reloaded))
    assert first[1].tobytes() == again[1].tobytes() and first[2].tobytes() == again[2].tobytes()


LIGHT = LightConfig(texel_m=0.2, direct_samples=4, gather_rays=16, bounces=0)


def values_of(field: IrradianceField) -> np.ndarray:
    return np.array(field.values)


def test_the_second_call_loads_what_the_first_baked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(tmp_path, FLOOR, POINT)
    cache = tmp_path / "deep" / "cache"
    baked = lighting.baked_field(scene, "hash", LIGHT, cache, silent)
    assert len(list(cache.iterdir())) == 1  # no temporary file is left

    def fail(*_: Any) -> Any:
        raise AssertionError("baked again")

    with monkeypatch.context() as patch:
        patch.setattr(lighting, "bake", fail)
        loaded = lighting.baked_field(scene, "hash", LIGHT, cache, silent)
        np.testing.assert_array_equal(values_of(loaded), values_of(baked))
        with pytest.raises(AssertionError, match="baked again"):
            lighting.baked_field(scene, "another hash", LIGHT, cache, silent)

    # A damaged file is baked again and mended: truncated, garbage, empty, of another scene's size.
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    wrong = tmp_path / "wrong.npz"
    np.savez(wrong, front=np.zeros((3, 4)), back=np.zeros((3, 4)))
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 0xFF
    for damage in (whole[: len(whole) // 2], b"garbage", b"", wrong.read_bytes(), bytes(flipped)):
        file.write_bytes(damage)
        mended = lighting.baked_field(scene, "hash", LIGHT, cache, silent)
        np.testing.assert_array_equal(values_of(mended), values_of(baked))
        assert file.read_bytes() != damage


def test_the_caches_key_depends_on_all_that_decides_the_light() -> None:
    keys = [lighting.cache_key("scene", LIGHT), lighting.cache_key("other scene", LIGHT)]
    for name, value in {
        "texel_m": 0.3,
        "direct_samples": 5,
        "target_db": 41.0,
        "gather_rays": 17,
        "bounces": 1,
    }.items():
        keys.append(lighting.cache_key("scene", LIGHT.model_copy(update={name: value})))
    assert len(set(keys)) == len(keys)
    content = {"texel_m", "direct_samples", "target_db", "gather_rays", "bounces"}
    assert content | {"mode", "max_depth", "glossy_spp"} == set(LightConfig.model_fields)
    assert lighting.cache_key("scene", LIGHT.model_copy(update={"glossy_spp": 3})) == keys[0]
    # The reference integrator's settings do not touch the bake.
    assert lighting.cache_key("scene", LIGHT.model_copy(update={"max_depth": 3})) == keys[0]
    assert lighting.cache_key("scene", LIGHT) == keys[0]


def test_a_cache_that_cannot_be_written_only_warns(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = scene_of(tmp_path, FLOOR, POINT)
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with caplog.at_level(logging.WARNING, "rsgen"):
        field = lighting.baked_field(scene, "hash", LIGHT, blocked / "cache", silent)
    assert values_of(field).max() > 0
    assert len(caplog.records) == 1 and "cannot be written" in caplog.text


def test_the_cache_lies_beside_the_scene_or_in_the_users_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert lighting.cache_folder(tmp_path / "scene.xml") == tmp_path / ".rsgen-cache"
    monkeypatch.setattr(lighting.os, "access", lambda *_: False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert lighting.cache_folder(tmp_path / "scene.xml") == tmp_path / "home" / "rsgen"


def test_a_dark_scene_is_an_error(tmp_path: Path) -> None:
    behind = POINT.replace('z="0.8"', 'z="5"').replace("1,2,4", "0")
    with pytest.raises(UserError, match="dark") as caught:
        bake(scene_of(tmp_path, FLOOR, behind))
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="dark"):
        bake(scene_of(tmp_path, FLOOR))


def test_progress_grows_to_one(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, FLOOR, POINT)
    seen: list[float] = []
    light = LIGHT.model_copy(update={"bounces": 3})
    lighting.bake(scene, make_lattice(scene, 0.1), light, lambda stage, fraction, note: seen.append(fraction))
    assert seen == sorted(seen) and seen[0] >= 0 and seen[-1] == 1.0


def test_the_dark_inside_of_a_thin_sheet_does_not_darken_its_outside(tmp_path: Path) -> None:
    """Regression: a folded curtain lost a third of its light to samples 2 mm behind it that have the same normal."""
    slab = trimesh.creation.box((0.3, 0.3, 0.002))
    slab.update_faces(slab.face_normals[:, 0] < 0.5)  # one end is open, so that a little light gets in
    vertices, faces = trimesh.remesh.subdivide_to_size(slab.vertices, slab.faces, 0.006)
    trimesh.Trimesh(vertices, faces).export(tmp_path / "slab.ply")
    scene = scene_of(
        tmp_path,
        """<shape type="ply"><string name="filename" value="slab.ply"/><boolean name="face_normals" value="true"/>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
        <emitter type="constant"><rgb name="radiance" value="1,2,3"/></emitter>""",
    )
    light = LightConfig(texel_m=0.02, bounces=2, gather_rays=64, direct_samples=256)
    front, back = lighting.bake(scene, make_lattice(scene, light.texel_m), light, silent)
    # A convex body's outside sees the whole hemisphere of a uniform sky: E = π L.
    assert (front[:, 3] == 1).all()
    np.testing.assert_allclose(front[:, :3].mean(axis=0), np.pi * np.array([1, 2, 3]), rtol=0.005)
    assert np.quantile(np.abs(front[:, 0] / np.pi - 1), 0.95) < 0.05
    assert back[:, 0].mean() < 0.5  # and the inside is dark, but not all of it
    assert back[:, 3].any()
