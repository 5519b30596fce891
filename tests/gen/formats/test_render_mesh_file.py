"""Mesh files with their own colours, against the same content written for Mitsuba by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from mesh_files import (
    CAMERA,
    DIRECT,
    SKY,
    TURNED,
    albedo,
    baked,
    flat_arrays,
    looking,
    obj_text,
    ours,
    picture,
    psnr,
    quad,
    seen_from_above,
    stock,
    textured,
    with_image,
    write_gltf,
)
from PIL import Image
from rendering import mi
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from rsgen import srgb
from rsgen.geometry.shutter import Shutter
from rsgen.render.images import DepthRenderer
from rsgen.scene.loading import load_scene
from rsgen.scene.meshes import surface

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


@pytest.mark.nightly
def test_shiny_surfaces_look_the_same_traced_and_in_baked_light(tmp_path: Path) -> None:
    """Balls of plastic, of metal and of something between."""
    scene = trimesh.Scene([textured(quad((-2, -0.55, 2), (2, -0.55, 2), (2, -0.55, -2), (-2, -0.55, -2)))])
    for k, (metallic, roughness) in enumerate([(0.0, 0.4), (1.0, 0.5), (0.5, 0.6)]):
        ball = trimesh.creation.icosphere(2, 0.4)
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
