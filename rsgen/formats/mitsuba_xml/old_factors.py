"""Colours and textures of old scenes times a factor: Mitsuba 0.x had a texture for that, Mitsuba 3 has none.

Colours are multiplied in the tree. An image gets its factor as a property of ours, and is multiplied when it is loaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from rsgen.formats.mitsuba_xml import old_values as old

_FACTOR = "rsgen_factor"
_COLORS = ("rgb", "srgb", "spectrum", "float", "blackbody")
_CHECKERS = {"color0": "0.4", "color1": "0.2"}


class Factors:
    """Products of a scene's colours and textures, of those too that a `ref` names."""

    def __init__(self, root: Element) -> None:
        self._named = {e.get("id", ""): deepcopy(e) for e in root.iter("texture") if e.get("id")}
        self.kept: list[Element] = []
        """Textures as they were of which there is a product now: others may name them."""

    def times(self, e: Element, factor: Sequence[float]) -> Element | None:
        """A copy of a colour, a texture or a reference to one, times a factor (3); None if there is no way."""
        e = deepcopy(e)
        if e.get("id") is not None and e.tag == "texture":
            self.kept.append(old.renamed(deepcopy(e), None))
            del e.attrib["id"]
        if e.tag in _COLORS:
            return _color_times(old.as_rgb(e), factor)
        if e.tag == "ref":
            target = self._taken(e)
            product = None if target is None else self.times(target, factor)
            self._given_back(e, target)
            return None if product is None else old.renamed(product, e.get("name"))
        plugin = e.get("type", "")
        if plugin == "scale":
            product = self.times(old.scaled_by(e), [a * b for a, b in zip(factor, old.factor_of(e), strict=True)])
            return None if product is None else old.renamed(product, e.get("name"))
        if plugin == "bitmap":
            before = old.numbers(old.take(e, _FACTOR, "1, 1, 1"))
            value = old.joined(a * b for a, b in zip(before, factor, strict=True))
            SubElement(e, "string", name=_FACTOR, value=value)
            return e
        if plugin != "checkerboard":
            return None
        for name, default in _CHECKERS.items():
            color = old.named(e, name)
            if color is None:
                color = SubElement(e, "rgb", name=name, value=default)
            product = self.times(color, factor)
            if product is None:
                return None
            e[list(e).index(color)] = product
        return e

    def most(self, e: Element | None, default: float) -> float:
        """The most that any channel of a colour or a texture may have; an image: white, times its factor."""
        if e is None:
            return default
        if e.tag == "ref":
            target = self._taken(e)
            found = self.most(target, 1.0)
            self._given_back(e, target)
            return found
        if e.tag in _COLORS:
            return max(_values(old.as_rgb(e)), default=default)
        if e.get("type") == "scale":
            return self.most(old.scaled_by(e), 1.0) * max(old.factor_of(e))
        if e.get("type") == "checkerboard":
            return max(self.most(old.named(e, name), float(value)) for name, value in _CHECKERS.items())
        return max(old.numbers(factor.get("value", "1"))) if (factor := old.named(e, _FACTOR)) is not None else 1.0

    def _taken(self, ref: Element) -> Element | None:
        """What a reference names, not to be found again meanwhile: it may name itself."""
        target = self._named.pop(ref.get("id", ""), None)
        if target is None:
            return None
        target = deepcopy(target)
        target.attrib.pop("id")
        return target

    def _given_back(self, ref: Element, target: Element | None) -> None:
        if target is not None:
            target.set("id", ref.get("id", ""))
            self._named[ref.get("id", "")] = target


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
        if _FACTOR not in node.props:
            continue
        props, factor = node.props, np.array(old.numbers(node.props[_FACTOR]), np.float32)
        file = Path(str(mi.file_resolver().resolve(str(props["filename"]))))
        pixels = _pixels(mi, file, bool(props.get("raw", False)), bool((factor != factor[0]).any()))
        channels = min(3, pixels.shape[2] - (pixels.shape[2] in (2, 4)))  # but not alpha
        pixels[..., :channels] *= factor[:channels]
        if number not in of_lamps:
            np.minimum(pixels, 1, out=pixels)
        del props["filename"], props[_FACTOR]
        props["bitmap"] = mi.Bitmap(pixels)


def _pixels(mi: Any, file: Path, raw: bool, coloured: bool) -> Any:
    """(h, w, channels) float32 as Mitsuba looks them up: linear, unless raw; of three channels at least if coloured."""
    image = mi.Bitmap(str(file))
    format = image.pixel_format()
    if coloured and format == mi.Bitmap.PixelFormat.Y:
        format = mi.Bitmap.PixelFormat.RGB
    image = image.convert(format, mi.Struct.Type.Float32, srgb_gamma=image.srgb_gamma() and raw)
    return np.atleast_3d(np.array(image, np.float32))


def _values(color: Element) -> list[float]:
    value = color.get("value", "")
    if ":" not in value:
        return old.numbers(value)
    return [float(word.rpartition(":")[2]) for word in value.replace(";", ",").split(",")]


def _color_times(color: Element, factor: Sequence[float]) -> Element | None:
    """An <rgb>, or a spectrum of 'nm: value' pairs, times a factor of one value."""
    value = color.get("value", "")
    if ":" in value:
        pairs = [pair.partition(":") for pair in value.replace(";", ",").split(",")]
        color.set("value", ", ".join(f"{nm.strip()}:{float(v) * factor[0]:.7g}" for nm, _, v in pairs))
        return color if len(set(factor)) == 1 else None
    if color.tag == "ref" or not value:
        return None
    values = old.numbers(value)
    values = values * 3 if len(values) == 1 and len(set(factor)) > 1 else values
    color.set("value", old.joined(a * b for a, b in zip(values, factor, strict=False)))
    return color
