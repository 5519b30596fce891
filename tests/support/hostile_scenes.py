"""Hostile scenes: XML of either Mitsuba, and mesh files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import hostile
import tiny
import trimesh
from hostile_cases import Base, Case, linked, of_8_gb, piped, replaced_by

from rsgen.scene.loading import load_scene


def scenes(folder: Path) -> Iterator[Case]:
    new = tiny.write_scene(folder / "scene")
    base = Base("scenes", new.parent, lambda path, out: load_scene(path / "scene.xml"))
    yield from base.damaged("scene.xml", 2)
    yield from base.damaged("paper.png", 3)
    old = tiny.SCENE.replace("3.0.0", "0.6.0")
    for version in ("0.6.0", "3.0.0"):
        laughs = hostile.LAUGHS + f'<scene version="{version}"><string name="a" value="&a11;"/></scene>'
        entity = f'<!DOCTYPE s [<!ENTITY e SYSTEM "/etc/hostname">]><scene version="{version}">&e;</scene>'
        deep = f'<scene version="{version}">' + '<shape type="cube">' * 50000
        closed = f'<scene version="{version}">' + "<bsdf type='twosided'>" * 3000 + "</bsdf>" * 3000 + "</scene>"
        ring = f'<scene version="{version}"><include filename="scene.xml"/></scene>'
        for name, text in (("billion laughs", laughs), ("an entity of another file", entity), ("deep", deep),
                           ("deep and whole", closed), ("itself within itself", ring)):  # fmt: skip
            yield base.case(f"{version} {name}", replaced_by("scene.xml", text.encode()))
        text = tiny.SCENE.replace("3.0.0", version)
        for what, was in (("nan", '"0.5"'), ("1e400", '"0.5"'), ("x" * 9999, '"0.5"'), ("\N{SNOWMAN}", '"sphere"')):
            changed = text.replace(was, f'"{what}"', 1)
            refused = (version, was) != ("0.6.0", '"sphere"')  # of an old file a shape that there is none of is dropped
            yield base.case(f"{version} {was} becomes {what[:9]}", replaced_by("scene.xml", changed.encode()), refused)
        for name in ("../../beside/secret.txt", "/dev/zero", "x" * 5000):
            changed = text.replace("paper.png", name)
            yield base.case(f"{version} a texture {name[:20]}", replaced_by("scene.xml", changed.encode()))
    assert old != tiny.SCENE
    yield base.case("8 GB", of_8_gb("scene.xml"))
    yield base.case("a pipe", piped("scene.xml"))
    yield base.case("a device", linked("scene.xml", "/dev/zero"))
    yield base.case("a texture of 670 MB", replaced_by("paper.png", hostile.png_bomb(False)))
    yield base.case("a texture that is a pipe", piped("paper.png"))
    yield from meshes(folder / "meshes")


def meshes(folder: Path) -> Iterator[Case]:
    folder.mkdir()
    box = trimesh.creation.box()
    for suffix in ("glb", "gltf", "obj", "ply", "stl"):
        made = folder / suffix
        made.mkdir()
        exported = trimesh.Scene(box).export(file_type=suffix)
        parts = exported if isinstance(exported, dict) else {f"box.{suffix}": exported}
        for name, data in parts.items():
            name = f"box.{suffix}" if name.endswith(f".{suffix}") else name
            (made / name).write_bytes(data.encode() if isinstance(data, str) else data)
        base = Base("scenes", made, lambda path, out, suffix=suffix: load_scene(path / f"box.{suffix}"))  # type: ignore[misc]
        yield from base.damaged(f"box.{suffix}", 2)
        yield base.case("8 GB", of_8_gb(f"box.{suffix}"))
        yield base.case("a pipe", piped(f"box.{suffix}"))
    gltf = Base("scenes", folder / "gltf", lambda path, out: load_scene(path / "box.gltf"))
    import json

    data = json.loads((folder / "gltf/box.gltf").read_text())
    for name, change in _gltf_changes(data):
        yield gltf.case(name, replaced_by("box.gltf", json.dumps(change).encode()), "node" not in name)
    yield gltf.case("very deep", replaced_by("box.gltf", b'{"asset":' + b"[" * 50000))
    ply = b"ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty double x\nproperty double y\n"
    ply += b"property double z\nelement face 2000000000\nproperty list uchar int vertex_indices\nend_header\n"
    for name, bytes_ in (("ply", ply + bytes(100)), ("stl", bytes(80) + b"\xff\xff\xff\x7f" + bytes(50)),
                         ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999\nf -9999999 1 2\n"),
                         ("obj", b"mtllib ../../beside/secret.txt\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")):  # fmt: skip
        base = Base("scenes", folder / name, lambda path, out, name=name: load_scene(path / f"box.{name}"))  # type: ignore[misc]
        yield base.case(f"{bytes_[:20]!r}", replaced_by(f"box.{name}", bytes_), b"mtllib" not in bytes_)


def _gltf_changes(data: dict[str, object]) -> Iterator[tuple[str, dict[str, object]]]:
    import copy

    def changed(key: str, field: str, value: object) -> dict[str, object]:
        new = copy.deepcopy(data)
        new[key][0][field] = value  # type: ignore[index]
        return new

    yield "2^31 points", changed("accessors", "count", 2**31 - 1)
    yield "-1 points", changed("accessors", "count", -1)
    no_view = changed("accessors", "count", 300_000_000)
    for accessor in no_view["accessors"]:  # type: ignore[attr-defined]
        accessor.pop("bufferView", None)
        accessor["count"] = 300_000_000
    yield "points of no buffer", no_view
    yield "a buffer outside", changed("buffers", "uri", "../../../beside/secret.txt")
    yield "a buffer of the machine", changed("buffers", "uri", "/etc/hostname")
    yield "a view beyond its buffer", changed("bufferViews", "byteLength", 2**40)
    yield "an offset beyond its buffer", changed("bufferViews", "byteOffset", 2**62)
    yield "a node within itself", changed("nodes", "children", [0])
