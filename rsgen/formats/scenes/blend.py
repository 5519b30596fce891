"""Read a Blender file: Blender itself, as PyPI's `bpy` in a process of its own, writes it as GLB and lists its lights.

What is rendered there is read, with modifiers applied, at the file's current frame; its scripts are not run.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.formats.meshes.mesh_file import read_parts
from rsgen.formats.scenes.import_scene import Content, Lamp, check_installed
from rsgen.scene.placement import SceneOptions, world_from_file

_LONGEST_S = 1800
# Blender's z is up, in GLB y is: (x, y, z) becomes (x, z, -y).
_T_GLB_BLENDER = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
# The middle of Blender's sky pictures is its x axis, of Mitsuba's its z; both are seen from inside.
_T_BLENDER_SKY = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


def read_content(path: Path, scale: float | None, up: Any) -> Content:
    """All of a Blender file that its render shows. scale: metres per unit; None: the file's own. up: of the file, y
    standing for Blender's z; None: that.

    Raises UserError if Blender is missing or cannot read the file, or if nothing in it can be rendered.
    """
    check_installed("bpy", ".blend files need Blender's Python module bpy", "blender", " (Python 3.11)")
    with tempfile.TemporaryDirectory(prefix="rsgen-blend-") as scratch:
        folder = Path(scratch)
        _run(path, folder)
        found = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
        if not (folder / "scene.glb").is_file():
            raise UserError(f"scene {path}: holds no surface that its render shows: add a mesh, or unhide one")
        options = SceneOptions(scale or float(found["metres_per_unit"]), up or "y")
        try:
            parts = read_parts(folder / "scene.glb", options)
        except UserError as error:
            raise UserError(str(error).replace(str(folder / "scene.glb"), str(path))) from None
        T_world_blender = world_from_file(options) @ _T_GLB_BLENDER
        lamps = [lamp_of(entry, T_world_blender, folder) for entry in found["lights"]]
    return Content(parts, lamps, found["notes"])


def lamp_of(entry: dict[str, Any], T_world_blender: FloatArray, folder: Path) -> Lamp:
    """The lamp of a light as the worker lists it.

    Of P W, a point or a spot has the intensity P / 4π, a surface of area A the radiance P / πA; a sun's irradiance is
    its strength: so Cycles 4.2 renders them (docs/notebook/scenes.md). T_world_blender (4, 4): to the
    world, m; lengths of the entry are Blender's units.
    """
    T = T_world_blender @ np.array(entry["T_blender_light"], float)
    metres = abs(np.linalg.det(T_world_blender[:3, :3])) ** (1 / 3)
    value = np.array(entry["value"], float)
    T_rigid = T.copy()
    length = np.linalg.norm(T[:3, :3], axis=0)
    T_rigid[:3, :3] /= length
    kind = entry["kind"]
    if kind == "sky":
        T_sky = T_rigid @ _T_BLENDER_SKY
        file = entry.get("picture")
        if file is None:
            return Lamp("sky", value, T_sky)
        return Lamp("sky", value, T_sky, picture=(folder / file).read_bytes(), suffix=Path(file).suffix)
    if kind == "directional":
        return Lamp("directional", value, T_rigid)
    if kind in ("point", "spot"):
        # Watts of a scene in other units are watts of that unit: its picture stays what it is.
        cone = float(entry.get("cone_deg", 45.0))
        return Lamp(kind, value * metres**2 / (4 * np.pi), T_rigid, (cone, cone * (1 - float(entry.get("blend", 0.0)))))
    half = np.array(entry["size"], float) / 2
    across = length[:2] / metres * half
    area = float(across.prod()) * (np.pi if kind == "disk" else 4.0)
    return Lamp(kind, value / (np.pi * area), T @ np.diag([*half, 1.0, 1.0]))


def _run(path: Path, folder: Path) -> None:
    with (folder / "log.txt").open("w+") as log:
        words = [sys.executable, "-m", "rsgen.formats.scenes.blend_worker", str(path.resolve()), str(folder)]
        try:
            done = subprocess.run(words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, timeout=_LONGEST_S)
        except subprocess.TimeoutExpired:
            raise UserError(f"scene {path}: Blender did not end within {_LONGEST_S} s: export it as GLB") from None
        if done.returncode == 0 and (folder / "scene.json").is_file():
            return
        log.seek(0)
        output = [line.strip() for line in log.read().splitlines() if line.strip()]
    raise UserError(
        f"scene {path}: Blender cannot read it ({output[-1][:200] if output else f'status {done.returncode}'}): "
        "save it again with the version of bpy, or export it as GLB"
    )
