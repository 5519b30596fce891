"""An image against a reference: its scale and its last linearisation, used as long as it is good.

And the score test of a frame (Rao 1948): whether its observations agree with where it was found. See `scores`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.brightness import SAME, credible, matched
from rstrack.alignment.linearise import Linearised, Terms
from rstrack.alignment.normal_equations import Quadratic, block_diagonal
from rstrack.alignment.residuals import LEVEL
from rstrack.alignment.spline_state import SplineState
from rstrack.alignment.weights import START_DEPTH, START_INTENSITY
from rstrack.compiled import compiled
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.fast_spline import motion
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.keyframes.keyframe import THINNED, Reference
from rstrack.options import Options

# Increments of control points (m, rad) that change the derivatives of lines by less than a step's own error.
_SAME_SLOPES = 2e-2
# Change of gain and offset, in σ of the intensities, that calls for a new linearisation.
_SAME = 0.2
# Part of the pixels that count below which a quarter of them has as much information as all.
THIN_BELOW = 1.0 / 16.0
# Prior σ of a shift (m) and turn (rad): a direction that the images do not see has a score of zero.
_PRIOR = np.tile([0.05, 0.05, 0.05, *np.radians([3.0, 3.0, 3.0])], 2)


@dataclass(frozen=True)
class _Linearisation:
    """What an observation knows: the model and the next σ.

    at: increments (k, 6) that the model's control points had received when it was made. stands_for: pixels of the
    finest level for each.
    nuisance: see `Observation.nuisance`, there.
    """

    lin: Linearised | None = None
    sigma: float = 0.0
    at: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))
    stands_for: float = 1.0
    nuisance: FloatArray | None = None


class _Now(NamedTuple):
    """A state's spline, a linearisation, what its control points moved by since (k, 6), and its model there."""

    spline: Spline
    linearisation: _Linearisation
    since: FloatArray
    model: Quadratic


@dataclass
class Observation:
    """An image against a reference. linearisation: the last one; putting an earlier one back takes a step back.

    occluder: the depth image that shows which points of the reference are hidden from a colour image. expected:
    predicted gain and offset (2,) of a colour image against the reference. independent: part of its pixels that count,
    see `Independence`.
    """

    frame: int
    image: DepthImage | ColorImage
    ref: Reference
    occluder: DepthImage | None = None
    expected: FloatArray = field(default_factory=lambda: SAME)
    independent: float = 1.0
    linearisation: _Linearisation = _Linearisation()
    _visible: Any = None
    _slopes_at: SplineState | None = None
    _last: _Now | None = None
    _last_steady: tuple[_Now, float, tuple[FloatArray, FloatArray]] | None = None

    @property
    def is_depth(self) -> bool:
        """Whether this is the geometric term."""
        return isinstance(self.image, DepthImage)

    @property
    def is_linearised(self) -> bool:
        """Whether there is a linearisation."""
        return self.linearisation.lin is not None

    @property
    def lin(self) -> Linearised:
        """The last linearisation, of which there must be one."""
        assert self.linearisation.lin is not None
        return self.linearisation.lin

    @property
    def pixels(self) -> int:
        """Pixels of the finest level that count, if all of them were looked at."""
        return round(self.linearisation.stands_for * self.lin.count)

    @property
    def inflation(self) -> float:
        """That of the linearisation, by pixels of the finest level; see `weights.inflation`."""
        return self.linearisation.stands_for * self.lin.inflation

    @property
    def stands_for(self) -> float:
        """Independent pixels of the finest level for each that was looked at."""
        return self.independent * self.linearisation.stands_for

    def see(self, ref: Reference) -> None:
        """Take another version of the reference, nearly the same."""
        self.ref, self._visible = ref, None

    def hidden_by(self, occluder: DepthImage) -> None:
        """Take another depth image to find which points are hidden from a colour image."""
        self.occluder, self._visible = occluder, None

    def count_as(self, independent: float) -> None:
        """Another part of its pixels counts."""
        self.independent, self._visible = independent, None

    def begin(self, sigma: float) -> None:
        """The first linearisation takes this σ."""
        self.linearisation = _Linearisation(sigma=sigma)

    def restart(self, state: SplineState, keep_sigma: bool) -> None:
        """Begin anew, as at a new level of the pyramid."""
        sigma = self.linearisation.sigma if keep_sigma else 0.0
        self.linearisation = _Linearisation(sigma=sigma, nuisance=self.nuisance(state))

    def linearise(self, terms: Terms, state: SplineState, level: int) -> None:
        """Around the current state; takes the σ that the one before suggested."""
        self.start(terms, state, level)()

    def start(self, terms: Terms, state: SplineState, level: int) -> Callable[[], None]:
        """The same in two steps: the device works until what this returns is called."""
        image, sigma, slopes_at = self.image, self.linearisation.sigma, self.slopes_at(state)
        is_finest = level == 0
        level = THINNED if is_finest and self.independent < THIN_BELOW else level
        nuisance, before = self.nuisance(state), state.copy()
        if isinstance(image, DepthImage):
            sigma = sigma or START_DEPTH
            started = terms.geometric(image, self.ref, state.spline, level, sigma, slopes_at, nuisance)
        else:
            if is_finest and self._visible is None and self.occluder is not None:
                # Once: the coarse levels have brought the poses close enough, and a fixed set converges.
                self._visible = terms.visible(self.occluder, self.ref, state.spline, level)
            visible = self._visible if is_finest else None
            sigma = sigma or START_INTENSITY
            started = terms.photometric(
                image, self.ref, state.spline, level, sigma, slopes_at, visible, nuisance, self.expected
            )
        # A coarse level's pixels stand for those left out: the priors' share must not depend on the level.
        stands_for = 4.0 ** (1 if level == THINNED else level)

        def finish() -> None:
            lin = started()
            at = before.received(lin.model.first, lin.model.last)
            self.linearisation = _Linearisation(lin, lin.next_sigma, at, stands_for, nuisance)

        return finish

    def nuisance(self, state: SplineState) -> FloatArray:
        """What else is unknown of the image, in the current state; at first as expected.

        Gain and offset (2,) of a colour image; what a depth image is off by as a whole (3,), see `whole_image`.
        """
        lin, before = self.linearisation.lin, self.linearisation.nuisance
        if before is None:
            return LEVEL if self.is_depth else self.expected
        if lin is None or lin.nuisance is None:
            return before
        found = lin.nuisance.after(before, self._since(state).ravel())
        return found if self.is_depth else credible(found)

    def shift(self, state: SplineState, focal: float) -> float:
        """Pixels that the lines have moved since the linearisation; infinite where the brightness has changed too."""
        lin, before = self.linearisation.lin, self.linearisation.nuisance
        if lin is None:
            return np.inf
        changed = 0.0 if self.is_depth or before is None else float(np.abs(self.nuisance(state) - before).max())
        if changed > _SAME * lin.sigma:
            return np.inf
        return lin.row_shift(self._since(state), focal, self.ref.median_depth)

    def model(self, state: SplineState) -> Quadratic:
        """Quadratic model around the current state."""
        return self._model(state).scaled(self.stands_for)

    def change(self, state: SplineState) -> float:
        """Change of the cost since the linearisation, by the quadratic model."""
        # g δ + ½ δᵀ H δ, the moved model's slope being g + H δ.
        slopes = self.lin.model.g + self._model(state).g
        return self.stands_for * 0.5 * float(slopes @ self._since(state).ravel())

    def distance(self, state: SplineState) -> float:
        """How far the state is from that of the linearisation, squared, in σ of this image's own information."""
        added = self._model(state).g - self.lin.model.g
        return self.stands_for * float(added @ self._since(state).ravel())

    def steady(self, state: SplineState) -> tuple[FloatArray, FloatArray]:
        """H (12, 12) and g (12,) of two twists of the lines, in the world's axes about the camera at mid readout.

        The first six move all lines, the others as much as a line is after mid readout: the last by all of it, the
        first by its opposite (no line if all are exposed at once). All control points moved by one left increment move
        every pose by it; by one that grows with their times (Greville), by one that grows with the pose's, to first
        order.
        """
        now, last = self._now(state), self._last_steady
        if last is None or last[0] is not now or last[1] != self.stands_for:
            model, exposure = now.model, self.image.exposure
            mid, half = exposure.mid_time, 0.5 * (exposure.last_time - exposure.first_time)
            at = state.spline.t0 + (np.arange(model.first, model.last) - 1) * state.dt
            after = (at - mid) / half if half > 0.0 else np.zeros(len(at))
            H, g = _steady(model.H, model.g, after, *motion(state.spline, mid)[0][:3, 3])
            known = self.stands_for
            self._last_steady = last = now, known, (known * H, known * g)
        return last[2]

    def slopes_at(self, state: SplineState) -> Spline:
        """Where the poses of its lines are differentiated: an earlier state as long as that is as good."""
        before = self._slopes_at
        if before is None or state.distance_from(before) > _SAME_SLOPES:
            self._slopes_at = before = state.copy()
        return before.spline

    def _since(self, state: SplineState) -> FloatArray:
        """What the model's control points have been moved by since (k, 6)."""
        return self._now(state).since

    def _model(self, state: SplineState) -> Quadratic:
        """That of the linearisation around the current state."""
        return self._now(state).model

    def _now(self, state: SplineState) -> _Now:
        """The current state as this image has it: asked for several times before the state moves on."""
        now = self._last
        if now is None or now.spline is not state.spline or now.linearisation is not self.linearisation:
            model = self.lin.model
            since = state.received(model.first, model.last) - self.linearisation.at
            self._last = now = _Now(state.spline, self.linearisation, since, model.moved(since))
        return now


def observe(
    frame: DeviceFrame, ref: Reference, options: Options, expected: FloatArray = SAME,
    inflations: tuple[float, float] = (1.0, 1.0),
) -> list[Observation]:  # fmt: skip
    """What the terms of a method make of a frame against a reference: its depth image, and its colour images.

    expected (2,): gain and offset that the colour images are expected to have against the reference. inflations: of
    depth and of colour, see `Independence`.
    """
    depth, color = (1.0 / inflation for inflation in inflations)
    seen = [Observation(frame.index, frame.depth, ref, independent=depth)] if options.geometric else []
    hider, colors = frame.depth.hider, frame.colors if ref.points else ()
    return seen + [Observation(frame.index, image, ref, hider, expected, color) for image in colors]


def matched_brightness(frame: DeviceFrame, ref: Reference) -> FloatArray:
    """Gain and offset (2,) of a frame's colour images against a reference, by what both are like as a whole."""
    if not (frame.colors and ref.points):
        return SAME
    return np.asarray(matched(frame.colors[0].moments, ref.moments))


# -- the score test --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scores:
    """sigmas: √(gᵀ H⁻¹ g) of all images of a frame, of depth and of colour alone; NaN without any.

    formal (6, 6): information that the normal equations of all of them have of the pose, all lines moved at once, as
    increments [m; rad] in the depth camera's axes at mid readout.
    """

    sigmas: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    formal: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def excess(self) -> float:
        """Factor by which formal σ are too small, 1 at least: the Birge ratio (Physical Review 40, 1932) of the largest
        of the three, √(χ²/12) with the two twists' numbers."""
        known = [sigmas for sigmas in self.sigmas if np.isfinite(sigmas)]
        return max(1.0, max(known, default=0.0) / np.sqrt(len(_PRIOR)))

    @property
    def information(self) -> FloatArray:
        """Information (6, 6) of the pose, as far as the images agree with it."""
        return self.formal / self.excess**2


_Steady = tuple[Observation, FloatArray, FloatArray]
"""An observation with its H (12, 12) and g (12,) of `steady`."""


def scores(fresh: Sequence[Observation], state: SplineState) -> Scores:
    """Score test of a frame by its observations in the current state, together and each term alone.

    At the solution of (12) the gradients of all terms add up to zero. Where a frame has been found, those of its own
    images do so by themselves, but for noise. Where it has not, they balance the frames before and the prior of the
    motion, or depth balances colour, though each may fit its neighbourhood well enough. So they do where the spline
    cannot follow the motion within an image: the test has a twist of all lines and one that grows from the first line
    to the last.
    """
    seen = [(o, *o.steady(state)) for o in fresh if o.is_linearised]
    kinds = [[s for s in seen if s[0].is_depth is is_depth] for is_depth in (True, False)]
    return Scores((_score(seen), _score(kinds[0]), _score(kinds[1])), _information(seen, state))


def _information(seen: Sequence[_Steady], state: SplineState) -> FloatArray:
    total = np.zeros((6, 6))
    for o, H, _ in seen:
        turn = block_diagonal(motion(state.spline, o.image.exposure.mid_time)[0][:3, :3], 2)
        total += turn.T @ H[:6, :6] @ turn
    values, basis = np.linalg.eigh(total)
    # Of a motion that no pixel sees rounding may leave less than nothing, which would pass for knowledge when inverted.
    return total if values[0] >= 0.0 else np.asarray((basis * np.maximum(values, 0.0)) @ basis.T)


def _score(seen: Sequence[_Steady]) -> float:
    if not seen:
        return float("nan")
    H = np.diag(1.0 / _PRIOR**2) + sum(own for _, own, _ in seen)
    g = np.sum([own for _, _, own in seen], axis=0)
    return float(np.sqrt(max(0.0, float(g @ np.linalg.solve(H, g)))))


@compiled
def _steady(H: Any, g: Any, after: Any, x: Any, y: Any, z: Any) -> Any:
    """Of a model H (6k, 6k), g (6k,), whose control points follow mid readout by `after` (k,) half readouts; the camera
    is then at x, y, z (m)."""
    about = np.eye(6)
    about[0, 4], about[0, 5], about[1, 3] = -z, y, z
    about[1, 5], about[2, 3], about[2, 4] = -x, -y, x
    both, slope = np.zeros((12, 12)), np.zeros(12)
    for i in range(len(after)):
        for p in range(6):
            slope[p] += g[6 * i + p]
            slope[6 + p] += after[i] * g[6 * i + p]
            for j in range(len(after)):
                for q in range(6):
                    h = H[6 * i + p, 6 * j + q]
                    both[p, q] += h
                    both[6 + p, q] += after[i] * h
                    both[p, 6 + q] += after[j] * h
                    both[6 + p, 6 + q] += after[i] * after[j] * h
    turn = np.zeros((12, 12))
    turn[:6, :6], turn[6:, 6:] = about, about
    return turn.T @ both @ turn, turn.T @ slope
