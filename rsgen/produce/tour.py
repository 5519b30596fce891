"""A tour that has been found, in words, and the unit that its scene may be in."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rsgen.motion.free_space import HIGHEST_M, Cast, FloorPlan, find_floors, floor_plan, share_without_floor
from rsgen.motion.statistics import motion_statistics
from rsgen.motion.walk import free_region
from rsgen.produce.views import MOST_CLIPPED, Exposure, Scores, Shine

REACH_M = 1.0  # surfaces farther off are not reported
_LARGEST_THING_M = 50.0
_SEEN_M = (0.4, 5.0)
_VIEWS, _MOST_VIEWS = 20, 120
_AS_WISHED = 1.1
_EMPTY = 0.3


_STOREYS = 6  # floors that are looked at, the largest first
_LARGE = 0.3  # of the scene's ground, what walls enclose where the scene is a room
_SKIN = 0.01  # of a scene's size: what lies so flat is its ground
_SMALLEST_M = 0.001


@dataclass(frozen=True, eq=False)
class TourScene:
    """A scene file's triangles (m, 3, 3), world, m, rays into it and the light along them. fineness (m,): how finely
    light is baked on each, of what is asked. placed: fields of its config but the file. hint: what may be the matter
    where no tour is found.
    """

    file: Path
    triangles: FloatArray
    fineness: FloatArray
    cast: Cast
    shine: Shine
    placed: Mapping[str, Any]
    hint: str = ""

    @property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Its least and largest corner (3,)."""
        return self.triangles.min(axis=(0, 1)), self.triangles.max(axis=(0, 1))

    def wrong(self, what: str) -> UserError:
        """An error of one line that names the file."""
        return UserError(f"scene {self.file}: {what}" + (f" ({self.hint})" if self.hint else ""))


@dataclass(frozen=True, eq=False)
class Thing:
    """Corners (3,) of the box of all but the ground, and the ground's height; world, m."""

    low: FloatArray
    high: FloatArray
    ground_y: float


def find_room(scene: TourScene, clearance_m: float) -> FloorPlan | None:
    """The plan of the floor with the largest room for a camera; None where the scene is no room. Raises UserError."""
    low, high = scene.box
    best, most = None, 0.0
    for floor in find_floors(scene.cast, low, high)[:_STOREYS]:
        if floor.area_m2 < most:
            break  # the others are smaller yet
        plan = floor_plan(scene.triangles, scene.cast, floor, clearance_m)
        free = plan.area_m2(plan.largest(clearance_m))
        if plan.inside.any() and (best is None or free > most):
            best, most = plan, free
    if best is None:
        if share_without_floor(scene.cast, low, high) >= _LARGE:
            raise scene.wrong("walls but no floor below them: add a floor, or say which axis is up (--up z)")
        return None
    height = float(high[1] - low[1])
    if height > HIGHEST_M:
        unit, scale = likely_unit(height)
        scale *= scene.placed.get("scale", 1.0)
        raise scene.wrong(
            f"a room of {height:.0f} m from bottom to top is rather one in {unit}: --scale {scale:g}, or see --up"
        )
    if free_region(best, clearance_m) is not None:
        return best
    if not best.solid and best.inside.mean() >= _LARGE:
        raise scene.wrong(
            f"no room for a camera: no way between its walls at eye height keeps {clearance_m:g} m from all surfaces: "
            "reduce --clearance, or see that the scene is in metres and y up"
        )
    return None


def find_thing(scene: TourScene) -> Thing:
    """All but the ground. Raises UserError if there is nothing else, or next to nothing."""
    low, high = scene.box
    size = float((high - low).max())
    rest = scene.triangles[scene.triangles[..., 1].max(axis=1) > low[1] + _SKIN * size]
    if not len(rest):
        raise scene.wrong("holds nothing but a floor: add something to look at")
    if size < _SMALLEST_M:
        raise scene.wrong(f"all of it lies within {1000.0 * size:.2g} mm: scale it to metres")
    return Thing(rest.min(axis=(0, 1)), rest.max(axis=(0, 1)), float(low[1]))


@dataclass(frozen=True, eq=False)
class Tour:
    """A config's spline, how long it lasts, its least distance to surfaces in m, how far off the camera sees something
    along it (n, pixels), m, how that is to be exposed (None: as it is), and how good it is then.
    """

    spline: Spline
    seconds: float
    least: float
    distance: FloatArray
    exposure: Exposure | None
    scores: Scores


def view_times(seconds: float) -> FloatArray:
    """Instants (n,) in s that views are looked at, over all of a made motion."""
    count = min(max(_VIEWS, math.ceil(seconds)), _MOST_VIEWS)
    return np.asarray((np.arange(count) + 0.5) * (seconds / count), float)


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
    stats = motion_statistics(tour.spline, 0.0, tour.seconds)
    distance, least = tour.distance, tour.least
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
    if (flat := tour.scores.flat) > 0:
        text = f"next to nothing but one plane in {100 * flat:.0f} % of the views"
        lines.append(f"{text}: depth alone does not tell how the camera moves there")
    lines.append(tour.scores.text())
    clipped = float(tour.scores.clipped.mean())
    if clipped > MOST_CLIPPED:
        lines.append(f"no exposure keeps more than {100 * (1 - clipped):.0f} % of the pixels from clipping")
    return lines


def exposure_text(exposure: Exposure | None) -> list[str]:
    """How the config's light is exposed, where that is not as before."""
    if exposure is None:
        return []
    gain = f"its light asks for an exposure gain of {exposure.gain:g}"
    if exposure.target is None:
        return [gain]
    return [f"{gain}, and for automatic exposure: no single one shows both its dark and its bright places"]


_UNITS = {"centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254}
_ROOM_M, _ROOMS_M = 2.5, (2.0, 6.0)


def likely_unit(height: float) -> tuple[str, float]:
    """The unit, and how many metres it has, in which a room of that height is as high as rooms are."""

    def unlike(metres: float) -> tuple[float, float]:
        low, high = _ROOMS_M
        outside = max(math.log(low / metres), math.log(metres / high), 0.0)
        return outside, abs(math.log(metres / _ROOM_M))

    return min(_UNITS.items(), key=lambda unit: unlike(unit[1] * height))


def doubt(height_m: float, scale: float) -> str:
    """A note on a room too high to be in metres, at so many metres per unit; '' for others and without a ceiling."""
    if not _ROOMS_M[1] < height_m < math.inf:
        return ""
    return f"; if that is too high, --scale {scale * _ROOM_M / height_m:.2g} makes it {_ROOM_M:g} m"
