"""What a figure shows, apart from how it is drawn: lines, ticks and bars, and camera paths in space.

A chart has a title, and a note with what the reader has to know.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray

# Seen on white and on black.
TRUE_COLOR, LOST_COLOR = "#8a919e", "#d1432f"
COLORS = ("#2a7fc9", "#e08a1e", "#1f9e77", "#c9579b", "#7d5cc4", "#8fae2b")
_METHOD_COLORS = {
    "baseline": "#a8742a", "gs-g": "#7cc4ea", "rs-g": "#2a7fc9", "gs-pg": "#f0b13c", "rs-pg": "#d9531e",
    "gs-p": "#b9a5e0", "rs-p": "#7d5cc4",
}  # fmt: skip
_OTHER_COLORS = ("#1f9e77", "#66c29a", "#c9579b", "#8fae2b", "#5c8a8a", "#b06a6a")

# A line is broken where poses are missing for so many times the median step.
_GAP_STEPS = 3.0
# A path may leave the true one's box by this part of the box's size before it is cut off.
_ROOM = 0.35


@dataclass(frozen=True)
class Curve:
    """Values y (n,) over x (n,), NaN where there is none. has_points: few values were measured, and each is marked.

    low, high (n,): ends of the values' intervals, where these are known.
    """

    name: str
    color: str
    x: FloatArray
    y: FloatArray
    is_dashed: bool = False
    has_points: bool = False
    low: FloatArray | None = None
    high: FloatArray | None = None


@dataclass(frozen=True)
class Ticks:
    """Instants x (n,), marked below the lines."""

    name: str
    color: str
    x: FloatArray


@dataclass(frozen=True)
class Bars:
    """A bar in each group, and a mark on it of what others have reached, NaN where there is none: both (groups,)."""

    name: str
    color: str
    values: FloatArray
    marks: FloatArray


@dataclass(frozen=True)
class Chart:
    """title, unit: of y. groups: below the bars. y_max: what lies above is cut off. note: what the reader has to know.

    Without a logarithm, and with from_zero, y begins at zero.
    """

    title: str
    unit: str
    x_label: str = ""
    lines: tuple[Curve, ...] = ()
    ticks: tuple[Ticks, ...] = ()
    bars: tuple[Bars, ...] = ()
    groups: tuple[str, ...] = ()
    is_log: bool = False
    from_zero: bool = True
    y_max: float | None = None
    note: str = ""

    @property
    def heading(self) -> str:
        """Title with unit."""
        return f"{self.title}, {self.unit}"

    @property
    def highest(self) -> float:
        """Of the lines' values, 1 if there is none."""
        return max((float(np.nanmax(line.y)) for line in self.lines if np.isfinite(line.y).any()), default=1.0)


@dataclass(frozen=True)
class CameraPath:
    """Poses T_world_cam (n, 4, 4) at stamps (n,), s; error_mm (n,) colours them where given."""

    name: str
    color: str
    stamps: FloatArray
    T_world_cam: FloatArray
    error_mm: FloatArray | None = None
    is_true: bool = False


@dataclass(frozen=True)
class PathChart:
    """Paths of cameras, the true one first where it is known. In the plot z points upwards: x and y are from above."""

    title: str
    paths: tuple[CameraPath, ...]
    note: str = ""

    @property
    def axes(self) -> tuple[tuple[int, int], ...]:
        """World axes, each with its sign, that are x, y and z of the plot; see `upright_axes`."""
        return upright_axes(self.paths[-1].T_world_cam)

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the plot's axes, with unit."""
        return tuple(f"{'−' if sign < 0 else ''}{'xyz'[k]}, m" for k, sign in self.axes)

    def points(self, path: CameraPath) -> FloatArray:
        """Positions (n, 3) of a path in the plot, m."""
        return np.stack([sign * path.T_world_cam[:, k, 3] for k, sign in self.axes], axis=-1)

    @property
    def ranges(self) -> list[tuple[float, float]]:
        """Of each axis: all paths, unless one leaves the first one's box far behind; none of them is flat."""
        p_plot = [self.points(path) for path in self.paths]
        low, high = p_plot[0].min(axis=0), p_plot[0].max(axis=0)
        room = _ROOM * float((high - low).max())
        everything = np.concatenate(p_plot)
        low, high = np.maximum(everything.min(axis=0), low - room), np.minimum(everything.max(axis=0), high + room)
        size = np.maximum(high - low, max(0.2 * float((high - low).max()), 1e-3))
        middle = (low + high) / 2
        return [(float(m - 0.53 * s), float(m + 0.53 * s)) for m, s in zip(middle, size, strict=True)]


def method_colors(methods: Iterable[str]) -> dict[str, str]:
    """A colour for each method, always the same for ours."""
    names = list(methods)
    # The setting of a method that 'rstrack bench' shows in its place.
    fused = {name: _METHOD_COLORS[plain] for name in names if (plain := name.removesuffix("-fuse")) in _METHOD_COLORS}
    others = [name for name in names if name not in fused]
    return _METHOD_COLORS | fused | {name: _OTHER_COLORS[k % len(_OTHER_COLORS)] for k, name in enumerate(others)}


def numbers(values: Sequence[float | None], scale: float = 1.0) -> FloatArray:
    """Values (n,), times a scale, None as NaN."""
    return np.array([np.nan if value is None else scale * value for value in values], np.float64)


def upright_axes(T_world_cam: FloatArray) -> tuple[tuple[int, int], ...]:
    """World axes, each with its sign, to draw as x, y and z of a plot whose z points up: a right-handed system.

    Up is the world axis that the camera's −y is nearest to in the mean: nothing else shows which way is up.
    """
    up = -T_world_cam[:, :3, 1].mean(axis=0)
    k = int(np.argmax(np.abs(up)))
    a, b = (k + 1) % 3, (k + 2) % 3
    return ((a, 1), (b, 1), (k, 1)) if up[k] > 0.0 else ((b, 1), (a, 1), (k, -1))


def broken(stamps: FloatArray, *values: FloatArray) -> tuple[FloatArray, ...]:
    """Stamps and values (n,) with a NaN in every gap, where a line then breaks off."""
    steps = np.diff(stamps)
    gaps = np.flatnonzero(steps > _GAP_STEPS * np.median(steps)) + 1 if steps.size else np.empty(0, np.int64)
    return tuple(np.insert(np.asarray(array, np.float64), gaps, np.nan) for array in (stamps, *values))
