"""Writes the scene down: binary PLY meshes that Mitsuba reads, and the scene.xml that names them."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from scenes.kit.materials import Material
from scenes.kit.shapes import Mesh

_HEADER = """ply
format binary_little_endian 1.0
element vertex {vertices}
property float x
property float y
property float z
property float nx
property float ny
property float nz
property float u
property float v
element face {faces}
property list uchar int vertex_indices
end_header
"""


def write_ply(path: Path, mesh: Mesh, tile: tuple[float, float]) -> None:
    """Binary PLY with normals and texture coordinates (metres / tile; v downwards, as Mitsuba's bitmaps want it)."""
    table = np.concatenate([mesh.v, mesh.n, mesh.uv / np.asarray(tile)], axis=1).astype("<f4")
    faces = np.empty(len(mesh.f), dtype=[("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, mesh.f
    head = _HEADER.format(vertices=len(table), faces=len(faces)).encode()
    path.write_bytes(head + table.tobytes() + faces.tobytes())


def write_pfm(path: Path, image: np.ndarray) -> None:
    """Portable float map of a linear (h, w, 3) image, rows bottom up as the format says."""
    h, w, _ = image.shape
    path.write_bytes(f"PF\n{w} {h}\n-1.0\n".encode() + np.ascontiguousarray(image[::-1], "<f4").tobytes())


def bsdf(name: str, material: Material) -> str:
    """XML of one two-sided BSDF with the id `name`."""
    if material.metal:
        inner = (
            f'<bsdf type="roughconductor"><string name="material" value="{material.conductor}"/>'
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
