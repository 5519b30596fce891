"""Scenes that name files that are not there: refused with a word on --skip-missing, and rendered without them."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rsgen.config.config import Config, validate_config
from rsgen.errors import UserError
from rsgen.image_codecs import encode_png
from rsgen.scene.loading import content_hash, load_scene
from rsgen.scene.placement import SceneOptions

SKIP = SceneOptions(skip_missing=True)
XML = """<scene version="{version}">
  <shape type="cube"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
    <string name="filename" value="wall.png"/></texture></bsdf></shape>
  <shape type="ply"><string name="filename" value="chair.ply"/><emitter type="area"/></shape>
  <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
</scene>"""


@pytest.mark.parametrize("version", ["3.0.0", "0.6.0"])
def test_a_scene_is_loaded_without_what_is_missing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, version: str
) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(XML.format(version=version))
    for read in (load_scene, content_hash):
        with pytest.raises(UserError, match=r"file '.*' that it names is missing.*--skip-missing"):
            read(path)
    with caplog.at_level(logging.WARNING, "rsgen"):
        scene = load_scene(path, options=SKIP)
    told = [line for line in caplog.messages if "missing" in line]
    assert sorted(line.split("'")[1] for line in told) == ["chair.ply", "sky.exr", "wall.png"]
    assert [shape.is_mesh() for shape in scene.shapes()] == [True] and len(scene.emitters()) == 1
    without = content_hash(path, SKIP)
    (tmp_path / "wall.png").write_bytes(encode_png(np.zeros((2, 2, 3), np.uint8)))
    assert content_hash(path, SKIP) != without  # what is lit without it is not taken for what is lit with it


def test_a_mesh_file_is_loaded_without_its_texture(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "box.obj"
    path.write_text("mtllib box.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n")
    (tmp_path / "box.mtl").write_text("newmtl a\nmap_Kd wood.png\n")
    with pytest.raises(UserError, match=r"file 'wood\.png'.*--skip-missing"):
        load_scene(path)
    assert load_scene(path, options=SKIP).shapes()
    (tmp_path / "box.mtl").unlink()
    assert load_scene(path, options=SKIP).shapes()
    assert [line.split("'")[1] for line in caplog.messages] == ["wood.png", "box.mtl"]


def test_a_gltf_file_is_not_loaded_without_its_vertices(tmp_path: Path) -> None:
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box())).items():
        if name.endswith(".gltf"):
            (tmp_path / "box.gltf").write_bytes(data)
    with pytest.raises(UserError, match="is missing"):
        load_scene(tmp_path / "box.gltf", options=SKIP)


def test_a_sequence_says_so_only_where_files_are_left_out() -> None:
    def of(**scene: object) -> Config:
        return validate_config({"name": "a", "trajectory": {"file": "t"}, "scene": {"file": "s.xml", **scene}}, "it")

    assert of(skip_missing=True).content()["scene"] == {"file": "s.xml", "skip_missing": True}
    assert of(skip_missing=False).content() == of().content() and "skip_missing" not in of().content()["scene"]
