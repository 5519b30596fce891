"""What a pack is to be, and from what its sequences are drawn: scene, stretch of the motion, readout, exposure.

drawn = draw_stretch(PackOptions(count=1000).ranges, 3, 17, spans, rates_hz)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

from rsgen.errors import UserError
from rsgen.motion.stretch import Ranges

Layout = Literal["carla-rs", "fastec-rs"]
LAYOUTS: tuple[str, ...] = get_args(Layout)
_DEFAULTS = {"readout": (0.010, 0.030), "exposure": (0.0, 0.0), "speed": (0.7, 3.0)}


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
    def ranges(self) -> Ranges:
        """What sequences are drawn from."""
        return Ranges(self.length, self.span("readout"), self.span("exposure"), self.span("speed"), self.turn_deg)

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
