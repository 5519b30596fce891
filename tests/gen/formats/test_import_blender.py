"""Blender's files as Mitsuba's scenes: lamps by its measures, modifiers, colours and light, and no script run."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from usd_scenes import brightness, imported

from rsgen.errors import UserError
from rsgen.formats.scenes import blend
from rsgen.formats.scenes.import_scene import import_scene
from rsgen.scene.meshes import surface

needs_blender = pytest.mark.skipif(find_spec("bpy") is None, reason="needs Blender: pip install 'bpy==4.2.*'")


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
