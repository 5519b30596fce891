"""A stretch of a motion: from some time on, at another speed, looking aside; and stretches drawn at random, by seed.

drawn = draw_stretch(Ranges(frames=30), 3, 17, [(0.0, 20.0)], [30.0])      # of set 3 number 17
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import so3
from rsgen.geometry.spline import Spline

# Pitch and roll are drawn from this part of the angle that yaw is.
_TILT = 1 / 3
# A stretch may take up this part of the motion at most: the rest is where it may begin.
_MOST_OF_MOTION = 0.9


@dataclass(frozen=True)
class Ranges:
    """What stretches are drawn from, evenly. frames: of each; readout, exposure: s; speed: times the motion's own, by
    ratio; turn_deg: to either side, a third of it up, down and in roll."""

    frames: int
    readout: tuple[float, float] = (0.010, 0.030)
    exposure: tuple[float, float] = (0.0, 0.0)
    speed: tuple[float, float] = (0.7, 3.0)
    turn_deg: float = 20.0


@dataclass(frozen=True)
class Drawn:
    """One stretch. config: which of those given. start_s: of the config's motion, for the first frame's stamp; speed:
    times it; turn (3,): rotation vector of the view, rad. seed: of its images."""

    config: int
    readout_s: float
    exposure_s: float
    start_s: float
    speed: float
    turn: tuple[float, float, float]
    seed: int


def draw_stretch(
    ranges: Ranges, seed: int, index: int, spans: Sequence[tuple[float, float]], rates_hz: Sequence[float]
) -> Drawn:
    """Number `index` of a set, which depends on nothing but these arguments.

    spans: first and last time (s) of each config's motion. rates_hz: of its colour camera. Where a stretch would be
    longer than the motion, it is slower. Raises UserError: a motion too short even so, or a readout longer than the
    time between frames.
    """
    rng = np.random.default_rng([seed, index])
    config = int(rng.integers(len(spans)))
    begin, end = spans[config]
    slowest = ranges.readout[1]
    if slowest > 1.0 / rates_hz[config] + 1e-12:
        raise UserError(
            f"readout {slowest:g} s: is longer than the {1.0 / rates_hz[config]:.4g} s between frames: "
            "lower it, or color.rate_hz"
        )
    readout, exposure = (float(rng.uniform(*span)) for span in (ranges.readout, ranges.exposure))
    speed = math.exp(rng.uniform(*np.log(ranges.speed)))
    takes = (ranges.frames - 1) / rates_hz[config] + readout + exposure
    speed = min(speed, _MOST_OF_MOTION * (end - begin) / takes)
    if speed < 0.1 * ranges.speed[0]:
        raise UserError(f"the motion lasts {end - begin:.3g} s, a sequence {takes:.3g} s: use a longer one")
    start = float(rng.uniform(begin + speed * exposure, end - speed * (takes - exposure)))
    most = math.radians(ranges.turn_deg)
    yaw, pitch, roll = (float(rng.uniform(-1.0, 1.0)) * most * part for part in (1.0, _TILT, _TILT))
    return Drawn(config, readout, exposure, start, speed, (pitch, yaw, roll), int(rng.integers(2**31)))


def along(spline: Spline, start_s: float, speed: float, turn: npt.ArrayLike, T_body_cam: FloatArray) -> Spline:
    """T_world_cam(t) of a camera that is at the time start_s of T_world_body(t) when its own time is 0.

    turn (3,): rotation vector of its view, rad. Multiplied from the right, all control points move the whole curve;
    knots closer together go along it faster.
    """
    T_turn = np.eye(4)
    T_turn[:3, :3] = so3.exp(np.asarray(turn, float))
    return Spline(spline.control_points @ T_body_cam @ T_turn, (spline.t0 - start_s) / speed, spline.dt / speed)


def cut(spline: Spline, begin_s: float, end_s: float) -> Spline:
    """The part of a spline that is needed from one time to another. Raises UserError: it has no such times."""
    (first, last), _ = spline.locate([begin_s, end_s])
    return Spline(spline.control_points[first : last + 4], spline.t0 + first * spline.dt, spline.dt)
