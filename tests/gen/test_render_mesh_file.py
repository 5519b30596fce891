"""Mesh files with their own colours, against the same content written for Mitsuba by hand, and in the right place."""

from __future__ import annotations

import base64
import json
import re
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image
from rendering import mi
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from rsgen import srgb
from rsgen.config.config import LightConfig, load_config
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.light.bake import bake
from rsgen.render.baked import BakedIntegrator
from rsgen.render.images import ColorRenderer, DepthRenderer
from rsgen.render.irradiance import make_field, make_lattice
from rsgen.render.mesh_files.default_light import Probe
from rsgen.render.mesh_files.mesh_file import MeshOptions
from rsgen.render.scene import content_hash, load_scene, mesh_arrays, surface

WIDTH, HEIGHT, FOCAL = 80, 60, 70.0
CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
# One bounce, by rays from the surface: without noise under a uniform sky.
DIRECT = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": 0.8}}
AXES = {"x": 0, "y": 1, "z": 2}
# What is up in these glTF files is along the world's z, from where they are looked at.
TURNED = MeshOptions(up="-z")


def looking(eye: Any, target: Any) -> np.ndarray:
    """T_world_cam (4, 4) of a camera at `eye`, z towards `target`, y down."""
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3] = np.column_stack([x, np.cross(z, x), z, eye])
    return T


def ours(scene: Any, T_world_cam: np.ndarray, integrator: Any, spp: int = 64) -> np.ndarray:
    """sRGB (h, w, 3) by our renderer."""
    poses = lambda t: np.tile(T_world_cam, (len(t), 1, 1))  # noqa: E731
    linear = ColorRenderer(scene, integrator, CAMERA, Shutter(), spp).render(poses, 0.0, 1)
    return srgb.encode(np.clip(linear, 0, 1))


def stock(scene: Any, T_world_cam: np.ndarray, integrator: dict[str, Any], spp: int = 64) -> np.ndarray:
    """sRGB (h, w, 3) by Mitsuba's camera and integrator."""
    turned = T_world_cam @ np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's cameras have x to the left, y up
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    fov = float(np.degrees(2 * np.arctan(WIDTH / 2 / FOCAL)))
    camera = {"type": "perspective", "fov": fov, "to_world": mi.ScalarTransform4f(turned), "film": film}
    image = mi.render(scene, sensor=mi.load_dict(camera), integrator=mi.load_dict(integrator), spp=spp)
    return srgb.encode(np.clip(np.array(image)[..., :3], 0, 1))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def baked(scene: Any, texel_m: float = 0.2) -> BakedIntegrator:
    light = LightConfig(texel_m=texel_m, direct_samples=256, gather_rays=64, bounces=2)
    lattice = make_lattice(scene, texel_m)
    return BakedIntegrator(make_field(lattice, *bake(scene, lattice, light, no_progress)))


def picture(seed: int, size: int = 16) -> np.ndarray:
    """A smooth picture (size, size, 3) uint8 that is like none of its turned or mirrored selves."""
    coarse = np.random.default_rng(seed).integers(30, 230, (4, 4, 3), dtype=np.uint8)
    return cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)


def quad(*corners: Any) -> dict[str, Any]:
    """Vertices, faces and upright texture coordinates (v up) of a quad: lower left, lower right, upper right, left."""
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    return {"vertices": np.array(corners, float), "faces": np.array([[0, 1, 2], [0, 2, 3]]), "uv": uv}


def textured(shape: dict[str, Any], **material: Any) -> trimesh.Trimesh:
    how = {"metallicFactor": 0.0, "roughnessFactor": 1.0} | material
    visual = TextureVisuals(uv=shape["uv"], material=PBRMaterial(**how))
    return trimesh.Trimesh(shape["vertices"], shape["faces"], visual=visual, process=False)


def obj_text(shape: dict[str, Any], T: np.ndarray) -> str:
    """The quad as an OBJ file, which Mitsuba reads by itself."""
    p = shape["vertices"] @ T[:3, :3].T + T[:3, 3]
    lines = [f"v {x} {y} {z}" for x, y, z in p] + [f"vt {u} {v}" for u, v in shape["uv"]]
    return "\n".join([*lines, *(f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in shape["faces"] + 1), ""])


def write_gltf(path: Path, arrays: dict[str, np.ndarray], material: dict[str, Any] | None, **more: Any) -> Path:
    """A .gltf of one primitive: attributes and `indices`; `more` goes into the JSON as it stands."""
    data, views, accessors, attributes = b"", [], [], {}
    for name, array in arrays.items():
        kind = {np.dtype("f4"): 5126, np.dtype("u4"): 5125, np.dtype("u1"): 5121}[array.dtype]
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        shape = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        accessors.append({"bufferView": len(accessors), "componentType": kind, "count": len(array), "type": shape})
        attributes[name] = len(accessors) - 1
        data += array.tobytes() + b"\0" * (-array.nbytes % 4)
    primitive = {"attributes": attributes, "indices": attributes.pop("indices")}
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    header = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": len(data), "uri": uri}], "bufferViews": views,
        "accessors": accessors, "meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}], "scene": 0,
    }  # fmt: skip
    if material is not None:
        primitive["material"] = 0
        header["materials"] = [material]
    path.write_text(json.dumps(header | more))
    return path


def flat_arrays() -> dict[str, np.ndarray]:
    """A square of 2 x 2 m at height 0 (glTF's y) with texture coordinates (v down), seen from above as its picture."""
    position = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    indices = np.array([0, 1, 2, 0, 2, 3], np.uint32)
    return {"POSITION": position, "TEXCOORD_0": uv, "indices": indices}


def png_uri(image: np.ndarray) -> str:
    channels = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    return "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", cv2.cvtColor(image, channels))[1]).decode()


def with_image(image: np.ndarray, **more: Any) -> dict[str, Any]:
    return {"images": [{"uri": png_uri(image)}], "textures": [{"source": 0}]} | more


def seen_from_above(scene: Any, xy: np.ndarray) -> tuple[Any, Any]:
    """Interactions (n of them) of rays straight down at (x, y), and the BSDFs there."""
    o = np.column_stack([xy, np.full(len(xy), 50.0)]).astype(np.float32)
    d = np.tile(np.array([[0], [0], [-1]], np.float32), (1, len(xy)))
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d))
    si = scene.ray_intersect(ray)
    return si, si.bsdf(ray)


def albedo(scene: Any, xy: np.ndarray) -> np.ndarray:
    si, bsdf = seen_from_above(scene, xy)
    return np.array(bsdf.eval_diffuse_reflectance(si)).reshape(3, -1).T


# --- images


def test_a_glb_renders_as_the_same_content_written_by_hand(tmp_path: Path) -> None:
    """Textures with factors, instances, a mirrored one among them, and the y axis up, in baked light and traced."""
    floor = quad((-2, 0, 2), (2, 0, 2), (2, 0, -2), (-2, 0, -2))
    stand = quad((-0.5, 0, 0), (0.5, 0, 0), (0.5, 1, 0), (-0.5, 1, 0))
    factor = np.array([0.8, 0.6, 1.0])
    scene = trimesh.Scene()
    pictures = picture(1), picture(2)
    scene.add_geometry(textured(floor, baseColorTexture=Image.fromarray(pictures[0])), geom_name="floor")
    card = textured(stand, baseColorTexture=Image.fromarray(pictures[1]), baseColorFactor=[*factor, 1.0])
    poses = [trimesh.transformations.rotation_matrix(a, [0, 1, 0]) for a in (0.4, -0.5, 0.0)]
    poses[0][:3, 3], poses[1][:3, 3], poses[2][:3, 3] = (-0.9, 0.1, 0.2), (0.6, 0.05, 0.5), (0.1, 0.1, -1.0)
    poses[2] = poses[2] @ np.diag([-1.2, 1.2, 1.2, 1.0])
    for k, T in enumerate(poses):
        scene.add_geometry(card, geom_name="card" if k == 0 else None, transform=T, node_name=f"card {k}")
    path = tmp_path / "room.glb"
    scene.export(path)

    T_world_file = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    by_hand: dict[str, Any] = {"type": "scene", "sky": SKY}
    for k, (shape, image, tint, T) in enumerate(
        [(floor, pictures[0], np.ones(3), np.eye(4))] + [(stand, pictures[1], factor, T) for T in poses]
    ):
        (tmp_path / f"{k}.obj").write_text(obj_text(shape, T_world_file @ T))
        linear = (srgb.decode(image / 255) * np.round(tint * 255) / 255).astype(np.float32)
        paint = {"type": "bitmap", "bitmap": mi.Bitmap(linear), "raw": True}
        matte = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": paint}}
        by_hand[f"shape{k}"] = {"type": "obj", "filename": str(tmp_path / f"{k}.obj"), "face_normals": True, "b": matte}
    T_world_cam = looking((0.8, -4.5, 2.2), (0, 0, 0.4))
    loaded, reference = load_scene(path, options=TURNED), mi.load_dict(by_hand, optimize=False)
    traced = psnr(ours(loaded, T_world_cam, mi.load_dict(DIRECT), 256), stock(reference, T_world_cam, DIRECT, 256))
    assert traced > 40
    expected = stock(reference, T_world_cam, {"type": "path", "max_depth": 5}, 512)
    by_baked_light = psnr(ours(loaded, T_world_cam, baked(loaded, 0.1)), expected)
    assert by_baked_light > 36
    plain = psnr(expected, np.broadcast_to(expected.mean(axis=(0, 1)), expected.shape))
    assert plain < 20  # the pictures decide, not the sky


def test_a_ply_with_vertex_colours_renders_as_written_by_hand(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(3, 1.0)
    p = np.asarray(ball.vertices)
    colors = np.round(128 + 100 * np.sin(p @ np.array([[3, 1, 0], [0, 3, 1], [1, 0, -3.0]]))).astype(np.uint8)
    ball.visual.vertex_colors = np.column_stack([colors, np.full(len(p), 255, np.uint8)])
    ball.export(tmp_path / "ball.ply", vertex_normal=False)
    rows = np.concatenate([p, ((colors / 255 + 0.055) / 1.055) ** 2.4], axis=1)
    assert colors.min() > 20  # above the straight foot of sRGB's curve
    header = [f"element vertex {len(p)}", *(f"property float {name}" for name in "xyzrgb")]
    header += [f"element face {len(ball.faces)}", "property list uchar int vertex_indices", "end_header"]
    lines = [" ".join(f"{x:.9g}" for x in row) for row in rows] + [f"3 {a} {b} {c}" for a, b, c in ball.faces]
    (tmp_path / "by_hand.ply").write_text("\n".join(["ply", "format ascii 1.0", *header, *lines, ""]))
    paint = {"type": "mesh_attribute", "name": "vertex_color"}
    shape = {"type": "ply", "filename": str(tmp_path / "by_hand.ply"), "face_normals": True}
    shape["bsdf"] = {"type": "diffuse", "reflectance": paint}
    reference = mi.load_dict({"type": "scene", "sky": SKY, "shape": shape}, optimize=False)
    loaded, T_world_cam = load_scene(tmp_path / "ball.ply"), looking((1.5, -2.5, 1.2), (0, 0, 0))
    expected = stock(reference, T_world_cam, DIRECT, 256)
    traced = psnr(ours(loaded, T_world_cam, mi.load_dict(DIRECT), 256), expected)
    assert traced > 40
    by_baked_light = psnr(ours(loaded, T_world_cam, baked(loaded)), expected)
    assert by_baked_light > 40


def test_shiny_surfaces_look_the_same_traced_and_in_baked_light(tmp_path: Path) -> None:
    """Balls of plastic, of metal and of something between."""
    scene = trimesh.Scene([textured(quad((-2, -0.55, 2), (2, -0.55, 2), (2, -0.55, -2), (-2, -0.55, -2)))])
    for k, (metallic, roughness) in enumerate([(0.0, 0.4), (1.0, 0.5), (0.5, 0.6)]):
        ball = trimesh.creation.icosphere(3, 0.4)
        shiny = PBRMaterial(baseColorFactor=[200, 120, 60, 255], metallicFactor=metallic, roughnessFactor=roughness)
        visual = TextureVisuals(uv=np.zeros((len(ball.vertices), 2)), material=shiny)
        smooth = trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=ball.vertices / 0.4, visual=visual)
        scene.add_geometry(smooth, transform=trimesh.transformations.translation_matrix([k - 1, -0.1, 0]))
    scene.export(tmp_path / "balls.glb", include_normals=True)
    loaded = load_scene(tmp_path / "balls.glb", options=TURNED)
    T_world_cam = looking((0.8, -2.4, 0.8), (0, 0, -0.1))
    expected = stock(loaded, T_world_cam, {"type": "path", "max_depth": 6}, 512)
    value = psnr(ours(loaded, T_world_cam, baked(loaded, 0.1), 32), expected)
    assert value > 35


# --- colours and textures


def test_colours_of_a_gltf_are_linear_and_factors(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    colors = np.array([[0.02, 0.5, 0.9], [0.4, 0.1, 0.3], [0.4, 0.1, 0.3], [0.02, 0.5, 0.9]], np.float32)
    arrays = flat_arrays() | {"COLOR_0": colors}
    left, factor = np.array([[-0.999, 0.0]]), [0.5, 1.0, 0.25, 1.0]
    plain = load_scene(write_gltf(tmp_path / "plain.gltf", arrays, None), options=TURNED)
    np.testing.assert_allclose(albedo(plain, left)[0], colors[0], atol=1e-3)
    tinted = {"pbrMetallicRoughness": {"baseColorFactor": factor, "metallicFactor": 0}}
    scene = load_scene(write_gltf(tmp_path / "tinted.gltf", arrays, tinted), options=TURNED)
    np.testing.assert_allclose(albedo(scene, left)[0], colors[0] * factor[:3], atol=1e-3)
    # Bytes are fractions of 255, also linear.
    arrays["COLOR_0"] = np.tile(np.array([51, 102, 204, 255], np.uint8), (4, 1))
    scene = load_scene(write_gltf(tmp_path / "bytes.gltf", arrays, tinted), options=TURNED)
    np.testing.assert_allclose(albedo(scene, left)[0], [0.1, 0.4, 0.2], rtol=1e-4)
    # One colour for all vertices is a factor on a texture too; several are not, which is said.
    papered = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0}}
    white = with_image(np.full((2, 2, 3), 255, np.uint8))
    scene = load_scene(write_gltf(tmp_path / "papered.gltf", arrays, papered, **white), options=TURNED)
    np.testing.assert_allclose(albedo(scene, left)[0], [0.2, 0.4, 0.8], rtol=1e-3)
    arrays["COLOR_0"] = colors
    with caplog.at_level("WARNING"):
        scene = load_scene(write_gltf(tmp_path / "both.gltf", arrays, papered, **white), options=TURNED)
    assert "vertex colours of 'GLTF' left out" in caplog.text
    np.testing.assert_allclose(albedo(scene, left)[0], 1, rtol=1e-3)
    del arrays["COLOR_0"]
    scene = load_scene(write_gltf(tmp_path / "grey.gltf", arrays, None), options=TURNED)
    np.testing.assert_allclose(albedo(scene, left)[0], 0.6, rtol=1e-5)


def test_colours_of_faces_and_of_an_obj(tmp_path: Path) -> None:
    mesh = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.visual.face_colors = [[200, 40, 90, 255], [10, 120, 250, 255]]
    mesh.export(tmp_path / "faces.ply")
    where = np.array([[0.5, -0.5], [-0.5, 0.5]])
    expected = srgb.decode(np.array([[200, 40, 90], [10, 120, 250]]) / 255)
    np.testing.assert_allclose(albedo(load_scene(tmp_path / "faces.ply"), where), expected, rtol=1e-4)
    (tmp_path / "two.obj").write_text(
        "mtllib a.mtl\nmtllib b.mtl\nv -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "usemtl plain\nf 1/1 2/2 3/3\nusemtl papered\nf 1/1 3/3 4/4\n"
    )
    (tmp_path / "a.mtl").write_text("newmtl plain\nKd 0.1 0.2 0.3\nKe 1 2 3\n")
    (tmp_path / "b.mtl").write_text("newmtl papered\nKd 0 0 0\nmap_Kd paper.png\n")
    Image.fromarray(np.full((2, 2, 3), (30, 90, 200), np.uint8)).save(tmp_path / "paper.png")
    scene = load_scene(tmp_path / "two.obj")
    expected = np.array([[0.1, 0.2, 0.3], srgb.decode(np.array([30, 90, 200]) / 255)])
    np.testing.assert_allclose(albedo(scene, where), expected, rtol=1e-3)
    si, _ = seen_from_above(scene, where)
    glow = np.array(si.emitter(scene).eval(si)).T
    np.testing.assert_allclose(glow, [[1, 2, 3], [0, 0, 0]])


def test_textures_lie_as_gltf_says(tmp_path: Path) -> None:
    """Orientation, wrap modes, the nearest texel, second coordinates and transforms, by a picture of four colours."""
    image = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    red, green, blue, white = [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]
    quarters = np.array([[-0.5, 0.5], [0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])

    def colors(info: dict[str, Any], arrays: dict[str, np.ndarray], xy: np.ndarray = quarters, **sampler: int) -> Any:
        pbr = {"baseColorTexture": {"index": 0} | info, "metallicFactor": 0.0}
        more = with_image(image, samplers=[{"magFilter": 9728} | sampler], textures=[{"source": 0, "sampler": 0}])
        path = write_gltf(tmp_path / "scene.gltf", arrays, {"pbrMetallicRoughness": pbr}, **more)
        return albedo(load_scene(path, options=TURNED), xy).round(3).tolist()

    arrays = flat_arrays()
    assert colors({}, arrays) == [red, green, blue, white]
    twice = arrays | {"TEXCOORD_0": arrays["TEXCOORD_0"] * 2}
    x = np.column_stack([[-0.75, -0.25, 0.25, 0.75], np.full(4, 0.75)])
    assert colors({}, twice, x) == [red, green, red, green]
    assert colors({}, twice, x, wrapS=33071, wrapT=33071) == [red, green, green, green]
    assert colors({}, twice, x, wrapS=33648, wrapT=33648) == [red, green, green, red]
    other = arrays | {"TEXCOORD_1": arrays["TEXCOORD_0"][[1, 0, 3, 2]]}
    assert colors({"texCoord": 1}, other) == [green, red, white, blue]
    # The extension's own two examples: the lower left quarter, turned clockwise by 90 degrees; and v upside down.
    turned = {"extensions": {"KHR_texture_transform": {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}}}
    assert colors(turned, arrays) == [blue] * 4
    upside = {"extensions": {"KHR_texture_transform": {"offset": [0, 1], "scale": [1, -1]}}}
    assert colors(upside, arrays) == [blue, white, red, green]


def test_what_metal_normals_and_emission_become(tmp_path: Path) -> None:
    flags, middle = mi.BSDFFlags, np.array([[0.1, 0.3]])

    def lobes(**pbr: Any) -> tuple[bool, bool]:
        path = write_gltf(tmp_path / "scene.gltf", flat_arrays(), {"pbrMetallicRoughness": pbr})
        scene = load_scene(path, options=TURNED)
        both = int(seen_from_above(scene, middle)[1].flags()[0])
        return bool(both & int(flags.DiffuseReflection)), bool(both & int(flags.GlossyReflection))

    assert lobes(metallicFactor=0) == (True, False)
    assert lobes(metallicFactor=0, roughnessFactor=0.3) == (True, True)
    assert lobes() == (False, True)  # metal is the standard's default
    assert lobes(metallicFactor=0.5) == (True, True)

    # A normal map that leans to the right of the picture, and glows with strength.
    lean = np.array([0.6, 0.0, 0.8])
    image = np.tile(np.round((lean + 1) * 127.5).astype(np.uint8), (2, 2, 1))
    material = {
        "normalTexture": {"index": 0}, "pbrMetallicRoughness": {"metallicFactor": 0.0},
        "emissiveFactor": [0.1, 0.2, 1.0],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 3.0}},
    }  # fmt: skip
    scene = load_scene(write_gltf(tmp_path / "lean.gltf", flat_arrays(), material, **with_image(image)), options=TURNED)
    si, bsdf = seen_from_above(scene, np.tile(middle, (2, 1)))
    np.testing.assert_allclose(np.array(si.emitter(scene).eval(si)).T[0], [0.3, 0.6, 3.0], rtol=1e-5)
    wo = si.to_local(mi.Vector3f(np.array([[0.6, -0.6], [0, 0], [0.8, 0.8]], np.float32)))
    towards, away = np.array(bsdf.eval(mi.BSDFContext(), si, wo))[0]
    assert towards == pytest.approx(1 / np.pi, rel=0.02) and away == pytest.approx(0.28 / np.pi, rel=0.05)


# --- what a mask hides


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
def test_what_a_mask_hides_is_not_there(tmp_path: Path, mode: str) -> None:
    """A disc of 0.7 m in a square of 2 m: in depth, for rays and in its area."""
    size, radius = 64, 0.7
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    soft = np.clip(0.5 + (radius - np.hypot(x - 0.1, y)) * 8, 0, 1)  # 0.5 on the rim
    image = np.dstack([np.full((size, size, 3), 200), np.round(255 * soft)]).astype(np.uint8)
    pbr = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0}
    material = {"pbrMetallicRoughness": pbr, "alphaMode": mode}
    path = write_gltf(tmp_path / "disc.gltf", flat_arrays(), material, **with_image(image))
    scene = load_scene(path, options=TURNED)
    vertices, faces = surface(scene)
    assert trimesh.Trimesh(vertices, faces).area == pytest.approx(np.pi * radius**2, rel=1.5e-3)
    xy = np.random.default_rng(1).uniform(-1, 1, (4000, 2))
    hit = np.array(seen_from_above(scene, xy)[0].is_valid())
    distance = np.hypot(xy[:, 0] - 0.1, xy[:, 1])
    sure = np.abs(distance - radius) > 1 / size
    np.testing.assert_array_equal(hit[sure], distance[sure] < radius)
    T_world_cam = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 5], [0, 0, 0, 1.0]])
    z = DepthRenderer(scene, CAMERA, Shutter()).render(lambda t: np.tile(T_world_cam, (len(t), 1, 1)), 0.0)
    rays = CAMERA.unproject(CAMERA.pixel_grid()) * 5
    off = np.hypot(rays[..., 0] - 0.1, rays[..., 1]) - radius
    np.testing.assert_allclose(z[off < -0.04], 5, rtol=1e-5)
    assert not z[off > 0.04].any()
    # An opaque material takes no notice of alpha.
    del material["alphaMode"]
    whole = load_scene(write_gltf(path, flat_arrays(), material, **with_image(image)), options=TURNED)
    assert len(surface(whole)[1]) == 2
    # Where the picture repeats, so do its holes.
    material["alphaMode"] = mode
    arrays = flat_arrays()
    arrays["TEXCOORD_0"] *= 3
    vertices, faces = surface(load_scene(write_gltf(path, arrays, material, **with_image(image)), options=TURNED))
    assert trimesh.Trimesh(vertices, faces).area == pytest.approx(np.pi * radius**2, rel=1e-2)


# --- where things are


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_scale_and_up_place_every_point(tmp_path: Path, up: Any) -> None:
    rng = np.random.default_rng(8)
    mesh = trimesh.creation.icosphere(1)
    mesh.vertices *= rng.uniform(0.5, 2.0, (len(mesh.vertices), 1)) * [1, 2, 3]
    mesh.export(tmp_path / "blob.stl")
    scene = load_scene(tmp_path / "blob.stl", options=MeshOptions(scale=0.25, up=up))
    axis, sign = up[-1], -1 if up[0] == "-" else 1
    vertices, faces = surface(scene)
    heights = np.sort(vertices[faces][..., 1].ravel())
    np.testing.assert_allclose(heights, np.sort(0.25 * sign * mesh.triangles[..., AXES[axis]].ravel()), atol=1e-5)
    # A rotation: nothing is mirrored. Rays from outside then meet what trimesh says they meet.
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(mesh.volume * 0.25**3, rel=1e-4)
    R = np.array(_rotation(axis, sign), float)
    moved = trimesh.Trimesh(0.25 * mesh.vertices @ R.T, mesh.faces, process=False)
    direction = rng.normal(size=(500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = rng.normal(scale=0.1, size=(500, 3)) - 4 * direction
    ray = mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(direction.T.astype(np.float32)))
    points, which, _ = moved.ray.intersects_location(origin, direction, multiple_hits=False)
    assert len(which) > 400
    np.testing.assert_allclose(np.array(scene.ray_intersect(ray).p).T[which], points, atol=1e-4)


def _rotation(axis: str, sign: int) -> Any:
    """The rotation by a quarter turn about a horizontal axis, or by a half turn about x, that takes sign·axis to y."""
    if axis == "y":
        return np.diag([1, sign, sign])
    about = np.cross(np.eye(3)[AXES[axis]] * sign, [0, 1.0, 0])
    return np.round(trimesh.transformations.rotation_matrix(np.pi / 2, about)[:3, :3])


def test_shapes_are_in_one_order_whatever_their_nodes_are_called(tmp_path: Path) -> None:
    """trimesh names nodes of meshes of several primitives at random."""
    first, second = flat_arrays(), np.array([0, 1, 2], np.uint32)
    path = write_gltf(tmp_path / "scene.gltf", first | {"half": second}, None)
    header = json.loads(path.read_text())
    primitive = header["meshes"][0]["primitives"][0]
    half = primitive["attributes"].pop("half")
    header["meshes"][0]["primitives"] = [
        primitive,
        {"attributes": primitive["attributes"], "indices": half, "material": 0},
    ]
    header["nodes"] = [{"mesh": 0, "translation": [0, k, 0], "scale": [1, 1, -1 if k == 2 else 1]} for k in range(4)]
    header["scenes"] = [{"nodes": [3, 1, 0, 2]}]
    header["materials"] = [{}]
    path.write_text(json.dumps(header))
    scenes = [[mesh_arrays(shape) for shape in load_scene(path, options=TURNED).shapes()] for _ in range(6)]
    assert [len(faces) for _, faces in scenes[0]] == [8, 4]  # one shape a material
    for other in scenes[1:]:
        for (v, f), (v0, f0) in zip(other, scenes[0], strict=True):
            np.testing.assert_array_equal(v, v0)
            np.testing.assert_array_equal(f, f0)
    vertices, faces = scenes[0][0]
    corners = vertices[faces]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert (up > 0).all()  # mirrored ones are not turned over


def test_normals_turn_with_their_surfaces(tmp_path: Path) -> None:
    """Under mirrors and uneven scales; a file without normals is flat."""
    ball = trimesh.creation.icosphere(3)
    smooth = trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=np.array(ball.vertices), process=False)
    for normals in (True, False):
        scene = trimesh.Scene()
        T = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]) @ np.diag([-1.0, 2.0, 0.5, 1.0])
        scene.add_geometry(smooth, transform=T)
        scene.export(tmp_path / "ball.glb", include_normals=normals)
        loaded = load_scene(tmp_path / "ball.glb", options=MeshOptions())
        si, _ = seen_from_above(loaded, np.random.default_rng(2).uniform(-0.4, 0.4, (500, 2)))
        # The ellipsoid's own normal is the gradient of |T⁻¹ p|².
        gradient = np.array(si.p).T @ np.linalg.inv(T[:3, :3] @ T[:3, :3].T)
        cosine = np.einsum("ij,ij->i", np.array(si.sh_frame.n).T, gradient) / np.linalg.norm(gradient, axis=1)
        if normals:
            assert cosine.min() > 0.9995
        else:
            assert 0.95 < cosine.min() < 0.9995
            np.testing.assert_allclose(np.array(si.sh_frame.n), np.array(si.n), atol=1e-6)


# --- light


def room(open_top: bool = False) -> trimesh.Trimesh:
    """A room of 4 x 5 x 2.5 m whose walls face inwards, with a block in its middle."""
    walls = trimesh.creation.box((4, 5, 2.5))
    walls.invert()
    if open_top:
        walls.update_faces(walls.triangles_center[:, 2] < 1.2)
    block = trimesh.creation.box((0.6, 0.6, 0.6))
    return trimesh.util.concatenate([walls, block])


def test_rooms_get_lamps_and_objects_a_sky(tmp_path: Path) -> None:
    files = {}
    crooked = room()
    crooked.faces[:4] = crooked.faces[:4, ::-1]  # two walls turned over
    meshes = {"room": room(), "crooked": crooked, "open": room(open_top=True), "ball": trimesh.creation.icosphere(2)}
    for name, mesh in (meshes | {"turned": trimesh.creation.box((4, 5, 2.5))}).items():
        mesh.export(tmp_path / f"{name}.ply")
        files[name] = tmp_path / f"{name}.ply"

    def lights(name: str, light: Any = "auto") -> list[bool]:
        return [
            bool(e.is_environment())
            for e in load_scene(files[name], options=MeshOptions(up="z", light=light)).emitters()
        ]

    assert lights("ball") == [True] and lights("open") == [True] and lights("turned") == [True]
    assert lights("room") == lights("crooked") == [False] * 2  # one for each 2.5 m
    assert lights("room", "sky") == [True] and lights("room", "none") == []
    assert lights("turned", "ceiling") == [False] * 2  # walls that face outwards: an object, unless one says so
    with pytest.raises(UserError, match=r"open\.ply: has no ceiling.*scene\.light"):
        load_scene(files["open"], options=MeshOptions(up="z", light="ceiling"))
    bare = room(open_top=True)
    assert not Probe(mi, np.array(bare.vertices), np.array(bare.faces)).encloses()
    scene = load_scene(files["room"], options=MeshOptions(up="z"))
    lamps = [shape for shape in scene.shapes() if shape.is_emitter()]
    for shape in lamps:
        vertices, faces = mesh_arrays(shape)
        assert 1.0 < vertices[:, 1].min() < 1.25 and np.abs(vertices[:, [0, 2]]).max() < 2.5
        a, b, c = vertices[faces[0]]
        assert np.cross(b - a, c - a)[1] < 0  # shining down
    # The floor is about as bright as a sky would make it in the open.
    field = baked(scene, 0.5)
    poses = looking((1.5, 0.3, 2.0), (-1.5, -0.9, -2.0))
    seen = ours(scene, poses, field, 4)
    assert 0.3 < np.median(seen) < 0.95


# --- what goes wrong


def fails(path: Path, *words: str) -> None:
    with pytest.raises(UserError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 400 and path.name in message
    for word in words:
        assert re.search(word, message), f"{word!r} is not in: {message}"


def test_broken_files_say_what_is_wrong_in_one_line(tmp_path: Path) -> None:
    arrays = flat_arrays()

    def gltf(name: str, change: dict[str, np.ndarray] | None = None, **more: Any) -> Path:
        return write_gltf(tmp_path / f"{name}.gltf", arrays | (change or {}), {}, **more)

    nan = arrays["POSITION"].copy()
    nan[1, 0] = np.nan
    fails(gltf("nan", {"POSITION": nan}), "not finite", "mend it")
    fails(gltf("flat", {"POSITION": np.zeros((4, 3), np.float32)}), "no triangles", "export")
    fails(gltf("far", {"POSITION": arrays["POSITION"] * np.float32(1e8)}), "beyond", "scene.scale")
    fails(gltf("index", {"indices": np.array([0, 1, 9], np.uint32)}), "faces without vertices", "export it again")
    fails(gltf("zero", nodes=[{"mesh": 0, "scale": [0, 0, 0]}]), "no triangles")
    fails(gltf("endless", nodes=[{"mesh": 0, "translation": [0, float("inf"), 0]}]), "JSON cannot be read")
    fails(gltf("draco", extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression", "without")
    fails(gltf("gone", images=[{"uri": "gone%20away.png"}]), "gone away.png", "missing")
    texture = {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}], "textures": [{"source": 0}]}
    fails(gltf("words", images=[{"uri": "data:image/png;base64,AAAA"}], **texture), "texture", "PNG")
    half = base64.b64encode(cv2.imencode(".png", picture(1, 64))[1].tobytes()[:900]).decode()
    fails(gltf("half", images=[{"uri": f"data:image/png;base64,{half}"}], **texture), "texture", "damaged")
    sparse = json.loads(gltf("sparse").read_text())["accessors"]
    sparse[0]["sparse"] = {"count": 0}
    fails(gltf("sparse", accessors=sparse), "sparse accessors", "export it without")
    for name, content in {
        "empty.glb": b"", "words.glb": b"this is not a scene, is it?", "empty.gltf": b"", "list.gltf": b"[]",
        "short.glb": struct.pack("<IIIII", 0x46546C67, 2, 999, 999, 0x4E4F534A), "hollow.gltf": b"{}",
    }.items():  # fmt: skip
        (tmp_path / name).write_bytes(content)
        fails(tmp_path / name)
    (tmp_path / "odd.gltf").write_text('{"asset": {"version": "2.0"}, "buffers": 3, "images": [4]}')
    fails(tmp_path / "odd.gltf")
    with pytest.raises(UserError, match=r"odd\.gltf: is malformed"):
        content_hash(tmp_path / "odd.gltf")
    (tmp_path / "b.obj").write_text("mtllib b.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n")
    (tmp_path / "b.mtl").write_text("newmtl m\nmap_Kd b.png\n")
    (tmp_path / "b.png").write_bytes(b"no picture")
    fails(tmp_path / "b.obj", "b.png' cannot be read", "PNG")
    (tmp_path / "a.obj").write_text("mtllib none.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    fails(tmp_path / "a.obj", "none.mtl", "missing", "put it there")


def test_triangles_without_area_are_left_out(tmp_path: Path) -> None:
    indices = np.array([0, 1, 2, 0, 2, 3, 0, 0, 1, 2, 2, 2], np.uint32)
    path = write_gltf(tmp_path / "scene.gltf", flat_arrays() | {"indices": indices}, None)
    assert len(surface(load_scene(path))[1]) == 2


# --- what the light is cached under, and the config


def test_the_content_hash_covers_files_and_placement(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd maps\\paint.png\n")
    (tmp_path / "maps").mkdir()
    paint = tmp_path / "maps" / "paint.png"
    Image.fromarray(np.full((2, 2, 3), 80, np.uint8)).save(paint)
    gltf = write_gltf(tmp_path / "b.gltf", flat_arrays(), {}, images=[{"uri": "maps/paint.png"}])
    seen = {content_hash(path) for path in (tmp_path / "a.obj", gltf)}
    assert seen == {content_hash(path) for path in (tmp_path / "a.obj", gltf)} and len(seen) == 2
    seen |= {content_hash(gltf, MeshOptions(**how)) for how in ({"scale": 2.0}, {"up": "x"}, {"light": "sky"})}
    assert len(seen) == 5
    Image.fromarray(np.full((2, 2, 3), 81, np.uint8)).save(paint)
    seen |= {content_hash(path) for path in (tmp_path / "a.obj", gltf)}
    assert len(seen) == 7
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 1 1\nmap_Kd maps\\paint.png\n")
    seen.add(content_hash(tmp_path / "a.obj"))
    assert len(seen) == 8
    load_scene(tmp_path / "a.obj")
    paint.unlink()
    for path in (tmp_path / "a.obj", gltf):
        with pytest.raises(UserError, match=r"paint\.png' that it names is missing"):
            content_hash(path)


def test_a_config_places_mesh_files_only(tmp_path: Path) -> None:
    (tmp_path / "t.yaml").write_text("name: t\ntrajectory: {file: t.txt}\nscene: {file: a.glb}\n")
    config = load_config(tmp_path / "t.yaml")
    assert config.content()["scene"] == {"file": "a.glb"}  # as sequences of older versions have it
    placed = load_config(tmp_path / "t.yaml", {"scene.scale": "0.01", "scene.up": "-y", "scene.light": "ceiling"})
    assert placed.content()["scene"] == {"file": "a.glb", "scale": 0.01, "up": "-y", "light": "ceiling"}
    for key, value in (("scene.scale", "0"), ("scene.scale", "-1"), ("scene.up", "w"), ("scene.light", "lamp")):
        with pytest.raises(UserError, match=key):
            load_config(tmp_path / "t.yaml", {key: value})
    for key, value in (("scale", "2"), ("up", "z"), ("light", "sky")):
        with pytest.raises(UserError, match=f"{key}: is for mesh files"):
            load_config(tmp_path / "t.yaml", {"scene.file": "a.xml", f"scene.{key}": value})
