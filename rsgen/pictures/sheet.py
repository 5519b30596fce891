"""Contact sheets: small pictures along a sequence or a config's motion, colour over depth, with their times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import matplotlib
import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.config.cameras import ColorConfig
from rsgen.config.config import Config
from rsgen.console.progress import Progress
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.geometry import se3
from rsgen.geometry.shutter import Shutter
from rsgen.image_codecs import encode_png
from rsgen.produce.camera_sources import small_camera
from rsgen.produce.parts import load_motion, load_scene
from rsgen.produce.views import adapted
from rsgen.sensors.color import to_srgb8
from rsgen.sequence.reader import read_sequence

_WIDTH, _SPP, _DEPTH = 160, 24, 8
_COLUMNS, _LABEL, _GAP = 8, 18, 3  # label and gap in pixels
_MOST = 600
_FAR = 0.98  # of the depths, that the colours tell apart


def sheet_of_sequence(path: Path, out: Path | None, every_s: float) -> Path:
    """Write the frames of a sequence every so many seconds as a PNG; returns its path. Raises UserError."""
    sequence = read_sequence(path)
    color, depth = (sequence.streams[name].stamps for name in ("color", "depth"))
    if not len(color) or not len(depth):
        raise UserError(f"{path}: no frames to show: render some")
    t = _instants(float(color[0]), float(color[-1]), every_s)
    shown = np.unique([int(np.abs(color - instant).argmin()) for instant in t])
    beside = [int(np.abs(depth - color[k]).argmin()) for k in shown]
    pictures = [_shrunk(sequence.color(int(k))) for k in shown]
    depths = [_shrunk(sequence.depth(k)) for k in beside]
    return _write(sheet(pictures, depths, color[shown] - color[0]), out or path / "sheet.png")


def sheet_of_config(config: Config, out: Path | None, every_s: float, progress: Progress) -> Path:
    """Path trace small pictures along a config's motion, sharp and without noise, and write them as a PNG.

    Things that move by themselves are left out. Returns the PNG's path. Raises UserError.
    """
    mi = mitsuba(config.backend)
    from rsgen.light.lamps import straight_through_bulbs
    from rsgen.render.images import ColorRenderer, DepthRenderer

    motion, scene = load_motion(config), load_scene(config)
    own = config.cameras[config.view]
    camera, T_body_cam = small_camera(own.camera, _WIDTH), se3.inverse(config.T_cam_body(config.view))

    def T_world_cam(t: float | FloatArray) -> FloatArray:
        return motion.spline.pose(t) @ T_body_cam

    integrator = mi.load_dict({"type": "path", "max_depth": _DEPTH})
    color, depth = ColorRenderer(scene, integrator, camera, Shutter(), _SPP), DepthRenderer(scene, camera, Shutter())
    t = _instants(motion.first_stamp, motion.last_stamp, every_s)
    light, z = [], []
    with straight_through_bulbs(scene):
        for k, instant in enumerate(t):
            progress("looking", k / len(t), f"{instant:.1f} s")
            light.append(color.render(T_world_cam, float(instant), k))
            z.append(depth.render(T_world_cam, float(instant)))
    linear, gains = np.stack(light), np.ones(len(t))
    if isinstance(own, ColorConfig):
        automatic = own.auto_exposure
        gains = gains * own.exposure_gain if automatic is None else adapted(linear[None], automatic.target)
    pictures = [to_srgb8(image, gain) for image, gain in zip(linear, gains.tolist(), strict=True)]
    return _write(sheet(pictures, z, t - t[0]), out or Path(f"{config.name}_sheet.png"))


def sheet(color: Sequence[ByteArray], depth: Sequence[Float32Array], t: FloatArray) -> ByteArray:
    """Pictures (h, w, 3) over depths (h, w) in m, 0 for none, row by row, each pair with its time, s, as one picture.

    Depth is dark near and bright far, black where there is none.
    """
    seen = np.concatenate([z[z > 0].ravel() for z in depth])
    far = float(np.quantile(seen, _FAR)) if len(seen) else 1.0
    shapes = [image.shape[:2] for image in color] + [z.shape for z in depth]
    height, width = (max(shape[k] for shape in shapes) for k in (0, 1))
    columns = min(_COLUMNS, len(t))
    high, wide = 2 * height + _LABEL + _GAP, width + _GAP
    whole = np.full((math.ceil(len(t) / columns) * high, columns * wide, 3), 255, np.uint8)
    colors = matplotlib.colormaps["viridis"]
    for k, (image, z, instant) in enumerate(zip(color, depth, t.tolist(), strict=True)):
        y, x = k // columns * high, k % columns * wide
        drawn = (255 * colors(np.clip(z / far, 0, 1))[..., :3]).astype(np.uint8) * (z > 0)[..., None]
        cv2.putText(whole, f"{instant:.1f} s", (x + 4, y + 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1)
        whole[y + _LABEL : y + _LABEL + image.shape[0], x : x + image.shape[1]] = image
        whole[y + _LABEL + height : y + _LABEL + height + z.shape[0], x : x + z.shape[1]] = drawn
    return whole


def _instants(first: float, last: float, every_s: float) -> FloatArray:
    count = math.floor((last - first) / every_s + 1e-9) + 1
    if count > _MOST:
        raise UserError(f"--every {every_s:g}: makes {count} pictures, at most {_MOST} are shown: take a longer time")
    return np.asarray(first + every_s * np.arange(count), float)


def _shrunk(image: np.ndarray) -> np.ndarray:
    """No wider than a thumbnail: colours averaged; of depths one of those there."""
    height, width = image.shape[:2]
    size = min(_WIDTH, width), max(1, round(height * min(_WIDTH, width) / width))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if image.ndim == 3 else cv2.INTER_NEAREST)


def _write(picture: ByteArray, out: Path) -> Path:
    if out.suffix.lower() != ".png":
        raise UserError(f"--out {out}: a contact sheet is a PNG: name it .png")
    atomic_write(out, encode_png(picture))
    return out
