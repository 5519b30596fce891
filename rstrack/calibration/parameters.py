"""What is calibrated: readouts, colour's clock against depth's, the extrinsics, and on request lenses and depth.

`Known` is what is known of them beforehand: values that a solution starts from and is drawn to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rstrack.data.rig import DepthError

Group = Literal["readout", "offset", "extrinsics", "depth", "intrinsics"]
GROUPS: tuple[str, ...] = get_args(Group)

LENS = "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"
DEPTH = "offset_m", "inverse_offset", "radial"


@dataclass(frozen=True)
class Unknown:
    """One of the unknowns. prior: σ that holds it while it is looked for, where nothing is known of it. useful: σ above
    which it is called undetermined and keeps what it was. label, unit, factor: how the screen shows it. needs: what a
    recording needs to determine it. typical: σ of what camera files state."""

    name: str
    group: Group
    prior: float
    useful: float
    label: str
    unit: str
    factor: float
    needs: str
    typical: float = np.inf


def _unknowns() -> Iterator[Unknown]:
    shapes, texture = "surfaces that lie at many angles", "texture"
    shaking, changing = "turning and shaking in front of", "motion that changes"
    yield Unknown("depth.readout_s", "readout", 0.03, 2e-3, "depth readout", "ms", 1e3, f"{shaking} {shapes}")
    yield Unknown("color.readout_s", "readout", 0.03, 2e-3, "colour readout", "ms", 1e3, f"{shaking} {texture}")
    yield Unknown("color.offset_s", "offset", 0.05, 2e-3, "colour offset", "ms", 1e3, changing)
    yield Unknown("color.drift", "offset", 5e-3, 5e-5, "colour drift", "ppm", 1e6, f"some ten seconds of {changing}")
    # A lens can make up for where the colour camera sits.
    group: Group = "extrinsics"
    label, turning, degree = "colour from depth,", "turning about two axes", float(np.radians(1.0))
    for axis in "xyz":
        needs = f"{turning} in front of near and far texture"
        yield Unknown(f"T_color_depth.{axis}", group, 0.05, 5e-3, f"{label} {axis}", "mm", 1e3, needs, 0.01)
    for axis in "xyz":
        name, sigmas = f"T_color_depth.r{axis}", (float(np.radians(5.0)), float(np.radians(0.3)))
        yield Unknown(name, group, *sigmas, f"{label} about {axis}", "deg", float(np.degrees(1.0)), turning, degree)
    # A principal point that is stated as the middle is off by 8 of 525 px (σ), and elements are centred, so that
    # tangential distortion stays small. A recording that hardly turns about some axis does not separate a principal
    # point from tangential distortion and a turn; what lenses are like then does.
    typical = 0.03, 0.03, 0.015, 0.015, 0.2, 0.5, 3e-3, 3e-3, 1.0
    useful = 0.01, 0.01, 0.01, 0.01, 0.05, 0.2, 5e-3, 5e-3, 0.5
    for camera, shown, seen in (("depth", "depth", "shapes"), ("color", "colour", texture)):
        needs = f"turning about all axes, so that all of the image sees {seen}"
        for name, sigma, least in zip(LENS, typical, useful, strict=True):
            unit, factor = ("px", 1.0) if name[0] in "fc" else ("1e-3", 1e3)
            label = f"{shown} {name}"
            yield Unknown(f"{camera}.{name}", "intrinsics", 10.0 * sigma, least, label, unit, factor, needs, sigma)
    needs = "surfaces near and far, seen from near and far"
    yield Unknown("depth.error.offset_m", "depth", 0.03, 0.01, "depth offset", "mm", 1e3, needs)
    yield Unknown("depth.error.inverse_offset", "depth", 0.02, 5e-3, "depth inverse offset", "1/km", 1e3, needs)
    yield Unknown("depth.error.radial", "depth", 0.02, 5e-3, "depth radial", "1/km", 1e3, needs)


UNKNOWNS = tuple(_unknowns())
"""All unknowns, in the order of their vectors.

Extrinsics: T_color_depth ← exp(ε) T_color_depth, ε in colour's axes. Lenses: fx and fy as parts of what the camera file
has, cx and cy in its focal lengths, and distortion as OpenCV counts it. Depth: see `DepthError`.
"""
NAMES = tuple(unknown.name for unknown in UNKNOWNS)
PRIOR, USEFUL, _TYPICAL = np.array([(each.prior, each.useful, each.typical) for each in UNKNOWNS]).T
COUNT, POSES = len(NAMES), NAMES.index("depth.fx")
DRIFT = NAMES.index("color.drift")
EXTRINSICS = slice(DRIFT + 1, POSES)
DEPTH_LENS, COLOR_LENS = slice(POSES, POSES + len(LENS)), slice(POSES + len(LENS), POSES + 2 * len(LENS))
LENSES = np.isin(np.arange(COUNT), np.r_[DEPTH_LENS, COLOR_LENS])
"""Which of the unknowns (31,) are lenses'."""
BY_COLOR = np.isin(np.arange(COUNT), [NAMES.index("color.readout_s"), *range(COUNT)[COLOR_LENS]])
"""Those (31,) that are seen in colour images."""
DEPTH_ERROR = slice(POSES + 2 * len(LENS), COUNT)
# σ of fy over fx: a camera's pixels are as wide as high.
_ASPECT_SIGMA = 3e-3
# How far, in σ, the estimate of a recording may lie from what was known before it is taken to contradict it.
_CONTRADICTS = 3.0
# The part of what was known by which a solution has to move at least, over that many σ, to count as moved.
_LEAST = 0.1


@dataclass(frozen=True)
class Parameters:
    """Values of the unknowns.

    *_readout_s: from the first line of an image to after its last, in the camera file's scan; negative: the other way
    round. Colour's stamps t are late or early: taken at t + color_offset_s + color_drift (t − epoch_s). T_color_depth
    (4, 4): p_color from p_depth. depth_lens, color_lens (9,): changes of the cameras; depth_error (3,): see DEPTH.
    """

    depth_readout_s: float
    color_readout_s: float
    color_offset_s: float
    color_drift: float
    T_color_depth: FloatArray
    epoch_s: float = 0.0
    depth_lens: FloatArray = field(default_factory=lambda: np.zeros(len(LENS)))
    color_lens: FloatArray = field(default_factory=lambda: np.zeros(len(LENS)))
    depth_error: FloatArray = field(default_factory=lambda: np.zeros(len(DEPTH)))

    def moved(self, step: FloatArray) -> Parameters:
        """After a step (31,) in the order of NAMES."""
        return replace(
            self,
            depth_readout_s=self.depth_readout_s + float(step[0]),
            color_readout_s=self.color_readout_s + float(step[1]),
            color_offset_s=self.color_offset_s + float(step[2]),
            color_drift=self.color_drift + float(step[3]),
            T_color_depth=se3.orthonormalise(se3.exp(step[EXTRINSICS]) @ self.T_color_depth),
            depth_lens=self.depth_lens + step[DEPTH_LENS],
            color_lens=self.color_lens + step[COLOR_LENS],
            depth_error=self.depth_error + step[DEPTH_ERROR],
        )

    def since(self, start: Parameters) -> FloatArray:
        """The step (31,) that leads here from `start`."""
        T = se3.log(self.T_color_depth @ se3.inverse(start.T_color_depth))
        clocks = (
            self.depth_readout_s - start.depth_readout_s, self.color_readout_s - start.color_readout_s,
            self.color_offset_s - start.color_offset_s, self.color_drift - start.color_drift,
        )  # fmt: skip
        lenses = self.depth_lens - start.depth_lens, self.color_lens - start.color_lens
        return np.concatenate([clocks, T, *lenses, self.depth_error - start.depth_error])

    def color_time(self, stamp: float) -> float:
        """When a colour image that is stamped so was taken, on depth's clock (s)."""
        return stamp + self.color_offset_s + self.color_drift * (stamp - self.epoch_s)

    @property
    def error(self) -> DepthError:
        """The depth camera's error."""
        offset_m, inverse_offset, radial = (float(x) for x in self.depth_error)
        return DepthError(offset_m, inverse_offset, radial)


def changed(camera: Camera, lens: FloatArray) -> Camera:
    """The camera after changes (9,) of its LENS. Raises UserError: focal lengths that nothing holds."""
    if not lens.any():
        return camera
    fx, fy, cx, cy, *bent = (float(x) for x in lens)
    if not (fx > -1.0 and fy > -1.0):
        raise UserError(
            "nothing in these frames holds the focal length: choose --frames that turn before print, or leave "
            "'intrinsics' out of --free"
        )
    distortion = camera.distortion
    if camera.model == "radtan":
        distortion = tuple(a + b for a, b in zip(distortion, bent, strict=False))
    return replace(
        camera, fx=camera.fx * (1.0 + fx), fy=camera.fy * (1.0 + fy), cx=camera.cx + cx * camera.fx,
        cy=camera.cy + cy * camera.fy, distortion=distortion,
    )  # fmt: skip


def free_of(groups: Sequence[str]) -> BoolArray:
    """Which of the unknowns (31,) belong to the groups."""
    return np.array([unknown.group in groups for unknown in UNKNOWNS])


@dataclass(frozen=True)
class Known:
    """values, and how sure they are: σ (31,) in the order of NAMES, in their units, infinite where nothing is known.

    aspect: σ of fy over fx, of both lenses.
    """

    values: Parameters
    sigmas: FloatArray
    aspect: float = np.inf

    @property
    def information(self) -> FloatArray:
        """The inverse covariance (31, 31), zero where nothing is known."""
        found = np.diag(self.sigmas**-2.0)
        for lens in (DEPTH_LENS, COLOR_LENS):
            focal = slice(lens.start, lens.start + 2)
            found[focal, focal] += self.aspect**-2.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
        return found

    @staticmethod
    def nothing(start: Parameters) -> Known:
        """Nothing is known; `start` is where to begin."""
        return Known(start, np.full(COUNT, np.inf))

    def with_lenses(self) -> Known:
        """With what lenses are like and where two cameras sit, where nothing else is known of them."""
        sigmas = np.where(np.isfinite(self.sigmas), self.sigmas, _TYPICAL)
        return replace(self, sigmas=sigmas, aspect=_ASPECT_SIGMA)

    def contradicted(self, found: Parameters, sigmas: FloatArray) -> BoolArray:
        """Which (31,) of the known values a recording contradicts, by what was found with them and its σ (10,).

        A solution that was drawn to a right value moves away from it by as much as it gained: σ² before less σ² after.
        """
        is_known = np.isfinite(self.sigmas)
        before = np.where(is_known, self.sigmas, 0.0)
        gained = np.sqrt(np.maximum(before**2 - sigmas**2, (_LEAST * before) ** 2))
        return is_known & (np.abs(found.since(self.values)) > _CONTRADICTS * gained)

    def without(self, dropped: BoolArray) -> Known:
        """The same values, those of `dropped` (31,) for a start only."""
        return replace(self, sigmas=np.where(dropped, np.inf, self.sigmas))
