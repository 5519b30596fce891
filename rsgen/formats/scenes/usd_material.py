"""A USD material as ours: UsdPreviewSurface as it is, the base of other surfaces by the names of their inputs."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from rsgen.array_types import Float32Array, FloatArray
from rsgen.formats.scenes.import_scene import Notes
from rsgen.formats.scenes.usd_texture import (
    UsdImage,
    asset_bytes,
    decoded,
    same_size,
    transform_of,
    wrap_of,
)  # fmt: skip
from rsgen.scene.material import Material, Texture

COORDINATES = "st"
COLORS = "displayColor"

_THERE = 0.5  # opacity from which a surface without a threshold is there, as for mesh files
_PREVIEW = ("UsdPreviewSurface", "ND_UsdPreviewSurface_surfaceshader")
# What surfaces of other makers (MaterialX, Omniverse) call the same.
_NAMES = {
    "color": ("diffuseColor", "base_color", "diffuse_color_constant", "diffuse_color"),
    "metallic": ("metallic", "metalness", "base_metalness", "metallic_constant"),
    "roughness": ("roughness", "specular_roughness", "reflection_roughness_constant"),
    "opacity": ("opacity", "geometry_opacity", "opacity_constant"),
    "threshold": ("opacityThreshold", "opacity_threshold"),
    "emission": ("emissiveColor", "emissive_color"),
    "normal": ("normal",),
}
_FILES = {"color": "diffuse_texture", "normal": "normalmap_texture"}  # whose inputs are images at once
_LEFT_OUT = ("clearcoat", "displacement", "transmission")
_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}


@dataclass(frozen=True, eq=False)
class BoundMaterial:
    """A material, the primvars by which it is looked up and coloured, if any, and whether it is one of the file."""

    material: Material
    coordinates: str | None = COORDINATES
    colors: str | None = None
    bound: bool = True


UNBOUND = BoundMaterial(Material(), None, COLORS, bound=False)


class Materials:
    """Materials of a stage at one time; each is made once."""

    def __init__(self, time: Any, notes: Notes) -> None:
        """time: a Usd.TimeCode. notes: takes what has no place here."""
        self._time, self._notes = time, notes
        self._made: dict[str, BoundMaterial] = {}
        self._equal: dict[bytes, Material] = {}
        self._images: dict[tuple[str, str], Float32Array | None] = {}

    def bound(self, material: Any) -> BoundMaterial:
        """What a bound UsdShade.Material is here; UNBOUND for none."""
        if not material:
            return UNBOUND
        path = str(material.GetPath())
        if path not in self._made:
            self._made[path] = self._bound(material, path)
        return self._made[path]

    def _bound(self, material: Any, path: str) -> BoundMaterial:
        shader = _surface(material)
        if not shader:
            self._notes.add("material without a surface that is read here, rendered grey", path)
            return replace(UNBOUND, bound=True, colors=None)
        kind = _identifier(shader)
        if kind not in _PREVIEW:
            self._notes.add(f"surface '{kind}' read by its base colour, roughness and metal only", path)
        inputs = {key: self._input(shader, key) for key in _NAMES}
        for name in _LEFT_OUT:
            given = shader.GetInput(name)
            if given and (given.HasConnectedSource() or given.Get(self._time)):
                self._notes.add(f"rendered without {name}", path)
        images = [v for v in inputs.values() if isinstance(v, _Channel)]
        coordinates = next((p.image.coordinates for p in images), COORDINATES)
        if any(p.image.coordinates != coordinates for p in images):
            self._notes.add("all textures looked up by the coordinates of the first", path)
        color = inputs["color"]
        made = self._color(inputs, Material(color=_constant(color, 3, 0.18)))
        made = self._metal(inputs, made)
        if isinstance(emission := inputs["emission"], _Channel):
            made = replace(made, emission=np.ones(3), emission_texture=emission.texture(emission.image.color))
        elif emission is not None:
            made = replace(made, emission=_constant(emission, 3, 0.0))
        if isinstance(normal := inputs["normal"], _Channel):
            bytes_ = normal.image.bytes_of((normal.image.values + 1) / 2)
            made = replace(made, normal_texture=normal.texture(bytes_))
        # Copies of a material are one: shapes are joined by their materials.
        made = self._equal.setdefault(_fingerprint(made), made)
        return BoundMaterial(made, coordinates, color if isinstance(color, str) else None)

    def _color(self, inputs: dict[str, Any], made: Material) -> Material:
        color, opacity = inputs["color"], inputs["opacity"]
        if isinstance(color, _Channel):
            made = replace(made, color=np.ones(3), color_texture=color.texture(color.image.color))
        threshold = float(_constant(inputs["threshold"], 1, 0.0)[0])
        cutoff = threshold if threshold > 0 else _THERE
        if not isinstance(opacity, _Channel):
            value = float(_constant(opacity, 1, 1.0)[0])
            return made if value >= 1 else replace(made, opacity=value, cutoff=cutoff, color_texture=None)
        if made.color_texture is None:
            pixels, base = np.full((1, 1, 4), 255, np.uint8), opacity
        else:
            pixels, base = made.color_texture.pixels, color
        channels = same_size([*np.moveaxis(pixels, -1, 0)[:3], opacity.image.bytes_of(opacity.values)])
        return replace(made, color_texture=base.texture(np.stack(channels, -1).astype(np.uint8)), cutoff=cutoff)

    def _metal(self, inputs: dict[str, Any], made: Material) -> Material:
        rough, metal = inputs["roughness"], inputs["metallic"]
        texture = next((v for v in (rough, metal) if isinstance(v, _Channel)), None)
        made = replace(
            made, roughness=float(_constant(rough, 1, 0.5)[0]), metallic=float(_constant(metal, 1, 0.0)[0])
        )  # fmt: skip
        if texture is None:
            return made
        g, b = (v.image.bytes_of(v.values) if isinstance(v, _Channel) else np.full((1, 1), 255) for v in (rough, metal))
        g, b = same_size([g, b])
        pixels = np.stack([np.zeros_like(g), g, b, np.full_like(g, 255)], axis=-1).astype(np.uint8)
        made = replace(made, metal_texture=texture.texture(pixels))
        made = replace(made, roughness=1.0) if isinstance(rough, _Channel) else made
        return replace(made, metallic=1.0) if isinstance(metal, _Channel) else made

    def _input(self, shader: Any, key: str) -> Any:
        """None, a constant, a `_Channel` of an image, or the name of the primvar that it takes."""
        from pxr import UsdShade

        given = next((i for name in _NAMES[key] if (i := shader.GetInput(name))), None)
        path = str(shader.GetPath())
        if key in _FILES and (file := shader.GetInput(_FILES[key])) and file.Get(self._time):
            return self._picture(file, None, "rgb", key == "normal", path)
        if given is None:
            return None
        source = next(iter(UsdShade.Utils.GetValueProducingAttributes(given)), None)
        if source is None:
            return given.Get(self._time)
        name, kind = UsdShade.Utils.GetBaseNameAndType(source.GetName())
        if kind != UsdShade.AttributeType.Output:
            return source.Get(self._time)
        node = UsdShade.Shader(source.GetPrim())
        if _identifier(node).startswith("UsdPrimvarReader_float3"):
            return str(_value(node.GetInput("varname"), self._time))
        if file := node.GetInput("file"):
            return self._picture(file, node, name, key == "normal", path)
        self._notes.add(f"{key}, made by a node '{_identifier(node)}', left out", path)
        return None

    def _picture(self, file: Any, node: Any, output: str, is_normal: bool, path: str) -> Any:
        from pxr import UsdShade

        source = next(iter(UsdShade.Utils.GetValueProducingAttributes(file)), file.GetAttr())
        asset = source.Get(self._time)

        def given(name: str) -> Any:
            return None if node is None else _value(node.GetInput(name), self._time)

        space = str(source.GetColorSpace() if node is None else given("sourceColorSpace"))
        space = space if space in ("raw", "sRGB") else "auto"
        values = None if asset is None else self._image(source, asset, space)
        if values is None:
            name = "of no name" if asset is None else asset.path
            self._notes.add("texture missing or unreadable, a constant in its place", f"{name} of {path}")
            return given("fallback")
        if asset is not None and "<UDIM>" in asset.path:
            self._notes.add("of a texture in tiles only the first is taken", asset.path)
        scale, bias = _four(given("scale"), 1.0), _four(given("bias"), 0.0)
        if is_normal and (scale == 1).all() and not bias.any():
            scale, bias = np.full(4, 2.0), np.full(4, -1.0)  # what is meant, though not stated
        if (scale != 1).any() or bias.any():
            values = (values * scale + bias).astype(np.float32)
        where, transform = self._lookup(None if node is None else node.GetInput("st"))
        return _Channel(UsdImage(values, wrap_of(given("wrapS"), given("wrapT")), transform, where), output)

    def _image(self, source: Any, asset: Any, space: str) -> Float32Array | None:
        key = str(asset.resolvedPath) or asset.path, space
        if key not in self._images:
            data = asset_bytes(source, asset)
            self._images[key] = None if data is None else decoded(data, space)
        return self._images[key]

    def _lookup(self, given: Any) -> tuple[str, FloatArray]:
        """The primvar by which a texture is looked up, and its transform."""
        from pxr import UsdShade

        transform, name = np.eye(3), COORDINATES
        for _ in range(8):  # transforms may follow each other, but not for ever
            found = UsdShade.Utils.GetValueProducingAttributes(given) if given else []
            if not found:
                break
            node = UsdShade.Shader(found[0].GetPrim())
            if (var := node.GetInput("varname")) or "PrimvarReader" in _identifier(node):
                name = str(_value(var, self._time) or COORDINATES)
                break
            own = {k: _value(node.GetInput(k), self._time) for k in ("rotation", "scale", "translation")}
            scale = np.ones(2) if own["scale"] is None else np.array(own["scale"], float)
            move = np.zeros(2) if own["translation"] is None else np.array(own["translation"], float)
            step = transform_of(float(own["rotation"] or 0.0), scale, move)
            transform = transform @ np.vstack([step, [0, 0, 1]])
            given = node.GetInput("in")
        return name, transform[:2]


@dataclass(frozen=True, eq=False)
class _Channel:
    """An image and which of its outputs is taken."""

    image: UsdImage
    output: str

    @property
    def values(self) -> Float32Array:
        """(h, w) of the output that is one number."""
        return self.image.values[..., _CHANNELS.get(self.output, 0)]

    def texture(self, pixels: Any) -> Texture:
        return Texture(pixels, self.image.wrap, False, self.image.transform)


def _fingerprint(material: Material) -> bytes:
    """The same for materials that look the same."""
    digest = hashlib.sha256()
    for field in fields(material):
        value = getattr(material, field.name)
        if isinstance(value, Texture):
            digest.update(f"{value.pixels.shape} {value.wrap} {value.nearest}".encode())
            digest.update(np.ascontiguousarray(value.pixels).tobytes() + value.transform.tobytes())
        else:
            digest.update(f"{field.name} {np.asarray(value).tolist() if value is not None else None!r}".encode())
    return digest.digest()


def _surface(material: Any) -> Any:
    """The shader of a material's surface, in whatever render context it has one; None."""
    from pxr import UsdShade

    shader = material.ComputeSurfaceSource()[0]
    if shader:
        return shader
    for output in material.GetSurfaceOutputs():
        for attribute in UsdShade.Utils.GetValueProducingAttributes(output):
            return UsdShade.Shader(attribute.GetPrim())
    return None


def _identifier(shader: Any) -> str:
    name = shader.GetShaderId() or shader.GetSourceAssetSubIdentifier("mdl") or shader.GetPrim().GetName()
    return str(name)


def _value(given: Any, time: Any) -> Any:
    """Of an input, through whatever it is connected to; None."""
    from pxr import UsdShade

    if not given:
        return None
    found = UsdShade.Utils.GetValueProducingAttributes(given)
    return found[0].Get(time) if found else given.Get(time)


def _constant(value: Any, size: int, default: float) -> FloatArray:
    """A constant as (size,); of a colour that is to be one number, its mean; the default for what is none."""
    if value is None or isinstance(value, (_Channel, str)):
        return np.full(size, default)
    array = np.atleast_1d(np.array(value, float))
    array = array[:3].mean(keepdims=True) if size == 1 else array[:size]
    return np.full(size, array[0]) if len(array) == 1 else array


def _four(value: Any, default: float) -> FloatArray:
    return np.full(4, default) if value is None else np.array(value, float)
