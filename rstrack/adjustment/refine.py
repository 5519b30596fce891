"""The best spline that a recording holds: every frame against all keyframes that see it, all of it solved at once.

Dense bundle adjustment by turns. With the spline as it is, keyframes are made where the camera has been and the depth
of all frames that see them is averaged in; then every frame is linearised once against each, and control points and
keyframes' poses move together (`Graph.step`). Where the camera came back, old and new frames are in one keyframe, so
that loops are closed too, if they are known to within what alignment forgives (`rstrack track --loops end`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.console.progress import Progress, no_progress
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.chain import BandedHessian, KeyframeModel
from rstrack.adjustment.graph import Graph, State
from rstrack.adjustment.imu import ImuResult, ImuState, ImuTerm
from rstrack.alignment.linearise import Terms
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.observation import Observation, matched_brightness, observe
from rstrack.alignment.spline_state import SplineState
from rstrack.images.device_frame import DeviceFrame
from rstrack.inertial.estimate import ALIKE
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.options import Options

# Of the distance and angle at which a tracker leaves a keyframe: no two are nearer, and frames within see it.
_GRID, _SEEN = 0.5, 1.0
# Keyframes that a frame is aligned to, at most: the nearest. Weight of a fused pixel in measurements: all count alike.
_MOST, _FUSED = 4, 1e4
# Part of the keyframe's pixels that an image has to see, of those compared that must not be outliers, and scale of the
# residuals over the typical one.
_LEAST_SHARE, _LEAST_FIT, _WORST = 0.15, 0.6, 2.5
# Gain or offset that have changed by more call for another look, of so many at most.
_BRIGHTER, _LOOKS = 0.004, 5
# Bias of a colour image by reflections, as a part of what the way to the keyframe moves the image: they show things
# behind the surface, which move less (on a lacquered table, docs/notebook/hand-held.md); and information (m⁻², rad⁻²)
# of a frame that has not moved from its keyframe.
_SHINE, _UNMOVED = 3e-4, 1e14
# Furthest that a pose moves (m) in a round after which no other is worth it.
_STILL = 2e-5
# Steps of one round beside an IMU, and of control points and keyframes (m, rad) after which no other is worth it.
_STEPS, _SETTLED = 5, 1e-6

Near = list[tuple[int, float]]
"""Keyframes that a frame is near, by their numbers, and the weights of the frame against them."""


@dataclass(frozen=True)
class TypicalScales:
    """Scales of residuals that a track has: of depth at one metre (m), and of intensity; NaN where there is none."""

    depth: float
    intensity: float


@dataclass(frozen=True)
class Round:
    """What a round did, as run.json has it. moved_m: the furthest that a frame's pose moved; pairs: of a frame and a
    keyframe; usual: scales of residuals."""

    moved_m: float
    keyframes: int
    pairs: int
    usual: TypicalScales


@dataclass
class Refiner:
    """Refines the spline of a recording.

    frames, times: numbers of the frames within the spline, and their mid readouts (n,) s. begin: when (s) the camera
    stays where it was. load: frames by their numbers, on the device. scales: of residuals to begin with. imu: an IMU
    beside the camera; found: its estimate.
    """

    terms: Terms
    maker: KeyframeMaker
    options: Options
    frames: Sequence[int]
    times: FloatArray
    begin: float
    load: Callable[[Sequence[int]], Iterator[DeviceFrame]]
    scales: TypicalScales
    imu: ImuTerm | None = None
    found: ImuResult | None = None
    _inflations: tuple[float, float] = field(default=(1.0, 1.0))
    _sharing: float = 1.0
    # Gain and offset of the last colour image against each keyframe.
    _brightness: dict[int, FloatArray] = field(default_factory=dict)

    def refined(self, spline: Spline, rounds: int, progress: Progress = no_progress) -> tuple[Spline, list[Round]]:
        """The spline after so many rounds at most, and what they did.

        Raises numpy.linalg.LinAlgError where the system has no solution.
        """
        done: list[Round] = []
        while len(done) < rounds and (not done or done[-1].moved_m >= _STILL):

            def show(part: float, note: str) -> None:
                progress("refining", (len(done) + part) / rounds, f"round {len(done) + 1} of {rounds}, {note}")

            spline, result = self._round(spline, show)
            done.append(result)
        progress("refining", 1.0, f"{len(done)} rounds")
        return spline, done

    def _round(self, spline: Spline, show: Callable[[float, str], None]) -> tuple[Spline, Round]:
        anchors, near = _grid(spline.pose(self.times), self.options)
        self._sharing = sum(map(len, near)) / len(anchors)
        keyframes = self._fused(spline, anchors, near, show)
        state = SplineState(spline)
        against: dict[int, _Against] = {}
        scales: tuple[list[tuple[float, float]], ...] = ([], [])
        pairs = 0
        for n, frame in enumerate(self.load(self.frames)):
            for k, weight in near[n]:
                good = self._linearised(frame, keyframes[k], state)
                pairs += bool(good)
                for o in good:
                    against.setdefault(k, _Against()).add(self._model(o, state, frame).scaled(weight))
                    sigma = o.lin.next_sigma / (_spread(o) if o.is_depth else 1.0)
                    scales[not o.is_depth].append((sigma, o.inflation))
            show(0.5 + 0.5 * (n + 1) / len(self.frames), f"{pairs} pairs")
        at = State(spline, {k: keyframes[k].T_world_base for k in sorted(against)}, self._imu_state(spline))
        seen = [against[k].seen(k) for k in at.keyframes]
        moved = self._solved(at, seen).spline
        shift = np.linalg.norm((moved.pose(self.times) - spline.pose(self.times))[:, :3, 3], axis=1)
        self._learn(*scales)
        return moved, Round(float(shift.max()), len(seen), pairs, self.scales)

    def _solved(self, at: State, seen: Sequence[KeyframeModel]) -> State:
        """Where control points and keyframes belong.

        Beside an IMU readings are linearised until nothing moves: they bend sooner than images do.
        """
        graph = Graph(at, seen, (), keeps_motion=False, imu=self.imu)
        if self.imu is None:
            return self._placed(graph.step(at)[0], at)
        graph, state = graph.weakened(np.sqrt(ALIKE)), at
        for _ in range(_STEPS):
            state, x = graph.step(state)
            if np.abs(x[: len(at.spline.control_points) + len(at.keyframes)]).max() < _SETTLED:
                break
        state = self._placed(state, at)
        self.found = graph.found(state)
        if state.imu is not None:
            self.imu = self.imu.learnt(state.spline, state.imu)
        return state

    def _imu_state(self, spline: Spline) -> ImuState | None:
        if self.imu is None:
            return None
        return self.imu.start(spline) if self.found is None else self.found.state

    def _placed(self, state: State, before: State) -> State:
        """With the camera where it was in the beginning."""
        return state.placed(before.spline.pose(self.begin) @ se3.inverse(state.spline.pose(self.begin)))

    def _fused(
        self, spline: Spline, anchors: IntArray, near: list[Near], show: Callable[[float, str], None]
    ) -> list[Reference]:
        """A keyframe of each anchor, with the depth of all frames near it, wherever these come in the recording."""
        numbers = [self.frames[a] for a in anchors]
        note = f"{len(anchors)} keyframes"
        # Colours are looked up once depth is known.
        made = [self.maker.rectified(frame.index, frame.depth, (), spline, None) for frame in self.load(numbers)]
        fused = list(made)
        for n, frame in enumerate(self.load(self.frames)):
            for k, _ in near[n]:
                if made[k].index != frame.index:
                    fused[k] = self.maker.fused(fused[k], frame.depth, spline, _FUSED)
            show(0.4 * (n + 1) / len(self.frames), note)
        done = []
        shape = made[0].lens.camera.height, made[0].lens.camera.width
        for k, frame in enumerate(self.load(numbers)):
            rho, weight = (self.maker.e.download(a, shape) for a in (fused[k].inverse_depth, fused[k].weight))
            done.append(self.maker.with_depth(made[k], frame.depth, frame.colors, spline, rho, weight))
            show(0.4 + 0.1 * (k + 1) / len(numbers), note)
        return done

    def _linearised(self, frame: DeviceFrame, ref: Reference, state: SplineState) -> list[Observation]:
        """A frame's images against a keyframe, those that fit."""
        good = []
        known = self._brightness.get(ref.index)
        expected = matched_brightness(frame, ref) if known is None else known
        for o in observe(frame, ref, self.options, expected, self._inflations):
            usual = self._usual(o)
            o.begin(usual)
            before = o.nuisance(state)
            for _ in range(_LOOKS):
                o.linearise(self.terms, state, 0)
                if o.is_depth or (np.abs(o.nuisance(state) - before) < _BRIGHTER).all():
                    break
                before = o.nuisance(state)
            sees = o.pixels >= _LEAST_SHARE * ref.pixels and o.lin.fit >= _LEAST_FIT
            if sees and o.lin.next_sigma < _WORST * usual:
                good.append(o)
                if not o.is_depth:
                    self._brightness[ref.index] = o.nuisance(state)
        return good

    def _model(self, o: Observation, state: SplineState, frame: DeviceFrame) -> Quadratic:
        """The model of an image against a keyframe; reflections may bias a colour image as one body.

        That error is common to all n images of a keyframe and does not average out, so each has n times its covariance.
        """
        model = o.model(state)
        if o.is_depth:
            return model
        T_world_cam = state.spline.pose(frame.depth.exposure.mid_time)
        depth = o.ref.median_depth
        way = float(np.linalg.norm(T_world_cam[:3, 3] - o.ref.T_world_base[:3, 3])) / depth
        turn = self._sharing * (_SHINE * way) ** 2
        information = np.diag(np.minimum(1.0 / np.maximum(np.repeat([turn * depth**2, turn], 3), 1e-300), _UNMOVED))
        return doubted(model, se3.adjoint(T_world_cam), information)

    def _usual(self, o: Observation) -> float:
        return self.scales.depth * _spread(o) if o.is_depth else self.scales.intensity

    def _learn(self, depth: list[tuple[float, float]], color: list[tuple[float, float]]) -> None:
        """From the scales, of depth at one metre, and inflations of the images that fitted."""
        depth_sigma = _median([sigma for sigma, _ in depth], self.scales.depth)
        self.scales = TypicalScales(depth_sigma, _median([sigma for sigma, _ in color], self.scales.intensity))
        one, other = (max(1.0, _median([inflation for _, inflation in some], 1.0)) for some in (depth, color))
        self._inflations = one, other


@dataclass
class _Against:
    """Models of frames against one keyframe."""

    band: BandedHessian = field(default_factory=BandedHessian)
    models: list[tuple[int, FloatArray]] = field(default_factory=list)

    def add(self, model: Quadratic) -> None:
        """One more."""
        self.band.add(model)
        self.models.append((model.first, model.g.reshape(-1, 6)))

    def seen(self, keyframe: int) -> KeyframeModel:
        """All of it."""
        gradient = np.zeros((len(self.band), 6))
        for first, g in self.models:
            gradient[first - self.band.first :][: len(g)] += g
        return KeyframeModel(keyframe, self.band, gradient)


def doubted(model: Quadratic, to_world: FloatArray, information: FloatArray) -> Quadratic:
    """A model of control points whose image may be off as one body, eliminated.

    to_world (6, 6): adjoint that takes twists of that body to the world's. information (6, 6): of how far off it is.
    """
    together = np.tile(to_world, (model.last - model.first, 1))
    HB = model.H @ together
    solved = np.linalg.solve(information + together.T @ HB, np.column_stack([HB.T, together.T @ model.g]))
    H = model.H - HB @ solved[:, :-1]
    return Quadratic(model.first, 0.5 * (H + H.T), model.g - HB @ solved[:, -1])


def _grid(T: FloatArray, options: Options) -> tuple[IntArray, list[Near]]:
    """Numbers of the poses (n, 4, 4) that become keyframes, and for each pose the keyframes it is near.

    A frame's noise is in all its pairs, so that their weights sum to one; and the nearer a keyframe, the less of it is
    hidden, bent by interpolation or shines otherwise.
    """
    anchors: list[int] = []
    remote = np.full((len(T), 0), np.inf)
    nearest = np.full(len(T), np.inf)
    for n in range(len(T)):
        if nearest[n] > _GRID:
            anchors.append(n)
            remote = np.column_stack([remote, options.remoteness_of_each(se3.inverse(T[n]) @ T)])
            nearest = np.minimum(nearest, remote[:, -1])
    order = np.argsort(remote, axis=1, kind="stable")[:, :_MOST]
    near = []
    for n, row in enumerate(order):
        r = remote[n, row]
        weight = (1.0 - np.minimum(r / _SEEN, 1.0) ** 2) ** 2
        near.append([(int(k), float(w)) for k, w in zip(row, weight / max(weight.sum(), 1e-9), strict=True) if w > 0])
    return np.array(anchors), near


def _spread(o: Observation) -> float:
    """By how much depth scatters more there than at one metre."""
    return float(max(0.5, o.ref.median_depth) ** 2)


def _median(values: Sequence[float], otherwise: float) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else otherwise
