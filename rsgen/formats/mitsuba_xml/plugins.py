"""The walk that rewrites an old scene's tree (see `upgrade`): what became of every plugin of Mitsuba 0.x."""

from __future__ import annotations

import re
from collections.abc import Callable
from xml.etree.ElementTree import Element, SubElement

from rsgen.formats.mitsuba_xml import Changes
from rsgen.formats.mitsuba_xml import colors as old

_OBJECTS = ("scene", "shape", "bsdf", "texture", "emitter")
_VALUES = ("float", "integer", "boolean", "string", "point", "vector", "rgb", "spectrum", "transform", "ref", "alias")
_NOT_OURS = ("sensor", "integrator", "sampler", "film", "rfilter")  # rsgen has its own
_NO_COUNTERPART = ("medium", "subsurface", "phase", "volume")
_TAGS = {"luminaire": "emitter", "camera": "sensor", "lookAt": "lookat"}
_ATTRIBUTES = frozenset(
    ("type", "id", "name", "value", "x", "y", "z", "angle", "origin", "target", "up", "filename", "version", "as")
)
_RENAMED = {"bump": "bumpmap", "ldrtexture": "bitmap", "exrtexture": "bitmap", "lambertian": "diffuse"}
Exists = Callable[[str, str], bool]
"""Whether Mitsuba 3 has a plugin: its kind, as a tag ("shape", "bsdf", "texture", "emitter"), and its name."""


class Upgrade:
    """One walk over a tree, parents before children, since some plugins take their children apart."""

    def __init__(self, exists: Exists, changes: Changes) -> None:
        self._exists = exists
        self._dropped, self._replaced, self._not_used = changes.dropped, changes.replaced, changes.not_used
        self._version = tuple(map(int, changes.version.split(".")))
        self._alias: dict[str, str] = {}  # id of an object that went -> id of the one in its place
        self._gone: set[str] = set()
        self._factors = old.Factors(Element("scene"))

    def scene(self, root: Element) -> Element:
        """The tree, changed in place."""
        self._names(root)
        self._factors = old.Factors(root)
        self._children(root)
        for texture in self._factors.originals:  # they may become more on the way
            if all(element.get("id") != texture.get("id") or element.tag == "ref" for element in root.iter()):
                root.append(self._texture(texture))
                self._children(root[-1])
        root.set("version", "3.0.0")
        present = {element.get("id") for element in root.iter() if element.tag != "ref"}
        for parent in root.iter():
            for ref in parent.findall("ref"):
                name = ref.get("id", "")
                while name in self._alias:
                    name = self._alias[name]
                ref.set("id", name)
                if name in self._gone and name not in present:
                    parent.remove(ref)
        return root

    def _names(self, parent: Element) -> None:
        """Leave out what is not ours, and name tags, properties and plugins as Mitsuba 3 does."""
        for child in list(parent):
            child.tag = _TAGS.get(child.tag, child.tag)
            if child.tag in _NOT_OURS + _NO_COUNTERPART:
                (self._not_used if child.tag in _NOT_OURS else self._dropped)[child.tag] += 1
                self._leave_out(child)
                parent.remove(child)
                continue
            if "name" in child.attrib:
                name = child.attrib["name"]  # 'intIOR' -> 'int_ior', as Mitsuba's own upgrade has it
                child.set("name", re.sub(r"(?<=[a-z])([A-Z]+)", lambda found: "_" + found[1].lower(), name))
            if child.tag in _OBJECTS:
                child.set("type", _RENAMED.get(child.get("type", ""), child.get("type", "")))
            for key in [key for key in child.attrib if key not in _ATTRIBUTES and child.tag != "blackbody"]:
                self._dropped[f"attribute {key}"] += 1
                del child.attrib[key]
            self._names(child)

    def _children(self, parent: Element) -> None:
        left = []
        last = {child.get("name"): child for child in parent if child.tag in _VALUES and child.tag != "ref"}
        for child in list(parent):
            name = child.get("name")
            if name is not None and last.get(name, child) is not child:  # the last one counted
                self._dropped[f"repeated {name}"] += 1
                continue
            new = self._element(child)
            if new is None:
                self._leave_out(child)
                continue
            left.append(new)
            if parent.tag == "bsdf" and new.tag == "rgb" and self._version < (2, 0):
                self._bounded(new)
            if new.tag in _OBJECTS:
                self._children(new)
        parent[:] = left

    def _bounded(self, color: Element) -> None:
        """What would reflect more than there is, is darkened, as Mitsuba 0.x did."""
        values = old.numbers(color.get("value", ""))
        if color.get("name", "").endswith(("reflectance", "transmittance")) and max(values, default=0) > 1:
            self._replaced[f"{color.get('name')} of {max(values):g} by 0.99"] += 1
            color.set("value", old.joined(0.99 * value / max(values) for value in values))

    def _leave_out(self, e: Element) -> None:
        self._gone |= {inner.get("id", "") for inner in e.iter() if inner.tag != "ref"}

    def _element(self, e: Element) -> Element | None:
        """What stands in the place of one element; None if nothing does."""
        if e.tag == "ref":  # interior and exterior are media, and those are gone
            return None if e.get("name") in ("interior", "exterior") else e
        if e.tag == "animation":
            self._replaced["animation by its first pose"] += 1
            first = e.find("transform")
            return None if first is None else old.renamed(first, "to_world")
        if e.tag in ("srgb", "blackbody") or (e.tag in ("rgb", "spectrum") and self._version < (2, 0)):
            return e if "type" in e.attrib else old.as_rgb(e)
        if e.tag in ("point", "vector") and "value" not in e.attrib:
            for axis in "xyz":
                e.attrib.setdefault(axis, "0")
        if e.tag in ("shape", "bsdf", "texture", "emitter"):
            return getattr(self, f"_{e.tag}")(e)
        if e.tag in (*_OBJECTS, *_VALUES):
            return e
        self._dropped[f"<{e.tag}>"] += 1
        return None

    def _stand_in(self, gone: Element, new: Element) -> Element:
        """`new` under the name of `gone`; who names the id of `gone` gets `new`."""
        old.renamed(new, gone.get("name"))
        if (name := gone.get("id")) is not None:
            if (own := new.get("id")) is not None:
                self._alias[name] = own
                return new
            if new.tag == "rgb":  # a value has no id: a texture of one colour has
                color, new = new, old.renamed(Element("texture", type="srgb"), gone.get("name"))
                SubElement(new, "rgb", name="color", value=color.get("value", ""))
            new.set("id", name)
        return new

    def _shape(self, e: Element) -> Element | None:
        plugin = e.get("type", "")
        if not self._exists(e.tag, plugin):
            self._dropped[f"shape {plugin}"] += 1
            return None
        first, *others = [child for child in e if child.tag == "bsdf"] or [Element("bsdf")]
        for other in others:  # of an .obj with several materials, by name
            self._dropped["further bsdf of a shape"] += 1
            e.remove(other)
        first.attrib.pop("name", None)
        return e

    def _emitter(self, e: Element) -> Element | None:
        plugin = e.get("type", "")
        if plugin in ("sky", "sun", "sunsky") and self._version < (2, 0):
            return self._sky(e, plugin)
        if not self._exists(e.tag, plugin):
            self._dropped[f"emitter {plugin}"] += 1
            return None
        intensity = {"area": "radiance", "constant": "radiance", "directional": "irradiance"}.get(plugin)
        if self._version < (0, 4) and intensity is not None and (value := old.named(e, "intensity")) is not None:
            value.set("name", intensity)
        return e

    def _sky(self, e: Element, plugin: str) -> Element:
        """Mitsuba 3 has one plugin for all: x is south, y west and z up where x was east, y up and z south."""
        scale = old.take(e, "scale", "1")
        parts = {part: old.take(e, part, scale) for part in ("sun_scale", "sky_scale")}
        if plugin != "sunsky":
            parts = {"sun_scale": scale, "sky_scale": scale, "sky_scale" if plugin == "sun" else "sun_scale": "0"}
        radius = max(float(old.take(e, "sun_radius_scale", "1")), 0.05)  # 0 was a sun without size
        for name, value in {**parts, "sun_aperture": f"{0.5358 * radius:.6g}"}.items():
            SubElement(e, "float", name=name, value=value)
        if old.named(e, "albedo") is None:
            SubElement(e, "rgb", name="albedo", value="0.15")
        pose = old.named(e, "to_world")
        pose = SubElement(e, "transform", name="to_world") if pose is None else pose
        pose.insert(0, Element("matrix", value="0 -1 0 0 0 1 1 0 0"))
        self._replaced[f"emitter {plugin} by the sunsky of Mitsuba 3"] += 1
        e.set("type", "sunsky")
        return e

    def _texture(self, e: Element) -> Element:
        plugin = e.get("type", "")
        if plugin == "scale":
            return self._scale(e)
        if not self._exists(e.tag, plugin):
            self._replaced[f"texture {plugin} by one colour"] += 1
            shown = old.color_of(e)
            return self._stand_in(e, self._texture(shown) if shown.tag == "texture" else old.as_rgb(shown))
        if any(old.named(e, axis + word) is not None for axis in "uv" for word in ("offset", "scale")):
            pose = SubElement(e, "transform", name="to_uv")  # Mitsuba's own upgrade scales the offset, too
            SubElement(pose, "scale", x=old.take(e, "uscale", "1"), y=old.take(e, "vscale", "1"))
            SubElement(pose, "translate", x=old.take(e, "uoffset", "0"), y=old.take(e, "voffset", "0"))
        if plugin == "bitmap":
            self._bitmap(e)
        return e

    def _bitmap(self, e: Element) -> None:
        modes = {old.take(e, f"wrap_mode{axis}", "repeat") for axis in ("_u", "_v", "")} - {"repeat"}
        if modes:
            mode = min(modes) if modes <= {"clamp", "mirror"} else "clamp"
            for lost in sorted(modes - {mode}):
                self._replaced[f"wrap mode {lost} by {mode}"] += 1
            SubElement(e, "string", name="wrap_mode", value=mode)
        kind = old.take(e, "filter_type", "bilinear")
        if kind == "nearest":
            SubElement(e, "string", name="filter_type", value=kind)
        elif kind != "bilinear":
            self._replaced[f"texture filter {kind} by bilinear"] += 1
        gamma = float(old.take(e, "gamma", "-1"))
        if gamma == 1:
            SubElement(e, "boolean", name="raw", value="true")
        elif gamma > 0:
            self._dropped[f"gamma {gamma:g} of a bitmap"] += 1

    def _scale(self, e: Element) -> Element:
        """What it scales, times its factor."""
        factor, inner = old.factor_of(e), old.scaled_by(e)
        plugin = inner.get("type", "")
        if inner.tag == "texture" and plugin != "scale" and not self._exists("texture", plugin):
            inner = self._texture(inner)
        product = self._factors.times(inner, factor)
        if product is None:
            self._dropped[f"factor {old.joined(sorted(set(factor)))} of a scaled texture"] += 1
            product = inner
        return self._stand_in(e, self._texture(product) if product.tag == "texture" else product)

    def _bsdf(self, e: Element) -> Element:
        plugin = e.get("type", "")
        inner = old.nested(e, ("bsdf", "ref"))
        if plugin in ("coating", "roughcoating") and inner is not None:
            self._dropped[plugin] += 1
            return self._stand_in(e, self._bsdf(inner) if inner.tag == "bsdf" else inner)
        if plugin == "mixturebsdf":
            return self._mixture(e)
        if plugin in old.TWO_LOBES and (lobes := old.two_lobes(e, self._factors)) is not None:
            self._replaced[f"bsdf {plugin} by diffuse and roughconductor"] += 1
            return self._stand_in(e, lobes)
        if not self._exists(e.tag, plugin):
            self._replaced[f"bsdf {plugin} by diffuse"] += 1
            matte = Element("bsdf", type="diffuse")
            matte.append(old.renamed(old.color_of(e), "reflectance"))
            if plugin == "difftrans":  # light passes through it: seen from both sides
                twosided = Element("bsdf", type="twosided")
                twosided.append(matte)
                matte = twosided
            return self._stand_in(e, matte)
        if plugin == "diffuse" and (color := old.named(e, "diffuse_reflectance")) is not None:
            color.set("name", "reflectance")
        if (kind := old.named(e, "distribution")) is not None and kind.get("value") not in ("beckmann", "ggx"):
            self._replaced[f"distribution {kind.get('value')} by beckmann"] += 1
            kind.set("value", "beckmann")
        if plugin == "roughplastic" and (alpha := old.named(e, "alpha")) is not None and alpha.tag != "float":
            self._dropped["alpha texture of roughplastic"] += 1
            e.remove(alpha)
        texture = e.find("texture")
        if plugin == "bumpmap" and texture is not None and texture.get("type") == "scale":
            heights = old.nested(texture, ("texture", "ref"))
            if heights is not None:
                SubElement(e, "float", name="scale", value=f"{sum(old.factor_of(texture)) / 3:g}")
                e[list(e).index(texture)] = heights
        if plugin == "normalmap" and texture is not None:
            texture.set("name", "normalmap")
            if texture.get("type") == "bitmap":
                old.take(texture, "raw", "")
                SubElement(texture, "boolean", name="raw", value="true")
        return e

    def _mixture(self, e: Element) -> Element:
        """Blends of two. What weights of less than 1 in all would absorb is lost."""
        weights = old.numbers(old.take(e, "weights", ""))
        keeps_energy = old.take(e, "ensure_energy_conservation", "true") == "true"
        parts = [child for child in e if child.tag in ("bsdf", "ref")]
        if not parts or len(parts) != len(weights) or sum(weights) <= 0:
            self._replaced["bsdf mixturebsdf by diffuse"] += 1
            return self._stand_in(e, Element("bsdf", type="diffuse"))
        if sum(weights) < 0.999:
            self._dropped["absorption of a mixturebsdf"] += 1
        if sum(weights) > 1.001 and not keeps_energy:  # else weights are brought to 1 in all
            shares = old.added(parts, weights, self._factors)
            if shares is None:
                self._dropped[f"sum of weights {sum(weights):g} of a mixturebsdf"] += 1
            weights = weights if shares is None else shares
        mixed, total = old.renamed(parts[0], None), weights[0]
        if len(parts) == 1:
            return self._stand_in(e, self._bsdf(mixed) if mixed.tag == "bsdf" else mixed)
        for part, weight in zip(parts[1:], weights[1:], strict=True):
            total += weight
            blend = Element("bsdf", type="blendbsdf")
            SubElement(blend, "float", name="weight", value=f"{weight / total if total else 0:.6g}")
            blend.extend((mixed, old.renamed(part, None)))
            mixed = blend
        return self._stand_in(e, mixed)
