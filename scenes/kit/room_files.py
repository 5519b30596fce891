"""A room's folder, scene.xml, meshes/ and textures/, from its surfaces, materials and lamps; and its build command."""

from __future__ import annotations

import argparse
import inspect
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import cv2
import numpy as np

from rsgen.scene.meshes import ply_bytes
from scenes.kit.materials import Material, texture
from scenes.kit.pieces import Piece, parts_rows
from scenes.kit.shapes import Mesh, merge

Point = tuple[float, float, float]
ICL_FOV = float(np.degrees(2 * np.arctan(320 / 481.2)))  # width of ICL-NUIM's image, degrees


def write_ply(path: Path, mesh: Mesh, tile: tuple[float, float]) -> None:
    """Binary PLY with normals and texture coordinates (metres / tile; v downwards, as Mitsuba's bitmaps want it)."""
    path.write_bytes(ply_bytes(mesh.v, mesh.f, mesh.n, mesh.uv / np.asarray(tile)))


def write_pfm(path: Path, image: np.ndarray) -> None:
    """Portable float map of a linear (h, w, 3) image, rows bottom up as the format says."""
    h, w, _ = image.shape
    path.write_bytes(f"PF\n{w} {h}\n-1.0\n".encode() + np.ascontiguousarray(image[::-1], "<f4").tobytes())


def bsdf(name: str, material: Material) -> str:
    """XML of one BSDF with the id `name`, two-sided but for glass."""
    if material.glass:
        return f'  <bsdf type="thindielectric" id={quoteattr(name)}/>'
    if material.metal:
        inner = (
            f'<bsdf type="roughconductor"><string name="material" value="{material.metal}"/>'
            f'<string name="distribution" value="ggx"/><float name="alpha" value="{material.alpha}"/></bsdf>'
        )
    else:
        kind, slot, extra = "diffuse", "reflectance", ""
        if material.alpha > 0:
            kind, slot = "roughplastic", "diffuse_reflectance"
            extra = f'<string name="distribution" value="ggx"/><float name="alpha" value="{material.alpha}"/>'
        image = f'<string name="filename" value="textures/{name}.png"/>'
        inner = f'<bsdf type="{kind}">{extra}<texture type="bitmap" name="{slot}">{image}</texture></bsdf>'
    return f'  <bsdf type="twosided" id={quoteattr(name)}>{inner}</bsdf>'


def shape(name: str, material: str, emitter: str = "") -> str:
    """XML of the shape meshes/`name`.ply with the BSDF `material` and, if any, an area emitter's radiance."""
    light = f'<emitter type="area">{emitter}</emitter>' if emitter else ""
    return (
        f'  <shape type="ply" id={quoteattr("mesh_" + name)}><string name="filename" value="meshes/{name}.ply"/>'
        f"<ref id={quoteattr(material)}/>{light}</shape>"
    )


def radiance(rgb: tuple[float, float, float]) -> str:
    """Constant radiance (linear sRGB) of an area emitter."""
    return f'<rgb name="radiance" value="{rgb[0]:g} {rgb[1]:g} {rgb[2]:g}"/>'


def radiance_map(filename: str) -> str:
    """Radiance from a float image of linear values."""
    return (
        f'<texture type="bitmap" name="radiance"><string name="filename" value="{filename}"/>'
        '<boolean name="raw" value="true"/></texture>'
    )


def document(bsdfs: list[str], shapes: list[str], to_world: np.ndarray, fov: float) -> str:
    """The scene file: path integrator, ICL-NUIM's camera at `to_world` (4, 4), `fov` its width in degrees."""
    matrix = " ".join(f"{x:.9g}" for x in np.asarray(to_world).reshape(-1))
    lines = [
        '<scene version="3.0.0">',
        '  <default name="spp" value="64"/>',
        '  <integrator type="path"><integer name="max_depth" value="12"/></integrator>',
        f'  <sensor type="perspective"><float name="fov" value="{fov:.9g}"/><string name="fov_axis" value="x"/>',
        f'    <transform name="to_world"><matrix value="{matrix}"/></transform>',
        '    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>',
        '    <film type="hdrfilm"><integer name="width" value="640"/><integer name="height" value="480"/>',
        '      <rfilter type="box"/></film></sensor>',
        *bsdfs,
        *shapes,
        "</scene>",
    ]
    return "\n".join(lines) + "\n"


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


def look_at(eye: Point, target: Point) -> np.ndarray:
    """(4, 4) to_world of a Mitsuba camera (x left, y up, z forward) that looks from `eye` to `target`."""
    forward = np.subtract(target, eye)
    forward /= np.linalg.norm(forward)
    left = np.cross((0.0, 1.0, 0.0), forward)
    left /= np.linalg.norm(left)
    pose = np.eye(4)
    pose[:3] = np.stack([left, np.cross(forward, left), forward, np.asarray(eye, float)], axis=1)
    return pose


@dataclass(frozen=True)
class Room:
    """A room's pieces, its materials by name, its lamps, and the view that its file opens with.

    view: eye and target, m. pictures: linear (h, w, 3) images by name, for lamps' radiance.
    """

    pieces: Sequence[Piece]
    materials: Mapping[str, Material]
    lamps: Sequence[AreaLamp]
    view: tuple[Point, Point]
    pictures: Mapping[str, np.ndarray]


def write_room(out: Path, room: Room) -> Path:
    """Write the room into the folder `out` (made if need be) and return the path of its scene.xml, written last.

    One mesh for all surfaces of a material; parts.csv says which triangles are whose. Pictures are textures/NAME.pfm.
    Raises OSError if the folder cannot be written, KeyError for a material that is not in the room's.
    """
    materials = room.materials
    (out / "scene.xml").unlink(missing_ok=True)
    for folder in ("meshes", "textures"):
        shutil.rmtree(out / folder, ignore_errors=True)
        (out / folder).mkdir(parents=True)
    surfaces = [part for piece in room.pieces for part in piece.parts]
    used = sorted({name for name, _ in surfaces} | {lamp.material for lamp in room.lamps})
    shapes = []
    for name in used:
        own = [mesh for material, mesh in surfaces if material == name]
        if own:
            write_ply(out / "meshes" / f"{name}.ply", merge(own), materials[name].tile)
            shapes.append(shape(name, name))
    for lamp in room.lamps:
        tile = (1.0, 1.0) if lamp.atlas else materials[lamp.material].tile
        write_ply(out / "meshes" / f"{lamp.name}.ply", lamp.mesh, tile)
        shapes.append(shape(lamp.name, lamp.material, lamp.radiance))
    for name in used:
        if materials[name].paint is not None:
            image = texture(materials[name])
            cv2.imwrite(str(out / "textures" / f"{name}.png"), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])
    for name, image in room.pictures.items():
        write_pfm(out / "textures" / f"{name}.pfm", image)
    bsdfs = [bsdf(name, materials[name]) for name in used]
    (out / "parts.csv").write_text("\n".join(["shape,first,name", *parts_rows(room.pieces, used), ""]))
    path = out / "scene.xml"
    path.write_text(document(bsdfs, shapes, look_at(*room.view), ICL_FOV))
    return path


def command(build: Callable[..., Path], what: str, script: str) -> None:
    """Command line of a build script: --out, by default the script's folder, and --seed where `build` takes one.

    Prints the path of the scene's file.
    """
    folder = Path(script).resolve().parent
    parser = argparse.ArgumentParser(description=f"Build {what} as a Mitsuba 3 scene.")
    parser.add_argument("--out", type=Path, help="folder to write to (default: this script's, or its seedN)")
    if "seed" in inspect.signature(build).parameters:
        parser.epilog = "A config names a variant by its folder: ROOM/seed3/scene.xml is built with --seed 3 if absent."
        parser.add_argument("--seed", type=int, default=0, help="variant: arrangement, colours, lamps (default: 0)")
    words = vars(parser.parse_args())
    seed = words.get("seed", 0)
    if seed < 0:
        parser.error(f"--seed {seed}: give 0 or more")
    words["out"] = words["out"] or (folder / f"seed{seed}" if seed else folder)
    print(build(**words))
