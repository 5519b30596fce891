"""What is drawn at random for each sequence of a pack: scene, window of the motion, speed, view, readout, exposure.

drawn = draw_sequence(PackOptions(count=1000, seed=3), 17, spans, rate_hz=30.0)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import so3
from rsgen.geometry.spline import Spline

Layout = Literal["carla-rs", "fastec-rs"]
LAYOUTS: tuple[str, ...] = get_args(Layout)
_DEFAULTS = {"readout": (0.010, 0.030), "exposure": (0.0, 0.0), "speed": (0.7, 3.0)}
# Pitch and roll are drawn from this part of the angle that yaw is.
_TILT = 1 / 3
# A window may take up this part of the motion at most: the rest is where it may begin.
_MOST_OF_MOTION = 0.9


@dataclass(frozen=True)
class PackOptions:
    """What a pack is to be; each field's text is also the help of the option of its name. Ranges are drawn evenly."""

    count: Annotated[int, "pairs of a rolling and its global images, rounded up to whole sequences", "N"] = 100
    layout: Annotated[
        Layout, "names of files: those of Carla-RS (0000_rs.png ...) or Fastec-RS (000_rolling.png ...)"
    ] = "carla-rs"
    length: Annotated[int, "frames of a sequence; loaders of Carla-RS read 10, of Fastec-RS 34 at most", "N"] = 10
    readout: Annotated[tuple[float, ...] | None, "shortest and longest, s (default: 0.01 0.03)", "S"] = None
    exposure: Annotated[
        tuple[float, ...] | None, "shortest and longest, s; global images are sharp (default: 0 0)", "S"
    ] = None
    speed: Annotated[
        tuple[float, ...] | None, "slowest and fastest, times the config's own, drawn by ratio (default: 0.7 3)", "X"
    ] = None
    turn_deg: Annotated[float, "the camera looks up to so many degrees aside, and a third of it up or down"] = 20.0
    depth: Annotated[bool, "rolling images' exact depth, as Carla-RS has it: text, .pdepth, 2 MB at 640x480"] = False

    def __post_init__(self) -> None:
        if not 1 <= self.count <= 10_000_000:
            raise UserError(f"--count {self.count}: must be 1 or more")
        if not 2 <= self.length <= 34:
            raise UserError(f"--length {self.length}: must be 2 to 34: loaders take neighbouring frames of a sequence")
        for name, least, most in (("readout", 0.0, 1.0), ("exposure", 0.0, 1.0), ("speed", 1e-3, 100.0)):
            given = getattr(self, name) or _DEFAULTS[name]
            if len(given) != 2 or not least <= given[0] <= given[1] <= most:
                shown = " ".join(f"{value:g}" for value in given)
                raise UserError(f"--{name} {shown}: give two rising numbers between {least:g} and {most:g}")
        if not 0.0 <= self.turn_deg <= 180.0:
            raise UserError(f"--turn-deg {self.turn_deg:g}: must be between 0 and 180")

    def span(self, name: str) -> tuple[float, float]:
        """Ends of what 'readout' or 'exposure' (s), or 'speed', is drawn from."""
        low, high = getattr(self, name) or _DEFAULTS[name]
        return float(low), float(high)

    @property
    def content(self) -> dict[str, Any]:
        """What decides a pack's bytes, but for its count, as plain data."""
        spans = {name: list(self.span(name)) for name in _DEFAULTS}
        content = {"layout": self.layout, "length": self.length, **spans, "turn_deg": self.turn_deg}
        return content | ({"depth": True} if self.depth else {})  # packs of before go on without

    @property
    def sequences(self) -> int:
        """How many the count takes."""
        return -(-self.count // self.length)


@dataclass(frozen=True)
class Drawn:
    """One sequence. config: which of the pack's. start_s: of the config's motion, for the first frame's stamp; speed:
    times it; turn (3,): rotation vector of the view, rad. seed: of its images."""

    config: int
    readout_s: float
    exposure_s: float
    start_s: float
    speed: float
    turn: tuple[float, float, float]
    seed: int


def draw_sequence(
    options: PackOptions, seed: int, index: int, spans: Sequence[tuple[float, float]], rates_hz: Sequence[float]
) -> Drawn:
    """Sequence `index` of a pack, which depends on nothing but these arguments.

    spans: first and last time (s) of each config's motion. rates_hz: of its colour camera. Where a window would be
    longer than the motion, it is slower. Raises UserError: a motion too short even so, or a readout longer than the
    time between frames.
    """
    rng = np.random.default_rng([seed, index])
    config = int(rng.integers(len(spans)))
    begin, end = spans[config]
    slowest = options.span("readout")[1]
    if slowest > 1.0 / rates_hz[config] + 1e-12:
        raise UserError(
            f"--readout {slowest:g}: is longer than the {1.0 / rates_hz[config]:.4g} s between frames: "
            "lower it, or color.rate_hz"
        )
    readout, exposure = (float(rng.uniform(*span)) for span in (options.span("readout"), options.span("exposure")))
    speed = math.exp(rng.uniform(*np.log(options.span("speed"))))
    takes = (options.length - 1) / rates_hz[config] + readout + exposure
    speed = min(speed, _MOST_OF_MOTION * (end - begin) / takes)
    if speed < 0.1 * options.span("speed")[0]:
        raise UserError(f"the motion lasts {end - begin:.3g} s, a sequence {takes:.3g} s: use a longer one")
    start = float(rng.uniform(begin + speed * exposure, end - speed * (takes - exposure)))
    most = math.radians(options.turn_deg)
    yaw, pitch, roll = (float(rng.uniform(-1.0, 1.0)) * most * part for part in (1.0, _TILT, _TILT))
    return Drawn(config, readout, exposure, start, speed, (pitch, yaw, roll), int(rng.integers(2**31)))


def camera_spline(spline: Spline, drawn: Drawn, T_depth_color: FloatArray) -> Spline:
    """T_world_cam(t) of a sequence's colour camera, whose first frame has stamp 0, from the config's T_world_depth(t).

    Multiplied from the right, all control points move the whole curve; knots closer together go along it faster.
    """
    turn = np.eye(4)
    turn[:3, :3] = so3.exp(np.array(drawn.turn))
    points = spline.control_points @ T_depth_color @ turn
    return Spline(points, (spline.t0 - drawn.start_s) / drawn.speed, spline.dt / drawn.speed)
