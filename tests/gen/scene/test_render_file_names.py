"""Files that scenes name as Windows finds them."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rendering import mi
from scene_files import fails

from rsgen.scene.loading import content_hash, load_scene
from rsgen.scene.meshes import surface
from rsgen.scene.xml_scene import located

NAMED = """<scene version="{}"><shape type="ply"><string name="filename" value="MESHES\\Box.PLY"/><bsdf type="diffuse">
    <texture type="bitmap" name="reflectance"><string name="filename" value="textures/darkOAK.PNG"/></texture></bsdf>
    </shape><emitter type="constant"/></scene>"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("meshes", "Textures"):
        (tmp_path / name).mkdir()
    trimesh.creation.box().export(tmp_path / "meshes" / "box.ply")
    mi.Bitmap(np.full((2, 2, 3), 128, np.uint8)).write(str(tmp_path / "Textures" / "DARKOAK.png"))
    return tmp_path


@pytest.mark.parametrize("version", ["0.6.0", "3.0.0"])
def test_names_in_another_case_and_with_backslashes(
    folder: Path, version: str, caplog: pytest.LogCaptureFixture
) -> None:
    scene = folder / "scene.xml"
    scene.write_text(NAMED.format(version))
    with caplog.at_level(logging.WARNING, "rsgen"):
        hashed = content_hash(scene)
        assert not caplog.records
        assert len(surface(load_scene(scene))[1]) == 12
    assert [record.getMessage() for record in caplog.records] == [
        f"scene {scene}: found files by names that differ in case or slashes: 'MESHES\\Box.PLY' is 'meshes/box.ply', "
        "'textures/darkOAK.PNG' is 'Textures/DARKOAK.png'"
    ]
    trimesh.creation.box((1, 2, 3)).export(folder / "meshes" / "box.ply")
    assert content_hash(scene) != hashed
    (folder / "meshes" / "BOX.ply").write_bytes(b"")
    fails(scene, r"MESHES.*Box\.PLY' that it names is missing")


def test_the_name_itself_comes_first_and_only_what_is_clear_is_found(tmp_path: Path) -> None:
    for name in ("a.png", "A.png", "B.PNG", "sub/c.png", "SUB/d.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    expected = {
        "a.png": "a.png", "A.png": "A.png", "A.PNG": None, "b.png": "B.PNG", "Sub/C.png": "sub/c.png",
        "sub\\D.PNG": "SUB/d.png", "sUb\\E.PNG": None, "../{}/b.PNG": "../{}/B.PNG", "e.png": None, "": "",
        str(tmp_path / "a.png").upper(): None,
    }  # fmt: skip
    for name, file in expected.items():
        name, file = (text and text.format(tmp_path.name) for text in (name, file))
        assert located(tmp_path, name) == (None if file is None else tmp_path / file), name
