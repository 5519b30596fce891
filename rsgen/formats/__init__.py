"""Formats of other programs, by name. The module that handles a format is loaded when it is asked for.

The core imports this table and no format. A new format is a module and a line here (docs/adding-a-format.md).
"""

from __future__ import annotations

from pkgutil import resolve_name
from typing import Any

# Files that scene.file of a config may name, by suffix. The core itself reads .xml of Mitsuba 3.
SCENES = dict.fromkeys((".glb", ".gltf", ".obj", ".ply", ".stl"), "meshes.mesh_file")
_OTHER_SCENES = "meshes.mesh_file"  # trimesh knows more suffixes

# What a Mitsuba scene needs where Mitsuba 3 itself does not take it.
_XML = {
    "older version": "mitsuba_xml.upgrade",
    "mesh files": "mitsuba_xml.mesh_files",
}


def scene_reader(suffix: str) -> Any:
    """Module for a scene file: `scene_shapes(mi, path, scratch, options)` and `hash_into(digest, path, options)`."""
    return _load(SCENES.get(suffix.lower(), _OTHER_SCENES))


def xml_helper(name: str) -> Any:
    """Module for what a Mitsuba scene may hold: "older version" or "mesh files"."""
    return _load(_XML[name])


def _load(place: str) -> Any:
    """A module, or "module:function", of this package."""
    return resolve_name(f"rsgen.formats.{place}")
