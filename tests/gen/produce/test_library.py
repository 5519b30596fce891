"""The scenes that ship, as `rsgen scenes` tells of them: found by looking, honest about what is built, varied."""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import trimesh
import yaml

from rsgen.cli.main import main
from rsgen.produce import library

ROOT = Path(__file__).parents[3]
SCRIPT = '''"""Builds a cell: `python build.py`.

A cell of {size} m, for tests. It has no door.
"""
import argparse
import sys
from pathlib import Path


def build(out, seed=0):
    if seed == 13:
        sys.exit("no luck")
    import trimesh
    (Path(out) / "meshes").mkdir(parents=True, exist_ok=True)
    cell = trimesh.creation.box((4, 2.5 + seed, 3))
    cell.invert()
    cell.export(Path(out) / "meshes" / "cell.ply")
    (Path(out) / "scene.xml").write_text(
        "<scene version='3.0.0'><bsdf type='diffuse' id='paint'/><shape type='ply'>"
        "<string name='filename' value='meshes/cell.ply'/><ref id='paint'/></shape></scene>"
    )
    return Path(out) / "scene.xml"


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    parser.add_argument("--seed", type=int, default=0)
    print(build(**vars(parser.parse_args())))
'''


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A library of one scene that is not built, and one config of it; the folder of the scene."""
    folder = tmp_path / "scenes" / "cell"
    folder.mkdir(parents=True)
    (folder / "build.py").write_text(SCRIPT)
    (folder / "parts.py").write_text("def other():\n    pass\n")
    (tmp_path / "configs").mkdir()
    config = {"name": "round", "trajectory": {"file": "t.txt"}, "scene": {"file": "../scenes/cell/scene.xml"}}
    comment = "# Round the\n# cell. More of it\n"
    (tmp_path / "configs" / "round.yaml").write_text(comment + yaml.safe_dump(config) + "# and below\n")
    monkeypatch.setattr(library, "configs_folder", lambda: tmp_path / "configs")
    return folder


def test_what_ships_is_found(capsys: pytest.CaptureFixture[str]) -> None:
    found = {scene.name: scene for scene in library.shipped_scenes(ROOT / "scenes", ROOT / "configs")}
    scripts = [p for p in (ROOT / "scenes").glob("*/*.py") if "\ndef build(" in p.read_text()]
    assert len(found) == len(scripts) and {"living_room", "table", "workshop"} <= set(found)
    for scene in found.values():
        assert scene.about and len(scene.about) < 120 and scene.script in scripts
        assert scene.takes_seed == ("--seed" in scene.script.read_text())
    assert found["table"].file == ROOT / "scenes" / "living_room" / "table.xml"
    named = {file.stem for scene in found.values() for file in scene.configs}
    assert {"lr_kt0"} <= {file.stem for file in found["living_room"].configs}
    assert {"table1", "workshop1"} <= named and not named & {"evaluation"}


def test_a_scene_that_is_not_built_is_said_to_be_so(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("cell: A cell of {size} m, for tests\n  not built yet")
    assert "configs:\n    round          Round the cell\n" in text and "rsgen scenes cell --seed N --out DIR" in text
    assert main(["scenes", "cell", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["built"] is False and facts["triangles"] is None and facts["floor_y_m"] is None
    assert not (cell / "scene.xml").exists()  # to look does not build


def test_a_built_one_is_measured(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "cell", "--out", str(cell)]) == 0
    capsys.readouterr()
    assert main(["scenes", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)["cell"]
    assert facts["triangles"] == len(trimesh.load(cell / "meshes" / "cell.ply").faces) == 12
    assert facts["size_m"] == pytest.approx([4, 2.5, 3]) and facts["light_baked"] is False
    assert main(["scenes", "cell"]) == 0
    text = capsys.readouterr().out
    assert "4.0 x 2.5 x 3.0 m, 12 triangles, light not baked yet" in text
    assert "at y = -1.250 m, 2.50 m free above it" in text and "1: paint" in text


def test_light_that_is_baked_is_told(cell: Path) -> None:
    from rsgen.config.config import LightConfig
    from rsgen.device.backend import mitsuba

    mitsuba()
    from rsgen.light.bake import cache_folder, cache_key
    from rsgen.scene.loading import content_hash

    file = library.build_variant("cell", None, cell)
    folder = cache_folder(file)
    folder.mkdir()
    (folder / "irradiance-of another state.npz").touch()
    assert library.list_scenes().as_dict()["cell"]["light_baked"] is False
    (folder / f"irradiance-{cache_key(content_hash(file), LightConfig())}.npz").touch()
    assert library.list_scenes().as_dict()["cell"]["light_baked"] is True


def test_a_variant_is_built_by_seed(cell: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "cell", "--seed", "2", "--out", str(tmp_path / "two")]) == 0
    line = yaml.safe_load(capsys.readouterr().out)
    assert line == {"scene": {"file": str(tmp_path / "two" / "scene.xml")}}
    assert trimesh.load(tmp_path / "two" / "meshes" / "cell.ply").extents == pytest.approx([4, 4.5, 3])
    assert not (cell / "scene.xml").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("nowhere", "scene 'nowhere': no such scene ships: choose cell"),
        ("cell --seed 3", "--seed: needs --out DIR"),
        ("cell --seed -1 --out x", "--seed -1: must be at least 0"),
        ("cell --seed 13 --out x", "failed (no luck)"),
        ("--out x", "needs the name of a scene"),
        ("cell --out {file}", "is a file: name a folder"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(
    cell: Path,
    tmp_path: Path,
    words: str,
    told: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["scenes", *words.format(file=cell / "build.py").split()]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


def test_a_script_without_seeds_says_so(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (cell / "build.py").write_text(SCRIPT.replace("def build(out, seed=0)", "def build(out)"))
    assert main(["scenes", "cell", "--seed", "1", "--out", "x"]) == 2
    assert "takes no seed" in capsys.readouterr().err


@pytest.mark.parametrize("broken", ["xml", "ply", "missing"])
def test_a_damaged_scene_is_said_to_be_so(cell: Path, broken: str, capsys: pytest.CaptureFixture[str]) -> None:
    library.build_variant("cell", None, cell)
    if broken == "missing":
        shutil.rmtree(cell / "meshes")
    else:
        file = cell / ("scene.xml" if broken == "xml" else "meshes/cell.ply")
        file.write_bytes(file.read_bytes()[:60])
    assert main(["scenes"]) == 2
    error = capsys.readouterr().err
    assert "is damaged" in error and "delete it" in error and error.count("\n") == 1


def test_an_included_scene_counts(cell: Path) -> None:
    file = library.build_variant("cell", None, cell)
    (cell / "more.py").write_text('ABOUT = "two of them"\ndef build(out):\n    pass\n')
    root = ET.fromstring('<scene version="3.0.0"><include filename="scene.xml"/></scene>')
    shape = ET.SubElement(root, "shape", type="ply")
    ET.SubElement(shape, "string", name="filename", value="meshes/cell.ply")
    (cell / "more.xml").write_bytes(ET.tostring(root))
    assert file.is_file()
    facts = library.list_scenes().as_dict()["more"]
    assert facts["triangles"] == 24 and facts["about"] == "two of them" and facts["takes_seed"] is False
