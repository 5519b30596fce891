"""Scene files of Mitsuba 0.x and 2.x, rewritten as Mitsuba 3 takes them, with a list of all that was lost.

Mitsuba's own parser renames camelCase and no more: elements that it does not know (<srgb>, <blackbody>, <subsurface>),
plugins that are gone (phong, coating, sky) and values that changed their meaning end the loading. So the tree is
rewritten first. What has no counterpart becomes the nearest plain thing, a diffuse of the same colour, or is left out.
Properties that Mitsuba 3 does not know pass through here: it lists them itself when it loads the result.
"""

from __future__ import annotations

import itertools
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from rsgen.errors import UserError
from rsgen.formats.mitsuba_xml import Changes
from rsgen.formats.mitsuba_xml.colors import FACTOR, numbers
from rsgen.formats.mitsuba_xml.plugins import Exists, Upgrade
from rsgen.scene.xml_scene import located

METHOD = b"old-xml/2"
"""Raise when old files come out differently: their baked light is stored under it."""

_DEEPEST = 15  # includes, as in Mitsuba


def upgrade(path: Path, version: str, exists: Exists) -> tuple[bytes, Changes]:
    """The scene file as XML of Mitsuba 3, its includes within it, and what that changed.

    version: its major and minor number, '0.6'; exists: which plugins Mitsuba 3 has. Raises UserError if it
    is no XML, if an included file is missing, or if a number is none.
    """
    changes = Changes(version)
    root = _read(path, path, [], {}, changes, 0)
    try:
        upgraded = Upgrade(exists, changes).scene(root)
    except ValueError as error:
        raise UserError(f"scene {path}: {error}: mend the number in the file") from None
    return ET.tostring(upgraded, "utf-8", xml_declaration=True), changes


def _read(
    scene: Path, file: Path, folders: list[Path], defaults: dict[str, str], changes: Changes, depth: int
) -> Element:
    """The file's tree with its includes in their places and $parameters replaced by their <default>.

    folders: where the files that include this one look for others. Names of files become relative to the scene's own.
    """
    try:
        root = ET.parse(file).getroot()
    except (ET.ParseError, ValueError, LookupError) as error:
        raise UserError(f"scene {scene}: {file.name} is not well-formed XML ({error})") from None
    except OSError as error:
        raise UserError(f"scene {scene}: include '{file}' cannot be read ({error.strerror}): mend its path") from None
    if depth >= _DEEPEST:
        raise UserError(f"scene {scene}: more than {_DEEPEST} files include one another: end the circle")
    if depth:
        changes.files.append(file)
    folders = [file.parent, *folders]

    def fill(parent: Element) -> None:
        for child in list(parent):
            for key, value in child.attrib.items():
                child.set(key, re.sub(r"\$(\w+)", lambda found: defaults.get(found[1], found[0]), value))
            if child.tag == "default":
                defaults.setdefault(child.get("name", ""), child.get("value", ""))
                parent.remove(child)
            elif child.tag == "path":
                folders.insert(0, _found(folders, child.get("value", "")))
                parent.remove(child)
            elif child.tag == "include":
                part = _found(folders, child.get("filename", ""))
                included = _read(scene, part, folders, defaults, changes, depth + 1)
                place = list(parent).index(child)
                parent.remove(child)
                for offset, element in enumerate(list(included) if included.tag == "scene" else [included]):
                    parent.insert(place + offset, element)
            elif child.get("name") == "filename":
                name = child.get("value", "")
                file = _found(folders, name)
                if file.exists():
                    child.set("value", os.path.relpath(file, scene.parent))
                    if not any((folder / name).exists() for folder in folders):
                        changes.renamed[name] = child.get("value", "")
            else:
                if "filename" in child.attrib:  # a spectrum, which the parser reads itself
                    named = _found(folders, child.attrib["filename"])
                    changes.files += [named] if named.is_file() else []
                    child.set("filename", str(named.resolve()))
                fill(child)

    fill(root)
    return root


def _found(folders: list[Path], name: str) -> Path:
    """The file or folder of that name in the first of the folders that has one; if none has, in the first."""
    exact = (folder / name for folder in folders if (folder / name).exists())
    alike = (file for folder in folders if (file := located(folder, name)) is not None)
    return next(itertools.chain(exact, alike), folders[0] / name)


def multiply_images(mi: Any, state: Any) -> None:
    """Multiply the bitmaps of a parsed scene that have a factor, in place; at most to 1, but for what lamps emit."""
    of_lamps = {
        node.props[key].index()
        for node in state.nodes
        if node.type == mi.ObjectType.Emitter
        for key in node.props.keys()  # noqa: SIM118 (Mitsuba's Properties is no dict)
        if node.props.type(key) == mi.Properties.Type.ResolvedReference
    }
    for number, node in enumerate(state.nodes):
        if FACTOR not in node.props:
            continue
        props, factor = node.props, np.array(numbers(node.props[FACTOR]), np.float32)
        if "filename" not in props:  # a missing one was left out
            del props[FACTOR]
            continue
        file = Path(str(mi.file_resolver().resolve(str(props["filename"]))))
        pixels = _pixels(mi, file, bool(props.get("raw", False)), bool((factor != factor[0]).any()))
        channels = min(3, pixels.shape[2] - (pixels.shape[2] in (2, 4)))  # but not alpha
        pixels[..., :channels] *= factor[:channels]
        if number not in of_lamps:
            np.minimum(pixels, 1, out=pixels)
        del props["filename"], props[FACTOR]
        props["bitmap"] = mi.Bitmap(pixels)


def _pixels(mi: Any, file: Path, raw: bool, coloured: bool) -> Any:
    """(h, w, channels) float32 as Mitsuba looks them up: linear, unless raw; of three channels at least if coloured."""
    image = mi.Bitmap(str(file))
    format = image.pixel_format()
    if coloured and format == mi.Bitmap.PixelFormat.Y:
        format = mi.Bitmap.PixelFormat.RGB
    image = image.convert(format, mi.Struct.Type.Float32, srgb_gamma=image.srgb_gamma() and raw)
    return np.atleast_3d(np.array(image, np.float32))
