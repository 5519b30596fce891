"""The process that renders with Blender Cycles: `python -m benchmarks.rendering.blender_worker JOB` (see `blender`).

JOB holds job.json and job.npz. Each line on standard input asks for one picture and is answered by one line of JSON on
standard output, seconds and all. Blender's own chatter goes to standard error.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SENSOR_MM = 36.0
# Blender's cameras look along -z with y up, ours along z with y down.
_T_CAM_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])
# The camera's path between the shutter's opening and closing: 2^(steps - 1) straight pieces.
_MOTION_STEPS = 4


def main(folder: Path) -> None:
    """Build the scene of `folder`, then answer requests until standard input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    bpy: Any = importlib.import_module("bpy")
    job = json.loads((folder / "job.json").read_text())
    with np.load(folder / "job.npz") as arrays:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        for k, name in enumerate(job["meshes"]):
            _add_mesh(bpy, name, {key.rpartition("_")[0]: arrays[key] for key in arrays if key.endswith(f"_{k}")})
        _add_sky(bpy, job["sky"])
        _add_camera(bpy, job, [arrays[f"poses{k}"] for k in range(len(job["line_shares"]))])
    _configure(bpy, job)
    print(json.dumps({"version": bpy.app.version_string}), file=answers)
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps({"seconds": _render(bpy, job, **request)}), file=answers)


def _render(bpy: Any, job: dict[str, Any], exposure: int, picture: str | None) -> float:
    """Seconds that Blender takes for a picture, its own preparations included; writes it as EXR if there is a path."""
    scene = bpy.context.scene
    share = job["line_shares"][exposure]
    scene.cycles.rolling_shutter_type = "TOP" if share is not None and share < 1 else "NONE"
    scene.cycles.rolling_shutter_duration = share or 0.0
    scene.update_tag()  # or Cycles, which keeps its scene, goes on with the settings of the picture before
    scene.frame_set(2 * exposure)
    begin = time.perf_counter()
    bpy.ops.render.render()
    seconds = time.perf_counter() - begin
    if picture is not None:
        bpy.data.images["Render Result"].save_render(picture)
    return seconds


def _configure(bpy: Any, job: dict[str, Any]) -> None:
    """Plain path tracing with exactly the samples asked for; nothing clamped, denoised or stopped early."""
    scene = bpy.context.scene
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.resolution_percentage = job["width"], job["height"], 100
    render.pixel_aspect_x, render.pixel_aspect_y = max(1, job["fy"] / job["fx"]), max(1, job["fx"] / job["fy"])
    render.use_compositing = render.use_sequencer = False
    render.use_persistent_data = True  # later frames keep the scene, as our renderers do
    # For stills too, whose camera rests: Cycles crashes if this changes while it keeps a scene.
    render.use_motion_blur = any(share is not None for share in job["line_shares"])
    render.motion_blur_position, render.motion_blur_shutter = "START", 1.0
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_depth, render.image_settings.exr_codec = "32", "ZIP"
    settings = {
        "device": "CPU", "samples": job["spp"], "use_adaptive_sampling": False, "use_denoising": False,
        "pixel_filter_type": "BOX", "light_sampling_threshold": 0.0, "sample_clamp_indirect": 0.0,
        "blur_glossy": 0.0, "use_light_tree": False,  # the tree takes 1.4 times as long a sample
        "max_bounces": job["max_bounces"], "diffuse_bounces": job["max_bounces"],
    }  # fmt: skip
    for name, value in settings.items():
        setattr(cycles, name, value)


def _add_mesh(bpy: Any, name: str, arrays: dict[str, NDArray]) -> None:
    vertices, faces = arrays["vertices"], arrays["faces"]
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", faces.astype(np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(len(faces), "normals" in arrays))
    if "uv" in arrays:
        mesh.uv_layers.new().uv.foreach_set("vector", arrays["uv"][faces.ravel()].ravel())
    mesh.update(calc_edges=True)
    if "normals" in arrays:
        mesh.normals_split_custom_set_from_vertices(arrays["normals"])
    mesh.materials.append(_material(bpy, name, arrays["colour"], arrays.get("radiance")))
    item = bpy.data.objects.new(name, mesh)
    item.cycles.use_motion_blur = False
    bpy.context.collection.objects.link(item)


def _material(bpy: Any, name: str, colour: NDArray, radiance: NDArray | None) -> Any:
    """Lambertian, and for a lamp also glowing: on the front only, as Mitsuba's area lights do."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, link = material.node_tree.nodes, material.node_tree.links.new
    nodes.clear()
    surface = nodes.new("ShaderNodeBsdfDiffuse")
    _paint(bpy, nodes, link, surface.inputs["Color"], colour, f"{name} colour")
    if radiance is not None:
        emission, both, front = (nodes.new(f"ShaderNode{kind}") for kind in ("Emission", "AddShader", "Math"))
        _paint(bpy, nodes, link, emission.inputs["Color"], radiance, f"{name} radiance")
        front.operation, front.inputs[0].default_value = "SUBTRACT", 1.0
        link(front.inputs[1], nodes.new("ShaderNodeNewGeometry").outputs["Backfacing"])
        link(emission.inputs["Strength"], front.outputs[0])
        link(both.inputs[0], surface.outputs[0])
        link(both.inputs[1], emission.outputs[0])
        material.cycles.emission_sampling = "FRONT"
        surface = both
    link(nodes.new("ShaderNodeOutputMaterial").inputs["Surface"], surface.outputs[0])
    return material


def _paint(bpy: Any, nodes: Any, link: Any, socket: Any, colour: NDArray, name: str) -> None:
    """One linear colour (3,), or a picture (h, w, 3) whose first row lies at v = 0."""
    rgba = np.concatenate([colour.astype(np.float32), np.ones((*colour.shape[:-1], 1), np.float32)], axis=-1)
    if colour.ndim == 1:
        socket.default_value = rgba.tolist()
        return
    image = bpy.data.images.new(name, colour.shape[1], colour.shape[0], float_buffer=True, is_data=True)
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    link(socket, texture.outputs["Color"])


def _add_sky(bpy: Any, radiance: list[float]) -> None:
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = [*radiance, 1.0]
    background.inputs["Strength"].default_value = 1.0
    bpy.context.scene.world = world


def _add_camera(bpy: Any, job: dict[str, Any], poses: list[NDArray]) -> None:
    """The camera; exposure k, `poses[k]` (n, 4, 4) T_world_cam evenly spaced in time, fills Blender's frame 2 k."""
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", _SENSOR_MM
    lens.lens = _SENSOR_MM * job["fx"] / job["width"]
    lens.shift_x = 0.5 - (job["cx"] + 0.5) / job["width"]
    lens.shift_y = (job["cy"] + 0.5 - 0.5 * job["height"]) * job["fx"] / job["fy"] / job["width"]
    lens.clip_start, lens.clip_end = 1e-3, 1e4
    camera = bpy.data.objects.new("camera", lens)
    camera.rotation_mode = "QUATERNION"
    camera.cycles.motion_steps = _MOTION_STEPS
    bpy.context.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    matrix = importlib.import_module("mathutils").Matrix
    for k, T_world_cam in enumerate(poses):
        before = None
        path = np.broadcast_to(T_world_cam, (max(2, len(T_world_cam)), 4, 4))
        for step, T in enumerate(path @ _T_CAM_BLENDER):
            location, rotation, _ = matrix(T.tolist()).decompose()
            if before is not None and rotation.dot(before) < 0:
                rotation.negate()
            before = rotation
            camera.location, camera.rotation_quaternion = location, rotation
            for name in ("location", "rotation_quaternion"):
                camera.keyframe_insert(name, frame=2 * k + step / (len(path) - 1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
