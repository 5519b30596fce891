"""Scenes as triangles: analytic shapes, mesh files, content hashes, and one-line errors for bad input."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import tracemalloc
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny
import trimesh
from rendering import mi

from rsgen.config.config import LightConfig, load_config
from rsgen.errors import UserError
from rsgen.files import encode_exr
from rsgen.light.bake import bake
from rsgen.produce.frame_source import make_integrator
from rsgen.render.irradiance import make_lattice
from rsgen.render.scene import content_hash, ensure_built, load_scene, mesh_arrays, ply_bytes, surface
from rsgen.render.scene_xml.parsed import messages_to_log

# What 96 segments around leave between chord and circle: radius · (1 − cos(π / 96)).
SAGITTA = 1 - np.cos(np.pi / 96)
_RIGID = '<rotate x="0.36" y="0.48" z="-0.8" angle="50"/><translate x="0.3" y="-0.2" z="0.4"/>'
ANY_POSE = '<scale x="0.8" y="1.3" z="0.6"/>' + _RIGID
EVEN_POSE = '<scale value="0.9"/>' + _RIGID
MIRRORED = '<scale x="-1"/>'
# A plugin's own parameters, whether Mitsuba takes an uneven scale of it, and its size across for the tolerance.
SHAPES = {
    "rectangle": ("", True),
    "disk": ("", True),
    "sphere": ('<float name="radius" value="0.7"/><point name="center" x="0.2" y="0.1" z="-0.3"/>', False),
    "cylinder": (
        '<float name="radius" value="0.4"/><point name="p0" x="0.1" y="-0.5" z="0.2"/>'
        '<point name="p1" x="-0.3" y="0.6" z="0.4"/>',
        False,
    ),
}


def write_scene(folder: Path, *elements: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "scene.xml"
    path.write_text('<scene version="3.0.0">' + "\n".join(elements) + "</scene>")
    return path


def shape_xml(plugin: str, to_world: str, inside: str = "", flip: bool = False) -> str:
    flipped = '<boolean name="flip_normals" value="true"/>' if flip else ""
    pose = f'<transform name="to_world">{to_world}</transform>'
    return f'<shape type="{plugin}" id="it">{SHAPES[plugin][0]}{flipped}{pose}{inside}</shape>'


def rays_at(center: np.ndarray, spread: float, count: int = 4000) -> Any:
    """Rays from all around towards a region."""
    rng = np.random.default_rng(5)
    from_direction = rng.normal(size=(count, 3))
    origin = center + 5 * from_direction / np.linalg.norm(from_direction, axis=-1, keepdims=True)
    d = center + spread * rng.uniform(-1, 1, (count, 3)) - origin
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return mi.Ray3f(mi.Point3f(origin.astype(np.float32).T), mi.Vector3f(d.astype(np.float32).T))


def hits(scene: Any, ray: Any) -> dict[str, np.ndarray]:
    si = scene.ray_intersect(ray)
    vectors = {"p": si.p, "n": si.n, "sh_n": si.sh_frame.n, "uv": si.uv, "emitted": si.emitter(scene).eval(si)}
    found = {name: np.array(v).reshape(len(v), -1).T for name, v in vectors.items()}
    return {**found, "t": np.array(si.t), "valid": np.array(si.is_valid())}


@pytest.mark.parametrize("flip", [False, True], ids=["", "flipped"])
@pytest.mark.parametrize("mirrored", [False, True], ids=["", "mirrored"])
@pytest.mark.parametrize("plugin", SHAPES)
def test_analytic_shapes_become_meshes_of_the_same_surface(
    tmp_path: Path, plugin: str, mirrored: bool, flip: bool
) -> None:
    pose = (MIRRORED if mirrored else "") + (ANY_POSE if SHAPES[plugin][1] else EVEN_POSE)
    glow = '<emitter type="area"><rgb name="radiance" value="1,2,3"/></emitter>'
    path = write_scene(tmp_path, shape_xml(plugin, pose, glow, flip))
    ours, stock = load_scene(path), mi.load_file(str(path))
    assert all(s.is_mesh() for s in ours.shapes())
    assert plugin == "rectangle" or not any(s.is_mesh() for s in stock.shapes())  # the reference is analytic
    ray = rays_at(np.array([0.3, -0.2, 0.4]), 0.9)
    a, b = hits(ours, ray), hits(stock, ray)
    both = a["valid"] & b["valid"]
    assert both.sum() > 300
    outline = np.mean(a["valid"] != b["valid"]) / np.mean(b["valid"])
    assert outline < 0.02
    # Grazing rays stretch the sagitta; distances to the surface itself stay below it.
    cosine = np.abs(np.einsum("ij,ij->i", b["n"], np.array(ray.d).T))
    direct = both & (cosine > 0.2)
    flat = plugin in ("rectangle", "disk")
    off = np.abs(a["t"][direct] - b["t"][direct]) * cosine[direct]
    assert off.max() < (5e-6 if flat else 2.5 * SAGITTA)
    agree = np.einsum("ij,ij->i", a["sh_n"], b["sh_n"])  # a mirrored rectangle of Mitsuba's has n = −sh_n
    assert np.quantile(agree[direct], 0.01) > (1 - 1e-6 if flat else 1 - 2e-3)
    assert np.einsum("ij,ij->i", a["n"], a["sh_n"])[direct].min() > 0.99  # winding and vertex normals agree
    # The same side glows.
    np.testing.assert_allclose(a["emitted"][direct], b["emitted"][direct])
    if plugin != "sphere":
        assert 0.1 < np.mean(a["emitted"][direct, 0] > 0) < 0.9
    else:  # a closed one shows one side only
        assert np.all((a["emitted"][direct, 0] > 0) == (flip == mirrored))
    if plugin == "rectangle":
        np.testing.assert_allclose(a["uv"][direct], b["uv"][direct], atol=2e-5)
    if plugin in ("disk", "sphere"):
        difference = np.abs(a["uv"][direct] - b["uv"][direct])
        difference = np.minimum(difference, 1 - difference)  # around the seam
        assert np.quantile(difference, 0.95) < 0.02


def test_a_shape_without_any_parameter_is_mitsubas_unit_shape(tmp_path: Path) -> None:
    for plugin, low, high in (
        ("rectangle", (-1, -1, 0), (1, 1, 0)),
        ("disk", (-1, -1, 0), (1, 1, 0)),
        ("sphere", (-1, -1, -1), (1, 1, 1)),
        ("cylinder", (-1, -1, 0), (1, 1, 1)),
    ):
        vertices, _ = surface(load_scene(write_scene(tmp_path, f'<shape type="{plugin}"/>')))
        np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], [low, high], atol=1e-6)


def test_a_converted_shape_keeps_its_bsdf_and_emitter(tmp_path: Path) -> None:
    bsdf = '<bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.1,0.5,0.9"/></bsdf>'
    glow = '<emitter type="area"><rgb name="radiance" value="1,2,3"/></emitter>'
    scene = load_scene(write_scene(tmp_path, shape_xml("disk", EVEN_POSE, bsdf + glow)))
    (shape,) = scene.shapes()
    assert shape.is_emitter() and len(scene.emitters()) == 1
    si = scene.ray_intersect(rays_at(np.array([0.3, -0.2, 0.4]), 0.2, 50))
    albedo = np.array(shape.bsdf().eval_diffuse_reflectance(si, si.is_valid())).reshape(3, -1)
    np.testing.assert_allclose(albedo.max(axis=1), [0.1, 0.5, 0.9], rtol=1e-5)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "PLY"])
def test_mesh_files_load_lit_and_with_their_orientation(tmp_path: Path, suffix: str) -> None:
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.apply_translation((0.5, 0, 0))
    path = tmp_path / f"mesh.{suffix}"
    path.write_bytes(
        trimesh.exchange.export.export_mesh(mesh, None, file_type=suffix.lower()) if suffix != "obj" else b""
    )
    if suffix == "obj":
        mesh.export(path)
    scene = load_scene(path)
    assert len(scene.emitters()) == 1
    vertices, faces = surface(scene)
    np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], mesh.bounds, atol=1e-6)
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(6.0, rel=1e-5)  # negative if turned inside out
    found = hits(scene, rays_at(np.array([0.5, 0, 0]), 0.4))
    outward = np.einsum("ij,ij->i", found["n"], found["p"] - np.array([0.5, 0, 0]))
    assert found["valid"].all() and outward.min() > 0


def test_meshes_named_by_a_scene_are_found_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "scene"
    path = write_scene(folder, '<shape type="ply"><string name="filename" value="meshes/box.ply"/></shape>')
    (folder / "meshes").mkdir()
    trimesh.creation.box((1, 2, 3)).export(folder / "meshes" / "box.ply")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    assert len(surface(load_scene(path))[1]) == 12
    monkeypatch.chdir(folder)
    assert len(surface(load_scene(Path("scene.xml")))[1]) == 12
    assert content_hash(Path("scene.xml")) == content_hash(path)


def test_the_surface_is_all_triangles_of_all_shapes(tmp_path: Path) -> None:
    scene = load_scene(
        write_scene(
            tmp_path,
            shape_xml("rectangle", ANY_POSE),
            '<shape type="cube"><transform name="to_world"><translate x="3"/></transform></shape>',
        )
    )
    vertices, faces = surface(scene)
    parts = [mesh_arrays(shape) for shape in scene.shapes()]
    assert len(parts) == 2
    triangles = np.concatenate([v[f] for v, f in parts])
    np.testing.assert_array_equal(vertices[faces], triangles)
    assert vertices.dtype == np.float32 and faces.dtype == np.uint32
    assert len(triangles) == 2 + 12
    # A unit square of Mitsuba's is 2 x 2, here scaled by 0.8 and 1.3; the cube is 2 x 2 x 2.
    assert trimesh.Trimesh(vertices, faces, process=False).area == pytest.approx(4 * 0.8 * 1.3 + 24, rel=1e-5)
    ray = rays_at(np.array([0.3, -0.2, 0.4]), 2.0)
    found = hits(scene, ray)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    origin, direction = np.array(ray.o).T, np.array(ray.d).T
    points, which, _ = mesh.ray.intersects_location(origin, direction, multiple_hits=False)
    both = np.isin(np.arange(len(origin)), which) & found["valid"]
    expected = np.full((len(origin), 3), np.nan)
    expected[which] = points
    assert both.mean() > 0.2 and np.mean(np.isin(np.arange(len(origin)), which) != found["valid"]) < 0.002
    np.testing.assert_allclose(found["p"][both], expected[both], atol=2e-5)


# --- errors


def fails(path: Path, *words: str) -> None:
    with pytest.raises(UserError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600
    for word in (path.name, *words):
        assert re.search(word, message), f"{word!r} is not in: {message}"


@pytest.mark.parametrize(
    "shape",
    [
        '<shape type="bsplinecurve"><string name="filename" value="curves.txt"/></shape>',
        '<shape type="linearcurve"><string name="filename" value="curves.txt"/></shape>',
        '<shape type="sdfgrid"><string name="filename" value="grid.vol"/></shape>',
    ],
    ids=["bsplinecurve", "linearcurve", "sdfgrid"],
)
def test_shapes_that_cannot_become_triangles(tmp_path: Path, shape: str) -> None:
    fails(write_scene(tmp_path, shape), "cannot become triangles: export it as a mesh")


def test_bad_scene_files(tmp_path: Path) -> None:
    fails(tmp_path / "absent.xml", "no such file")
    fails(tmp_path / "absent.ply", "no such file")
    fails(write_scene(tmp_path / "unknown", '<shape type="nonsense"/>'), "nonsense")
    fails(write_scene(tmp_path / "property", '<shape type="cube"><float name="sise" value="2"/></shape>'), "sise")
    missing = write_scene(tmp_path / "missing", '<shape type="ply"><string name="filename" value="gone.ply"/></shape>')
    fails(missing, "gone.ply")
    for name, content in {
        "truncated.xml": b'<scene version="3.0.0"><shape type="cube">',
        "words.xml": b"this is not a scene",
        "empty.xml": b"",
        "binary.xml": bytes(range(256)),
        "words.ply": b"this is not a mesh",
        "empty.obj": b"",
        "truncated.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\nend_header\n\0\0",
        "unknown.mesh7": b"?",
    }.items():
        (tmp_path / name).write_bytes(content)
        fails(tmp_path / name)


def test_scenes_without_surfaces(tmp_path: Path) -> None:
    fails(write_scene(tmp_path / "empty"), "no surfaces", "add a shape")
    fails(write_scene(tmp_path / "sky", '<emitter type="constant"/>'), "no surfaces")
    points = tmp_path / "points.ply"
    trimesh.PointCloud(np.eye(3)).export(points)
    fails(points)


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_vertices_that_are_not_finite(tmp_path: Path, value: str) -> None:
    mesh = tmp_path / "bad.obj"
    mesh.write_text(f"v 0 0 0\nv 1 0 0\nv 0 {value} 0\nf 1 2 3\n")
    fails(mesh, "finite")
    folder = tmp_path / "xml"
    path = write_scene(folder, '<shape type="ply"><string name="filename" value="bad.ply"/></shape>')
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, float(value), 0]])
    (folder / "bad.ply").write_bytes(ply_bytes(vertices, np.array([[0, 1, 2]])))
    fails(path, "bad.ply.*invalid vertex position")


def mesh_scene(folder: Path, name: str, content: bytes, more: str = "") -> Path:
    path = write_scene(folder, f'<shape type="{name[-3:]}"><string name="filename" value="{name}"/>{more}</shape>')
    (folder / name).write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("cut.ply", ply_bytes(np.eye(3), np.array([[0, 1, 2]]))[:-9], "shape ply 'cut.ply'.*export it anew"),
        ("bare.ply", ply_bytes(np.zeros((0, 3)), np.zeros((0, 3), int)), "shape ply 'bare.ply'.*export it anew"),
        ("far.ply", ply_bytes(np.eye(3), np.array([[0, 1, 7]])), "names vertex 7 of 3: export it anew"),
        ("line.ply", ply_bytes(np.eye(3), np.array([[0, 1, 1]])), "no triangle of it has an area: export"),
        ("words.obj", b"this is no mesh\n", "shape obj 'words.obj'.*export it anew"),
    ],
    ids=["cut", "empty", "indices", "line", "words"],
)
def test_meshes_that_are_broken(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    fails(mesh_scene(tmp_path, name, content), words)


def test_images_that_are_missing_or_broken(tmp_path: Path) -> None:
    image = '<texture type="bitmap" name="reflectance"><string name="filename" value="a.png"/></texture>'
    path = write_scene(tmp_path, f'<shape type="cube"><bsdf type="diffuse">{image}</bsdf></shape>')
    fails(path, "file 'a.png' is missing: put it there, or mend its path")
    (tmp_path / "a.png").write_bytes(b"\x89PNG and no more")
    fails(path, "texture bitmap 'a.png'.*save the image anew")


@pytest.mark.parametrize("plugin", ["cube", "rectangle", "sphere"])
@pytest.mark.parametrize("to_world", ['<scale y="0"/>', '<translate x="nan"/>'], ids=["flat", "nan"])
def test_transforms_that_squash_a_shape(tmp_path: Path, plugin: str, to_world: str) -> None:
    pose = f'<transform name="to_world">{to_world}</transform>'
    fails(write_scene(tmp_path, f'<shape type="{plugin}" id="wall">{pose}</shape>'), "shape 'wall'.*scale no axis by 0")


def test_plugins_that_do_not_exist(tmp_path: Path) -> None:
    fails(write_scene(tmp_path / "a", '<shape type="cube"><bsdf type="zork"/></shape>'), "bsdf zork: .*no such plugin")
    fails(write_scene(tmp_path / "b", '<shape type="cube"/><emitter type="zork"/>'), "emitter zork: .*no such plugin")


def test_triangles_without_area_and_normals_without_direction_are_harmless(tmp_path: Path) -> None:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, -1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 4, 1], [2, 2, 2], [0, 2, 3]])
    normals = np.tile([0, 0, 1.0], (5, 1))
    good = ply_bytes(corners, faces, normals)
    start = good.index(b"end_header\n") + len(b"end_header\n")
    table = np.frombuffer(good, "<f4", 30, start).reshape(5, 6).copy()
    table[1, 3:], table[2, 3:] = np.nan, 0
    line = '<shape type="ply" id="line"><string name="filename" value="line.ply"/></shape>'
    (tmp_path / "line.ply").write_bytes(ply_bytes(corners, np.array([[0, 4, 1]])))
    path = mesh_scene(tmp_path, "it.ply", good[:start] + table.tobytes() + good[start + 120 :])
    path.write_text(path.read_text().replace("</scene>", f'{line}<emitter type="constant"/></scene>'))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(path)
        assert len(scene.shapes()) == 1 and len(scene.emitters()) == 1
        np.testing.assert_array_equal(surface(scene)[1], faces[[0, 3]])
        ray = rays_at(np.zeros(3), 0.9)
        found = hits(scene, ray)
        light = LightConfig(texel_m=0.2, bounces=1, direct_samples=4, gather_rays=16)
        baked = bake(scene, make_lattice(scene, light.texel_m), light, lambda *_: None)
    seen = found["valid"]
    through = np.array(ray.o).T - np.array(ray.d).T * (np.array(ray.o.z) / np.array(ray.d.z))[:, None]
    assert seen.mean() > 0.3 and np.mean(seen != (np.abs(through) < 1).all(axis=1)) < 1e-3
    np.testing.assert_allclose(np.abs(found["sh_n"][seen]), np.tile([0, 0, 1.0], (seen.sum(), 1)), atol=1e-6)
    for side in baked:
        assert np.isfinite(side).all() and side[:, :3].mean() == pytest.approx(np.pi, rel=0.1)  # under a sky of 1


def test_light_that_would_not_fit_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path, '<shape type="rectangle"/>'))
    size = '<transform name="to_world"><scale value="300"/></transform>'
    large = load_scene(write_scene(tmp_path, *(f'<shape type="cube">{size}</shape>' for _ in range(2))))
    make_lattice(scene, 1.2e-3)
    tracemalloc.start()
    with pytest.raises(UserError, match=r"light.texel_m 0.015 needs .* GB.*set it to (\S+) or more") as caught:
        make_lattice(large, 0.015)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()
    named = re.search(r"set it to (\S+) or", str(caught.value))
    assert named is not None
    fits = float(named[1])
    tracemalloc.start()
    points = make_lattice(large, fits).points
    tracemalloc.stop()
    assert 0.9 * 4e9 / 400 < points <= 4e9 / 400 and "\n" not in str(caught.value)
    config = load_config(tiny.write_config(tmp_path, light={"texel_m": 0.015}))
    with pytest.raises(UserError, match=r"^scene .*scene\.xml: light\.texel_m"):
        make_integrator(mi, large, config, lambda *_: None)


def test_nothing_reaches_the_screen_while_a_scene_loads(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write_scene(tmp_path, '<shape type="cube"><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>')
    before = mi.logger().appender_count()
    with caplog.at_level(logging.DEBUG, "rsgen"), messages_to_log(mi) as seen:
        load_scene(path)
        mi.Log(mi.LogLevel.Warn, "a warning")
    assert any("a warning" in message for message in seen) and "a warning" in caplog.text
    assert capfd.readouterr() == ("", "") and mi.logger().appender_count() == before


# --- what a scene's light is cached under


def test_the_content_hash_covers_every_file_of_the_scene(tmp_path: Path) -> None:
    path = write_scene(
        tmp_path,
        """<bsdf type="diffuse" id="paint"><texture type="bitmap" name="reflectance">
            <string name="filename" value="paint.png"/></texture></bsdf>""",
        '<shape type="ply"><string name="filename" value="box.ply"/><ref id="paint"/></shape>',
        '<include filename="more.xml"/>',
    )
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.export(tmp_path / "box.ply")
    more = tmp_path / "more.xml"
    more.write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    paint = tmp_path / "paint.png"
    mi.Bitmap(np.full((4, 4, 3), 100, np.uint8)).write(str(paint))
    first = content_hash(path)
    assert re.fullmatch("[0-9a-f]{64}", first) and content_hash(path) == first

    seen = {first}

    def is_new() -> bool:
        before = len(seen)
        seen.add(content_hash(path))
        return len(seen) == before + 1

    mi.Bitmap(np.full((4, 4, 3), 101, np.uint8)).write(str(paint))
    assert is_new()
    mesh.apply_translation((0, 0, 1e-3))
    mesh.export(tmp_path / "box.ply")
    assert is_new()
    path.write_text(path.read_text().replace('id="paint"', 'id="paint" '))
    assert is_new()
    more.write_text(more.read_text().replace('type="constant"', 'type="constant" id="sky"'))
    assert is_new()
    (tmp_path / "unrelated.txt").write_text("not part of the scene")
    assert not is_new()
    paint.unlink()
    with pytest.raises(UserError, match=r"paint\.png.*missing"):
        content_hash(path)


def test_the_content_hash_of_a_mesh_file(tmp_path: Path) -> None:
    path = tmp_path / "mesh.stl"
    trimesh.creation.box((1, 1, 1)).export(path)
    first = content_hash(path)
    trimesh.creation.box((1, 1, 1.001)).export(path)
    assert content_hash(path) != first
    with pytest.raises(UserError, match="no such file"):
        content_hash(tmp_path / "absent.stl")
    path = tmp_path / "broken.xml"
    path.write_text("<scene")
    with pytest.raises(UserError, match=r"broken\.xml"):
        content_hash(path)


# --- scenes that build themselves


def test_a_missing_scene_is_built_by_the_script_beside_it(tmp_path: Path) -> None:
    (tmp_path / "build.py").write_text(
        "from pathlib import Path\n"
        "here = Path(__file__).parent\n"
        "log = here / 'runs'\n"
        "log.write_text(log.read_text() + 'x' if log.exists() else 'x')\n"
        "(here / 'scene.xml').write_text('<scene version=\"3.0.0\"><shape type=\"cube\"/></scene>')\n"
    )
    path = tmp_path / "scene.xml"
    assert len(surface(load_scene(path))[1]) == 12
    load_scene(path)
    assert (tmp_path / "runs").read_text() == "x"  # once


def test_a_missing_variant_is_built_by_the_script_of_its_room(tmp_path: Path) -> None:
    (tmp_path / "build.py").write_text(
        "import sys\nfrom pathlib import Path\n"
        "assert sys.argv[1] == '--seed' and sys.argv[3] == '--out' and len(sys.argv) == 5, sys.argv\n"
        "out = Path(sys.argv[4])\nout.mkdir()\n"
        "cubes = '<shape type=\"cube\"/>' * int(sys.argv[2])\n"
        "(out / 'scene.xml').write_text(f'<scene version=\"3.0.0\">{cubes}</scene>')\n"
    )
    assert len(surface(load_scene(tmp_path / "seed3" / "scene.xml"))[1]) == 36
    fails(tmp_path / "seed" / "scene.xml", "no such file")
    fails(tmp_path / "other3" / "scene.xml", "no such file")


def test_a_build_script_that_fails_says_why_in_one_line(tmp_path: Path) -> None:
    script = tmp_path / "build.py"
    script.write_text("raise SystemExit('first line\\nno disk space left')")
    fails(tmp_path / "scene.xml", r"build\.py failed", "no disk space left")
    script.write_text("pass")
    fails(tmp_path / "scene.xml", "no such file")
    with pytest.raises(UserError, match="no such file"):
        ensure_built(tmp_path / "scene.xml")


def test_one_thread_is_enough_to_read_an_exr(tmp_path: Path) -> None:
    """As on a machine of one core, where Mitsuba alone waits for ever."""
    (tmp_path / "sky.exr").write_bytes(encode_exr(np.full((4, 8, 3), 0.5, np.float32), ("R", "G", "B")))
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
        '<shape type="sphere"/></scene>'
    )
    code = (
        "from rsgen.device.backend import select\nselect()\nimport sys, drjit, pathlib\ndrjit.set_thread_count(1)\n"
        "from rsgen.render.scene import load_scene\nload_scene(pathlib.Path(sys.argv[1]))\n"
        "assert drjit.thread_count() == 1"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "scene.xml")]
    subprocess.run(words, cwd=Path(__file__).parents[2], check=True, timeout=60)
