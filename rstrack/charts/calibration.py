"""Charts of a calibration: how far values moved, and where in the recording they are told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.calibration.findings.record import LensMap, Parameter, Record
from rstrack.charts.chart import COLORS, Line, broken

BLUE, ORANGE = COLORS[:2]


@dataclass(frozen=True)
class Moved:
    """How far a value moved from its start, and twice its σ, NaN where undetermined; both in the chart's unit."""

    label: str
    change: float
    two_sigma: float
    hover: str

    @property
    def is_found(self) -> bool:
        """Whether the recording tells it."""
        return bool(np.isfinite(self.two_sigma))


@dataclass(frozen=True)
class ChangeChart:
    """For each unit an axis of its own, with a row for each of its values."""

    title: str
    by_unit: tuple[tuple[str, tuple[Moved, ...]], ...]
    note: str = ""

    @property
    def heading(self) -> str:
        """As a `Chart` has one."""
        return self.title

    @property
    def rows(self) -> int:
        """Of all units."""
        return sum(len(rows) for _, rows in self.by_unit)


@dataclass(frozen=True)
class StripChart:
    """Rows of cells over time, the darker the larger their parts (r, s), and curves below along the same time.

    spans (s, 2): from when to when a column is, s. curves: each has an axis of its own, of this unit.
    """

    title: str
    names: tuple[str, ...]
    spans: FloatArray
    parts: FloatArray
    curves: tuple[tuple[str, Line], ...]
    x_label: str
    note: str = ""

    @property
    def heading(self) -> str:
        """As a `Chart` has one."""
        return self.title


@dataclass(frozen=True)
class LensChart:
    """Points of an image at (n, 2), how far the lens has moved them (n, 2), drawn `magnified` times as far, and their
    2 σ (n,); px."""

    title: str
    at: FloatArray
    moved: FloatArray
    two_sigma: FloatArray
    magnified: float
    note: str = ""

    @property
    def heading(self) -> str:
        """As a `Chart` has one."""
        return self.title


def lens_charts(record: Record) -> tuple[LensChart, ...]:
    """Where each lens that was looked for puts points, against what it began with."""
    return tuple(_lens_chart(name, lens) for name, lens in record.lens_maps.items() if lens.at_px)


def _lens_chart(name: str, lens: LensMap) -> LensChart:
    at, moved = np.array(lens.at_px), np.array(lens.moved_px)
    longest = float(np.linalg.norm(moved, axis=1).max())
    spacing = float(np.diff(np.unique(at[:, 0])).min(initial=np.inf))
    magnified = spacing / longest if np.isfinite(spacing) and longest > 0.0 else 1.0
    note = (
        f"From where the lens before had a point of the scene, a dot, to where the new one has it: {longest:.2g} px at "
        f"most, drawn {magnified:.2g} times as long. Colour: 2 σ of that place."
    )
    return LensChart(f"The {name} camera's lens", at, moved, 2.0 * np.array(lens.sigma_px)[:, 0], magnified, note)


def change_chart(record: Record) -> ChangeChart:
    """Values against what they were before."""
    by_unit: dict[str, list[Moved]] = {}
    for p in record.parameters.values():
        by_unit.setdefault(p.shown.unit, []).append(_moved(p))
    note = (
        "Zero is where a value began; whiskers are 2 σ, often narrower than the dot. Hollow: undetermined, it has "
        "stayed where it was."
    )
    return ChangeChart("How far values moved from their starts", tuple((u, tuple(m)) for u, m in by_unit.items()), note)


def strip_chart(record: Record) -> StripChart:
    """Which stretches of the recording tell each value, and how the camera moved there."""
    found = [p for p in record.parameters.values() if p.is_found]
    parts = np.array([p.told_by_stretch for p in found]).reshape(len(found), len(record.stretches))
    t, speed, turning = broken(
        *(np.array(values) for values in (record.pace.time_s, record.pace.m_s, record.pace.rad_s))
    )
    curves = (
        ("m/s", Line("speed", BLUE, t, speed)), ("deg/s", Line("turning", ORANGE, t, np.degrees(turning))),
    )  # fmt: skip
    note = (
        "Each row is one value: the part of what is known of it that a stretch tells, in percent, all other values "
        "known. Between the stretches nothing was used. Below, how fast the camera moves and turns, by the first rough "
        "track; it is broken where that was lost."
    )
    return StripChart(
        "Where in the recording values are told", tuple(p.shown.label for p in found),
        np.array(record.stretch_times_s).reshape(-1, 2), parts, curves, "time since the first frame, s", note,
    )  # fmt: skip


def _moved(p: Parameter) -> Moved:
    shown, factor = p.shown, p.shown.factor
    if p.sigma is None:
        return Moved(shown.label, 0.0, float("nan"), f"undetermined, kept at {factor * p.value:.4g} {shown.unit}")
    hover = f"{factor * p.value:.4g} ± {2.0 * factor * p.sigma:.2g} {shown.unit}, from {factor * p.start:.4g}"
    return Moved(shown.label, factor * (p.value - p.start), 2.0 * factor * p.sigma, hover)
