"""`shapegroup` and `instance` flattened: every instance of a group becomes shapes of its own, in the scene's order."""

from __future__ import annotations

from typing import Any

import numpy as np


def flatten(mi: Any, state: Any) -> None:
    """Replace the instances of a parsed scene, references resolved, by copies of their groups' shapes, in place.

    A copy has its group's BSDF and the pose `to_world(instance) @ to_world(shape)`; an emitter is copied along, since
    each belongs to one shape. Groups may hold instances of other groups. Groups that nobody instances vanish.
    """
    made = 0
    # The root is fetched anew each time: the list of nodes moves as it grows.
    for key, index in _children(mi, state.nodes[0].props):
        plugin = _shape_plugin(mi, state.nodes[index])
        if plugin not in ("instance", "shapegroup"):
            continue
        del state.nodes[0].props[key]
        if plugin == "instance":
            for copy in _copies(mi, state, index, np.eye(4)):
                state.nodes[0].props[f"rsgen_instance_{made:06d}"] = mi.Properties.ResolvedReference(copy)
                made += 1


def _children(mi: Any, props: Any) -> list[tuple[str, int]]:
    """Names and node numbers of the objects that a node holds, in their order."""
    kind = mi.Properties.Type.ResolvedReference
    return [(key, props[key].index()) for key in list(props.keys()) if props.type(key) == kind]


def _shape_plugin(mi: Any, node: Any) -> str | None:
    return node.props.plugin_name() if node.type == mi.ObjectType.Shape else None


def _copies(mi: Any, state: Any, instance: int, pose: Any) -> list[int]:
    """Numbers of new nodes: the shapes of an instance's group at `pose` (4, 4) times the instance's own."""
    props = state.nodes[instance].props
    pose = pose @ _to_world(props)
    made: list[int] = []
    for _, group in _children(mi, props):
        if _shape_plugin(mi, state.nodes[group]) != "shapegroup":
            continue
        for _, index in _children(mi, state.nodes[group].props):
            plugin = _shape_plugin(mi, state.nodes[index])
            if plugin == "instance":
                made += _copies(mi, state, index, pose)
            elif plugin is not None:
                made.append(_copy(mi, state, index, pose))
    return made


def _copy(mi: Any, state: Any, index: int, pose: Any) -> int:
    node = mi.parser.SceneNode(state.nodes[index])
    node.props.set_id("")  # the same one twice is an error
    node.props["to_world"] = mi.ScalarTransform4f(pose @ _to_world(node.props))
    for key, child in _children(mi, node.props):
        if state.nodes[child].type == mi.ObjectType.Emitter:
            state.nodes.append(mi.parser.SceneNode(state.nodes[child]))
            node.props[key] = mi.Properties.ResolvedReference(len(state.nodes) - 1)
    state.nodes.append(node)
    return len(state.nodes) - 1


def _to_world(props: Any) -> Any:
    return np.asarray(props["to_world"].matrix, float).reshape(4, 4) if "to_world" in props else np.eye(4)
