"""Values in scene files of Mitsuba 0.x: properties by name, and every way of writing a colour as an <rgb>."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from xml.etree.ElementTree import Element, SubElement

_COLORS = (
    *("reflectance", "diffuse_reflectance", "transmittance", "diffuse_transmittance"),
    *("base_color", "albedo", "color", "value", "color0", "interior_color"),
)


def snake(name: str) -> str:
    """'intIOR' -> 'int_ior', as Mitsuba's own upgrade has it."""
    return re.sub(r"(?<=[a-z])([A-Z]+)", lambda found: "_" + found[1].lower(), name)


def named(e: Element, name: str) -> Element | None:
    """The child of that name, if there is one."""
    return next((child for child in e if child.get("name") == name), None)


def take(e: Element, name: str, default: str) -> str:
    """The value of a property, which is taken out, or the default."""
    child = named(e, name)
    if child is None:
        return default
    e.remove(child)
    return child.get("value", default)


def renamed(e: Element, name: str | None) -> Element:
    """The element under another name, or under none."""
    e.attrib.pop("name", None)
    if name is not None:
        e.set("name", name)
    return e


def nested(e: Element, tags: tuple[str, ...]) -> Element | None:
    """The first child with one of the tags."""
    return next((child for child in e if child.tag in tags), None)


def numbers(text: str) -> list[float]:
    """All numbers of a text, by commas or blanks."""
    return [float(word) for word in re.split(r"[\s,;]+", text.strip()) if word]


def joined(values: Iterable[float]) -> str:
    """Numbers as a text."""
    return ", ".join(f"{value:.7g}" for value in values)


def factor_of(scale: Element) -> list[float]:
    """Of a scale texture: three values, of the channels."""
    factor = named(scale, "scale")
    values = [1.0] if factor is None else numbers(as_rgb(factor).get("value", "1"))
    return values if len(values) == 3 else [sum(values) / len(values)] * 3


def scaled_by(scale: Element) -> Element:
    """What a scale texture scales: a texture, a reference to one, or a colour."""
    inner = nested(scale, ("texture", "ref"))
    return color_of(scale) if inner is None else inner


def color_of(e: Element) -> Element:
    """The colour or texture that an object shows; grey where it names none."""
    found = next((child for name in _COLORS if (child := named(e, name)) is not None), None)
    return Element("rgb", value="0.5") if found is None else found


def texture_of(rgb: Element) -> Element:
    """A colour as a texture, for where Mitsuba 3 takes nothing else."""
    texture = Element("texture", type="srgb")
    SubElement(texture, "rgb", name="color", value=rgb.get("value", ""))
    return texture


def as_rgb(e: Element) -> Element:
    """An <rgb> for the colours of old: sRGB, hexadecimal, black bodies, and spectra of one or of three values."""
    value = e.get("value", "").strip()
    if e.tag == "blackbody":
        return _black_body(e)
    if e.tag == "ref" or ":" in value or "filename" in e.attrib:
        return e
    coded = value.startswith("#")
    rgb = [int(value[k : k + 2], 16) / 255 for k in (1, 3, 5)] if coded else numbers(value)
    if e.tag == "srgb" or coded:
        rgb = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in rgb]
    return renamed(Element("rgb", value=joined(rgb)), e.get("name"))


def _black_body(e: Element) -> Element:
    """Planck's law in W m^-2 sr^-1 nm^-1 as a spectrum, which Mitsuba turns into a colour."""
    kelvin = float(e.get("temperature", "5000").strip().rstrip("kK"))
    scale = float(e.get("scale", e.get("multiplier", "1")))
    lines = []
    for nm in range(360, 831, 10):
        m = nm * 1e-9
        radiance = 1.191042972e-16 / m**5 / math.expm1(0.01438776877 / (m * kelvin)) * 1e-9
        lines.append(f"{nm}:{radiance * scale:.6g}")
    return renamed(Element("spectrum", value=", ".join(lines)), e.get("name"))
