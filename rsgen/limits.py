"""Limits of numbers in a configuration: beyond them lies a wrong unit, or more memory than there is, never a camera."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import AfterValidator

MOST_M = 1e6
"""No coordinate of a scene or a pose is larger, m: float32 places a point to 6 cm there."""

Vector4 = tuple[float, float, float, float]
Matrix4 = tuple[Vector4, Vector4, Vector4, Vector4]


def limits(low: float, high: float, why: str, or_zero: bool = False) -> AfterValidator:
    """For `Annotated[float, limits(...)]`: refuses what is not in [low, high] (nor 0, with or_zero), NaN included.

    why: the unit, and where it is no matter of course what goes wrong beyond; ends the complaint.
    """

    def check(value: float) -> float:
        if not (low <= value <= high or (or_zero and value == 0)):
            raise ValueError(f"must {'be 0 or ' if or_zero else ''}lie in {low:g} to {high:g} {why}")
        return value

    return AfterValidator(check)


def rigid(value: Matrix4) -> Matrix4:
    """The value, if it is a rigid transform with its translation within MOST_M. Raises ValueError."""
    T = np.asarray(value, float)
    R = np.clip(T[:3, :3], -2, 2)  # absurd numbers stay wrong, without overflow on the way
    ok = np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-5) and np.linalg.det(R) > 0
    if not (ok and np.array_equal(T[3], (0, 0, 0, 1))):
        raise ValueError("not a rigid transform: rows of an orthonormal rotation with the translation, then 0 0 0 1")
    if np.abs(T).max() > MOST_M:
        raise ValueError(f"its translation must lie within {MOST_M:g} m")
    return value


RigidTransform = Annotated[Matrix4, AfterValidator(rigid)]
"""A 4x4 matrix [R t; 0 0 0 1] in a configuration, translation in metres."""
