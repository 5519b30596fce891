"""Pictures of a sequence: some frames, one beside itself rendered again with a global shutter, and contact sheets.

The second is the paper's Figure 3: global shutter, rolling shutter, signed difference. Contact sheets are small
pictures along a sequence or a config's motion, colour over depth, with their times.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.config.cameras import ColorConfig
from rsgen.config.config import Config, recorded_config
from rsgen.console.progress import Progress, no_progress
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.figures import bare_axes, save
from rsgen.files import atomic_write, read_yaml
from rsgen.geometry import se3
from rsgen.geometry.shutter import Shutter
from rsgen.image_codecs import encode_png
from rsgen.produce.camera_sources import setting_of, small_camera
from rsgen.produce.generate import ORIGIN
from rsgen.produce.parts import load_motion, load_scene, open_frames, scene_hash
from rsgen.produce.views import adapted
from rsgen.sensors.color import to_srgb8
from rsgen.sequence.format import RIG_FORMAT
from rsgen.sequence.reader import read_sequence

log = logging.getLogger("rsgen")


def preview_sequence(path: Path, out: Path | None, count: int) -> Path:
    """Write a picture of `count` frames over the whole sequence, colour over depth; returns its path.

    Raises UserError if the sequence cannot be read or the picture not be written.
    """
    sequence = read_sequence(path)
    streams = sequence.streams
    available = min(len(streams["color"].stamps), len(streams["depth"].stamps))
    if available == 0 or count < 1:
        raise UserError(f"{path}: no frames to show: render some, and ask for at least one")
    chosen = np.linspace(0, available - 1, min(count, available)).round().astype(int)
    shutter = streams["color"].shutter
    numbers = ", ".join(str(k) for k in streams["color"].indices[chosen])
    title = f"{sequence.name}: frames {numbers} (readout {1000 * shutter.readout_s:g} ms)"
    out = out or path / "preview.png"
    save(preview([sequence.color(k) for k in chosen], [sequence.depth(k) for k in chosen], title), out)
    return out


def compare_frame(
    path: Path, frame: int, out: Path | None, scene: Path | None, progress: Progress = no_progress
) -> Path:
    """Write the paper's Figure 3 for one frame: global shutter, rolling shutter, signed difference; returns its path.

    The global-shutter pictures are rendered at the time of the middle line. `scene` names the scene file if it is no
    longer where it was. Raises UserError.
    """
    sequence = read_sequence(path).as_taken
    color, depth = (sequence.streams[name] for name in ("color", "depth"))
    for stream in (color, depth):
        if frame not in stream.indices:
            raise UserError(f"{path}: has no {stream.name} frame {frame}: choose one of {_span(stream.indices)}")
    config = config_of(path, sequence.meta, scene)
    if scene_hash(config) != _mapping(sequence.meta.get("inputs")).get("scene"):
        log.warning("%s: the scene %s has changed since, so more than the shutter differs", path, config.scene.file)
    things = [thing.spline for thing in sequence.objects]
    source = open_frames(config, progress, global_shutter=True, objects=things)
    at = {stream.name: int(np.flatnonzero(stream.indices == frame)[0]) for stream in (color, depth)}
    middle = {s.name: float(s.stamps[at[s.name]]) + s.shutter.readout_s / 2 for s in (color, depth)}
    setting = setting_of(config.color, color.table, at["color"])
    colors = source.color.picture(sequence.spline, middle["color"], frame, setting), sequence.color(at["color"])
    depths = source.depth.exact(sequence.spline, middle["depth"]), sequence.truth_depth(at["depth"])
    title = (
        f"{sequence.name}, frame {frame}: readout {1000 * color.shutter.readout_s:g} ms (colour), "
        f"{1000 * depth.shutter.readout_s:g} ms (depth); global shutter at the middle line's time"
    )
    out = out or path / f"compare_{frame:06d}.png"
    save(comparison(colors, depths, title), out)
    return out


def config_of(path: Path, meta: dict[str, Any], scene: Path | None) -> Config:
    """The config that a sequence records, with its scene and its objects' meshes found on this machine."""
    if meta.get("format") == RIG_FORMAT:
        raise UserError(f"{path}: is of a rig, of which no frame is rendered again: take a sequence of two cameras")
    origin = read_yaml(path / ORIGIN) if (path / ORIGIN).is_file() else {}
    recorded = _mapping(meta.get("config"))
    file = scene or Path(str(origin.get("scene", "")))
    if not file.is_file():
        raise UserError(f"{path}: its scene '{file}' is not on this machine: name it with --scene")
    recorded["scene"] = _mapping(recorded.get("scene")) | {"file": str(file.resolve())}
    if recorded.get("motion") is None:
        trajectory = {"file": str(origin.get("trajectory", "unused"))}
        recorded["trajectory"] = _mapping(recorded.get("trajectory")) | trajectory
    things = [_mapping(thing) for thing in recorded.get("objects") or ()]
    for thing in things:
        if (mesh := origin.get(f"object {thing.get('name')}")) is not None:
            thing["mesh"] = str(mesh)
    recorded["objects"] = things
    return recorded_config(recorded, f"{path}/sequence.yaml: config")


def _mapping(value: Any) -> dict[str, Any]:
    """A copy of a YAML mapping; empty for anything else, which is for the validation to complain about."""
    return dict(value) if isinstance(value, dict) else {}


def _span(indices: Any) -> str:
    return f"{min(indices)} to {max(indices)}" if len(indices) else "none: it is empty"


def comparison(
    color: tuple[ByteArray, ByteArray], depth: tuple[Float32Array, Float32Array], title: str
) -> Figure:  # fmt: skip
    """Figure 3 of the paper. `color` (h, w, 3) sRGB and `depth` (h, w) metres, each (global, rolling shutter)."""
    figure, axes = bare_axes(2, 3, (13.5, 7.2))
    figure.suptitle(title)
    grey = [image.astype(float).mean(axis=-1) for image in color]
    span = max(float(np.percentile(np.abs(grey[1] - grey[0]), 99.5)), 1.0)
    for axis, image, name in zip(axes[0], color, ("global shutter", "rolling shutter"), strict=False):
        axis.imshow(image)
        axis.set_title(f"colour, {name}")
    _draw_signed(figure, axes[0, 2], grey[1] - grey[0], span, "rolling − global, grey levels (of 255)")
    axes[0, 2].set_title("colour, difference")

    measured = [np.where(z > 0, z, np.nan) for z in depth]
    low, high = np.nanpercentile(measured, [0.5, 99.5]) if np.isfinite(measured).any() else (0.0, 1.0)
    for axis, z, name in zip(axes[1], measured, ("global shutter", "rolling shutter"), strict=False):
        axis.imshow(z, cmap="viridis", vmin=low, vmax=high)
        axis.set_title(f"depth, {name}")
    figure.colorbar(axes[1, 1].images[0], ax=axes[1, 1], label="planar depth, m", shrink=0.9)
    difference = 1000 * (measured[1] - measured[0])
    finite = np.abs(difference[np.isfinite(difference)])
    # Depth edges jump by whole objects; the scale is set by surfaces.
    span = max(float(np.percentile(finite, 90)), 0.1) if finite.size else 1.0
    _draw_signed(figure, axes[1, 2], difference, span, "rolling − global, mm")
    axes[1, 2].set_title("depth, difference")
    return figure


def preview(color: list[ByteArray], depth: list[Float32Array], title: str) -> Figure:
    """Frames of a sequence over their depth: images (h, w, 3) sRGB, planar z (h, w) in metres, equally many."""
    figure, axes = bare_axes(2, len(color), (3.9 * len(color) + 0.9, 6.2))
    figure.suptitle(title)
    measured = [np.where(z > 0, z, np.nan) for z in depth]
    high = max(float(np.nanmax(z)) if np.isfinite(z).any() else 1.0 for z in measured)
    for k, (image, z) in enumerate(zip(color, measured, strict=True)):
        axes[0, k].imshow(image)
        axes[1, k].imshow(z, cmap="viridis", vmin=0, vmax=high)
    figure.colorbar(axes[1, -1].images[0], ax=axes[1, -1], label="planar depth, m", shrink=0.9)
    return figure


def _draw_signed(figure: Figure, axis: Axes, difference: NDArray, span: float, label: str) -> None:
    drawn = axis.imshow(difference, cmap="RdBu_r", vmin=-span, vmax=span)
    axis.set_facecolor("0.8")
    figure.colorbar(drawn, ax=axis, label=label, shrink=0.9)


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
