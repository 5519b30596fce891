"""Limits of numbers in a configuration: beyond them lies a wrong unit, or more memory than there is, never a camera."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator

from rsgen.array_types import FloatArray

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


def rigid(value: npt.ArrayLike, tolerance: float = 2e-5) -> FloatArray:
    """The value as an array (4, 4), if it is a rigid transform with its translation within MOST_M.

    tolerance: how far R Rᵀ may be from the identity. Raises ValueError.
    """
    try:
        T = np.array(value, float)
    except (TypeError, ValueError):
        T = np.empty(0)
    ok = T.shape == (4, 4) and bool(np.isfinite(T).all()) and np.allclose(T[3], (0, 0, 0, 1), rtol=0)
    R = np.clip(T[:3, :3], -2, 2) if ok else np.zeros((3, 3))  # absurd numbers stay wrong, without overflow on the way
    if np.abs(R @ R.T - np.eye(3)).max() > tolerance or np.linalg.det(R) < 0:
        raise ValueError("not a rigid transform: rows of an orthonormal rotation with the translation, then 0 0 0 1")
    if np.abs(T).max() > MOST_M:
        raise ValueError(f"its translation must lie within {MOST_M:g} m")
    return T


def _checked(value: Matrix4) -> Matrix4:
    rigid(value)
    return value


RigidTransform = Annotated[Matrix4, AfterValidator(_checked)]
"""A 4x4 matrix [R t; 0 0 0 1] in a configuration, translation in metres."""
