"""An image against a reference: its scale and its last linearisation, used as long as it is good."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.brightness import SAME, best
from rstrack.alignment.linearise import Linearised, Terms
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.spline_state import SplineState
from rstrack.alignment.weights import START_DEPTH, START_INTENSITY
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.keyframes.keyframe import THINNED, Reference
from rstrack.options import Options

# Increments of control points (m, rad) that change the derivatives of lines by less than a step's own error.
_SAME_SLOPES = 2e-2
# Change of gain and offset, in σ of the intensities, that calls for a new linearisation.
_SAME = 0.2
# Part of the pixels that count below which a quarter of them has as much information as all.
THIN_BELOW = 1.0 / 16.0


@dataclass(frozen=True)
class _Linearisation:
    """What an observation knows: the model and the next σ.

    at: increments (k, 6) that the model's control points had received when it was made. stands_for: pixels of the
    finest level for each.
    brightness: gain and offset (2,) of a colour image there.
    """

    lin: Linearised | None = None
    sigma: float = 0.0
    at: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))
    stands_for: float = 1.0
    brightness: FloatArray | None = None


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
        self.linearisation = _Linearisation(sigma=sigma, brightness=self.brightness(state))

    def linearise(self, terms: Terms, state: SplineState, level: int) -> None:
        """Around the current state; takes the σ that the one before suggested."""
        self.start(terms, state, level)()

    def start(self, terms: Terms, state: SplineState, level: int) -> Callable[[], None]:
        """The same in two steps: the device works until what this returns is called."""
        image, sigma, slopes_at = self.image, self.linearisation.sigma, self.slopes_at(state)
        is_finest = level == 0
        level = THINNED if is_finest and self.independent < THIN_BELOW else level
        brightness, before = self.brightness(state), state.copy()
        if isinstance(image, DepthImage):
            started = terms.geometric(image, self.ref, state.spline, level, sigma or START_DEPTH, slopes_at)
        else:
            if is_finest and self._visible is None and self.occluder is not None:
                # Once: the coarse levels have brought the poses close enough, and a fixed set converges.
                self._visible = terms.visible(self.occluder, self.ref, state.spline, level)
            visible = self._visible if is_finest else None
            sigma = sigma or START_INTENSITY
            started = terms.photometric(
                image, self.ref, state.spline, level, sigma, slopes_at, visible, brightness, self.expected
            )
        # A coarse level's pixels stand for those left out: the priors' share must not depend on the level.
        stands_for = 4.0 ** (1 if level == THINNED else level)

        def finish() -> None:
            lin = started()
            at = before.received(lin.model.first, lin.model.last)
            self.linearisation = _Linearisation(lin, lin.next_sigma, at, stands_for, brightness)

        return finish

    def brightness(self, state: SplineState) -> FloatArray:
        """Gain and offset (2,) of a colour image in the current state; at first those expected."""
        lin, before = self.linearisation.lin, self.linearisation.brightness
        if before is None or lin is None or lin.brightness is None:
            return self.expected if before is None else before
        return best(before, lin.brightness, self._since(state).ravel())

    def shift(self, state: SplineState, focal: float) -> float:
        """Pixels that the lines have moved since the linearisation; infinite where the brightness has changed too."""
        lin, before = self.linearisation.lin, self.linearisation.brightness
        if lin is None:
            return np.inf
        if before is not None and (np.abs(self.brightness(state) - before) > _SAME * lin.sigma).any():
            return np.inf
        return lin.row_shift(self._since(state), focal, self.ref.median_depth)

    def model(self, state: SplineState) -> Quadratic:
        """Quadratic model around the current state."""
        return self.lin.model.moved(self._since(state)).scaled(self.stands_for)

    def change(self, state: SplineState) -> float:
        """Change of the cost since the linearisation, by the quadratic model."""
        model, moved = self.lin.model, self._since(state).ravel()
        return self.stands_for * float(model.g @ moved + 0.5 * moved @ model.H @ moved)

    def distance(self, state: SplineState) -> float:
        """How far the state is from that of the linearisation, squared, in σ of this image's own information."""
        model, moved = self.lin.model, self._since(state).ravel()
        return self.stands_for * float(moved @ model.H @ moved)

    def slopes_at(self, state: SplineState) -> Spline:
        """Where the poses of its lines are differentiated: an earlier state as long as that is as good."""
        before = self._slopes_at
        if before is None or state.distance_from(before) > _SAME_SLOPES:
            self._slopes_at = before = state.copy()
        return before.spline

    def _since(self, state: SplineState) -> FloatArray:
        """What the model's control points have been moved by since (k, 6)."""
        model = self.lin.model
        return state.received(model.first, model.last) - self.linearisation.at


def observe(frame: DeviceFrame, ref: Reference, options: Options, expected: FloatArray = SAME) -> list[Observation]:
    """What the terms of a method make of a frame against a reference: its depth image, and its colour images.

    expected (2,): gain and offset that the colour images are expected to have against the reference.
    """
    depth = [Observation(frame.index, frame.depth, ref)] if options.geometric else []
    return depth + [Observation(frame.index, c, ref, frame.depth.hider, expected) for c in frame.colors if ref.points]
