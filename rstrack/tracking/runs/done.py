"""How far a run is: what a checkpoint keeps beside the tracker."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Done:
    """How far a run is: frames that have been looked at, seconds that it took, and what became of the frames.

    waited: seconds that the tracker waited for each frame's images. seconds: that it took for each that it was fed.
    """

    count: int = 0
    total_s: float = 0.0
    waited: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    fed: list[int] = field(default_factory=list)
    unreadable: list[tuple[int, str]] = field(default_factory=list)
