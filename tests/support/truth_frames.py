"""Truth images of one frame of the glowing room, as the colour camera sees it along a spline."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import synthetic
from rendering import emission_integrator

from rsgen.config.cameras import ColorConfig
from rsgen.config.sections import TruthConfig
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.truth.renderer import TruthRenderer

STAMP, NEXT = 0.31, 0.31 + 1 / 30
T_CAM_BODY = synthetic.T_COLOR_DEPTH
SPLINE = synthetic.make_spline()
EVERYTHING = TruthConfig(
    global_shutter=("first", "middle", "last"),
    flow=("global", "next"),
    normals=True,
    blur_length=True,
    color_depth=True,
)
GEOMETRY = ("flow_global_first", "flow_global_middle", "flow_global_last", "flow_next")


def motion(t: Any) -> np.ndarray:
    """The colour camera's poses along the spline."""
    return SPLINE.pose(t) @ se3.inverse(T_CAM_BODY)


def stream(camera: Camera, shutter: Shutter) -> ColorConfig:
    return ColorConfig(
        width=camera.width, height=camera.height, intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy),
        model=camera.model, distortion=camera.distortion, readout_s=shutter.readout_s, exposure_s=shutter.exposure_s,
        scan=shutter.scan,
    )  # fmt: skip


def render(
    scene: Any, camera: Camera, shutter: Shutter, path: Any = motion, stamps: Any = (STAMP, NEXT), **what: Any
) -> dict[str, np.ndarray]:
    """All geometry of one frame (and twins of one sample a pixel, which nobody looks at), or what is asked for."""
    truth = TruthConfig(**what) if what else EVERYTHING.model_copy(update={"spp": 1})
    return TruthRenderer(scene, emission_integrator(), stream(camera, shutter), truth).render(path, *stamps, seed=3)


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Values of an image (h, w) at pixels uv (..., 2)."""
    u, v = (uv[..., k].astype(np.float32) for k in (0, 1))
    return cv2.remap(image.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
