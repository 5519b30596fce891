"""A tour that has been found, in words: the room or the thing, how the camera moves, and what it sees."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.config import Config
from rsgen.geometry.spline import Spline
from rsgen.motion.floor_plan import FloorPlan
from rsgen.motion.statistics import motion_statistics
from rsgen.motion.walk import Seen, free_region

REACH_M = 1.0  # so near a surface's distance is told
_LARGEST_THING_M = 50.0
_SEEN_M = (0.4, 5.0)
_VIEWS = 40
_AS_WISHED = 1.1
_EMPTY = 0.3


@dataclass(frozen=True, eq=False)
class Tour:
    """A config, its spline, that one's least distance to surfaces in m, and what the camera sees along it."""

    config: Config
    spline: Spline
    least: float
    seen: Seen

    @property
    def flat(self) -> float:
        """Share of the views that hold nothing but one plane."""
        return float(np.mean(self.seen.flat))


def view_times(config: Config) -> FloatArray:
    """Instants (n,) in s that views are looked at, over all of a made motion."""
    assert config.motion is not None
    return np.linspace(0.0, config.motion.duration_s, _VIEWS)


def room_text(plan: FloorPlan, clearance_m: float) -> str:
    """A room by its floor plan."""
    cells = free_region(plan, clearance_m)
    assert cells is not None
    area, gap = plan.area_m2(cells), plan.floor.gap_m
    high = f"{gap:.2f} m high, {area * gap:.1f} m³ free" if math.isfinite(gap) else "without a ceiling"
    return f"a room, {high}; {plan.eye_y - plan.floor.y:.2f} m above the floor a camera has {area:.1f} m²"


def thing_text(size: FloatArray) -> str:
    """A thing by the size (3,) of its box, m."""
    text = "a thing of {:.2f} x {:.2f} x {:.2f} m, and a way round it".format(*size)
    if size.max() <= _LARGEST_THING_M:
        return text
    return f"{text}; if that is too large, it may be in centimetres: --scale 0.01"


def motion_text(tour: Tour, rotation_deg_s: float | None) -> list[str]:
    """What the spline is like, and what its camera sees. rotation_deg_s: mean that was wished for, if any."""
    stats = motion_statistics(tour.spline, 0.0, float(view_times(tour.config)[-1]))
    distance, least = tour.seen.distance, tour.least
    near, far = _SEEN_M
    seen, nothing = np.mean((distance >= near) & (distance <= far)), np.mean(~np.isfinite(distance))
    lines = [
        f"{stats.length_m:.1f} m in {stats.duration_s:.0f} s: {stats.mean_speed_m_s:.2f} m/s, "
        f"{stats.mean_rotation_deg_s:.0f} deg/s in the mean; "
        + (f"nearest surface {least:.2f} m" if math.isfinite(least) else f"no surface within {REACH_M:g} m"),
        f"surfaces {near:g} to {far:g} m away in {100 * seen:.0f} % of the views, nothing in {100 * nothing:.0f} %",
    ]
    if rotation_deg_s is not None and stats.mean_rotation_deg_s > _AS_WISHED * rotation_deg_s:
        lines.append(f"turns faster than the {rotation_deg_s:.0f} deg/s of the other: what it looks at asks for it")
    if nothing > _EMPTY:
        lines.append("much of the views is empty: a floor and walls would help a tracker")
    if tour.flat > 0:
        flat = f"one plane fills {100 * tour.flat:.0f} % of the views"
        lines.append(f"{flat}: depth alone does not tell how the camera moves there")
    return lines
