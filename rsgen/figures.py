"""Writing figures in the format of the file's suffix."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rsgen.errors import UserError
from rsgen.files import atomic_write, write_error

_DPI = 130


def save(figure: Figure, path: Path) -> None:
    """Write a figure in the format of its suffix (.png, .jpg, .svg, .pdf) and close it. Raises UserError."""
    kind = path.suffix.lower().removeprefix(".")
    if kind not in figure.canvas.get_supported_filetypes():
        raise UserError(f"{path}: pictures cannot be written as '{path.suffix}': choose .png, .jpg, .svg or .pdf")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=_DPI)
    plt.close(figure)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(path, error) from None
    atomic_write(path, buffer.getvalue())


def bare_axes(rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, Any]:
    """A figure of this size, inches, and its axes (rows, columns), which have no ticks."""
    bare: dict[str, Any] = {"xticks": [], "yticks": []}
    return plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False, subplot_kw=bare)


def save_grid(rows: Sequence[Sequence[NDArray]], titles: Sequence[str], path: Path) -> None:
    """Write rows of images, each (h, w, 3) in [0, 1], with a title over each column. Raises UserError."""
    height, width = rows[0][0].shape[:2]
    size = (4.2 * len(titles), 4.2 * height / width * len(rows) + 0.5)
    figure, axes = bare_axes(len(rows), len(titles), size)
    for row, images in zip(axes, rows, strict=True):
        for axis, image in zip(row, images, strict=True):
            axis.imshow(np.clip(image, 0, 1), interpolation="nearest")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title)
    save(figure, path)
