"""Puts a room's surfaces, materials and lamps into the folder of a Mitsuba 3 scene: scene.xml, meshes/, textures/."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scenes.kit import scene_files
from scenes.kit.materials import Material, texture
from scenes.kit.shapes import Mesh, Parts, merge

ICL_FOV = float(np.degrees(2 * np.arctan(320 / 481.2)))  # width of ICL-NUIM's image, degrees


@dataclass(frozen=True)
class AreaLamp:
    """A luminous `mesh` named `name` with the BSDF `material` and an emitter's `radiance` (XML, see scene_files).

    `atlas`: its texture coordinates are those of a picture, not metres.
    """

    name: str
    material: str
    mesh: Mesh
    radiance: str
    atlas: bool = False


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """(4, 4) to_world of a Mitsuba camera (x left, y up, z forward) that looks from `eye` to `target`."""
    forward = np.subtract(target, eye)
    forward /= np.linalg.norm(forward)
    left = np.cross((0.0, 1.0, 0.0), forward)
    left /= np.linalg.norm(left)
    pose = np.eye(4)
    pose[:3] = np.stack([left, np.cross(forward, left), forward, np.asarray(eye, float)], axis=1)
    return pose


def write_room(
    out: Path,
    surfaces: Parts,
    materials: Mapping[str, Material],
    lamps: Sequence[AreaLamp],
    *,
    camera: np.ndarray,
    pictures: Mapping[str, np.ndarray] | None = None,
) -> Path:
    """Write the scene into the folder `out` (made if need be) and return the path of its scene.xml, written last.

    One mesh for all surfaces of a material. `camera`: (4, 4) to_world of the view that the file opens with; `pictures`:
    linear (h, w, 3) images by name, written as textures/NAME.pfm, for lamps' radiance. Raises OSError if the folder
    cannot be written, KeyError for a material that is not in `materials`.
    """
    out = Path(out)
    (out / "scene.xml").unlink(missing_ok=True)
    for folder in ("meshes", "textures"):
        shutil.rmtree(out / folder, ignore_errors=True)
        (out / folder).mkdir(parents=True)
    used = sorted({name for name, _ in surfaces} | {lamp.material for lamp in lamps})
    shapes = []
    for name in used:
        own = [mesh for material, mesh in surfaces if material == name]
        if own:
            scene_files.write_ply(out / "meshes" / f"{name}.ply", merge(own), materials[name].tile)
            shapes.append(scene_files.shape(name, name))
    for lamp in lamps:
        tile = (1.0, 1.0) if lamp.atlas else materials[lamp.material].tile
        scene_files.write_ply(out / "meshes" / f"{lamp.name}.ply", lamp.mesh, tile)
        shapes.append(scene_files.shape(lamp.name, lamp.material, lamp.radiance))
    for name in used:
        if materials[name].paint is not None:
            image = texture(materials[name])
            cv2.imwrite(str(out / "textures" / f"{name}.png"), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])
    for name, image in (pictures or {}).items():
        scene_files.write_pfm(out / "textures" / f"{name}.pfm", image)
    bsdfs = [scene_files.bsdf(name, materials[name]) for name in used]
    path = out / "scene.xml"
    path.write_text(scene_files.document(bsdfs, shapes, camera, ICL_FOV))
    return path
