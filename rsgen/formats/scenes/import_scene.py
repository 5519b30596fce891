"""Make a scene folder of a file of another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rsgen.config.sections import Up
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.formats import IMPORTS, scene_importer
from rsgen.formats.meshes.mesh_file import finished, light_shapes, part_shapes, read_parts
from rsgen.formats.scenes.content import Content, lamp_shapes
from rsgen.formats.scenes.folder import NAME, write_folder, write_scene
from rsgen.inputs import check_input
from rsgen.render.placement import SceneOptions


@dataclass(frozen=True)
class Imported:
    """The scene that was written, and in a line each what is in it, and what has been left out or changed."""

    scene: Path
    found: tuple[str, ...]
    notes: tuple[str, ...]


def import_scene(
    file: Path, out: Path, force: bool = False, scale: float | None = None, up: Up | None = None
) -> Imported:
    """Write `file` as a Mitsuba scene, with its meshes and textures, into the new folder `out`.

    force: replace a folder that is there. scale: metres per unit of the file, up: its axis that is up; None: what it
    states, metres and y for mesh files. Raises UserError for files that cannot be read or hold no surface,
    where the package that reads them is missing, and for folders that cannot be written; nothing is written then.
    """
    suffix = file.suffix.lower()
    if suffix not in IMPORTS:
        kinds = ": of these kinds are read: " + " ".join(IMPORTS)
        hint = ": name it in scene.file as it is" if suffix == ".xml" else kinds
        raise UserError(f"scene {file}: is no file to import{hint}")
    if not file.is_file():
        raise UserError(f"scene {file}: no such file")
    found, notes = write_folder(out, force, lambda folder: _fill(file, folder, scale, up))
    return Imported(out / NAME, found, notes)


def _fill(file: Path, folder: Path, scale: float | None, up: Up | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    content: Content = scene_importer(file.suffix).read_content(file, scale, up)
    mi = mitsuba()
    parts = finished(file, content.parts)
    lights, remarks = lamp_shapes(content.lamps, folder)
    notes = [*content.notes, *remarks]
    glows = any(part.material.emission.any() for part in parts)
    if not lights and not glows:
        lights = light_shapes(mi, file, parts, "auto", folder)
        notes.append("no light of its own: given a sky, or lamps under its ceiling")
    corners = np.array([f(p.vertices[p.faces], axis=(0, 1)) for p in parts for f in (np.min, np.max)])
    size = np.ptp(corners, axis=0)
    found = (
        f"{sum(len(p.faces) for p in parts)} triangles in {len(parts)} shapes, "
        "{:.2f} x {:.2f} x {:.2f} m (y up)".format(*size),
        f"{len(content.lamps)} lights" + (", and surfaces that glow" if glows else ""),
    )
    scene = {"type": "scene", **part_shapes(mi, parts, folder), **lights}
    write_scene(scene, [f"made by rsgen import-scene of {file.name}", *found, *notes], folder)
    return found, tuple(notes)


def read_content(path: Path, scale: float | None, up: Up | None) -> Content:
    """The parts of a mesh file. Raises UserError."""
    check_input(path)
    parts = read_parts(path, SceneOptions(scale or 1.0, up or "y"))
    return Content(parts, [], ["scene.file of a config takes a mesh file as it is, too"])
