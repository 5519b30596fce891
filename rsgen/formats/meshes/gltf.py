"""What trimesh leaves out of a glTF file's JSON, and the file as trimesh reads it best.

trimesh keeps images and factors, but no samplers, texture transforms, second texture coordinates or extensions, and
rounds factors and colours to 8 bits. So the JSON is read here, and materials are numbered in it on the way in.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError

SUFFIXES = (".glb", ".gltf")

_GLB_MAGIC, _JSON_CHUNK = 0x46546C67, 0x4E4F534A
# Of the extensions that a file may call required, those without which its shapes and colours are still right.
_KNOWN = ("KHR_texture_transform", "KHR_lights_punctual", "EXT_texture_webp", "KHR_materials_pbrSpecularGlossiness")
_WRAP = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_NO_MATERIAL = "none"


def read_header(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON of a .gltf or .glb file, and the chunks that follow it in a .glb. Raises UserError."""
    data = path.read_bytes()
    chunks = b""
    if path.suffix.lower() == ".glb":
        if len(data) < 20 or struct.unpack_from("<II", data) != (_GLB_MAGIC, 2):
            raise UserError(f"scene {path}: is no binary glTF 2.0 file: export it again")
        length, kind = struct.unpack_from("<II", data, 12)
        if kind != _JSON_CHUNK or 20 + length > len(data):
            raise UserError(f"scene {path}: is cut short or damaged: export it again")
        data, chunks = data[20 : 20 + length], data[20 + length :]
    try:
        header = json.loads(data, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict):
        raise UserError(f"scene {path}: its JSON cannot be read: export it again")
    return header, chunks


def external_files(header: dict[str, Any], kinds: tuple[str, ...] = ("buffers", "images")) -> list[str]:
    """Names of the files of such kinds that the JSON refers to, relative to its own."""
    uris = [str(item["uri"]) for key in kinds for item in header.get(key, []) if "uri" in item]
    return [unquote(uri) for uri in uris if not uri.startswith("data:")]


def for_trimesh(path: Path, header: dict[str, Any], chunks: bytes) -> bytes:
    """The same file with its materials named by their numbers, each primitive with one, and one set of coordinates.

    Changes `header`. Primitives without a material get one, since trimesh rounds their colours to 8 bits otherwise.
    Raises UserError if trimesh would read what it does not understand as something else.
    """
    primitives = [p for mesh in header.get("meshes", []) for p in mesh.get("primitives", [])]
    _refuse_unknown(path, header, primitives)
    materials = header.setdefault("materials", [])
    sets = [_coordinate_set(material) for material in materials]
    for number, material in enumerate(materials):
        material["name"] = str(number)
    materials.append({"name": _NO_MATERIAL})
    for primitive in primitives:
        own = sets[primitive["material"]] if "material" in primitive else 0
        primitive.setdefault("material", len(materials) - 1)
        attributes = primitive["attributes"]
        if own and f"TEXCOORD_{own}" in attributes:
            attributes["TEXCOORD_0"] = attributes[f"TEXCOORD_{own}"]
    header.setdefault("scenes", [{"nodes": _roots(header)}])
    for item in (*header.get("buffers", []), *header.get("images", [])):
        if "uri" in item:
            item["uri"] = _readable(item["uri"])
    text = json.dumps(header).encode()
    if not chunks:
        return text
    text += b" " * (-len(text) % 4)
    total = 20 + len(text) + len(chunks)
    return struct.pack("<IIIII", _GLB_MAGIC, 2, total, len(text), _JSON_CHUNK) + text + chunks


def material_of(header: dict[str, Any], name: str) -> dict[str, Any] | None:
    """The JSON of the material that trimesh knows by this name; None where its primitive has none."""
    return None if name == _NO_MATERIAL else header["materials"][int(name)]


def sampling(header: dict[str, Any], info: dict[str, Any]) -> tuple[str, bool, FloatArray]:
    """How a textureInfo's image is looked up: wrap mode, whether by the nearest texel, and its transform (2, 3).

    The transform takes the coordinates (u to the right, v down, 0 to 1) to those of the image.
    """
    texture = header.get("textures", [])[info["index"]] if "index" in info else {}
    sampler = header["samplers"][texture["sampler"]] if "sampler" in texture else {}
    how = info.get("extensions", {}).get("KHR_texture_transform", {})
    s, c = np.sin(how.get("rotation", 0.0)), np.cos(how.get("rotation", 0.0))
    # Counter-clockwise as seen in the image, whose v runs down.
    turned = np.array([[c, s], [-s, c]]) @ np.diag(how.get("scale", [1.0, 1.0]))
    transform = np.column_stack([turned, how.get("offset", [0.0, 0.0])])
    return _WRAP.get(int(sampler.get("wrapS", 0)), "repeat"), sampler.get("magFilter") == _NEAREST, transform


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no number in JSON")


def _refuse_unknown(path: Path, header: dict[str, Any], primitives: list[dict[str, Any]]) -> None:
    required = header.get("extensionsRequired", [])
    required = [name for name in required if name not in _KNOWN and not name.startswith("KHR_materials_")]
    if required:
        raise UserError(f"scene {path}: needs {', '.join(required)}, which is not read here: export it without")
    used = {i for p in primitives for i in (*p["attributes"].values(), p.get("indices", -1))}
    if any("sparse" in accessor for i, accessor in enumerate(header.get("accessors", [])) if i in used):
        raise UserError(f"scene {path}: has sparse accessors, which are not read here: export it without")


def _coordinate_set(material: dict[str, Any]) -> int:
    """Number of the texture coordinates that the first of a material's textures takes; they then serve all of them."""
    both = material.get("pbrMetallicRoughness", {}) | material
    names = ("baseColorTexture", "metallicRoughnessTexture", "emissiveTexture", "normalTexture")
    info: dict[str, Any] = next((both[name] for name in names if name in both), {})
    how = info.get("extensions", {}).get("KHR_texture_transform", {})
    return int(how.get("texCoord", info.get("texCoord", 0)))


def _roots(header: dict[str, Any]) -> list[int]:
    nodes = header.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    return [i for i in range(len(nodes)) if i not in children]


def _readable(uri: str) -> str:
    """trimesh takes names as they stand and data only in base64."""
    if not uri.startswith("data:"):
        return unquote(uri)
    kind, _, content = uri.partition(",")
    if kind.endswith(";base64"):
        return uri
    return f"{kind};base64,{base64.b64encode(unquote(content).encode('latin-1')).decode()}"
