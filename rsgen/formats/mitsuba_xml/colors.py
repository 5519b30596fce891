"""Colours of scene files of Mitsuba 0.x: as an <rgb>, times a factor, and shared out between two lobes of a BSDF."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from copy import deepcopy
from xml.etree.ElementTree import Element, SubElement

_COLORS = (
    *("reflectance", "diffuse_reflectance", "transmittance", "diffuse_transmittance"),
    *("base_color", "albedo", "color", "value", "color0", "interior_color"),
)


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


FACTOR = "rsgen_factor"
_COLOR_TAGS = ("rgb", "srgb", "spectrum", "float", "blackbody")
_CHECKERS = {"color0": "0.4", "color1": "0.2"}


class Factors:
    """Products of a scene's colours and textures, of those too that a `ref` names."""

    def __init__(self, root: Element) -> None:
        self._named = {e.get("id", ""): deepcopy(e) for e in root.iter("texture") if e.get("id")}
        self.originals: list[Element] = []
        """Textures as they were of which there is a product now: others may name them."""

    def times(self, e: Element, factor: Sequence[float]) -> Element | None:
        """A copy of a colour, a texture or a reference to one, times a factor (3); None if there is no way."""
        e = deepcopy(e)
        if e.get("id") is not None and e.tag == "texture":
            self.originals.append(renamed(deepcopy(e), None))
            del e.attrib["id"]
        if e.tag in _COLOR_TAGS:
            return _color_times(as_rgb(e), factor)
        if e.tag == "ref":
            target = self._taken(e)
            product = None if target is None else self.times(target, factor)
            self._given_back(e, target)
            return None if product is None else renamed(product, e.get("name"))
        plugin = e.get("type", "")
        if plugin == "scale":
            product = self.times(scaled_by(e), [a * b for a, b in zip(factor, factor_of(e), strict=True)])
            return None if product is None else renamed(product, e.get("name"))
        if plugin == "bitmap":
            before = numbers(take(e, FACTOR, "1, 1, 1"))
            value = joined(a * b for a, b in zip(before, factor, strict=True))
            SubElement(e, "string", name=FACTOR, value=value)
            return e
        if plugin != "checkerboard":
            return None
        for name, default in _CHECKERS.items():
            color = named(e, name)
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
        if e.tag in _COLOR_TAGS:
            return max(_values(as_rgb(e)), default=default)
        if e.get("type") == "scale":
            return self.most(scaled_by(e), 1.0) * max(factor_of(e))
        if e.get("type") == "checkerboard":
            return max(self.most(named(e, name), float(value)) for name, value in _CHECKERS.items())
        return max(numbers(factor.get("value", "1"))) if (factor := named(e, FACTOR)) is not None else 1.0

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


def _values(color: Element) -> list[float]:
    value = color.get("value", "")
    if ":" not in value:
        return numbers(value)
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
    values = numbers(value)
    values = values * 3 if len(values) == 1 and len(set(factor)) > 1 else values
    color.set("value", joined(a * b for a, b in zip(values, factor, strict=False)))
    return color


TWO_LOBES = ("phong", "ward")

_LOBE_COLORS = {"diffuse": "reflectance", "conductor": "specular_reflectance", "roughconductor": "specular_reflectance"}
_MATTE, _MIRRORED = "0.5", "0.2"  # reflectances, where a file has none
_EXPONENT, _ALPHA = "30", "0.1"
_MOST = 0.99  # of both together, to which Mitsuba 0.x brought those that would make light


def two_lobes(e: Element, factors: Factors) -> Element | None:
    """`diffuse` and `roughconductor`, of the reflectances that they had; None if one of these cannot be multiplied.

    cos^n about the mirrored direction has the peak and energy of Beckmann's microfacets of alpha^2 = 1 / (2 (n + 2)):
    these turn half as far as what they mirror. Ward's alpha is theirs.
    """
    matte = _color_or(e, "diffuse_reflectance", _MATTE)
    mirrored = _color_or(e, "specular_reflectance", _MIRRORED)
    most = factors.most(matte, 1.0), factors.most(mirrored, 1.0)
    total = sum(most)
    if most[1] <= 0:
        return _lobe("diffuse", "reflectance", matte)
    if most[0] <= 0:
        return _metal(e, mirrored)
    brighter = min(total, _MOST)  # times total / most[k] for its share, times _MOST / total to keep energy
    colors = [factors.times(color, [brighter / part] * 3) for color, part in zip((matte, mirrored), most, strict=True)]
    if colors[0] is None or colors[1] is None:
        return None
    blend = Element("bsdf", type="blendbsdf")
    SubElement(blend, "float", name="weight", value=f"{most[1] / total:.6g}")
    blend.extend((_lobe("diffuse", "reflectance", colors[0]), _metal(e, colors[1])))
    return blend


def added(parts: list[Element], weights: list[float], factors: Factors) -> list[float] | None:
    """Shares by lot, 1 in all, of BSDFs that a mixture adds with weights that are more than 1 in all; their colours are
    changed in place. None if one of them is none that has a single colour, or that cannot be multiplied.
    """
    colors = [named(part, _LOBE_COLORS.get(part.get("type", ""), "")) for part in parts]
    most = [weight * factors.most(color, 0.0) for weight, color in zip(weights, colors, strict=True)]
    if not all(most):
        return None
    brighter = min(sum(most), _MOST)
    products = [
        None if color is None else factors.times(color, [weight * brighter / part_most] * 3)
        for color, weight, part_most in zip(colors, weights, most, strict=True)
    ]
    if None in products:
        return None
    for part, color, product in zip(parts, colors, products, strict=True):
        assert color is not None and product is not None
        part[list(part).index(color)] = product
    return [part_most / sum(most) for part_most in most]


def _color_or(e: Element, name: str, default: str) -> Element:
    found = named(e, name)
    return Element("rgb", value=default) if found is None else found


def _lobe(plugin: str, name: str, color: Element) -> Element:
    lobe = Element("bsdf", type=plugin)
    lobe.append(renamed(color, name))
    return lobe


def _metal(e: Element, color: Element) -> Element:
    """A mirror of that colour, as rough as the lobe of `e`; of the default roughness where `e` has a texture for it."""
    metal = _lobe("roughconductor", "specular_reflectance", color)
    SubElement(metal, "string", name="material", value="none")
    if e.get("type") == "phong":
        alphas = {"alpha": math.sqrt(0.5 / (float(_number_or(e, "exponent", _EXPONENT)) + 2))}
    else:
        both = _number_or(e, "alpha", _ALPHA)
        alphas = {name: float(_number_or(e, name, both)) for name in ("alpha_u", "alpha_v")}
    for name, alpha in alphas.items():
        SubElement(metal, "float", name=name, value=f"{min(alpha, 1):.6g}")
    return metal


def _number_or(e: Element, name: str, default: str) -> str:
    found = named(e, name)
    return default if found is None else found.get("value", default)
