"""Pictures of a sequence: a preview, and the paper's Figure 3 (global shutter, rolling shutter, signed difference)."""

from __future__ import annotations

import matplotlib

from rsgen.array_types import ByteArray, Float32Array

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray


def comparison(
    color: tuple[ByteArray, ByteArray],
    depth: tuple[Float32Array, Float32Array],
    title: str,
) -> Figure:
    """Figure 3 of the paper. `color` (h, w, 3) sRGB and `depth` (h, w) metres, each (global, rolling shutter)."""
    figure, axes = plt.subplots(2, 3, figsize=(13.5, 7.2), layout="constrained")
    grey = [image.astype(float).mean(axis=-1) for image in color]
    span = max(float(np.percentile(np.abs(grey[1] - grey[0]), 99.5)), 1.0)
    for axis, image, name in zip(axes[0], color, ("global shutter", "rolling shutter"), strict=False):
        axis.imshow(image)
        axis.set_title(f"colour, {name}")
    _signed(figure, axes[0, 2], grey[1] - grey[0], span, "rolling − global, grey levels (of 255)")
    axes[0, 2].set_title("colour, difference")

    seen = [np.where(z > 0, z, np.nan) for z in depth]
    low, high = np.nanpercentile(seen, [0.5, 99.5]) if np.isfinite(seen).any() else (0.0, 1.0)
    for axis, z, name in zip(axes[1], seen, ("global shutter", "rolling shutter"), strict=False):
        axis.imshow(z, cmap="viridis", vmin=low, vmax=high)
        axis.set_title(f"depth, {name}")
    figure.colorbar(axes[1, 1].images[0], ax=axes[1, 1], label="planar depth, m", shrink=0.9)
    difference = 1000 * (seen[1] - seen[0])
    finite = np.abs(difference[np.isfinite(difference)])
    # Depth edges jump by whole objects; the scale is set by surfaces.
    span = max(float(np.percentile(finite, 90)), 0.1) if finite.size else 1.0
    _signed(figure, axes[1, 2], difference, span, "rolling − global, mm")
    axes[1, 2].set_title("depth, difference")
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle(title)
    return figure


def preview(color: list[ByteArray], depth: list[Float32Array], title: str) -> Figure:
    """Frames of a sequence over their depth: images (h, w, 3) sRGB, planar z (h, w) in metres, equally many."""
    count = len(color)
    figure, axes = plt.subplots(2, count, figsize=(3.9 * count + 0.9, 6.2), layout="constrained", squeeze=False)
    seen = [np.where(z > 0, z, np.nan) for z in depth]
    high = max(float(np.nanmax(z)) if np.isfinite(z).any() else 1.0 for z in seen)
    for k in range(count):
        axes[0, k].imshow(color[k])
        axes[1, k].imshow(seen[k], cmap="viridis", vmin=0, vmax=high)
    figure.colorbar(axes[1, -1].images[0], ax=axes[1, -1], label="planar depth, m", shrink=0.9)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle(title)
    return figure


def _signed(figure: Figure, axis: Axes, difference: NDArray, span: float, label: str) -> None:
    shown = axis.imshow(difference, cmap="RdBu_r", vmin=-span, vmax=span)
    axis.set_facecolor("0.8")
    figure.colorbar(shown, ax=axis, label=label, shrink=0.9)
