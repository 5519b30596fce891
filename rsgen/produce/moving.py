"""From a config's `objects` to things that can be rendered: meshes, splines, and the light along their paths."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.config.config import Config
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.motion.object_paths import check_objects_clear, object_spline

_LIGHT_STEP_S = 0.1  # between the places along a path at which light is gathered


def object_splines(config: Config, first: float, last: float) -> tuple[Spline, ...]:
    """T_world_object(t) of each of the config's objects, covering every line of frames from `first` to `last` s.

    Raises UserError.
    """
    streams = (config.color, config.depth)
    before = max(s.longest_exposure_s - min(s.offset_s, 0.0) for s in streams)
    after = max(s.readout_s for s in streams)
    return tuple(object_spline(thing, first, last, before, after) for thing in config.objects)


def load_meshes(config: Config) -> tuple[Any, ...]:
    """An `ObjectMesh` for each of the config's objects. Raises UserError."""
    from rsgen.render.object_meshes import load_object

    return tuple(load_object(thing) for thing in config.objects)


def lit_objects(scene: Any, field: Any, meshes: Sequence[Any], splines: Sequence[Spline]) -> Any:
    """`MovingObjects` of meshes along splines in a scene whose baked irradiance is `field`."""
    from rsgen.light.probes import gathered_light
    from rsgen.render.moving_objects import MovingObject, MovingObjects, ObjectLight

    things = []
    for mesh, spline in zip(meshes, splines, strict=True):
        count = max(2, math.ceil((spline.t_end - spline.t_begin) / _LIGHT_STEP_S) + 1)
        t = np.linspace(spline.t_begin, spline.t_end, count)
        middles = se3.transform(spline.pose(t), np.broadcast_to(mesh.middle, (count, 3)))
        light = ObjectLight(gathered_light(scene, field, middles), spline.t_begin, float(t[1] - t[0]))
        things.append(MovingObject(mesh, spline, light))
    return MovingObjects(things)


def check_clear_of_camera(
    config: Config, meshes: Sequence[Any], splines: Sequence[Spline], camera: Spline, first: float, last: float
) -> None:
    """Raises UserError if an object comes through a camera."""
    triangles = [mesh.vertices[mesh.faces] for mesh in meshes]
    names = [thing.name for thing in config.objects]
    T_color_depth = np.asarray(config.T_color_depth, float)
    check_objects_clear(names, splines, triangles, camera, (first, last), T_color_depth)


def object_hashes(config: Config) -> dict[str, str]:
    """Content hashes of all that the config's objects are made of, by names for sequence.yaml. Raises UserError."""
    files = {thing.name: thing.motion.file for thing in config.objects}
    return mesh_hashes(config) | {
        f"motion of {name}": _file_hash(file, name) for name, file in files.items() if file is not None
    }


def mesh_hashes(config: Config) -> dict[str, str]:
    """Those of `object_hashes` that are of meshes. Raises UserError."""
    if not config.objects:
        return {}
    from rsgen.device.backend import mitsuba

    mitsuba(config.backend)
    from rsgen.render.object_meshes import object_hash

    return {f"object {thing.name}": object_hash(thing) for thing in config.objects}


def _file_hash(path: Path, name: str) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise UserError(f"objects.{name}.motion: file {path}: cannot be read ({error.strerror})") from None


def object_mesh_ply(mesh: Any) -> bytes:
    """Triangles of an object in its own frame, m, as binary PLY."""
    from rsgen.render.meshes import ply_bytes

    return ply_bytes(mesh.vertices, mesh.faces)
