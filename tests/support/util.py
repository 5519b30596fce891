"""Helpers that several tests share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rsgen.geometry import se3
from rsgen.geometry.spline import Spline


def numeric_jacobian(function: Callable[[np.ndarray], np.ndarray], size: int, step: float = 1e-3) -> np.ndarray:
    """Derivative (*output, size) of a function of (size,) at zero: central differences, fourth order in `step`."""
    columns = []
    for direction in np.eye(size):
        near = function(step * direction) - function(-step * direction)
        far = function(2.0 * step * direction) - function(-2.0 * step * direction)
        columns.append((8.0 * near - far) / (12.0 * step))
    return np.stack(columns, axis=-1)


def random_twists(rng: np.random.Generator, shape: tuple[int, ...], angle: float, distance: float = 1.0) -> np.ndarray:
    """Twists (*shape, 6) in random directions, all with this angle in radians and this |rho| in metres."""
    parts = rng.normal(size=(*shape, 2, 3))
    parts /= np.linalg.norm(parts, axis=-1, keepdims=True)
    return (parts * np.array([[distance], [angle]])).reshape(*shape, 6)


def random_spline(seed: int, points: int = 9, angle: float = 0.6, distance: float = 1.0, dt: float = 0.05) -> Spline:
    """Spline whose neighbouring control points are `angle` radians and about `distance` metres apart."""
    rng = np.random.default_rng(seed)
    T = [se3.exp(random_twists(rng, (), 1.0))]
    for step in random_twists(rng, (points - 1,), angle, distance):
        T.append(T[-1] @ se3.exp(step))
    return Spline(np.stack(T), t0=0.3, dt=dt)


def swung(seconds: float = 12.0) -> Spline:
    """A camera that is carried to and fro, and tilted, as a hand does."""
    t = np.arange(round(seconds / 0.05) + 3) * 0.05
    twist = np.zeros((len(t), 6))
    for i, (size, hertz) in enumerate(
        zip((0.2, 0.1, 0.2, 0.4, 0.5, 0.3), (0.3, 0.5, 0.4, 0.45, 0.35, 0.6), strict=True)
    ):
        twist[:, i] = size * np.sin(2 * np.pi * hertz * t + i)
    return Spline(se3.exp(twist), 0.0, 0.05)
