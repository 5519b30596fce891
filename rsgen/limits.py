"""Limits of numbers in a configuration: beyond them lies a wrong unit, or more memory than there is, never a camera."""

from __future__ import annotations

from pydantic import AfterValidator

MOST_M = 1e6
"""No coordinate of a scene or a pose is larger, m: float32 places a point to 6 cm there."""


def limits(low: float, high: float, why: str, or_zero: bool = False) -> AfterValidator:
    """For `Annotated[float, limits(...)]`: refuses what is not in [low, high] (nor 0, with or_zero), NaN included.

    why: the unit, and where it is no matter of course what goes wrong beyond; ends the complaint.
    """

    def check(value: float) -> float:
        if not (low <= value <= high or (or_zero and value == 0)):
            raise ValueError(f"must {'be 0 or ' if or_zero else ''}lie in {low:g} to {high:g} {why}")
        return value

    return AfterValidator(check)
