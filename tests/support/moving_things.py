"""Things that move by themselves: shapes, motions and their splines."""

from __future__ import annotations

from typing import Any

from rendering import RADTAN

from rsgen.config.motion import ObjectConfig
from rsgen.geometry.camera import Camera
from rsgen.motion.object_paths import object_spline

BOX = {"kind": "box", "size_m": [0.5, 0.3, 0.4]}
CIRCLE = {"kind": "circle", "position": [0.1, 0.2, 0.9], "radius_m": 0.4, "period_s": 1.0}
SWING = {"kind": "swing", "position": [-0.3, 0.3, 1.3], "pivot": [-0.3, -0.5, 1.3], "angle_deg": 20, "period_s": 0.7}
BALL = {"kind": "sphere", "size_m": [0.5, 0.4, 0.45], "color": [0.7, 0.1, 0.1], "check_color": [0.8, 0.8, 0.6]}
CAMERA = Camera(80, 60, 62.0, 60.0, 38.3, 30.2, RADTAN.model, RADTAN.distortion)


def thing(name: str = "thing", shape: Any = BOX, **motion: Any) -> ObjectConfig:
    return ObjectConfig.model_validate({"name": name, "shape": shape, "motion": motion})


def spline_of(config: ObjectConfig, begin: float = 0.0, end: float = 2.0) -> Any:
    return object_spline(config, begin, end, 0.05, 0.05)
