"""Builds the living room: `python scenes/living_room/build.py [--out DIR]` writes scene.xml, meshes/, textures/ there.

A furnished room of ICL-NUIM's dimensions (4.94 x 2.50 x 4.93 m) in the frame of its trajectories: right-handed, y up,
metres, x = -x_POV, so that kt0..kt3 pass through it. Everything is procedural and seeded: two builds are equal byte for
byte. The result is a plain Mitsuba 3 scene of triangle meshes (one per BSDF, binary PLY with normals and texture
coordinates), diffuse and a few rough plastic BSDFs, and area lights (window pane, ceiling spots, lamp shades).

    build.py      puts it all together          room.py       shell, window, door, mouldings, spots
    shapes.py     solids with normals and uv    furniture.py  sofas, tables, shelves, lamps
    textures.py   noise, plaster, wood, cloth   decor.py      pictures, pottery, plants
    pictures.py   paintings, books, rug, view   layout.py     what stands where
    materials.py  BSDFs and their textures      scene_files.py  PLY, XML
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np

_ROOT = Path(__file__).resolve().parents[2]
if str(_ROOT) not in sys.path:  # so that it also runs as a script from anywhere
    sys.path.insert(0, str(_ROOT))

from scenes.living_room import layout, materials, pictures, room, scene_files  # noqa: E402
from scenes.living_room.shapes import Mesh, Parts, merge  # noqa: E402

SHADE_RADIANCE = (0.62, 0.46, 0.28)
SKY, GROUND = 2.2, 0.62  # radiance behind the window
SPOT_COLOUR = np.array([1.05, 0.98, 0.86])


def parts() -> tuple[Parts, list[Mesh], list[tuple[Mesh, float]]]:
    """Everything in the room: surfaces by material, glowing lamp shades, luminous discs with their radiance."""
    furniture, shades = layout.furnishing()
    housings, discs = room.spots()
    return [*room.architecture(), *housings, *furniture], shades, discs


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """(4, 4) to_world of a Mitsuba camera (x left, y up, z forward) that looks from `eye` to `target`."""
    forward = np.subtract(target, eye)
    forward /= np.linalg.norm(forward)
    left = np.cross((0.0, 1.0, 0.0), forward)
    left /= np.linalg.norm(left)
    pose = np.eye(4)
    pose[:3] = np.stack([left, np.cross(forward, left), forward, np.asarray(eye, float)], axis=1)
    return pose


def build(out: Path) -> Path:
    """Write the scene into the folder `out` (made if need be) and return the path of its scene.xml, written last.

    Raises OSError if the folder cannot be written.
    """
    out = Path(out)
    (out / "scene.xml").unlink(missing_ok=True)
    for folder in ("meshes", "textures"):
        shutil.rmtree(out / folder, ignore_errors=True)
        (out / folder).mkdir(parents=True)
    surfaces, shades, discs = parts()
    used = sorted({name for name, _ in surfaces} | {"shade", "black"})
    shapes = []
    for name in used:
        own = [mesh for material, mesh in surfaces if material == name]
        if own:
            scene_files.write_ply(out / "meshes" / f"{name}.ply", merge(own), materials.MATERIALS[name].tile)
            shapes.append(scene_files.shape(name, name))
    lights = [(f"lamp_shade_{i}", "shade", mesh, scene_files.radiance(SHADE_RADIANCE)) for i, mesh in enumerate(shades)]
    lights += [
        (f"spot_{i}", "black", mesh, scene_files.radiance(tuple(power * SPOT_COLOUR)))
        for i, (mesh, power) in enumerate(discs)
    ]
    lights.append(("window_pane", "black", room.pane(), scene_files.radiance_map("textures/garden.pfm")))
    for name, material, mesh, emission in lights:
        tile = (1.0, 1.0) if name == "window_pane" else materials.MATERIALS[material].tile
        scene_files.write_ply(out / "meshes" / f"{name}.ply", mesh, tile)
        shapes.append(scene_files.shape(name, material, emission))
    for name in used:
        if materials.MATERIALS[name].paint is not None:
            image = materials.texture(materials.MATERIALS[name])
            cv2.imwrite(str(out / "textures" / f"{name}.png"), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])
    scene_files.write_pfm(out / "textures" / "garden.pfm", pictures.garden((512, 512), 901, SKY, GROUND))
    camera = look_at((-1.6, 1.55, 1.9), (0.7, 0.75, -0.9))
    bsdfs = [scene_files.bsdf(name, materials.MATERIALS[name]) for name in used]
    fov = float(np.degrees(2 * np.arctan(320 / 481.2)))
    path = out / "scene.xml"
    path.write_text(scene_files.document(bsdfs, shapes, camera, fov))
    return path


def main() -> None:
    """Command line: build into --out, by default this script's own folder."""
    parser = argparse.ArgumentParser(description="Build the living room as a Mitsuba 3 scene.")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent, help="folder to write to")
    print(build(parser.parse_args().out))


if __name__ == "__main__":
    main()
