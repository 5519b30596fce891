"""Motions, estimates that err by known amounts, and their truth, for the tests of the metrics."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import Truth

CAMERA = Camera(16, 12, 12.0, 12.0, 7.5, 5.5)
SHUTTER = Shutter(0.028, 0.004)
SPLINE = synthetic.make_spline()  # [-0.2, 1.3] s
FRAMES = np.arange(39) / 30.0


def walk(seed: int, n: int, step: float = 0.03) -> np.ndarray:
    """Random poses (n, 4, 4), neighbours about `step` metres and radians apart."""
    rng = np.random.default_rng(seed)
    T = [se3.exp(rng.normal(size=6))]
    for xi in step * rng.normal(size=(n - 1, 6)):
        T.append(T[-1] @ se3.exp(xi))
    return se3.orthonormalise(np.stack(T))


def noisy(T: np.ndarray, seed: int, sigma: float = 0.01) -> np.ndarray:
    xi = sigma * np.random.default_rng(seed).normal(size=(len(T), 6))
    return se3.orthonormalise(T @ se3.exp(xi))


def truth(motion: Spline | Trajectory, stamps: np.ndarray = FRAMES, interpolate: bool = False) -> Truth:
    return Truth(motion, stamps, CAMERA, SHUTTER, interpolate)


def moved(spline: Spline, T: np.ndarray) -> Spline:
    return Spline(se3.orthonormalise(T @ spline.control_points), spline.t0, spline.dt)


def spline_estimate(spline: Spline, stamps: np.ndarray = FRAMES, **info: object) -> Estimate:
    return Estimate(stamps, se3.orthonormalise(spline.pose(stamps)), spline, dict(info))


def one_line(error: pytest.ExceptionInfo[UserError]) -> str:
    text = str(error.value)
    assert text and "\n" not in text
    return text


def rows_of(stamps: list[float]) -> str:
    return "".join(f"{t} 0 0 0 0 0 0 1\n" for t in stamps)
