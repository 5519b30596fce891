"""USD scenes as Mitsuba's: where things are, what colour and how bright, and which files are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from usd_scenes import (
    MATTE,
    SQUARE,
    albedo,
    brightness,
    canonical,
    imported,
    material,
    needs_usd,
    square,
    triangles,
    usda,
)

from rsgen.errors import UserError
from rsgen.formats.scenes.import_scene import import_scene
from rsgen.scene.meshes import surface

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
