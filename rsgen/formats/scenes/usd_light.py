"""UsdLux lights as lamps: radiance is intensity · 2^exposure · colour, by the size of a light with `normalize`."""

from __future__ import annotations

from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.formats.scenes.import_scene import Kind, Lamp, Notes
from rsgen.formats.scenes.usd_texture import asset_bytes

LIGHTS = ("SphereLight", "RectLight", "DiskLight", "DistantLight", "DomeLight", "DomeLight_1")

_SKY_SUFFIXES = (".exr", ".hdr", ".png", ".jpg", ".jpeg")
_SPOT_DEG = 90.0  # cones as wide as this are none


def lamp(
    prim: Any, T_world_prim: FloatArray, T_stage_prim: FloatArray, z_up: bool, time: Any, notes: Notes
) -> Lamp | None:
    """The lamp of a light prim. T_world_prim, T_stage_prim (4, 4): into the world, m, and into the stage, its units.

    z_up: of the stage. None where the light has no extent or sends nothing out.
    """
    from pxr import UsdLux

    kind, name = prim.GetTypeName(), str(prim.GetPath())
    light = UsdLux.LightAPI(prim)

    def number(key: str, default: float) -> float:
        attribute = prim.GetAttribute(f"inputs:{key}")
        value = attribute.Get(time) if attribute else None
        return default if value is None else float(value)

    color = light.GetColorAttr().Get(time)
    value = np.ones(3) if color is None else np.array(color, float)
    if light.GetEnableColorTemperatureAttr().Get(time):
        value = value * np.array(UsdLux.BlackbodyTemperatureAsRgb(number("colorTemperature", 6500.0)), float)
    # The default of a distant light's is another than the others'.
    value = value * float(light.GetIntensityAttr().Get(time)) * 2.0 ** number("exposure", 0.0)
    if not np.isfinite(value).all() or not value.any():
        notes.add("light left out, it sends nothing out", name)
        return None
    for key in ("shaping:ies:file", "shaping:focus"):
        attribute = prim.GetAttribute(f"inputs:{key}")
        if attribute and attribute.Get(time):
            notes.add(f"light rendered without its {key}", name)
    normalize = bool(light.GetNormalizeAttr().Get(time))
    linear = T_stage_prim[:3, :3]
    if kind.startswith("DomeLight"):
        return _dome(prim, value, T_world_prim, kind == "DomeLight_1" and z_up, time, notes)
    if kind == "DistantLight":
        angle = np.radians(number("angle", 0.53)) / 2
        solid = np.pi * np.sin(angle) ** 2
        irradiance = value if normalize or solid == 0 else value * solid
        if number("angle", 0.53) > 2:
            notes.add("distant light rendered without its angle, its shadows are sharp", name)
        return Lamp("directional", irradiance, _rigid(T_world_prim))
    if kind == "SphereLight":
        return _sphere(prim, value, T_world_prim, linear, normalize, number, time, notes)
    if prim.GetAttribute("inputs:texture:file") and prim.GetAttribute("inputs:texture:file").Get(time):
        notes.add("light rendered without its texture", name)
    half = [number("radius", 0.5)] * 2 if kind == "DiskLight" else [number(k, 1.0) / 2 for k in ("width", "height")]
    across = linear[:, :2] * half
    area = float(np.linalg.norm(np.cross(across[:, 0], across[:, 1]))) * (np.pi if kind == "DiskLight" else 4.0)
    if area == 0:
        notes.add("light left out, it has no area", name)
        return None
    T = T_world_prim @ np.diag([*half, 1.0, 1.0])
    shape: Kind = "disk" if kind == "DiskLight" else "rectangle"
    return Lamp(shape, value / area if normalize else value, T)


def _sphere(
    prim: Any, value: FloatArray, T_world_prim: FloatArray, linear: FloatArray, normalize: bool, number: Any, time: Any,
    notes: Notes,
) -> Lamp:  # fmt: skip
    """A ball; a spot where a cone shapes its light, a point where it is to be treated as one."""
    scale = abs(np.linalg.det(linear)) ** (1 / 3)
    radius = number("radius", 0.5) * scale
    world = abs(np.linalg.det(T_world_prim[:3, :3])) ** (1 / 3) / max(scale, 1e-30)  # metres per unit of the stage
    point = prim.GetAttribute("treatAsPoint")
    is_point = bool(point and point.Get(time)) or radius == 0
    cone = number("shaping:cone:angle", 180.0)
    # A point's intensity is what the ball's would be: radiance by the area that it shows.
    intensity = value * world**2 / 4 if normalize else value * np.pi * (radius * world) ** 2
    if radius == 0 and not normalize:
        intensity = value * world**2
    if cone < _SPOT_DEG:
        notes.add("light with a cone rendered as a spot from one point", str(prim.GetPath()))
        soft = number("shaping:cone:softness", 0.0)
        return Lamp("spot", intensity, _rigid(T_world_prim), (cone, cone * (1 - min(max(soft, 0.0), 1.0))))
    if is_point:
        return Lamp("point", intensity, _rigid(T_world_prim))
    area = 4 * np.pi * radius**2
    return Lamp(
        "sphere", value / area if normalize else value, T_world_prim @ np.diag([*[number("radius", 0.5)] * 3, 1.0])
    )


def _dome(prim: Any, value: FloatArray, T_world_prim: FloatArray, pole_z: bool, time: Any, notes: Notes) -> Lamp:
    T = _rigid(T_world_prim)
    if pole_z:  # its pole is the stage's up axis; else it is its own y, as in Mitsuba
        T = T @ np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    file = prim.GetAttribute("inputs:texture:file")
    asset = file.Get(time) if file else None
    if asset is None or not asset.path:
        return Lamp("sky", value, T)
    suffix = "." + asset.path.rstrip("]").rpartition(".")[2].lower()
    layout = prim.GetAttribute("inputs:texture:format")
    data = asset_bytes(file, asset)
    if (
        data is None
        or suffix not in _SKY_SUFFIXES
        or (layout and layout.Get(time) not in (None, "automatic", "latlong"))
    ):
        notes.add("dome's texture missing or of no kind that is read here, a uniform sky in its place", asset.path)
        return Lamp("sky", value, T)
    return Lamp("sky", value, T, picture=data, suffix=suffix)


def _rigid(T: FloatArray) -> FloatArray:
    """The rotation nearest to a map's, with its place."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    out = T.copy()
    out[:3, :3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return out
