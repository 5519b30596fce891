"""Scenes of other programs as folders of ours: what importers find, and scene.xml with its meshes and pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeVar
from xml.etree import ElementTree

import numpy as np

from rsgen import srgb
from rsgen.array_types import FloatArray
from rsgen.config.sections import Up
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError, first_few, how_to_install
from rsgen.files import whole_folder
from rsgen.formats import IMPORTS, scene_importer
from rsgen.formats.meshes.default_light import light_shapes
from rsgen.formats.meshes.mesh_file import part_shapes, read_parts
from rsgen.formats.meshes.parts import Part, finished
from rsgen.image_codecs import encode_exr, encode_png
from rsgen.inputs import check_input
from rsgen.scene.placement import SceneOptions

MOST_TRIANGLES = 30_000_000

Kind = Literal["rectangle", "disk", "sphere", "point", "spot", "directional", "sky"]


@dataclass(frozen=True, eq=False)
class Lamp:
    """A light in the world frame, m, shining along the -z axis of its own frame where it has a direction.

    value (3,), linear: radiance of a surface or the sky, intensity (per sr) of a point or spot, irradiance across the
    direction of a directional one. T_world_lamp (4, 4): of the unit shape (square and disk of half-width 1, ball of
    radius 1), rigid for the others. cone_deg: half the angle of a spot, and where its light begins to fall off.
    picture: bytes of a latitude-longitude image, which the sky's value is a factor of; suffix: of its file's name.
    """

    kind: Kind
    value: FloatArray
    T_world_lamp: FloatArray = field(default_factory=lambda: np.eye(4))
    cone_deg: tuple[float, float] = (45.0, 45.0)
    picture: bytes | None = None
    suffix: str = ""


@dataclass(frozen=True, eq=False)
class Content:
    """All of a scene that can be rendered; `notes` list in one line each what cannot, or is changed."""

    parts: Sequence[Part]
    lamps: Sequence[Lamp]
    notes: Sequence[str]


def check_installed(module: str, need: str, extra: str, note: str = "") -> None:
    """Raises UserError, beginning with the need, if there is no such module: the extra's packages, and a note."""
    if find_spec(module) is None:
        raise UserError(f"{need}, which is not installed: install it with: {how_to_install(extra)}{note}")


class Notes:
    """Collects remarks, each with the names of what it is about."""

    def __init__(self) -> None:
        self._names: dict[str, list[str]] = {}

    def add(self, remark: str, name: str) -> None:
        """Remark on the thing called `name`; of many, the first few are named."""
        names = self._names.setdefault(remark, [])
        if name not in names:
            names.append(name)

    def lines(self) -> list[str]:
        """A line a remark."""
        return [f"{remark}: {first_few(names)}" for remark, names in self._names.items()]


_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # Mitsuba's lights shine along z, USD's and Blender's along -z
_SURFACES = ("rectangle", "disk", "sphere")


def lamp_shapes(lamps: Sequence[Lamp], folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Entries of a scene dictionary, and remarks; pictures of skies go into `folder`. Of several skies one counts."""
    skies = [lamp for lamp in lamps if lamp.kind == "sky"]
    # Mitsuba takes one; uniform ones add up where there is no picture.
    pictured = [lamp for lamp in skies if lamp.picture is not None]
    taken = "one with a picture" if pictured else "the sum"
    remarks = [f"of {len(skies)} skies {taken} is taken"] if len(skies) > 1 else []
    others = [lamp for lamp in lamps if lamp.kind != "sky"]
    shapes = {f"light{number:05}": _entry(lamp) for number, lamp in enumerate(others)}
    if pictured:
        sky, file = pictured[0], folder / f"sky{pictured[0].suffix}"
        file.write_bytes(sky.picture or b"")
        # Its one factor is the value's mean, so that the colour of a sky with a picture is lost.
        factor = float(sky.value.mean())
        shapes["sky"] = {"type": "envmap", "filename": str(file), "scale": factor, "to_world": sky.T_world_lamp}
    elif skies:
        total = np.sum([lamp.value for lamp in skies], axis=0)
        shapes["sky"] = {"type": "constant", "radiance": _rgb(total)}
    return shapes, remarks


def _entry(lamp: Lamp) -> dict[str, Any]:
    T = lamp.T_world_lamp
    if lamp.kind in _SURFACES:
        return {
            "type": lamp.kind, "to_world": T if lamp.kind == "sphere" else T @ _TURN,
            "bsdf": {"type": "diffuse", "reflectance": _rgb(np.full(3, 0.5))},
            "emitter": {"type": "area", "radiance": _rgb(lamp.value)},
        }  # fmt: skip
    if lamp.kind == "directional":
        return {"type": "directional", "to_world": T @ _TURN, "irradiance": _rgb(lamp.value)}
    if lamp.kind == "point":
        place = np.eye(4)
        place[:3, 3] = T[:3, 3]
        return {"type": "point", "to_world": place, "intensity": _rgb(lamp.value)}
    cutoff, beam = lamp.cone_deg
    cone = {"cutoff_angle": cutoff, "beam_width": min(beam, 0.999 * cutoff)}
    return {"type": "spot", "to_world": T @ _TURN, "intensity": _rgb(lamp.value), **cone}


def _rgb(value: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(v) for v in value]}


@dataclass(frozen=True)
class Imported:
    """The scene that was written, and in a line each what is in it, and what has been left out or changed."""

    scene: Path
    found: tuple[str, ...]
    notes: tuple[str, ...]


def import_scene(
    file: Path, out: Path, force: bool = False, scale: float | None = None, up: Up | None = None
) -> Imported:
    """Write `file` as a Mitsuba scene, with its meshes and textures, into the new folder `out`.

    force: replace a folder that is there. scale: metres per unit of the file, up: its axis that is up; None: what it
    states, metres and y for mesh files. Raises UserError for files that cannot be read or hold no surface,
    where the package that reads them is missing, and for folders that cannot be written; nothing is written then.
    """
    suffix = file.suffix.lower()
    if suffix not in IMPORTS:
        kinds = ": of these kinds are read: " + " ".join(IMPORTS)
        hint = ": name it in scene.file as it is" if suffix == ".xml" else kinds
        raise UserError(f"scene {file}: is no file to import{hint}")
    if not file.is_file():
        raise UserError(f"scene {file}: no such file")
    found, notes = write_folder(out, force, lambda folder: _fill(file, folder, scale, up))
    return Imported(out / NAME, found, notes)


def _fill(file: Path, folder: Path, scale: float | None, up: Up | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    content: Content = scene_importer(file.suffix).read_content(file, scale, up)
    mi = mitsuba()
    parts = finished(file, content.parts)
    lights, remarks = lamp_shapes(content.lamps, folder)
    notes = [*content.notes, *remarks]
    glows = any(part.material.emission.any() for part in parts)
    if not lights and not glows:
        lights = light_shapes(mi, file, parts, "auto", folder)
        notes.append("no light of its own: given a sky, or lamps under its ceiling")
    corners = np.array([f(p.vertices[p.faces], axis=(0, 1)) for p in parts for f in (np.min, np.max)])
    size = np.ptp(corners, axis=0)
    found = (
        f"{sum(len(p.faces) for p in parts)} triangles in {len(parts)} shapes, "
        "{:.2f} x {:.2f} x {:.2f} m (y up)".format(*size),
        f"{len(content.lamps)} lights" + (", and surfaces that glow" if glows else ""),
    )
    scene = {"type": "scene", **part_shapes(mi, parts, folder), **lights}
    write_scene(scene, [f"made by 'rsgen import' of {file.name}", *found, *notes], folder)
    return found, tuple(notes)


def read_content(path: Path, scale: float | None, up: Up | None) -> Content:
    """The parts of a mesh file. Raises UserError."""
    check_input(path)
    parts = read_parts(path, SceneOptions(scale or 1.0, up or "y"))
    return Content(parts, [], ["scene.file of a config takes a mesh file as it is, too"])


NAME = "scene.xml"

Made = TypeVar("Made")

_TAGS = {
    "bsdf": ("diffuse", "roughplastic", "roughconductor", "blendbsdf", "normalmap", "twosided"),
    "texture": ("bitmap", "mesh_attribute", "uniform"),
    "emitter": ("area", "constant", "envmap", "point", "spot", "directional"),
    "shape": ("ply", "rectangle", "disk", "sphere"),
}  # fmt: skip
_TAG_OF = {kind: tag for tag, kinds in _TAGS.items() for kind in kinds}
_BYTE_STEP = 2e-5  # linear; a picture whose values are this near to bytes in sRGB is written as those


def write_folder(out: Path, force: bool, fill: Callable[[Path], Made]) -> Made:
    """Make the folder `out` by `fill`, which is given an empty one and whose result is returned. Raises UserError.

    One that is there is refused, or with force replaced once the new one is whole.
    """
    if out.exists() and not force:
        raise UserError(f"{out}: is there already: choose another folder, or replace it with --force")
    if out.exists() and not (out / NAME).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out}: is no folder of 'rsgen import' ({NAME} is not in it): delete it yourself")
    with whole_folder(out) as folder:
        return fill(folder)


def write_scene(scene: dict[str, Any], comments: Sequence[str], folder: Path) -> None:
    """scene.xml of a scene dictionary in `folder`, where its meshes are; pictures go into `folder`/textures.

    comments: lines at its top.
    """
    root = ElementTree.Element("scene", version="3.0.0")
    for name, value in scene.items():
        if name != "type":
            _element(root, name, value, folder)
    ElementTree.indent(root)
    text = "".join(f"<!-- {line.replace('--', '- -')} -->\n" for line in comments)
    (folder / NAME).write_text(f"{text}{ElementTree.tostring(root, encoding='unicode')}\n", encoding="utf-8")


def _element(parent: ElementTree.Element, name: str, value: Any, folder: Path) -> None:
    if isinstance(value, dict) and value["type"] == "rgb":
        rgb = value["value"]
        rgb = [rgb] if isinstance(rgb, int | float) else rgb
        ElementTree.SubElement(parent, "rgb", name=name, value=" ".join(f"{x:.9g}" for x in rgb))
    elif isinstance(value, dict) and value["type"] == "bitmap":
        _picture(parent, name, value, folder)
    elif isinstance(value, dict):
        tag = _TAG_OF[value["type"]]
        own = ElementTree.SubElement(parent, tag, {"type": value["type"], "id" if tag == "shape" else "name": name})
        for key, inner in value.items():
            if key != "type":
                _element(own, key, inner, folder)
    elif isinstance(value, bool):
        ElementTree.SubElement(parent, "boolean", name=name, value=str(value).lower())
    elif isinstance(value, int | float):
        ElementTree.SubElement(parent, "float", name=name, value=f"{value:.9g}")
    elif isinstance(value, str):
        is_file = name == "filename"
        text = Path(value).relative_to(folder).as_posix() if is_file and Path(value).is_absolute() else value
        ElementTree.SubElement(parent, "string", name=name, value=text)
    else:
        _matrix(parent, name, np.asarray(value, float))


def _matrix(parent: ElementTree.Element, name: str, T: FloatArray) -> None:
    own = ElementTree.SubElement(parent, "transform", name=name)
    ElementTree.SubElement(own, "matrix", value=" ".join(f"{x:.9g}" for x in T.ravel()))


def _picture(parent: ElementTree.Element, name: str, bitmap: dict[str, Any], folder: Path) -> None:
    """A bitmap's picture as a PNG where that keeps its values, else as an EXR."""
    values = np.atleast_3d(np.array(bitmap["bitmap"], np.float32))
    encoded = srgb.encode(np.clip(values, 0, 1).astype(np.float64))
    in_bytes = np.round(encoded * 255).astype(np.uint8)
    as_bytes = values.shape[2] == 3 and np.abs(srgb.decode(in_bytes / 255) - values).max() < _BYTE_STEP
    digest = hashlib.sha256(repr(values.shape).encode() + values.tobytes()).hexdigest()[:16]
    file = folder / "textures" / f"{digest}.{'png' if as_bytes else 'exr'}"
    file.parent.mkdir(exist_ok=True)
    if not file.exists():
        if as_bytes:
            file.write_bytes(encode_png(in_bytes))
        else:
            # Not by Mitsuba, whose writer waits for itself for ever where Dr.Jit has one thread.
            file.write_bytes(encode_exr(values, ("Y",) if values.shape[2] == 1 else ("R", "G", "B")))
    own = ElementTree.SubElement(parent, "texture", type="bitmap", name=name)
    ElementTree.SubElement(own, "string", name="filename", value=file.relative_to(folder).as_posix())
    ElementTree.SubElement(own, "boolean", name="raw", value=str(not as_bytes).lower())
    for key in ("format", "wrap_mode", "filter_type"):
        ElementTree.SubElement(own, "string", name=key, value=bitmap[key])
    _matrix(own, "to_uv", _to_uv(bitmap["to_uv"]))


def _to_uv(transform: Any) -> FloatArray:
    """A transform of coordinates (3, 3) as Mitsuba's XML takes it, (4, 4), whose translation is in its last column."""
    flat = np.asarray(transform.matrix, float).reshape(3, 3)
    out = np.eye(4)
    out[:2, :2], out[:2, 3] = flat[:2, :2], flat[:2, 2]
    return out
