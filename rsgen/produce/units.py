"""Units of length that scenes may be in, by how high rooms are."""

from __future__ import annotations

import math

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
    """What to say of a room that high, taken at so many metres per unit: nothing if rooms are, or without a ceiling."""
    if not _ROOMS_M[1] < height_m < math.inf:
        return ""
    return f"; if that is too high, --scale {scale * _ROOM_M / height_m:.2g} makes it {_ROOM_M:g} m"
