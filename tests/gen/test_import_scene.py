"""USD and Blender scenes as Mitsuba's: where things are, what colour and how bright, and what is said of the rest."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from rendering import dr, mi

from rsgen import srgb
from rsgen.cli.main import main
from rsgen.errors import UserError
from rsgen.importing import blend, usd_stage
from rsgen.importing.folder import write_folder, write_scene
from rsgen.importing.import_scene import import_scene
from rsgen.importing.triangulate import triangulate
from rsgen.render.mesh_files.material import Material, Texture, bsdf
from rsgen.render.scene import load_scene, surface

needs_usd = pytest.mark.skipif(find_spec("pxr") is None, reason="needs USD: pip install usd-core")
needs_blender = pytest.mark.skipif(find_spec("bpy") is None, reason="needs Blender: pip install 'bpy==4.2.*'")

SQUARE = """
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1)]
    uniform token subdivisionScheme = "none"
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "faceVarying")
"""
MATTE = "float inputs:roughness = 1"


# USD wants a line an attribute.
_TYPES = "(?:double|float|color3f|point3f|int|int64|quath|bool|asset|string|token|rel)"
_ATTRIBUTE = re.compile(rf"(?<!uniform) +(?=(?:uniform )?(?:{_TYPES}\d?(?:\[\])? [\w:.]+(?: =| *[}}\n]))|\}}|def )")


def usda(path: Path, content: str, unit: float = 1.0, up: str = "Y") -> Path:
    """A stage of this content, in which spaces will do between attributes."""
    content = _ATTRIBUTE.sub("\n", content)
    path.write_text(f'#usda 1.0\n(\n    metersPerUnit = {unit}\n    upAxis = "{up}"\n)\n{content}')
    return path


def material(inputs: str, more: str = "") -> str:
    return f"""
def Material "Paint" {{
    token outputs:surface.connect = </Paint/Surface.outputs:surface>
    def Shader "Surface" {{
        uniform token info:id = "UsdPreviewSurface"
        {inputs}
        token outputs:surface
    }}
    {more}
}}
"""


def square(extra: str = "", bound: bool = True) -> str:
    binding = "rel material:binding = </Paint>" if bound else ""
    api = '(prepend apiSchemas = ["MaterialBindingAPI"])' if bound else ""
    return f'def Mesh "Square" {api} {{{SQUARE}{binding}\n{extra}\n}}\n'


def imported(file: Path, out: Path | None = None, **options: Any) -> tuple[Any, tuple[str, ...]]:
    """The scene as it is loaded again, and the notes."""
    made = import_scene(file, out or file.with_suffix(""), force=True, **options)
    return load_scene(made.scene), made.notes


def triangles(scene: Any) -> np.ndarray:
    """(m, 3, 3) in an order of their own, each beginning with its least corner."""
    vertices, faces = surface(scene)
    return canonical(vertices[faces])


def canonical(t: np.ndarray) -> np.ndarray:
    t = np.round(np.asarray(t, float), 4) + 0.0
    first = [min(range(3), key=lambda k: tuple(x[k])) for x in t]
    turned = np.array([np.roll(x, -k, axis=0) for x, k in zip(t, first, strict=True)])
    return turned[np.lexsort(turned.reshape(len(t), 9).T[::-1])]


def brightness(scene: Any, spp: int = 1, **how: int) -> np.ndarray:
    """Radiance (3,) that leaves the scene's middle, seen askew from above, by direct light."""
    sensor = {
        "type": "radiancemeter", "origin": [0.3, 0.4, 0.2], "direction": [-0.3, -0.4, -0.2],
        "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
    }  # fmt: skip
    image = mi.render(scene, sensor=mi.load_dict(sensor), integrator=mi.load_dict({"type": "direct"} | how), spp=spp)
    return np.array(image).ravel()[:3]


def albedo(scene: Any, xz: np.ndarray) -> np.ndarray:
    """Linear diffuse reflectance (n, 3) of what lies below points (n, 2)."""
    o = np.column_stack([xz[:, 0], np.full(len(xz), 5.0), xz[:, 1]]).astype(np.float32).T
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(0, -1, 0)))
    return np.array(si.bsdf().eval_diffuse_reflectance(si)).reshape(3, -1).T


# --- where things are


@needs_usd
def test_meshes_solids_and_instances_lie_where_trimesh_puts_them(tmp_path: Path) -> None:
    """Centimetres, z up, nested and mirrored transforms, references, an instancer with a mask; both orientations."""
    box = trimesh.creation.box([1, 2, 3])
    points, faces = box.vertices, box.faces
    mesh = (
        f"point3f[] points = {[tuple(map(float, p)) for p in points]}\n"
        f"int[] faceVertexCounts = {[3] * len(faces)}\n"
        f"int[] faceVertexIndices = {faces.ravel().tolist()}\n"
        'uniform token subdivisionScheme = "none"\n'
    )
    usda(tmp_path / "box.usda", f'def Xform "Box" {{ def Mesh "Mesh" {{ {mesh} }} }}')
    file = usda(
        tmp_path / "all.usda",
        f"""
def Xform "A" {{
    double3 xformOp:translate = (10, 20, 30)
    float xformOp:rotateZ = 30
    float3 xformOp:scale = (2, -1, 3)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]
    def Mesh "Left" {{ {mesh.replace(str(faces.ravel().tolist()), str(faces[:, ::-1].ravel().tolist()))}
        uniform token orientation = "leftHanded" }}
    def "Reference" (instanceable = true
        prepend references = @box.usda@</Box>) {{
        double3 xformOp:translate = (0, 5, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def Mesh "Unseen" {{ {mesh} token visibility = "invisible" }}
    def Mesh "Guide" {{ {mesh} uniform token purpose = "guide" }}
}}
def PointInstancer "Many" {{
    rel prototypes = [</Many/Protos/Box>]
    int[] protoIndices = [0, 0, 0]
    point3f[] positions = [(40, 0, 0), (50, 0, 0), (60, 0, 0)]
    quath[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5)]
    float3[] scales = [(1, 1, 1), (1, 1, 1), (2, 2, 2)]
    int64[] invisibleIds = [1]
    def Scope "Protos" {{ def Mesh "Box" {{ {mesh}
        double3 xformOp:translate = (0, 0, 7)
        uniform token[] xformOpOrder = ["xformOp:translate"] }} }}
}}
def Camera "Eye" {{ }}
def BasisCurves "Hair" {{ }}
""",
        0.01,
        "Z",
    )
    scene, notes = imported(file)
    turn = trimesh.transformations.rotation_matrix
    move = trimesh.transformations.translation_matrix
    A = move([10, 20, 30]) @ turn(np.radians(30), [0, 0, 1]) @ np.diag([2, -1, 3, 1.0])
    quarter = np.eye(4)
    quarter[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # of the quaternion (1, 1, 1, 1) / 2
    places = [
        A,
        A @ move([0, 5, 0]),
        move([40, 0, 7]),
        move([60, 0, 0]) @ quarter @ np.diag([2, 2, 2, 1.0]) @ move([0, 0, 7]),
    ]
    T_world_stage = 0.01 * np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    expected = []
    for T in places:
        moved = box.copy().apply_transform(T)  # trimesh turns faces round where it mirrors
        expected.append(np.asarray(moved.vertices)[moved.faces] @ T_world_stage.T)
    np.testing.assert_allclose(triangles(scene), canonical(np.concatenate(expected)), atol=1.5e-4)
    vertices, faces = surface(scene)
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(1e-6 * 6 * (6 + 6 + 1 + 8), rel=1e-4)
    said = " ".join(notes)
    for word in (
        "invisible, left out: /A/Unseen",
        "left out: /A/Guide",
        "camera left out: /Eye",
        "BasisCurves left out",
    ):
        assert word in said


@needs_usd
def test_solids_have_their_size_and_axis(tmp_path: Path) -> None:
    content = """
def Cube "A" { double size = 3 }
def Sphere "B" { double radius = 2 double3 xformOp:translate = (10, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"] }
def Cylinder "C" { double radius = 1 double height = 6 uniform token axis = "X" double3 xformOp:translate = (20, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"] }
def Cone "D" { double radius = 1 double height = 3 uniform token axis = "Y" double3 xformOp:translate = (30, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"] }
def Plane "E" { double width = 2 double length = 5 uniform token axis = "Y" double3 xformOp:translate = (40, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"] }
"""
    vertices, faces = surface(imported(usda(tmp_path / "solids.usda", content))[0])
    bodies = trimesh.Trimesh(vertices, faces).split(only_watertight=False)
    by_place = sorted(bodies, key=lambda body: body.bounds.mean(axis=0)[0])
    volumes = [27, 4 / 3 * np.pi * 8, 6 * np.pi, np.pi]
    assert [b.volume for b in by_place[:4]] == pytest.approx(volumes, rel=8e-3)
    sizes = [[3, 3, 3], [4, 4, 4], [6, 2, 2], [2, 3, 2], [2, 0, 5]]
    np.testing.assert_allclose([np.ptp(b.bounds, axis=0) for b in by_place], sizes, atol=2e-2)
    np.testing.assert_allclose(by_place[3].vertices[:, 1].max(), 1.5)
    assert by_place[3].vertices[by_place[3].vertices[:, 1] > 1.4].shape[0] == 1  # its tip is up
    np.testing.assert_allclose(by_place[4].face_normals, [[0, 1, 0]] * 2, atol=1e-9)


def test_polygons_of_any_shape_keep_their_area() -> None:
    """Against the shoelace formula: convex ones, stars, and an L whose first corner is its inner one."""
    rng = np.random.default_rng(3)
    points, counts, expected = [], [], []
    for n in (3, 4, 5, 6, 8, 12, 4):
        angle = np.sort(rng.uniform(0, 2 * np.pi, n)) if n != 4 else np.radians([0, 80, 100, 270])
        radius = np.where(np.arange(n) % 2, 0.3, 1.0) if n in (8, 12) else np.ones(n)
        if len(counts) == 6:
            radius[1] = 0.05  # an arrow head
        if n in (8, 12):
            angle = np.arange(n) * 2 * np.pi / n
        flat = np.roll(radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]), n // 2 + 1, axis=0)
        x, y = flat.T
        expected.append(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
        tilt = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        points.append(np.column_stack([flat, np.zeros(n)]) @ tilt.T)
        counts.append(n)
    flat_L = np.array([[1, 1], [1, 2], [0, 2], [0, 0], [2, 0], [2, 1.0]])
    points.append(np.column_stack([flat_L, np.ones(6)]))
    counts.append(6)
    expected.append(3.0)
    p = np.concatenate(points)
    kept = np.ones(len(counts), bool)
    kept[2] = False  # a hole
    corners, polygon = triangulate(p, np.arange(len(p)), np.array(counts), kept)
    areas = (
        np.linalg.norm(np.cross(p[corners[:, 1]] - p[corners[:, 0]], p[corners[:, 2]] - p[corners[:, 0]]), axis=1) / 2
    )
    np.testing.assert_allclose(
        np.bincount(polygon, areas, len(counts)), np.where(kept, expected, 0), rtol=1e-9, atol=1e-12
    )
    assert (np.diff(polygon) >= 0).all()


# --- colours


@needs_usd
def test_a_square_shines_as_its_material_and_light_say(tmp_path: Path) -> None:
    """Closed forms: under a uniform sky, a sun, a point and a lamp of known size; in centimetres as well."""
    color = np.array([0.2, 0.5, 0.8])
    paint = material(f"color3f inputs:diffuseColor = (0.2, 0.5, 0.8)\n{MATTE}")
    down = 'float xformOp:rotateX = -90\nuniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]'

    def seen(light: str, unit: float, spp: int = 1, **how: int) -> np.ndarray:
        scaled = square(
            f'float3 xformOp:scale = ({1 / unit}, 1, {1 / unit})\nuniform token[] xformOpOrder = ["xformOp:scale"]'
        )
        scene, _ = imported(usda(tmp_path / "lit.usda", paint + scaled + light, unit))
        return brightness(scene, spp, **how)

    sky = """def DomeLight "L" { float inputs:intensity = 0.5 float inputs:exposure = 2
        color3f inputs:color = (1, 0.5, 0.25) }"""
    np.testing.assert_allclose(seen(sky, 1.0, emitter_samples=0, bsdf_samples=1), color * 2 * [1, 0.5, 0.25], rtol=1e-4)
    slanted = 'float xformOp:rotateX = -30\nuniform token[] xformOpOrder = ["xformOp:rotateX"]'
    # Down by 30 degrees: half of what falls on a surface across its way.
    sun = f'def DistantLight "L" {{ float inputs:intensity = 3 bool inputs:normalize = 1 {slanted} }}'
    np.testing.assert_allclose(seen(sun, 1.0), color * 3 * 0.5 / np.pi, rtol=1e-4)
    wide = sun.replace("bool inputs:normalize = 1", "float inputs:angle = 1")
    np.testing.assert_allclose(seen(wide, 1.0), color * 3 * np.sin(np.radians(0.5)) ** 2 * 0.5, rtol=1e-4)
    for unit in (1.0, 0.01):
        high = f"double3 xformOp:translate = (0, {2 / unit}, 0)"
        point = f"""def SphereLight "L" {{ bool treatAsPoint = 1 float inputs:radius = {0.1 / unit}
            float inputs:intensity = 100 {high} uniform token[] xformOpOrder = ["xformOp:translate"] }}"""
        np.testing.assert_allclose(seen(point, unit), color * 100 * 0.1**2 / 2**2, rtol=1e-4)
        # By its size in units of the stage, of which its intensity keeps a quarter.
        by_size = point.replace("intensity = 100", f"intensity = {100 / unit**2} bool inputs:normalize = 1")
        np.testing.assert_allclose(seen(by_size, unit), color * 100 / 4 / 2**2 / np.pi, rtol=1e-4)
    a, b = 0.25, 0.5  # half sides over height
    form = sum(
        2 * p / np.hypot(1, p) * np.arctan(q / np.hypot(1, p)) for p, q in ((a, b), (b, a))
    )  # irradiance below the middle of a rectangle of radiance 1
    lamp = f"""def RectLight "L" {{ float inputs:width = 100 float inputs:height = 200 float inputs:intensity = 60000
        bool inputs:normalize = 1 double3 xformOp:translate = (0, 200, 0) {down} }}"""
    np.testing.assert_allclose(seen(lamp, 0.01, 4096), color * 60000 / (100 * 200) * form / np.pi, rtol=1e-2)


@needs_usd
def test_textures_lie_as_usd_says(tmp_path: Path) -> None:
    """Orientation and a transform, by a picture of four colours; a missing one gives its fallback and is named."""
    image = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    Image.fromarray(image).save(tmp_path / "four.png")
    red, green, blue, white = [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]
    quarters = np.array([[-0.9, -0.9], [0.9, -0.9], [-0.9, 0.9], [0.9, 0.9]])  # as one looks down, z towards oneself

    def colors(texture: str, st: str = "</Paint/Reader.outputs:result>") -> tuple[list[list[float]], tuple[str, ...]]:
        nodes = f"""
    def Shader "Reader" {{ uniform token info:id = "UsdPrimvarReader_float2" string inputs:varname = "st"
        float2 outputs:result }}
    def Shader "Turn" {{ uniform token info:id = "UsdTransform2d" float inputs:rotation = 90
        float2 inputs:scale = (1, 1) float2 inputs:translation = (1, 0)
        float2 inputs:in.connect = </Paint/Reader.outputs:result> float2 outputs:result }}
    def Shader "Image" {{ uniform token info:id = "UsdUVTexture" {texture}
        float4 inputs:fallback = (0.5, 0.25, 0.125, 1) token inputs:wrapS = "clamp"
        float2 inputs:st.connect = {st} float3 outputs:rgb }}"""
        paint = material(f"color3f inputs:diffuseColor.connect = </Paint/Image.outputs:rgb>\n{MATTE}", nodes)
        scene, notes = imported(usda(tmp_path / "papered.usda", paint + square()))
        return albedo(scene, quarters).round(3).tolist(), notes

    assert colors("asset inputs:file = @four.png@")[0] == [red, green, blue, white]
    turned = colors("asset inputs:file = @four.png@", "</Paint/Turn.outputs:result>")[0]
    # st -> (1 - t, s): upper left (0, 1) looks at (0, 0), the picture's lower left.
    assert turned == [blue, red, white, green]
    missing, notes = colors("asset inputs:file = @none.png@")
    assert missing == [[0.5, 0.25, 0.125]] * 4 and any("none.png" in line for line in notes)


@needs_usd
def test_subsets_colours_of_vertices_and_opacity(tmp_path: Path) -> None:
    two = """
    int[] faceVertexCounts = [4, 4]
    int[] faceVertexIndices = [0, 1, 2, 3, 1, 4, 5, 2]
    point3f[] points = [(-1, 0, 1), (0, 0, 1), (0, 0, -1), (-1, 0, -1), (1, 0, 1), (1, 0, -1)]
    uniform token subdivisionScheme = "none"
    color3f[] primvars:displayColor = [(0.1, 0.2, 0.3), (0.4, 0.5, 0.6)] (interpolation = "uniform")
    """
    paint = material(f"color3f inputs:diffuseColor = (0.7, 0.8, 0.9)\n{MATTE}\nfloat inputs:metallic = 0")
    subset = """def GeomSubset "Part" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        uniform token elementType = "face" uniform token familyName = "materialBind" int[] indices = [1]
        rel material:binding = </Paint> }"""
    where = np.array([[-0.5, 0.1], [0.5, 0.2]])
    scene, _ = imported(usda(tmp_path / "two.usda", paint + f'def Mesh "Two" {{ {two} {subset} }}'))
    np.testing.assert_allclose(albedo(scene, where), [[0.1, 0.2, 0.3], [0.7, 0.8, 0.9]], rtol=1e-5)
    scene, notes = imported(usda(tmp_path / "bare.usda", f'def Mesh "Two" {{ {two} }}'))
    np.testing.assert_allclose(albedo(scene, where), [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], rtol=1e-5)
    assert any("no light of its own" in line for line in notes)
    glass = paint.replace("float inputs:metallic = 0", "float inputs:opacity = 0.2")
    scene, _ = imported(usda(tmp_path / "glass.usda", glass + f'def Mesh "Two" {{ {two} {subset} }}'))
    assert len(surface(scene)[1]) == 2  # what is hardly there is not there


# --- files


def test_a_mesh_file_becomes_the_scene_that_it_is_by_itself(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    image = rng.integers(0, 255, (4, 4, 3), dtype=np.uint8)
    visual = trimesh.visual.TextureVisuals(
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]),
        material=trimesh.visual.material.PBRMaterial(
            baseColorTexture=Image.fromarray(image), metallicFactor=0.0, roughnessFactor=1.0
        ),
    )
    corners = [[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(tmp_path / "card.glb")
    scene, notes = imported(tmp_path / "card.glb")
    direct = load_scene(tmp_path / "card.glb")
    np.testing.assert_array_equal(triangles(scene), triangles(direct))
    where = rng.uniform(-0.9, 0.9, (50, 2))
    np.testing.assert_allclose(albedo(scene, where), albedo(direct, where), atol=1e-3)
    assert len(scene.emitters()) == len(direct.emitters()) == 1
    assert "scene.file of a config takes a mesh file as it is" in notes[0]
    assert list((tmp_path / "card/textures").glob("*.png"))


def test_pictures_that_bytes_cannot_hold_are_written_as_they_are(tmp_path: Path) -> None:
    pixels = np.random.default_rng(2).integers(0, 255, (3, 5, 4), dtype=np.uint8)
    transform = np.array([[2.0, 0.5, 0.1], [0, -1, 0.3]])
    looks = Material(np.array([0.31, 0.52, 0.93]), Texture(pixels, "mirror", True, transform), roughness=0.4)
    scene = {"type": "scene", "shape": {"type": "rectangle", "bsdf": bsdf(mi, looks, None)}}
    dr.set_thread_count(max(2, dr.thread_count()))  # with one, Mitsuba waits for itself for ever over an EXR
    direct = mi.load_dict(scene)
    write_scene(scene, ["a -- comment"], tmp_path)
    read = load_scene(tmp_path / "scene.xml")
    assert list((tmp_path / "textures").glob("*.exr"))
    uv = np.random.default_rng(3).uniform(-1, 1, (2, 40)).astype(np.float32)
    rays = mi.Ray3f(mi.Point3f(uv[0], uv[1], 3), mi.Vector3f(0, 0, -1))
    values = [
        np.array(s.ray_intersect(rays).bsdf().eval_diffuse_reflectance(s.ray_intersect(rays))) for s in (direct, read)
    ]
    np.testing.assert_allclose(values[0], values[1], rtol=2e-3)
    assert np.ptp(values[0]) > 0.3


def test_a_folder_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "room"

    def fails(folder: Path) -> None:
        (folder / "scene.xml").write_text("half")
        raise UserError("no more")

    with pytest.raises(UserError, match="no more"):
        write_folder(out, False, fails)
    assert not list(tmp_path.iterdir())
    assert write_folder(out, False, lambda folder: (folder / "scene.xml").write_text("one")) == 3
    with pytest.raises(UserError, match="is there already: choose another folder, or replace it with --force"):
        write_folder(out, False, fails)
    with pytest.raises(UserError, match="no more"):
        write_folder(out, True, fails)
    assert (out / "scene.xml").read_text() == "one"
    write_folder(out, True, lambda folder: (folder / "scene.xml").write_text("two"))
    assert (out / "scene.xml").read_text() == "two" and [p.name for p in tmp_path.iterdir()] == ["room"]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/diary.txt").write_text("mine")
    with pytest.raises(UserError, match="no folder of import-scene"):
        write_folder(tmp_path / "mine", True, fails)


def test_what_is_missing_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    (tmp_path / "a.blend").write_bytes(b"BLENDER")
    (tmp_path / "a.txt").write_text("")
    for module in (usd_stage, blend):
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    for name, text in [
        ("a.usda", "need the package usd-core, which is not installed: install it with: pip install"),
        ("a.blend", "need Blender's Python module bpy, which is not installed: install it with: pip install"),
        ("a.txt", "is no file to import: of these kinds are read: .usd"),
        ("none.usdz", "no such file"),
    ]:
        assert main(["import-scene", str(tmp_path / name), str(tmp_path / "out")]) == 2
        said = capsys.readouterr().err
        assert text in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@needs_usd
@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("this is no USD", "cannot be read"),
        ('#usda 1.0\ndef Camera "C" {}\n', r"holds no surface \(camera left out: /C\)"),
        (f'#usda 1.0\ndef Mesh "M" {{{SQUARE.replace("(-1, 0, 1)", "(nan, 0, 1)")}}}', "that are not finite: /M"),
        (f'#usda 1.0\ndef Mesh "M" {{{SQUARE.replace("[4]", "[5]")}}}', "vertices that are not there: /M"),
        (f'#usda 1.0\ndef Mesh "M" {{{SQUARE.replace("0, -1)", "0, 1)")}}}', "some area"),
        ('#usda 1.0\ndef "R" (prepend references = @gone.usda@) {}\n', r"missing: gone.usda"),
    ],
)  # fmt: skip
def test_a_broken_usd_file_is_refused_in_one_line(
    tmp_path: Path, content: str, text: str, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "broken.usda").write_text(content)
    with pytest.raises(UserError, match=text):
        import_scene(tmp_path / "broken.usda", tmp_path / "out")
    assert not (tmp_path / "out").exists() and capfd.readouterr().err == ""


# --- Blender


def test_lamps_of_blender_have_its_measures(tmp_path: Path) -> None:
    """As Cycles renders them; z up becomes y up, and a unit of half a metre makes lamps smaller, not dimmer to see."""
    turned = blend._T_GLB_BLENDER.copy()
    turned[:3] *= 0.5
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]

    def lamp(kind: str, **more: Any) -> Any:
        return blend.lamp_of(
            {"kind": kind, "value": [8, 4, 2], "T_blender_light": pose.tolist(), **more}, turned, tmp_path
        )

    area = lamp("rectangle", size=[2.0, 3.0])
    np.testing.assert_allclose(area.value, np.array([8, 4, 2]) / (np.pi * 6))
    np.testing.assert_allclose(area.T_world_lamp[:3, 3], [0.5, 1.5, -1])
    np.testing.assert_allclose(area.T_world_lamp @ [1, 1, 0, 1], [0.5 + 0.5, 1.5, -1 - 0.75, 1])
    np.testing.assert_allclose(area.T_world_lamp[:3, 2] / 0.5, [0, 1, 0], atol=1e-12)  # shines down, along -z
    np.testing.assert_allclose(lamp("disk", size=[2.0, 2.0]).value, np.array([8, 4, 2]) / np.pi**2)
    np.testing.assert_allclose(lamp("point").value, np.array([2, 1, 0.5]) / (4 * np.pi))
    spot = lamp("spot", cone_deg=30.0, blend=0.25)
    assert spot.cone_deg == pytest.approx((30.0, 22.5)) and np.linalg.det(spot.T_world_lamp[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(lamp("directional").value, [8, 4, 2])
    sky = lamp("sky").T_world_lamp[:3, :3]
    np.testing.assert_allclose(sky @ [0, 1, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(sky @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # the picture's middle is Blender's x axis


@needs_blender
def test_a_blender_file_comes_with_modifiers_colours_and_light_and_without_its_scripts(tmp_path: Path) -> None:
    script = tmp_path / "make.py"
    script.write_text(f"""
import os, bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_plane_add(size=4)
plane = bpy.context.object
paint = bpy.data.materials.new("paint")
paint.use_nodes = True
nodes = paint.node_tree.nodes
nodes.clear()
matte, out = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
matte.inputs[0].default_value = (0.2, 0.5, 0.8, 1)
paint.node_tree.links.new(matte.outputs[0], out.inputs[0])
plane.data.materials.append(paint)
bpy.ops.mesh.primitive_cube_add(size=1, location=(4, 0, 0.5))
array = bpy.context.object.modifiers.new("array", "ARRAY")
array.count, array.relative_offset_displace = 3, (0, 2, 0)
bpy.ops.mesh.primitive_cube_add(size=1, location=(40, 0, 0))
bpy.context.object.hide_render = True
light = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
light.data.energy, light.rotation_euler = 3, (1.0471975512, 0, 0)
bpy.context.collection.objects.link(light)
bpy.context.scene.unit_settings.scale_length = 0.5
text = bpy.data.texts.new("evil.py")
text.write("open({str(tmp_path / "was_run")!r}, 'w')")
text.use_module = True
bpy.ops.wm.save_as_mainfile(filepath={str(tmp_path / "made.blend")!r})
os._exit(0)
""")
    subprocess.run([sys.executable, str(script)], check=True, capture_output=True)
    scene, notes = imported(tmp_path / "made.blend")
    vertices, faces = surface(scene)
    assert len(faces) == 2 + 3 * 12 and not (tmp_path / "was_run").exists()
    np.testing.assert_allclose(vertices.min(axis=0), [-1, 0, -2.25], atol=1e-6)  # y of Blender runs to -z
    np.testing.assert_allclose(vertices.max(axis=0), [2.25, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(brightness(scene), np.array([0.2, 0.5, 0.8]) * 3 * 0.5 / np.pi, rtol=1e-3)
    assert any("'paint' read by its Diffuse BSDF" in line for line in notes)


@needs_blender
def test_what_is_no_blender_file_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "broken.blend").write_bytes(b"BLENDER-v402REND" + bytes(40))
    with pytest.raises(UserError, match="Blender cannot read it"):
        import_scene(tmp_path / "broken.blend", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_colours_survive_as_bytes() -> None:
    """What the PNGs rest on: sRGB's bytes, decoded and encoded again, are the same bytes."""
    codes = np.arange(256)
    np.testing.assert_array_equal(np.round(srgb.encode(srgb.decode(codes / 255)) * 255), codes)
