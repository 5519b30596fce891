"""What colour images' brightness was, and is expected to be: gain and offset against the track's first colour image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from rsgen.array_types import FloatArray
from rstrack.alignment import brightness
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference


@dataclass
class Gains:
    """Of the recent frames, by their numbers; moments: of the newest colour image."""

    found: dict[int, FloatArray] = field(default_factory=dict)
    moments: FloatArray | None = None

    def of(self, frame: DeviceFrame) -> FloatArray:
        """Gain and offset (2,) of a frame; of one that is not known those of the track's first."""
        return self.found.get(frame.index, brightness.SAME)

    def expected(self, frame: DeviceFrame, ref: Reference) -> FloatArray:
        """Gain and offset (2,) that a frame may have against a reference: as found, or about as the newest's."""
        own = self.found.get(frame.index)
        if own is None and frame.colors and self.found and self.moments is not None:
            own = brightness.expected(self.found[max(self.found)], frame.colors[0].moments, self.moments)
        return brightness.SAME if own is None else brightness.relative(own, ref.brightness)

    def learn(self, frame: DeviceFrame, fresh: Sequence[Observation], state: SplineState, oldest: int) -> None:
        """What a frame's colours were found to be; frames before number `oldest` are forgotten."""
        if not frame.colors:
            return
        color = next((o for o in fresh if not o.is_depth), None)
        own = brightness.SAME
        if color is not None:
            own = brightness.absolute(color.brightness(state), color.ref.brightness)
        self.found = {k: b for k, b in self.found.items() if k >= oldest} | {frame.index: own}
        self.moments = frame.colors[0].moments
