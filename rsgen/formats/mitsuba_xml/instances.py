"""`shapegroup` and `instance` flattened: every instance of a group becomes shapes of its own, in the scene's order."""

from __future__ import annotations

from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import aligned
from rsgen.render.mended import rebuilt

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
    """`to_world` (4, 4) of an object's properties; the identity if they say none."""
    return np.asarray(props["to_world"].matrix, float).reshape(4, 4) if "to_world" in props else np.eye(4)
