"""The rolling-shutter sensor in a plain Mitsuba script: any scene, any renderer of Mitsuba, a pose for every row.

    python docs/examples/mitsuba_sensor.py rolling.png

The camera turns by 240 degrees a second past a striped wall: with a readout of 30 ms its vertical stripes lean.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from rsgen import Camera, RollingShutterSensor, Shutter  # chooses a variant of Mitsuba, if you have not yet

import mitsuba as mi  # isort: skip

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
RATE = np.deg2rad(240.0)


def T_world_cam(t: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) at times (n,) in s: x right, y down, z forward. A Spline's `pose` will do."""
    T = np.broadcast_to(np.eye(4), (len(t), 4, 4)).copy()
    T[:, 0, 0] = T[:, 2, 2] = np.cos(RATE * t)
    T[:, 0, 2] = np.sin(RATE * t)
    T[:, 2, 0] = -np.sin(RATE * t)
    return T


def striped_wall() -> mi.Scene:
    """A wall two metres ahead with vertical stripes, lit evenly; its checkerboard has rows of one cell."""
    wall = mi.ScalarTransform4f().translate([0, 0, 2]).rotate([0, 1, 0], 180).scale(4)
    stripes = {
        "type": "checkerboard",
        "to_uv": mi.ScalarTransform4f().scale([10, 1e-6, 1]),
        "color0": {"type": "rgb", "value": 0.1},
        "color1": {"type": "rgb", "value": 0.8},
    }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "light": {"type": "constant"},
            "wall": {"type": "rectangle", "to_world": wall, "bsdf": {"type": "diffuse", "reflectance": stripes}},
        }
    )


def render(readout_s: float) -> np.ndarray:
    """The image (h, w, 3), linear, of the frame stamped 0 s; readout_s 0 is a global shutter."""
    sensor = RollingShutterSensor(CAMERA, Shutter(readout_s=readout_s))
    sensor.expose(T_world_cam, stamp=0.0)
    return np.array(mi.render(striped_wall(), sensor=sensor, spp=4, seed=0))


def main(words: list[str]) -> None:
    """Write the picture."""
    out = Path(words[0] if words else "rolling.png")
    mi.util.write_bitmap(str(out), render(0.03), write_async=False)
    print(f"{out}: stripes lean by {CAMERA.fx * np.tan(RATE * 0.03):.1f} px from the first row to the last")


if __name__ == "__main__":
    main(sys.argv[1:])
