"""A scene file parsed by Mitsuba and made ready for it: old files upgraded, instances flattened, broken parts named.

Files that it names are found as Windows finds them: in whatever case, with backslashes between folders. Mitsuba's own
messages go to the logger meanwhile, never onto the screen.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from rsgen.errors import UserError, first_few
from rsgen.formats import xml_helper
from rsgen.inputs import MOST_BYTES, MOST_PIXELS, image_size
from rsgen.scene.placement import children, flatten, pose_of

log = logging.getLogger("rsgen")

# In these a JPEG with a preview in front of it has stated its size.
_HEADER_BYTES = 1 << 20
_UNKNOWN = re.compile(r'(\w+) plugin of type "(\w+)":|- \w+ "(\w+)"')
_FAILED = re.compile(r'At (.*?\(line \d+, col \d+\)): failed to instantiate (\w+) plugin of type "(\w+)": (.*)')


def parse(mi: Any, config: Any, path: Path, scratch: Path, shape: str | None = None) -> tuple[Any, Any, dict[str, str]]:
    """A scene file's parsed state, what an upgrade changed if it is older than Mitsuba 3 (None: it is not), and files
    that it names otherwise than they are called, by the names there.

    config: a ParserConfig; scratch: a folder for files made on the way; shape: XML of one more shape, which is added as
    the last. Raises UserError, and what Mitsuba's parser raises.
    """
    version = older_version(path)
    file, changes = path.resolve(), None
    if version is not None:
        text, changes = xml_helper("older version").upgrade(path, version, plugin_finder(mi))
        file = scratch / "upgraded.xml"
        file.write_bytes(text)
        config.unused_properties = mi.LogLevel.Warn  # listed as dropped, later
    if shape is not None:
        whole = scratch / "with_shape.xml"
        shape = shape.replace(' version="3.0.0"', "")
        whole.write_text(f"<scene version='3.0.0'><include filename={quoteattr(str(file))}/>{shape}</scene>")
        file = whole
    state = mi.parser.parse_file(config, str(file))
    renamed = {} if changes is None else changes.renamed
    return state, changes, renamed | repair_names(state, path.parent)


def older_version(path: Path) -> str | None:
    """Major and minor number, '0.6', of a scene file older than Mitsuba 3; None of any other file."""
    found = re.search(rb"<scene\b[^>]*?\bversion\s*=\s*[\"']\s*(\d+)\.(\d+)", path.read_bytes())
    return None if found is None or int(found[1]) >= 3 else f"{int(found[1])}.{int(found[2])}"


def plugin_finder(mi: Any) -> Callable[[str, str], bool]:
    """Tells whether Mitsuba has a plugin of a kind and a name."""
    manager, kind = mi.PluginManager.instance(), mi.ObjectType
    kinds = {"shape": kind.Shape, "bsdf": kind.BSDF, "texture": kind.Texture, "emitter": kind.Emitter}

    def exists(tag: str, plugin: str) -> bool:
        try:
            return manager.plugin_type(plugin) == kinds[tag]
        except RuntimeError:  # there is none of that name
            return False

    return exists


def prepare(mi: Any, config: Any, state: Any, path: Path) -> None:
    """Resolve references and flatten instances, in place. Raises UserError if a transform squashes a shape flat."""
    mi.parser.transform_upgrade(config, state)
    mi.parser.transform_resolve(config, state)
    flatten(mi, state)
    _sample_blends_from_behind(mi, state)
    for node in state.nodes:
        props = node.props
        if node.type == mi.ObjectType.Shape and "to_world" in props:
            pose = pose_of(props)
            linear, size = pose[:3, :3], float(np.linalg.norm(pose[:3, :3]))
            if not np.isfinite(pose).all() or abs(float(np.linalg.det(linear))) <= 1e-12 * size**3:
                what = props.id() or props.plugin_name()
                raise UserError(
                    f"scene {path}: to_world of shape '{what}' squashes it flat or is not finite: "
                    "scale no axis by 0, and mend its numbers"
                )


def _sample_blends_from_behind(mi: Any, state: Any) -> None:
    """Have rough metals in a `blendbsdf` that is not `twosided` sample all their microfacets, not the visible alone.

    Seen from behind, Mitsuba 3.9 samples the visible ones of Beckmann's to NaN, which a blend passes on to all light.
    """

    def below(index: int) -> set[int]:
        inner = [child for _, child in children(mi, state.nodes[index].props)]
        return set(inner).union(*(below(child) for child in inner))

    plugins = [node.props.plugin_name() for node in state.nodes]
    two_sided = set().union(*(below(k) for k, plugin in enumerate(plugins) if plugin == "twosided"))
    for blend in (k for k, plugin in enumerate(plugins) if plugin == "blendbsdf" and k not in two_sided):
        for metal in (k for k in below(blend) if plugins[k] == "roughconductor"):
            props = state.nodes[metal].props
            if str(props.get("distribution", "beckmann")) == "beckmann":
                props["sample_visible"] = False


def check_files(mi: Any, state: Any, path: Path, skip_missing: bool = False) -> None:
    """Raise UserError if a mesh or an image that the scene names is not there, or too large to be read.

    skip_missing: leave out what is not there, in place, with a warning each, where the scene can do without.
    """
    for number, node in enumerate(state.nodes):
        name = str(node.props["filename"]) if "filename" in node.props else None
        if name is None:
            continue
        file = Path(str(mi.file_resolver().resolve(name)))
        if not file.is_file():
            if not skip_missing or not _left_out(mi, state, number):
                raise UserError(missing_file(path, name))
            log.warning("scene %s: file '%s' is missing: rendered without it", path, name)
            continue
        with file.open("rb") as opened:
            width, height = image_size(opened.read(_HEADER_BYTES)) or (0, 0)
        if width * height > MOST_PIXELS or file.stat().st_size > MOST_BYTES:
            raise UserError(f"scene {path}: file '{name}' is too large to be read: make it smaller")


def missing_file(path: Path, name: str) -> str:
    """What is wrong with a scene that names a file that is not there, and how it is mended."""
    return (
        f"scene {path}: file '{name}' that it names is missing: put it there, mend its path in the scene, "
        "or leave it out with --skip-missing"
    )


def _left_out(mi: Any, state: Any, number: int) -> bool:
    """Take what needs a missing file out of a parsed scene, in place: a mesh altogether; a picture's place takes one
    even pixel, of a sky too. False where nothing can stand for it.
    """
    node, kind = state.nodes[number], mi.ObjectType
    holders = [(holder, key) for holder in state.nodes for key, child in children(mi, holder.props) if child == number]
    if node.type == kind.Shape:
        for holder, key in holders:
            del holder.props[key]
        node.props = mi.Properties("cube")  # which nobody holds, and so is not made
        return True
    plugin = node.props.plugin_name()
    if plugin not in ("bitmap", "envmap"):
        return False
    value = [0.5, 0.5, 0.5]
    if plugin == "envmap" or any(key == "opacity" for _, key in holders):
        value = [1.0, 1.0, 1.0]
    elif any(holder.props.plugin_name() == "normalmap" for holder, _ in holders):
        value = [0.5, 0.5, 1.0]
    size = (2, 4, 3) if plugin == "envmap" else (1, 1, 3)
    del node.props["filename"]
    node.props["bitmap"] = mi.Bitmap(np.broadcast_to(np.array(value, np.float32), size).copy())
    return True


@contextlib.contextmanager
def messages_to_log(mi: Any) -> Iterator[list[str]]:
    """While open, what Mitsuba would print goes to the logger at debug level, and into the list that this yields."""
    messages: list[str] = []

    class ToLog(mi.Appender):
        def append(self, level: Any, text: str) -> None:
            messages.append(text)
            log.debug("mitsuba: %s", text)

        def log_progress(self, *_: Any) -> None:
            pass

    logger = mi.logger()
    before = [logger.appender(k) for k in range(logger.appender_count())]
    logger.clear_appenders()
    logger.add_appender(ToLog())
    try:
        yield messages
    finally:
        logger.clear_appenders()
        for appender in before:
            logger.add_appender(appender)


def explained(mi: Any, state: Any, error: str) -> str:
    """Mitsuba's message about an object that it could not make, in one line: which one, why, and what to do."""
    text = " ".join(error.split())
    found = _FAILED.search(text)
    if found is None:
        return text[:300]
    place, kind, plugin, why = found.groups()
    node = next((n for n in state.nodes if str(mi.parser.file_location(state, n)) == place), None)
    props = None if node is None else node.props
    name = "" if props is None else str(props["filename"]) if "filename" in props else props.id()
    why = re.sub(r"\[[\w.:]+\] ?", "", why).rstrip("!. ")
    if "not found" in why and "Plugin" in why:
        why, mend = "Mitsuba 3 has no such plugin", "name another, or leave it out"
    elif kind == "shape":
        mend = "export it anew, whole, as triangles with finite vertices"
    elif plugin in ("bitmap", "envmap"):
        mend = "save the image anew"
    else:
        mend = "mend it in the scene"
    which = f" '{name}'" if name else ""
    return f"{kind} {plugin}{which}: {why[:200]}: {mend}"


def unknown_properties(messages: list[str]) -> list[str]:
    """'NAME of PLUGIN' for each property that Mitsuba's messages call unreferenced."""
    found, plugin = [], ""
    for message in messages:
        for match in _UNKNOWN.finditer(message) if "unreferenced" in message else ():
            if match[3] is None:
                plugin = match[2]
            else:
                found.append(f"{match[3]} of {plugin}")
    return sorted(found)


def located(folder: Path, name: str) -> Path | None:
    """The file or folder `name` in `folder`: by that very name, else by the only one that it is but for its case.

    Backslashes part folders where there is no such name. None if there is nothing, or more than one could be meant.
    """
    plain = name.replace("\\", "/")
    for exact in (folder / name, folder / plain):
        if exact.exists():
            return exact
    if not plain or Path(plain).is_absolute():
        return None
    found = [folder]
    for part in Path(plain).parts:
        found = [here for place in found for here in _alike(place, part)]
    return found[0] if len(found) == 1 else None


def repair_names(state: Any, folder: Path) -> dict[str, str]:
    """Rename files that a parsed scene names otherwise than they are called, in place; returns their names by those.

    folder: of the scene's file, which names are relative to. Names of no file stay as they are.
    """
    renamed: dict[str, str] = {}
    for node in state.nodes:
        if "filename" not in node.props:
            continue
        name = str(node.props["filename"])
        file = None if (folder / name).exists() else located(folder, name)
        if file is not None:
            renamed[name] = node.props["filename"] = os.path.relpath(file, folder)
    return renamed


def log_renamed(path: Path, renamed: Mapping[str, str]) -> None:
    """Log in a line which files of the scene `path` were found under other names than its own, if any."""
    pairs = [f"'{name}' is '{file}'" for name, file in sorted(renamed.items())]
    if pairs:
        log.warning("scene %s: found files by names that differ in case or slashes: %s", path, first_few(pairs))


def _alike(folder: Path, name: str) -> list[Path]:
    if name == "..":
        return [folder / name]
    try:
        return [other for other in folder.iterdir() if other.name.casefold() == name.casefold()]
    except OSError:
        return []
