"""How a scene file is placed: scaled to metres and turned y up, everything in it that has a place or a length.

What it looks like stays: radiance and irradiance have no length in them, the intensity of points does (W/sr meets m²).
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.sections import SceneLight, Up
from rsgen.errors import UserError
from rsgen.scene.xml_shapes import pose_of

# Rotations that bring an axis of the file up, the world's y.
_UP = {
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}
_AROUND = ("envmap", "sunsky", "timed_sunsky", "directional")  # directions, and no place
_POINTS = ("point", "spot", "projector")
_NO_PLACE = ("area", "directionalarea", "constant")  # those of shapes go with them
_DIRECTIONS = ("direction", "sun_direction")  # of the world: `to_world` does not turn them
_INTENSITY = {"PointLight": "intensity.", "SpotLight": "intensity.", "Projector": "scale"}
_UPRIGHT = 0.8  # cosine: a camera may be tilted, not rolled
_AXES: tuple[tuple[Up, Up], ...] = (("x", "-x"), ("y", "-y"), ("z", "-z"))


@dataclass(frozen=True)
class SceneOptions:
    """How a file becomes a scene: metres per unit of the file, which of its axes is up, what lights it.

    light: of a mesh file only, see `rsgen.formats.meshes.default_light`. skip_missing: files that it names and that are
    not there are left out rather than refused.
    """

    scale: float = 1.0
    up: Up = "y"
    light: SceneLight = "auto"
    skip_missing: bool = False


AS_IT_IS = SceneOptions()


def world_from_file(options: SceneOptions) -> FloatArray:
    """T_world_file (4, 4): scaled to metres and turned y up."""
    T_world_file = np.eye(4)
    T_world_file[:3, :3] = options.scale * np.array(_UP[options.up], float)
    return T_world_file


def place(mi: Any, state: Any, path: Path, options: SceneOptions, left: str) -> None:
    """Bring the nodes of a parsed scene, instances flattened, to metres and y up as `options` say, in place.

    left: id of a shape that is in the world already. `place_lamps` does what can be done on the finished scene only.
    Raises UserError naming `path` if the scene has a light that is not known here.
    """
    scale, T_world_file = options.scale, world_from_file(options)
    turn = world_from_file(replace(options, scale=1.0))
    for node in state.nodes:
        props, plugin = node.props, node.props.plugin_name()
        if node.type in (mi.ObjectType.Shape, mi.ObjectType.Volume):
            if props.id() != left and plugin not in ("merge", "shapegroup", "constvolume"):
                _premultiply(mi, props, T_world_file)
        elif node.type == mi.ObjectType.Emitter:
            if plugin not in _AROUND + _POINTS + _NO_PLACE:
                raise UserError(
                    f"scene {path}: emitter '{plugin}' cannot be scaled or turned: "
                    "take another, or bring the scene to metres and y up yourself"
                )
            _place_emitter(mi, props, turn, scale)
        elif plugin == "bumpmap":  # its heights are lengths
            props["scale"] = float(props.get("scale", 1.0)) * scale


def place_lamps(mi: Any, scene: Any, scale: float) -> None:
    """Points of light as bright as they were, where all that they shine on is `scale` times as far away."""
    for emitter in scene.emitters():
        start = _INTENSITY.get(emitter.class_name())
        if start is None:
            continue
        parameters = mi.traverse(emitter)
        for key in [key for key in parameters.keys() if key.startswith(start)]:  # noqa: SIM118 (no dict)
            parameters[key] = parameters[key] * scale**2
        parameters.update()


def _place_emitter(mi: Any, props: Any, turn: FloatArray, scale: float) -> None:
    given = [name for name in _DIRECTIONS if name in props]
    for name in given:
        props[name] = mi.ScalarVector3f(turn[:3, :3] @ np.asarray(props[name], float).ravel())
    plugin = props.plugin_name()
    if "position" in props:
        props["position"] = mi.ScalarPoint3f(scale * turn[:3, :3] @ np.asarray(props["position"], float).ravel())
    elif plugin in _POINTS:
        # Not scaled but moved: a projector's picture and a spot's cone have no size.
        pose = turn @ pose_of(props)
        pose[:3, 3] *= scale
        props["to_world"] = mi.ScalarTransform4f(pose)
    elif plugin in _AROUND and "direction" not in given:
        _premultiply(mi, props, turn)


def _premultiply(mi: Any, props: Any, T: FloatArray) -> None:
    props["to_world"] = mi.ScalarTransform4f(T @ pose_of(props))


def camera_up(path: Path) -> Up | None:
    """The axis of the file that the first of its cameras has up; None if it has none, or one that leans."""
    try:
        cameras = [e for e in ET.parse(path).getroot().iter() if e.tag in ("sensor", "camera")]
        placed = [e for camera in cameras for e in camera.iter() if e.tag in ("lookat", "lookAt", "look_at", "matrix")]
        text = placed[0].get("up") or placed[0].get("value") or ""
        numbers = [float(word) for word in re.split(r"[\s,;]+", text.strip()) if word]
        up = np.array(numbers if len(numbers) == 3 else numbers[1:12:4])  # of a matrix (4, 4) the second column
        axis = int(np.argmax(np.abs(up)))
        upright = abs(up[axis]) > _UPRIGHT * np.linalg.norm(up)
    except (ET.ParseError, OSError, ValueError, LookupError):
        return None
    return _AXES[axis][int(up[axis] < 0)] if upright else None
