"""Images of a USD material: found through its resolver, in packages too, and as bytes that a `Material` takes."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

from rsgen import srgb
from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.inputs import EXR_START, MOST_BYTES, MOST_PIXELS, image_size

_WRAP = {"clamp": "clamp", "black": "clamp", "mirror": "mirror"}
_FIRST_TILE = "1001"


@dataclass(frozen=True, eq=False)
class UsdImage:
    """An image as a UsdUVTexture node gives it: values (h, w, 4) in [0, 1] linear, row 0 on top, v running down.

    wrap, transform (2, 3): as `Texture` has them. coordinates: the primvar that it is looked up by.
    """

    values: Float32Array
    wrap: str
    transform: FloatArray
    coordinates: str

    def bytes_of(self, values: Any) -> ByteArray:
        """Values in [0, 1] as bytes."""
        return np.asarray(np.round(np.clip(values, 0, 1) * 255), np.uint8)

    @property
    def color(self) -> ByteArray:
        """(h, w, 4): sRGB, and alpha."""
        encoded = srgb.encode(np.clip(self.values[..., :3], 0, 1))
        return self.bytes_of(np.concatenate([encoded, self.values[..., 3:]], axis=-1))


def asset_bytes(attribute: Any, asset: Any) -> bytes | None:
    """What an asset-valued attribute names: a file, or a file in a .usdz; the first tile of many; None if missing."""
    from pxr import Ar, Sdf

    resolver = Ar.GetResolver()
    name = str(asset.resolvedPath)
    if not name and asset.path:
        path = asset.path.replace("<UDIM>", _FIRST_TILE)
        stack = attribute.GetPropertyStack()
        name = str(resolver.Resolve(Sdf.ComputeAssetPathRelativeToLayer(stack[0].layer, path) if stack else path))
    if not name or (Path(name).exists() and not Path(name).is_file()):  # a pipe would never end
        return None
    opened = resolver.OpenAsset(Ar.ResolvedPath(name))
    if opened is None or not 0 < opened.GetSize() <= MOST_BYTES:  # a device has no size
        return None
    return bytes(opened.GetBuffer())


def decoded(data: bytes, space: str) -> Float32Array | None:
    """Linear values (h, w, 4) of an image's bytes; None if they are no image. space: auto, raw or sRGB.

    auto is USD's rule: sRGB are 8-bit images of three or four channels.
    """
    width, height = image_size(data) or (0, 0)
    if width * height > MOST_PIXELS:
        return None
    if data.startswith(EXR_START):
        return _exr(data)
    try:
        with Image.open(io.BytesIO(data)) as image:
            deep = image.mode.startswith(("I", "F"))
            grey = image.mode in ("1", "L", "LA") or deep
            if deep:
                values = np.repeat(np.asarray(image.convert("F"))[..., None] / 65535, 4, axis=-1).astype(np.float32)
                values[..., 3] = 1
            else:
                values = np.asarray(image.convert("RGBA"), np.float32) / np.float32(255)
    except Exception:  # Pillow raises whatever its decoders do
        return None
    if space == "sRGB" or (space == "auto" and not grey):
        table = srgb.decode(np.arange(256) / 255).astype(np.float32)
        color = srgb.decode(values[..., :3]) if deep else table[np.round(values[..., :3] * 255).astype(np.uint8)]
        values = np.concatenate([color, values[..., 3:]], axis=-1)
    return values


def _exr(data: bytes) -> Float32Array | None:
    """Values (h, w, 4) of an EXR, which are linear."""
    try:
        with OpenEXR.File(io.BytesIO(data)) as file:
            planes = {name: np.atleast_3d(np.array(c.pixels, np.float32)) for name, c in file.channels().items()}
    except Exception:  # whatever OpenEXR raises on damaged files
        return None
    joint = next((planes[name] for name in ("RGBA", "RGB") if name in planes), None)
    if joint is None:
        first = next(iter(planes.values()))
        joint = np.concatenate([planes.get(name, first)[..., :1] for name in "RGB"], axis=-1)
    alpha = joint[..., 3:] if joint.shape[2] > 3 else planes.get("A", np.ones_like(joint[..., :1]))[..., :1]
    return np.concatenate([joint[..., :3], alpha], axis=-1)


def wrap_of(*modes: Any) -> str:
    """How a texture goes on outside: the first of USD's words, of either direction, that is known here."""
    return next((_WRAP[str(mode)] for mode in modes if str(mode) in _WRAP), "repeat")


def transform_of(rotation_deg: float, scale: FloatArray, translation: FloatArray) -> FloatArray:
    """(2, 3) for coordinates whose v runs down, of a UsdTransform2d, whose v runs up."""
    angle = np.radians(rotation_deg)
    s, c = np.sin(angle), np.cos(angle)
    up = np.eye(3)
    up[:2, :2] = np.array([[c, -s], [s, c]]) @ np.diag(scale)
    up[:2, 2] = translation
    flip = np.array([[1, 0, 0], [0, -1, 1], [0, 0, 1.0]])
    return np.asarray((flip @ up @ flip)[:2])


def same_size(images: list[Any]) -> list[Any]:
    """Channels (h, w), enlarged to the largest by repeating texels; (1, 1) are constants."""
    h, w = (max(p.shape[axis] for p in images) for axis in (0, 1))
    return [p[np.arange(h) * p.shape[0] // h][:, np.arange(w) * p.shape[1] // w] for p in images]
