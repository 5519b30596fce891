"""Formats of other programs, by name. The module that handles a format is loaded when it is asked for.

The core imports this table and no format. A new format is a module and a line here: docs/adding-a-format.md.
"""

from importlib import import_module
from typing import Any

_BAG = "a bag with images, IMU, tf and the lines' times"
# Exports that take all cameras of a rig; the others take one colour and one depth camera of it.
OF_RIGS = ("kalibr", "euroc", "ros1", "ros2", "mcap", "ncore", "rerun")
# Exports: module with a function export_MODULE, place within the sequence's folder ({} is its name), help.
EXPORTS = {
    "kalibr": ("kalibr", "kalibr", "camchain.yaml with line_delay, imu.yaml, of a target also target.yaml and images"),
    "euroc": ("euroc", "", "mav0/ (ASL)"),
    "registered": ("registered", "registered", "TUM folder, depth warped into the colour camera, its rows' times lost"),
    "ros1": ("ros", "{}.bag", _BAG),
    "ros2": ("ros", "ros2", _BAG),
    "mcap": ("ros", "{}.mcap", _BAG),
    "colmap": ("colmap", "colmap", "text model and images"),
    "nerfstudio": ("nerfstudio", "nerfstudio", "transforms.json, poses and velocities for rolling-shutter splatting"),
    "ncore": ("ncore", "ncore", "NVIDIA's format, poses for every line"),
    "vslamlab": ("vslamlab", "vslamlab", "a sequence's folder in VSLAM-LAB: rgb.csv, calibration.yaml"),
    "video": ("video", "shutter.mp4", "global beside rolling shutter (.mp4)"),
    "rerun": ("rerun", "{}.rrd", ".rrd recording"),
}  # fmt: skip
# Scene files that a config may name, by suffix; the core itself reads .xml. trimesh knows more than are listed.
_MESHES = (".glb", ".gltf", ".obj", ".ply", ".stl")
SCENES = dict.fromkeys(_MESHES, "meshes.mesh_file")
_OTHER_SCENES = "meshes.mesh_file"
# Files that rsgen import makes a Mitsuba scene of, by suffix.
IMPORTS = dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "scenes.usd_stage")
IMPORTS |= {".blend": "scenes.blend", **dict.fromkeys(_MESHES, "scenes.import_scene")}
# What a Mitsuba scene may hold that Mitsuba 3 itself does not take.
_XML = {"older version": "mitsuba_xml.upgrade", "mesh files": "mitsuba_xml.mesh_files"}


def exporter(name: str) -> Any:
    """Function of an export: `(sequence, out, options, progress) -> line to print`."""
    module = EXPORTS[name][0]
    return getattr(_load(f"export.{module}"), f"export_{module}")


def scene_reader(suffix: str) -> Any:
    """Module for a scene file: `scene_dict(mi, path, scratch, options)` and `hash_into(digest, path, options)`."""
    return _load(SCENES.get(suffix.lower(), _OTHER_SCENES))


def scene_importer(suffix: str) -> Any:
    """Module for a file to import: `read_content(path, scale, up) -> Content`."""
    return _load(IMPORTS[suffix.lower()])


def xml_helper(name: str) -> Any:
    """Module for what a Mitsuba scene may hold: "older version" or "mesh files"."""
    return _load(_XML[name])


def _load(name: str) -> Any:
    return import_module(f"rsgen.formats.{name}")
