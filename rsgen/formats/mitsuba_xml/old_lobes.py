"""BSDFs of Mitsuba 0.x that add a lobe that mirrors to a matte one, neither of them by Fresnel: `phong` and `ward`.

Mitsuba 3 has no sum of BSDFs, but one of two by lot: each is brighter by as much as it is rarer.
"""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element, SubElement

from rsgen.formats.mitsuba_xml import old_values as old
from rsgen.formats.mitsuba_xml.old_factors import Factors

PLUGINS = ("phong", "ward")

_COLOR_OF = {"diffuse": "reflectance", "conductor": "specular_reflectance", "roughconductor": "specular_reflectance"}
_MATTE, _MIRRORED = "0.5", "0.2"  # reflectances, where a file says nothing
_EXPONENT, _ALPHA = "30", "0.1"
_MOST = 0.99  # of both together, to which Mitsuba 0.x brought those that would make light


def two_lobes(e: Element, factors: Factors) -> Element | None:
    """`diffuse` and `roughconductor`, of the reflectances that they had; None if one of these cannot be multiplied.

    cos^n about the mirrored direction has the peak and energy of Beckmann's microfacets of alpha^2 = 1 / (2 (n + 2)):
    these turn half as far as what they mirror. Ward's alpha is theirs.
    """
    matte = _given(e, "diffuse_reflectance", _MATTE)
    mirrored = _given(e, "specular_reflectance", _MIRRORED)
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
    colors = [old.named(part, _COLOR_OF.get(part.get("type", ""), "")) for part in parts]
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


def _given(e: Element, name: str, default: str) -> Element:
    found = old.named(e, name)
    return Element("rgb", value=default) if found is None else found


def _lobe(plugin: str, name: str, color: Element) -> Element:
    lobe = Element("bsdf", type=plugin)
    lobe.append(old.renamed(color, name))
    return lobe


def _metal(e: Element, color: Element) -> Element:
    """A mirror of that colour, as rough as the lobe of `e`: of a texture, as rough as that is if nothing is said."""
    metal = _lobe("roughconductor", "specular_reflectance", color)
    SubElement(metal, "string", name="material", value="none")
    if e.get("type") == "phong":
        alphas = {"alpha": math.sqrt(0.5 / (float(_number(e, "exponent", _EXPONENT)) + 2))}
    else:
        both = _number(e, "alpha", _ALPHA)
        alphas = {name: float(_number(e, name, both)) for name in ("alpha_u", "alpha_v")}
    for name, alpha in alphas.items():
        SubElement(metal, "float", name=name, value=f"{min(alpha, 1):.6g}")
    return metal


def _number(e: Element, name: str, default: str) -> str:
    found = old.named(e, name)
    return default if found is None else found.get("value", default)
