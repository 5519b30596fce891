"""The child process that opens a Blender file: `python -m rsgen.formats.scenes.blend_worker FILE FOLDER` (see `blend`).

Writes FOLDER/scene.glb, scene.json (lights, notes, metres_per_unit) and the sky's picture. Changes nothing else.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

from rsgen.errors import first_few

_SURFACES = ("MESH", "CURVE", "SURFACE", "FONT", "META")
_COLORS = ("Base Color", "Color")


def main(file: Path, folder: Path) -> None:
    """Export the file's active scene, at its current frame, as its render shows it."""
    bpy: Any = importlib.import_module("bpy")
    bpy.context.preferences.filepaths.use_scripts_auto_execute = False
    bpy.ops.wm.open_mainfile(filepath=str(file), load_ui=False, use_scripts=False)
    scene = bpy.context.scene
    notes: list[str] = []
    if missing := [
        i.name for i in bpy.data.images if i.source == "FILE" and not i.packed_file and not _is_there(bpy, i)
    ]:
        notes.append(f"images missing, their colour is left out: {first_few(missing)}")
    shown = [o for o in scene.objects if not o.hide_render]
    lights = [light for o in shown if o.type == "LIGHT" for light in _light(o, notes)]
    lights += _sky(bpy, scene.world, folder, notes)
    if cameras := [o.name for o in scene.objects if o.type == "CAMERA"]:
        notes.append(f"cameras left out: {first_few(cameras)}")
    if others := [
        f"{o.name} ({o.type.lower()})" for o in shown if o.type in ("VOLUME", "CURVES", "GPENCIL", "POINTCLOUD")
    ]:
        notes.append(f"left out: {first_few(others)}")
    if hair := [o.name for o in shown if any(p.settings.type == "HAIR" for p in o.particle_systems)]:
        notes.append(f"hair left out: {first_few(hair)}")
    if any(o.animation_data or o.rigid_body for o in shown):
        notes.append(f"things that move: taken as they are at frame {scene.frame_current}")
    for material in {slot.material for o in shown for slot in o.material_slots if slot.material}:
        _made_plain(material, notes)
    if any(o.type in _SURFACES or o.instance_type == "COLLECTION" for o in shown):
        _export(bpy, folder / "scene.glb")
    found = {"lights": lights, "notes": notes, "metres_per_unit": scene.unit_settings.scale_length}
    (folder / "scene.json").write_text(json.dumps(found), encoding="utf-8")


def _export(bpy: Any, file: Path) -> None:
    bpy.ops.export_scene.gltf(
        filepath=str(file), export_format="GLB", export_apply=True, use_renderable=True, export_yup=True,
        export_texcoords=True, export_normals=True, export_materials="EXPORT", export_image_format="AUTO",
        export_cameras=False, export_lights=False, export_animations=False, export_skins=False, export_morph=False,
        export_gn_mesh=True, use_active_scene=True,
    )  # fmt: skip


def _light(item: Any, notes: list[str]) -> list[dict[str, Any]]:
    light = item.data
    value = [light.energy * c for c in light.color]
    if not any(value):
        return []
    if light.use_nodes:
        notes.append(f"light '{item.name}' rendered without its nodes")
    entry: dict[str, Any] = {"value": value, "T_blender_light": [list(row) for row in item.matrix_world]}
    if light.type == "SUN":
        return [entry | {"kind": "directional"}]
    if light.type == "AREA":
        round_ = light.shape in ("DISK", "ELLIPSE")
        size = [light.size, light.size_y if light.shape in ("RECTANGLE", "ELLIPSE") else light.size]
        return [entry | {"kind": "disk" if round_ else "rectangle", "size": size}]
    if light.type == "SPOT":
        return [entry | {"kind": "spot", "cone_deg": math.degrees(light.spot_size) / 2, "blend": light.spot_blend}]
    return [entry | {"kind": "point"}]


def _sky(bpy: Any, world: Any, folder: Path, notes: list[str]) -> list[dict[str, Any]]:
    """The world's background, if it is a colour or a picture; else its colour in the viewport."""
    if world is None:
        return []
    T = [[float(i == j) for j in range(4)] for i in range(4)]
    background = next(iter(_nodes(world, "BACKGROUND")), None)
    if background is None:
        color = list(world.color)
        return [{"kind": "sky", "value": color, "T_blender_light": T}] if any(color) else []
    strength, socket = background.inputs["Strength"].default_value, background.inputs["Color"]
    node = socket.links[0].from_node if socket.is_linked else None
    if node is None:
        color = [strength * c for c in socket.default_value[:3]]
        return [{"kind": "sky", "value": color, "T_blender_light": T}] if any(color) else []
    entry: dict[str, Any] = {"kind": "sky", "value": [strength] * 3, "T_blender_light": T}
    if node.type == "TEX_ENVIRONMENT" and node.image is not None and _is_there(bpy, node.image):
        if node.inputs["Vector"].is_linked:
            notes.append("the world's picture rendered without its turn")
        node.image.file_format = "OPEN_EXR"
        node.image.filepath_raw = str(folder / "sky.exr")
        node.image.save()
        return [entry | {"picture": "sky.exr"}]
    notes.append(f"the world's sky, made by a node '{node.bl_label}', rendered as a uniform one")
    return [entry]


def _made_plain(material: Any, notes: list[str]) -> None:
    """Give a material that has no Principled BSDF one, which is all that the exporter reads."""
    if not material.use_nodes or _nodes(material, "BSDF_PRINCIPLED"):
        return
    tree = material.node_tree
    output = next(iter(_nodes(material, "OUTPUT_MATERIAL")), None)
    kinds = ("BSDF_DIFFUSE", "BSDF_GLOSSY", "BSDF_ANISOTROPIC", "EMISSION", "BSDF_GLASS", "BSDF_TRANSPARENT")
    found = next((node for kind in kinds for node in _nodes(material, kind)), None)
    if output is None or found is None or not output.inputs["Surface"].is_linked:
        return
    if output.inputs["Surface"].links[0].from_node.type == "EMISSION":
        return  # the exporter reads a surface that only glows
    plain = tree.nodes.new("ShaderNodeBsdfPrincipled")
    source = next(found.inputs[name] for name in _COLORS if name in found.inputs)
    target = plain.inputs["Emission Color" if found.type == "EMISSION" else "Base Color"]
    target.default_value = source.default_value
    if source.is_linked:
        tree.links.new(source.links[0].from_socket, target)
    if found.type == "EMISSION":
        plain.inputs["Emission Strength"].default_value = found.inputs["Strength"].default_value
    plain.inputs["Roughness"].default_value = 1.0
    if "GLOSSY" in found.type or "ANISOTROPIC" in found.type:
        plain.inputs["Metallic"].default_value = 1.0
        plain.inputs["Roughness"].default_value = found.inputs["Roughness"].default_value
    if found.type in ("BSDF_GLASS", "BSDF_TRANSPARENT"):
        plain.inputs["Alpha"].default_value = 0.0
        material.blend_method = "BLEND"
    tree.links.new(plain.outputs[0], output.inputs["Surface"])
    notes.append(f"material '{material.name}' read by its {found.bl_label} only")


def _nodes(owner: Any, kind: str) -> list[Any]:
    return [n for n in owner.node_tree.nodes if n.type == kind] if owner.use_nodes and owner.node_tree else []


def _is_there(bpy: Any, image: Any) -> bool:
    return bool(image.packed_file) or Path(bpy.path.abspath(image.filepath, library=image.library)).is_file()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
    sys.stdout.flush()
    os._exit(0)  # bpy 4.2 crashes when it is taken down
