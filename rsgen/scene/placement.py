"""How a scene file comes into the world: instances flattened, analytic shapes as triangles, all in metres and y up.

Everything in it that has a place or a length is scaled and turned. What it looks like stays: radiance and irradiance
have no length in them, the intensity of points does (W/sr meets m²).
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from rsgen.array_types import FloatArray
from rsgen.config.sections import SceneLight, Up
from rsgen.device.arrays import aligned
from rsgen.errors import UserError
from rsgen.scene.meshes import grid_faces, ply_bytes, rebuilt

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


_MESHES = ("ply", "obj", "serialized", "cube")
_MIRRORED = "rsgen_mirrored_"


def flatten(mi: Any, state: Any) -> None:
    """Replace the instances of a parsed scene, references resolved, by copies of their groups' shapes, in place.

    A copy has its group's BSDF and the pose `to_world(instance) @ to_world(shape)`; an emitter is copied along, since
    each belongs to one shape. Groups may hold instances of other groups. Groups that nobody instances vanish.
    """
    # The root is fetched anew each time: the list of nodes moves as it grows.
    before = children(mi, state.nodes[0].props)
    after: list[tuple[str, int]] = []
    for key, index in before:
        plugin = _shape_plugin(mi, state.nodes[index])
        if plugin == "instance":
            after += [(f"rsgen_instance_{copy:06d}", copy) for copy in _copies(mi, state, index, np.eye(4))]
        elif plugin != "shapegroup":
            after.append((key, index))
    if after == before:
        return
    for key, _ in before:
        del state.nodes[0].props[key]
    for key, index in after:
        state.nodes[0].props[key] = mi.Properties.ResolvedReference(index)


def turn_mirrored(mi: Any, scene: Any) -> Any:
    """The scene with the meshes of mirrored instances right side out again.

    Mitsuba's instances keep their outside out. A mesh of its own with a mirroring pose has it inside where Mitsuba
    makes the normals from the triangles, not where the file brings them.
    """
    turned = [shape for shape in scene.shapes() if shape.id().startswith(_MIRRORED)]
    for shape in turned:
        parameters = mi.traverse(shape)
        vertices, faces = (np.asarray(parameters[key]).reshape(-1, 3) for key in ("vertex_positions", "faces"))
        if shape.has_vertex_normals():
            normals = np.asarray(parameters["vertex_normals"]).reshape(-1, 3)
            a, b, c = (vertices[faces[:, k]] for k in range(3))
            inside_out = np.einsum("ij,ij->", np.cross(b - a, c - a), normals[faces].sum(axis=1)) > 0
            # A copy: what is looked at here is the array that this takes the place of, and is freed.
            parameters["vertex_normals"] = mi.Float(aligned(-normals if inside_out else normals))
        parameters["faces"] = mi.UInt32(aligned(faces[:, ::-1], np.uint32))
        parameters.update()
    return rebuilt(mi, scene) if turned else scene


def children(mi: Any, props: Any) -> list[tuple[str, int]]:
    """Names and node numbers of the objects that a node holds, in their order."""
    kind = mi.Properties.Type.ResolvedReference
    return [(key, props[key].index()) for key in list(props.keys()) if props.type(key) == kind]


def _shape_plugin(mi: Any, node: Any) -> str | None:
    return node.props.plugin_name() if node.type == mi.ObjectType.Shape else None


def _copies(mi: Any, state: Any, instance: int, pose: Any) -> list[int]:
    """Numbers of new nodes: the shapes of an instance's group at `pose` (4, 4) times the instance's own."""
    props = state.nodes[instance].props
    pose = pose @ pose_of(props)
    made: list[int] = []
    for _, group in children(mi, props):
        if _shape_plugin(mi, state.nodes[group]) != "shapegroup":
            continue
        for _, index in children(mi, state.nodes[group].props):
            plugin = _shape_plugin(mi, state.nodes[index])
            if plugin == "instance":
                made += _copies(mi, state, index, pose)
            elif plugin is not None:
                made.append(_copy(mi, state, index, pose))
    return made


def _copy(mi: Any, state: Any, index: int, pose: Any) -> int:
    node = mi.parser.SceneNode(state.nodes[index])
    mirrored = np.linalg.det(pose[:3, :3]) < 0
    plugin = node.props.plugin_name()
    node.props.set_id(f"{_MIRRORED}{len(state.nodes)}" if mirrored and plugin in _MESHES else "")  # ids are unique
    if mirrored and plugin == "sphere":
        node.props["flip_normals"] = not node.props.get("flip_normals", False)
    node.props["to_world"] = mi.ScalarTransform4f(pose @ pose_of(node.props))
    for key, child in children(mi, node.props):
        if state.nodes[child].type == mi.ObjectType.Emitter:
            state.nodes.append(mi.parser.SceneNode(state.nodes[child]))
            node.props[key] = mi.Properties.ResolvedReference(len(state.nodes) - 1)
    state.nodes.append(node)
    return len(state.nodes) - 1


def pose_of(props: Any) -> FloatArray:
    """`to_world` (4, 4) of an object's properties; the identity if they have none."""
    return np.asarray(props["to_world"].matrix, float).reshape(4, 4) if "to_world" in props else np.eye(4)


ANALYTIC = ("rectangle", "disk", "sphere", "cylinder")
_SEGMENTS = 96


def tessellated(mi: Any, props: Any, file: Path) -> Any:
    """Properties of a `ply` shape that stands for an analytic one: same id, BSDF and emitter, triangles in `file`."""
    to_world, plugin = pose_of(props), props.plugin_name()
    if plugin in ("sphere", "cylinder"):
        radius = float(props.get("radius", 1.0))
        local = np.diag([radius, radius, radius, 1.0])
        if plugin == "sphere":
            local[:3, 3] = np.asarray(props.get("center", [0, 0, 0]), float).ravel()
        else:
            p0, p1 = (np.asarray(props.get(k, d), float).ravel() for k, d in (("p0", [0, 0, 0]), ("p1", [0, 0, 1])))
            local[:3, :3] = trimesh.geometry.align_vectors([0, 0, 1], p1 - p0)[:3, :3] @ np.diag(
                [radius, radius, float(np.linalg.norm(p1 - p0))]
            )
            local[:3, 3] = p0
        to_world = to_world @ local
    uv_grid = {
        "rectangle": (1, 1),
        "disk": (8, _SEGMENTS),
        "sphere": (_SEGMENTS // 2, _SEGMENTS),
        "cylinder": (1, _SEGMENTS),
    }
    position, normal, uv, faces = _parametric(plugin, *uv_grid[plugin])
    normal_matrix = np.linalg.inv(to_world[:3, :3]).T
    mirrored = np.linalg.det(to_world[:3, :3]) < 0
    # As Mitsuba does: mirroring turns its spheres inside out, the other shapes not.
    turned = bool(props.get("flip_normals", False)) != (mirrored and plugin == "sphere")
    flip = -1.0 if turned else 1.0
    normal = flip * normal @ normal_matrix.T
    if mirrored != turned:
        faces = faces[:, ::-1]
    file.write_bytes(ply_bytes(position @ to_world[:3, :3].T + to_world[:3, 3], faces, normal, uv))
    return as_ply(mi, props, file, ("to_world", "center", "radius", "p0", "p1", "flip_normals"))


def as_ply(mi: Any, props: Any, file: Path, left_out: Collection[str] = ()) -> Any:
    """The properties of a shape, but for some, whose triangles are in a PLY file."""
    out = mi.Properties("ply")
    out.set_id(props.id())
    for key in props.keys():  # noqa: SIM118 (Mitsuba's Properties is no dict)
        if key not in left_out:
            out[key] = props[key]
    out["filename"] = str(file)
    return out


def _parametric(plugin: str, nu: int, nv: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Vertices, unit normals, texture coordinates and faces of Mitsuba's unit shapes on a (nu + 1) x (nv + 1) grid."""
    grid = np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1), indexing="ij")
    a, b = (axis.ravel() for axis in grid)
    phi = 2 * np.pi * b
    zero, one = np.zeros_like(a), np.ones_like(a)
    if plugin == "rectangle":
        position, normal, uv = (
            np.stack([2 * a - 1, 2 * b - 1, zero], -1),
            np.stack([zero, zero, one], -1),
            np.stack([a, b], -1),
        )
    elif plugin == "disk":
        position, normal = np.stack([a * np.cos(phi), a * np.sin(phi), zero], -1), np.stack([zero, zero, one], -1)
        uv = np.stack([a, b], -1)
    elif plugin == "sphere":
        theta = np.pi * a
        position = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
        normal, uv = position, np.stack([b, a], -1)
    else:  # cylinder
        normal = np.stack([np.cos(phi), np.sin(phi), zero], -1)
        position, uv = normal + np.stack([zero, zero, a], -1), np.stack([b, a], -1)
    faces = grid_faces(nu, nv)[2]
    corners = position[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    kept = np.linalg.norm(across, axis=-1) > 1e-12  # not the poles' and the disk centre's degenerate halves
    faces = faces[kept]
    outward = np.einsum("ij,ij->i", across[kept], normal[faces].sum(1))
    faces[outward < 0] = faces[outward < 0][:, ::-1]
    return position, normal, uv, faces
