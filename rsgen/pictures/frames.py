"""Pictures of a sequence: a preview of some frames, and one frame rendered again with a global shutter beside it.

The latter is the paper's Figure 3: global shutter, rolling shutter, signed difference.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import ByteArray, Float32Array
from rsgen.config.config import Config, recorded_config
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import read_yaml
from rsgen.produce.camera_sources import setting_of
from rsgen.produce.generate import ORIGIN
from rsgen.produce.parts import open_frames, scene_hash
from rsgen.sequence.format import RIG_FORMAT
from rsgen.sequence.reader import read_sequence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

log = logging.getLogger("rsgen")


def preview_sequence(path: Path, out: Path | None, count: int) -> Path:
    """Write a picture of `count` frames over the whole sequence, colour over depth; returns its path.

    Raises UserError if the sequence cannot be read or the picture not be written.
    """
    from rsgen.figures import save

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
    from rsgen.figures import save

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
    figure, axes = _axes(3, (13.5, 7.2), title)
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
    figure, axes = _axes(len(color), (3.9 * len(color) + 0.9, 6.2), title)
    measured = [np.where(z > 0, z, np.nan) for z in depth]
    high = max(float(np.nanmax(z)) if np.isfinite(z).any() else 1.0 for z in measured)
    for k, (image, z) in enumerate(zip(color, measured, strict=True)):
        axes[0, k].imshow(image)
        axes[1, k].imshow(z, cmap="viridis", vmin=0, vmax=high)
    figure.colorbar(axes[1, -1].images[0], ax=axes[1, -1], label="planar depth, m", shrink=0.9)
    return figure


def _axes(columns: int, size: tuple[float, float], title: str) -> tuple[Figure, Any]:
    """A figure of two rows of axes without ticks."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, columns, figsize=size, layout="constrained", squeeze=False)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle(title)
    return figure, axes


def _draw_signed(figure: Figure, axis: Axes, difference: NDArray, span: float, label: str) -> None:
    drawn = axis.imshow(difference, cmap="RdBu_r", vmin=-span, vmax=span)
    axis.set_facecolor("0.8")
    figure.colorbar(drawn, ax=axis, label=label, shrink=0.9)
