"""The control points that still move, the images that touch them, and the problem that they make (equation (12)).

And where the frames were that have been found on the spline, with those poses that nothing moves any more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.linearise import Terms
from rstrack.alignment.normal_equations import assemble, solve_damped
from rstrack.alignment.observation import Observation
from rstrack.alignment.optimizer import MOST_STEPS, Problem, Solved, optimise
from rstrack.alignment.priors import (
    ACCELERATION,
    ENDS,
    VELOCITY,
    Prior,
    acceleration_prior,
    acceleration_sigmas,
    pose_constraint,
    velocity_prior,
)
from rstrack.alignment.spline_state import PointStore, SplineState
from rstrack.images.device_frame import DeviceFrame
from rstrack.inertial.inertia import Inertia
from rstrack.inertial.smoother import ReusedPrior
from rstrack.keyframes.keyframe import Reference

# Metres and radians within which the reference's pose is held while its own control points are free.
_GAUGE = np.full(6, 1e-6)
# Control points that are held beyond those that are needed, and how many are released at once.
_HELD, _RELEASED = 8, 128
# Seconds before the spline's end that an IMU has to tell, or the newest control points are held as if there were none.
_NEWEST_S = 0.05
# Levels to go through from a prediction by constant velocity, and from anything worse.
TRACKING_LEVELS, LEVELS = (1, 0), (2, 1, 0)
# Steps from constant velocity to what an IMU says of the motion since the last frame, and a step (m, rad) that is the
# last one.
_LED_STEPS, _LED = 4, 1e-2


class Window:
    """A spline and the observations of it.

    segment_start: first control point of the spline's current segment; those before it belong to another, or to a gap.
    first_free: first control point that moves when `solve` is called; all after it do. `active`: observations of
    earlier frames that touch those. `focal`: the depth camera's, in pixels. inertia: an IMU beside the images, or None.
    """

    def __init__(
        self, terms: Terms, focal: float, state: SplineState, segment_start: int = 0, inertia: Inertia | None = None
    ) -> None:  # fmt: skip
        self._terms, self._focal, self._inertia = terms, focal, inertia
        self.state, self.segment_start = state, segment_start
        self.first_free = segment_start
        self.active: list[Observation] = []
        self._led: ReusedPrior | None = None
        self._is_held = False

    @classmethod
    def still(
        cls, terms: Terms, focal: float, first: DeviceFrame, dt: float, phase: float, inertia: Inertia | None = None
    ) -> Window:  # fmt: skip
        """A camera at rest at the world's origin while its first frame is taken; knots dt s apart, one of them `phase`
        knots before it."""
        state = SplineState.still(min(first.first_time, first.stamp) - phase * dt, dt, np.eye(4))
        state.extend(first.last_time)
        return cls(terms, focal, state, inertia=inertia)

    @property
    def spline(self) -> Spline:
        """T_world_depth(t) as it is now."""
        return self.state.spline

    @property
    def has_time(self) -> bool:
        """Whether there is time for a step at full size."""
        return self._terms.pace.allows_step(0)

    def copy(self) -> Window:
        """A window that can be changed without changing this one."""
        twin = Window(self._terms, self._focal, self.state.copy(), self.segment_start, self._inertia)
        twin.first_free, twin.active, twin._is_held = self.first_free, list(self.active), self._is_held
        return twin

    def predict(self, new: DeviceFrame, end: float, young: bool = False) -> None:
        """Go on with constant velocity, or as an IMU leads, from time `end` (s) until the frame is covered; what it
        touches is free, and with an IMU what is known of in `Inertia.ahead`, which the frames before are in.

        young: the segment's first frame alone does not determine its velocity; all of the segment stays free. Where
        frames are missing, and an IMU leads over the gap, all control points in it are free.
        """
        begin, held, self._led = self.state.segment(new.first_time), None, None
        if self.is_led(end, new.last_time):
            self.state.extend(new.last_time)
            begin = min(begin, self.state.segment(end))
            held = None if young or self._inertia is None else self._inertia.held(self.segment_start)
            self._is_held = held is not None
            first = max(self.segment_start, min(self.first_free, begin)) if held is None else held
            self._follow_lead(first)
        else:
            self.state.smooth_end(end)
            self.state.extend(new.last_time)
            self._is_held = False
        if held is not None:
            self.first_free, self.active = held, []
            return
        self.first_free = self.segment_start if young else max(self.segment_start, begin)
        self.active = [o for o in self.active if o.is_linearised and o.lin.model.last > self.first_free]

    def is_led(self, begin: float, end: float) -> bool:
        """Whether an IMU tells the motion from time begin to end (s)."""
        return self._inertia is not None and self._inertia.is_usable and self._inertia.covers(begin, end)

    def _follow_lead(self, first: int) -> None:
        """Move the control points from `first` on to where the IMU has them; the images seen before hold those that
        their rows determine."""
        free = first, self.state.end
        priors = self._priors(free)
        active = [] if self._is_held else [o for o in self.active if o.is_linearised]
        for _ in range(_LED_STEPS):
            models = [o.model(self.state) for o in active] + [prior(self.spline)[0] for prior in priors]
            H, g = assemble(models, *free)
            step = solve_damped(H, g, len(g)).reshape(-1, 6)
            self.state.apply(first, step)
            if np.abs(step).max() < _LED:
                break

    def restarted(self, new: DeviceFrame, end: float, T_world_body: FloatArray) -> Window:
        """The same spline up to time `end` (s), and a new segment at rest at T_world_body (4, 4) for a new frame."""
        state = self.state.restarted(end, new.first_time, new.last_time, T_world_body)
        return Window(self._terms, self._focal, state, state.segment(new.first_time), self._inertia)

    def releasable(self, begin: float) -> int | None:
        """First control point that times from `begin` (s) on or the active observations depend on, if many are before
        it."""
        models = [o.lin.model.first for o in self.active if o.is_linearised]
        first = min([self.first_free, self.state.segment(begin), *models]) - _HELD
        return first if first - self.state.first >= _RELEASED else None

    def is_frozen(self, t: float) -> bool:
        """Whether nothing that time t (s) depends on moves any more."""
        return self.state.segment(t) + 4 <= self.first_free

    def solve(
        self, fresh: Sequence[Observation], levels: Sequence[int] = LEVELS, gauge: Reference | None = None,
        coupled: bool = False, hopeless: Callable[[Sequence[Observation]], bool] | None = None,
        before_finest: Callable[[], None] | None = None,
    ) -> Solved:  # fmt: skip
        """Align fresh observations, together with the active ones, by moving the free control points.

        gauge: a reference at whose pose the spline is held. coupled: lines depend on control points far apart, as those
        against a reference that moves too. hopeless, before_finest: see `optimise`. What was
        solved for becomes active with `keep`.
        """
        free = self.first_free, self.state.end
        priors = self._priors(free)
        bandwidth = 6 * (free[1] - free[0]) if coupled or isinstance(priors[-1], ReusedPrior) else 24
        priors += [] if gauge is None else [_pose_prior(gauge)]
        if self.segment_start > 0 and self.first_free == self.segment_start:
            priors.append(self._velocity_prior(free))
        problem = Problem(fresh, self.active, free, priors, self._focal, bandwidth, predicted=self._is_held)
        try:
            with self._terms.timer("optimiser"):
                return optimise(self._terms, self.state, problem, levels, MOST_STEPS, hopeless, before_finest)
        except np.linalg.LinAlgError:
            # The images say nothing about some motion, not even with the prior: as lost as can be.
            return Solved()

    def keep(self, fresh: Sequence[Observation]) -> None:
        """Fresh observations take part from now on."""
        self.active += fresh
        self._led = None

    def _priors(self, free: tuple[int, int]) -> list[Prior]:
        """What is known beside the images; the IMU's last."""
        if not self._is_held or self._inertia is None:
            return [self._motion_prior(free), *self._inertial(free)]
        known = self._led
        if known is None or known.state is not self.state or known.end != self.state.end:
            known = self._led = self._inertia.ahead(self.state)
        return [known]

    def _motion_prior(self, free: tuple[int, int]) -> Prior:
        first, last = max(self.segment_start, free[0] - 2), free[1]
        common = ACCELERATION if self._inertia is None else self._inertia.common
        count, newest, oldest = last - first - 2, 0 if self._inertial(free) else ENDS, 0
        if free[0] == self.segment_start and not self._informs(self.spline.t0 + self.segment_start * self.state.dt):
            oldest = max(0, min(ENDS, count - ENDS))
        sigma = acceleration_sigmas(common, self.state.dt, count, oldest, newest)
        return lambda spline: acceleration_prior(spline, first, last, sigma)

    def _inertial(self, free: tuple[int, int]) -> list[Prior]:
        """What an IMU says, where it tells the newest control points."""
        last, inertia = self.state.spline.t_end, self._inertia
        if inertia is None or not inertia.is_informative or not inertia.covers(last - _NEWEST_S, last):
            return []
        known = self._led
        if known is None or known.state is not self.state or known.first > free[0] or known.end != self.state.end:
            known = self._led = inertia.prior(self.state, self.segment_start, free[0])
        return [known]

    def _informs(self, begin: float) -> bool:
        """Whether an IMU measures how the motion changes in the first control points of a segment from `begin` (s)."""
        return (
            self._inertia is not None
            and self._inertia.is_informative
            and self._inertia.covers(begin, begin + _NEWEST_S)
        )

    def _velocity_prior(self, free: tuple[int, int]) -> Prior:
        """What is known of the motion of a segment that has just begun."""
        sigma = VELOCITY * self.state.dt
        return lambda spline: velocity_prior(spline, *free, sigma)


def _pose_prior(ref: Reference) -> Prior:
    """Holds the spline to a reference's pose while its control points are free."""
    return lambda spline: pose_constraint(spline, ref.t, ref.T_world_base, _GAUGE)


class FoundPoses:
    """stamps: of the frames that were found. valid: times (begin, end) in s within which the spline is an estimate.

    Poses of the first frames are stored here once nothing moves them; the others are the spline's.
    """

    def __init__(self) -> None:
        self.stamps: list[float] = []
        self.valid: list[tuple[float, float]] = []
        self._settled = PointStore()

    @property
    def end(self) -> float:
        """Time (s) until which the spline is known."""
        return self.valid[-1][1]

    def add(self, new: DeviceFrame, joined: bool = True) -> None:
        """A frame that has been found; joined: to the frames before it, not with a segment of its own."""
        self.stamps.append(new.stamp)
        begin = min(new.first_time, new.stamp)
        if joined and self.valid:
            begin = self.valid.pop()[0]
        self.valid.append((begin, new.last_time))

    def all(self, spline: Spline) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) and poses T_world_depth (n, 4, 4)."""
        return np.array(self.stamps), np.concatenate([self._settled.points, self._moving(spline, len(self.stamps))])

    def begin_segment(self, before: Spline, untouched: float) -> None:
        """All poses stay as they are with the spline `before`, which is another one from time `untouched` (s) on."""
        self._settled.put(self._settled.count, self._moving(before, len(self.stamps)))
        begin, end = self.valid.pop()
        if untouched > begin:
            self.valid.append((begin, min(end, untouched)))

    def release(self, window: Window, begin: float) -> None:
        """Hold no more of the spline than still moves, or times from `begin` (s) on depend on."""
        first = window.releasable(begin)
        if first is None:
            return
        end = self._settled.count
        while window.state.segment(self.stamps[end]) < first:
            end += 1
        self._settled.put(self._settled.count, self._moving(window.spline, end))
        window.state.release(first)

    def _moving(self, spline: Spline, end: int) -> FloatArray:
        """Poses (n, 4, 4) from the first one that is not settled to number `end`."""
        return spline.pose(np.array(self.stamps[self._settled.count : end]))
