"""Frames that show nothing usable while an IMU tells the motion: poses for them once the track goes on beyond."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from rstrack.images.device_frame import DeviceFrame
from rstrack.tracking.track import Track

# Seconds for which an IMU alone leads: in two a phone's is off by some centimetres, from where images are not aligned.
_LONGEST_S = 2.0
# Frames in a row that show something, but not where the IMU leads: then it is no blackout.
_MOST_ODD = 6


@dataclass
class Bridge:
    """over: frames since the last one that was found. odd: how many of them were not dark."""

    over: list[DeviceFrame] = field(default_factory=list)
    odd: int = 0

    def leads(self, track: Track, new: DeviceFrame) -> bool:
        """Whether the motion since the last frame that was found is told well enough to look for a new one there."""
        window, end = track.window, track.found.end
        return (
            window is not None
            and new.last_time - end < _LONGEST_S
            and self.odd < _MOST_ODD
            and window.is_led(end, new.last_time)
        )

    def put(self, track: Track, new: DeviceFrame) -> None:
        """A frame that was not found: lost, until one after it is."""
        self.over.append(new)
        self.odd += not track.succession.is_unfit(new)

    def close(self, track: Track) -> None:
        """A frame beyond was found, on the same piece of the spline: those before have poses, too."""
        for frame in self.over:
            track.found.add(frame)
            report = track.reports[frame.index]
            track.reports[frame.index] = replace(report, lost=False, bridged=True)
        self.forget()

    def forget(self) -> None:
        """The track begins anew: what was lost stays so."""
        self.over, self.odd = [], 0
