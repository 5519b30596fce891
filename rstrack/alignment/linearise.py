"""One image against one reference: its part of the normal equations of (12).

A kernel of `residuals` sums the pixels, the sums are chained to the control points, what is unknown of the image alone
is eliminated, and σ is estimated anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine, Kernels
from rsgen.device.lens import Lens
from rsgen.geometry.camera import Camera
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import BlockSums, Scaling, block_counts
from rstrack.alignment.brightness import SAME, SIGMA, contrast
from rstrack.alignment.normal_equations import Eliminated, Quadratic, Slopes, chain, eliminate
from rstrack.alignment.pace import Pace
from rstrack.alignment.residuals import (
    LEVEL,
    GeometricInput,
    PhotometricInput,
    VisibilityInput,
    geometric_kernel,
    photometric_kernel,
    visibility_kernel,
    whole_image_unit,
)
from rstrack.alignment.weights import (
    FLOOR_DEPTH,
    FLOOR_INTENSITY,
    GATE_INTENSITY,
    GATE_SIGMAS,
    inflation,
    scale_step,
)
from rstrack.compiled import compiled
from rstrack.images.device_frame import DeviceRig, Timer, untimed
from rstrack.images.line_poses import Exposure, from_base, to_base
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.keyframes.keyframe import Points, Reference, pyramid_level, strides
from rstrack.options import Options

# Where pixels are larger than those of this focal length (320×240), interpolation errs by the square of their size.
_FINE_FOCAL = 240.0


@dataclass(frozen=True)
class Linearised:
    """A term around a state: `model` divided by σ², and the sums over blocks of lines from which it was made.

    motion (n, 6, 6k): derivative of the blocks' twists by the model's control points. cost: of the pixels' weights and
    the nuisances' prior. floor: smallest credible σ of this camera and reference. median_depth (m): of the points.
    nuisance: a colour image's gain and offset, or a depth image's offset and tilts, eliminated from the model.
    contrast: see `brightness.contrast`; infinite for depth.
    """

    model: Quadratic
    motion: FloatArray
    sigma: float
    next_sigma: float
    cost: float
    floor: float
    median_depth: float
    sums: BlockSums
    nuisance: Eliminated | None = None
    contrast: float = np.inf

    @property
    def count(self) -> int:
        """Pixels that are within the gate."""
        return self.sums.count

    @cached_property
    def inflation(self) -> float:
        """See `weights.inflation`: asked for once a frame, not at every step."""
        return inflation(self.sums.H, self.sums.g, self.sums.count)

    @property
    def fit(self) -> float:
        """Part of the pixels that were compared whose residuals are no outliers for certain."""
        return self.sums.count / max(1, self.sums.compared)

    @property
    def observability(self) -> float:
        """Smallest eigenvalue of H (6, 6) per pixel, rotations divided by the depth: 0 where a motion is not seen."""
        scale = 1.0 / np.array([1.0, 1.0, 1.0, *[self.median_depth] * 3])
        seen = self.sums.H.sum(axis=(0, 1)) * np.outer(scale, scale) / max(1, self.sums.count)
        return float(np.linalg.eigvalsh(seen)[0])

    def row_shift(self, increments: FloatArray, focal: float, depth: float) -> float:
        """Largest movement of a block in pixels under increments (k, 6) of the model's control points."""
        return float(_row_shift(self.motion, increments.ravel(), focal, focal / depth))


@compiled
def _row_shift(motion: Any, increments: Any, of_turn: Any, of_shift: Any) -> Any:
    most = 0.0
    twist = np.empty(6)
    for block in motion:
        for i in range(6):
            total = 0.0
            for k in range(len(increments)):
                total += block[i, k] * increments[k]
            twist[i] = abs(total)
        shift = of_shift * max(twist[0], twist[1], twist[2]) + of_turn * max(twist[3], twist[4], twist[5])
        # Not a number is further than any.
        if not shift <= most:
            most = shift
    return most


# A linearisation whose kernel runs: calling it waits for the sums and chains them. What does not need them is done
# before, while the device works.
Started = Callable[[], Linearised]


@dataclass
class Terms:
    """Kernels of one rig, compiled when first needed. rays: those of the depth camera, on the device."""

    e: Engine
    rays: tuple[Any, Any]
    # Residual beyond which a pixel is an outlier for certain (m up to a distance of 1 m and growing with it, by level;
    # intensity), and smallest credible σ.
    gate_depth: tuple[float, ...] = (0.05, 0.05, 0.3)
    gate_intensity: float = GATE_INTENSITY
    floor_depth: float = FLOOR_DEPTH
    floor_intensity: float = FLOOR_INTENSITY
    # See `CalibrationSigma`: what depth images are off by as a whole is solved for with every pose; 0: nothing is.
    depth_image: float = 0.0
    # σ of equation (13) in the photometric term; 0: blurred points count like sharp ones.
    blur_sigma_px: float = 0.0
    # Part of σ by which interpolation may err: beyond that pixels are left out, or weigh less in coarse images.
    smooth: float = 0.25
    # Whether what large pixels bend counts, by little: smooth ones alone would let the camera slide. Colour holds it.
    counts_rough: bool = True
    timer: Timer = untimed
    pace: Pace = field(default_factory=Pace)
    _kernel: Kernels = field(init=False)

    def __post_init__(self) -> None:
        self._kernel = Kernels(self.e)

    @classmethod
    def of(cls, device: DeviceRig, options: Options) -> Terms:
        """The terms of a rig as a method has them."""
        return cls(
            device.e, device.device_rays, depth_image=device.sigma.depth_image, blur_sigma_px=options.blur_sigma_px,
            counts_rough=not options.photometric, timer=device.timer, pace=Pace(options.budget_ms),
        )  # fmt: skip

    def geometric(
        self, image: DepthImage, ref: Reference, spline: Spline, level: int, sigma: float,
        slopes_at: Spline | None = None, whole: FloatArray = LEVEL,
    ) -> Started:  # fmt: skip
        """Depth image against the reference's depth with the pixels of a level (`strides`), or `THINNED`.

        whole (3,): what it is off by as a whole here, in units of `whole_image_unit`.

        slopes_at: spline at which the lines' poses are differentiated by control points, if not `spline`: that changes
        by no more than the increments between the two (relative), which Gauss-Newton steps do not notice.
        """
        e, lens, shifts, floor = self.e, image.exposure.lens, self.depth_image > 0.0, self._floor_depth(image, ref)
        with self.timer(f"geometric kernel, level {level}"):
            poses = self._to_base(spline, ref, image.exposure), self._from_base(spline, ref, ref.rolling)
            stride = _stride(lens, level)
            kernel = self._kernel(geometric_kernel, lens, ref.lens, stride, shifts)
            scaling = self._scaling(ref, lens, lens.camera, ref, stride, 1)
            gate = self.gate_depth[pyramid_level(level)] * max(1.0, ref.median_depth)
            if pyramid_level(level) == 0:
                gate = min(gate, max(GATE_SIGMAS * sigma, 10 * floor))
            larger = max(1.0, _FINE_FOCAL / ref.lens.camera.fx) ** 2
            smooth = self.smooth * max(sigma, FLOOR_DEPTH * larger)
            rough = min(1.0, larger - 1.0) if self.counts_rough else 0.0
            off = whole * whole_image_unit(ref.median_depth)
            constants = e.upload(scaling.parameters(sigma, gate, smooth, rough, *off))
            surface = ref.inverse_depth, ref.slope_x, ref.slope_y, ref.roughness
            raw = kernel(GeometricInput(image.z, *self.rays, poses[0], *surface, poses[1], constants))
        slopes = self._slopes(slopes_at or spline, image.exposure, ref)

        def finish() -> Linearised:
            with self.timer(f"geometric kernel, level {level}"):
                sums = scaling.unpack(raw.numpy(), *block_counts(lens, ref.lens)[:2], len(whole) if shifts else 0)
                prior = np.full(len(whole), self.depth_image / whole_image_unit(ref.median_depth))
                return self._finish(sums, slopes, sigma, floor, ref.median_depth, whole, prior)

        return finish

    def _floor_depth(self, image: DepthImage, ref: Reference) -> float:
        # A camera at rest repeats its rounding, so that depth would seem far better than it is.
        return max(self.floor_depth, image.resolution * ref.median_depth**2 / np.sqrt(12.0))

    def visible(self, depth: DepthImage, ref: Reference, spline: Spline, level: int) -> Any:
        """Which of the reference's points of a level the depth image does not hide: 1 or 0, on the device."""
        lens, points = depth.exposure.lens, ref.points[level]
        kernel = self._kernel(visibility_kernel, lens, ref.lens, _stride(ref.lens, level))
        seen_at, seen_from = self._to_base(spline, ref, ref.rolling), self._from_base(spline, ref, depth.exposure)
        return kernel(VisibilityInput(points.x, points.y, points.z, seen_at, depth.z, seen_from))

    def photometric(
        self, image: ColorImage, ref: Reference, spline: Spline, level: int, sigma: float,
        slopes_at: Spline | None = None, visible: Any = None, brightness: FloatArray = SAME,
        expected: FloatArray = SAME,
    ) -> Started:  # fmt: skip
        """The reference's points of a level, those that are `visible`, against the colour image low-passed alike.

        brightness (2,): gain and offset of the image here; expected (2,): before anything is known of it.
        """
        with self.timer(f"photometric kernel, level {level}"):
            e, lens, points = self.e, image.exposure.lens, ref.points[level]
            stride, own_level = _stride(ref.lens, level), image.level(pyramid_level(level))
            kernel = self._kernel(photometric_kernel, lens, ref.lens, stride, own_level, self.blur_sigma_px)
            seen_at, seen_from = self._to_base(spline, ref, ref.rolling), self._from_base(spline, ref, image.exposure)
            # Moving closer or turning packs more points into a block than its share.
            scaling = self._scaling(points, lens, ref.lens.camera, ref, stride, 4)
            constants = e.upload(scaling.parameters(sigma, self.gate_intensity, *brightness))
            at = points.x, points.y, points.z, points.intensity, points.visible if visible is None else visible
            raw = kernel(PhotometricInput(*at, seen_at, image.levels[own_level], seen_from, constants))
        slopes = self._slopes(slopes_at or spline, image.exposure, ref)

        def finish() -> Linearised:
            with self.timer(f"photometric kernel, level {level}"):
                sums = scaling.unpack(raw.numpy(), *block_counts(lens, ref.lens)[:2], len(brightness))
                floor, median_depth, off = self.floor_intensity, points.median_depth, brightness - expected
                done = self._finish(sums, slopes, sigma, floor, median_depth, off, SIGMA)
                return done if sums.columns is None else replace(done, contrast=contrast(sums.columns.H, brightness))

        return finish

    def _slopes(self, spline: Spline, exposure: Exposure, ref: Reference) -> Slopes:
        with self.timer("poses of lines"):
            ref_per = block_counts(exposure.lens, ref.lens)[3]
            ref_times = None if ref.rolling is None else ref.rolling.block_times(ref_per)
            return Slopes.of(spline, ref.T_world_base, _block_times(exposure, ref), ref_times)

    def _to_base(self, spline: Spline, ref: Reference, exposure: Exposure | None) -> Any:
        with self.timer("poses of lines"):
            return to_base(self.e, spline, ref.T_world_base, exposure)

    def _from_base(self, spline: Spline, ref: Reference, exposure: Exposure | None) -> Any:
        with self.timer("poses of lines"):
            return from_base(self.e, spline, ref.T_world_base, exposure)

    @staticmethod
    def _scaling(
        units: Points | Reference, lens: Lens, grid: Camera, ref: Reference, stride: int, slack: int
    ) -> Scaling:
        pixels = -(-grid.width // stride) * -(-grid.height // stride)
        current = block_counts(lens, ref.lens)[0]
        per_block = -(-pixels // current) + max(grid.width, grid.height)
        return Scaling(units.median_depth, units.bound, min(pixels, slack * per_block))

    def _finish(
        self, sums: BlockSums, slopes: Slopes, sigma: float, floor: float, median_depth: float,
        off: FloatArray, prior: FloatArray,
    ) -> Linearised:  # fmt: skip
        """off: how far the nuisances are from what they are expected to be; prior: σ of that."""
        # Lines that are exposed at once move alike.
        moved = sums.summed() if len(sums.H) > len(slopes.current) else sums
        with self.timer("linear algebra: chain"):
            own = moved.columns
            model, coupling = chain(moved, slopes, None if own is None else own.coupling)
        H, g, cost, left = model.H / sigma**2, model.g / sigma, sums.cost, None
        if own is not None:
            left = eliminate(H, g, coupling / sigma**2, own.H / sigma**2, own.g / sigma, prior, off)
            cost += 0.5 * float(np.sum((off / prior) ** 2))
            H, g = left.H, left.g
        next_sigma = scale_step(sigma, sums.weighted, sums.count, floor)
        model = Quadratic(model.first, H, g)
        return Linearised(model, slopes.current, sigma, next_sigma, cost, floor, median_depth, sums, left)


def _block_times(exposure: Exposure, ref: Reference) -> FloatArray:
    """When the middles of an image's blocks of lines are exposed (n,)."""
    return exposure.block_times(block_counts(exposure.lens, ref.lens)[2])


def _stride(lens: Lens, level: int) -> int:
    return strides(lens.camera.width, lens.camera.height)[level]
