"""Terms that see poses instead of pixels: closed-form costs with which optimisers can be checked.

sight = sighting(times, T_world_body)
optimise(PoseTerms(), state, problem([sight], state), (0,), (15, 8, 30))
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import BlockSums
from rstrack.alignment.linearise import Linearised, Started
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.observation import Observation
from rstrack.alignment.optimizer import Problem
from rstrack.alignment.pace import Pace
from rstrack.alignment.spline_state import SplineState

FOCAL, DEPTH_M = 500.0, 2.0


@dataclass
class PoseTerms:
    """½ Σ ‖log(T(t) T_seen⁻¹)‖² over the times of an `image`, as a term of scale 1 would be.

    curvature: factor on H; below 1 steps are too long. next_sigma: what each linearisation suggests for the next.
    floor: smallest credible σ. calls: (level, σ) of each linearisation.
    """

    curvature: float = 1.0
    next_sigma: float = 0.7
    floor: float = 1.0
    calls: list[tuple[int, float]] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)
    slopes: list[Spline] = field(default_factory=list)
    visible_asked: int = 0
    pace: Pace = field(default_factory=Pace)

    def timer(self, name: str) -> Any:
        """Nothing is timed."""
        return nullcontext()

    def visible(self, *_: Any) -> str:
        """Which points are not hidden."""
        self.visible_asked += 1
        return "some"

    def expect(self, *_: object) -> None:
        """Nothing to work out beforehand."""

    def photometric(
        self, image: Any, ref: Any, spline: Spline, level: int, sigma: float, slopes_at: Spline, visible: Any = None,
        *_: Any,
    ) -> Started:  # fmt: skip
        """The poses that the image saw."""
        self.calls.append((level, sigma))
        self.slopes.append(slopes_at)
        image.shown = visible
        at, blocks = slopes_at.pose_jacobian(image.times)
        first, count = int(at.min()), int(at.max() - at.min()) + 4
        J = np.zeros((len(at), 6, count, 6))
        for i in range(4):
            J[np.arange(len(at)), :, at - first + i] = blocks[:, i]
        motion = J.reshape(len(at), 6, 6 * count)
        e = se3.log(spline.pose(image.times) @ se3.inverse(image.T_world_body))
        rows = se3.left_jacobian_inv(e) @ motion
        H = self.curvature * np.einsum("nia,nib->ab", rows, rows)
        cost = 0.5 * float((e**2).sum())
        self.costs.append(cost)
        model = Quadratic(first, H, np.einsum("nia,ni->a", rows, e))
        sums = BlockSums(np.zeros((1, 1, 6, 6)), np.zeros((1, 1, 6)), 0.0, cost, len(at), len(at))
        found = Linearised(model, motion, 1.0, self.next_sigma, cost, self.floor, 1.0, sums)
        return lambda: found


def sighting(times: np.ndarray, T_world_body: np.ndarray) -> Observation:
    """An observation of the poses (n, 4, 4) at times (n,)."""
    image: Any = SimpleNamespace(times=times, T_world_body=T_world_body)
    return Observation(0, image, SimpleNamespace(median_depth=DEPTH_M))  # type: ignore[arg-type]


def problem(
    fresh: Sequence[Observation], state: SplineState, settled: Sequence[Observation] = (), **how: Any
) -> Problem:
    """Of all control points unless told otherwise, without priors."""
    given: dict[str, Any] = {"free": (0, len(state.points)), "priors": (), "focal": FOCAL} | how
    return Problem(fresh, settled, **given)
