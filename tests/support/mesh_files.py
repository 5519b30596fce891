"""Mesh files of a few triangles, and how they are rendered."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from rendering import mi
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from rsgen import srgb
from rsgen.config.config import LightConfig
from rsgen.console.progress import no_progress
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.light.bake import bake
from rsgen.render.baked import BakedIntegrator
from rsgen.render.images import ColorRenderer
from rsgen.render.irradiance import IrradianceField, make_lattice
from rsgen.scene.placement import SceneOptions

WIDTH, HEIGHT, FOCAL = 80, 60, 70.0
CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
# One bounce, by rays from the surface: without noise under a uniform sky.
DIRECT = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": 0.8}}
AXES = {"x": 0, "y": 1, "z": 2}
# What is up in these glTF files is along the world's z, from where they are looked at.
TURNED = SceneOptions(up="-z")


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
    return BakedIntegrator(IrradianceField(lattice, *bake(scene, lattice, light, no_progress)))


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
