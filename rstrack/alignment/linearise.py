"""One image against one reference: run a kernel, chain it to the control points, remember the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine, Kernels
from rsgen.device.lens import Lens
from rsgen.geometry.camera import Camera
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import BlockSums, Scaling, block_counts
from rstrack.alignment.brightness import SAME, Eliminated, contrast
from rstrack.alignment.brightness import eliminate as without_brightness
from rstrack.alignment.independence import inflation
from rstrack.alignment.normal_equations import Quadratic, Slopes, chain, eliminate, prepare_jacobians
from rstrack.alignment.residuals import (
    WHOLE,
    GeometricInput,
    PhotometricInput,
    VisibilityInput,
    geometric_kernel,
    photometric_kernel,
    visibility_kernel,
    whole_image_unit,
)
from rstrack.alignment.student_t import scale_step
from rstrack.images.device_frame import DeviceRig, Timer, untimed
from rstrack.images.line_poses import IDENTITY_FROM_BASE, Exposure, from_base_table, prepare, to_base_table
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.keyframes.keyframe import Points, Reference, pyramid_level, strides
from rstrack.options import Options

# Smallest credible σ of depth (m): quantisation and interpolation leave about as much. Where pixels are larger than
# those of this focal length (320×240) interpolation errs more, by the square of their size.
_CREDIBLE_DEPTH, _FINE_FOCAL = 2e-4, 240.0


@dataclass(frozen=True)
class Linearised:
    """A term around a state: `model` divided by σ², and what the kernel saw.

    motion (n, 6, 6k): derivative of the blocks' twists, to tell how far rows have moved since.
    """

    model: Quadratic
    motion: FloatArray
    sigma: float
    next_sigma: float
    cost: float
    count: int
    compared: int
    # Smallest credible σ of this term, this camera and this reference.
    floor: float
    # Σ w j jᵀ / count (6, 6) with rotations scaled by the scene's depth.
    seen: FloatArray
    # Of the blocks of lines, from which it was made.
    sums: BlockSums
    # Of a colour image: its gain and offset, which the model no longer holds.
    brightness: Eliminated | None = None
    # The spread of the intensities that are expected in it, see `brightness.contrast`; infinite for depth.
    contrast: float = np.inf

    @cached_property
    def inflation(self) -> float:
        """See `independence.inflation`: asked for once a frame, not at every step."""
        return inflation(self.sums)

    @property
    def fit(self) -> float:
        """Part of the pixels that were compared whose residuals are no outliers for certain."""
        return self.count / max(1, self.compared)

    @property
    def observability(self) -> float:
        """Smallest eigenvalue of `seen`: 0 where a motion is not seen."""
        return weakest_motion(self.seen)

    def row_shift(self, increments: FloatArray, focal: float, depth: float) -> float:
        """Largest movement of a block in pixels under increments (k, 6) of the model's control points."""
        twist = self.motion @ increments.ravel()
        return float((focal * (np.abs(twist[:, :3]).max(axis=1) / depth + np.abs(twist[:, 3:]).max(axis=1))).max())


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
    gate_intensity: float = 0.3
    floor_depth: float = _CREDIBLE_DEPTH
    floor_intensity: float = 1.0 / 255.0
    # See `CalibrationSigma`: what depth images are off by as a whole is solved for with every pose; 0: nothing is.
    depth_image: float = 0.0
    # σ of equation (13) in the photometric term; 0: blurred points count like sharp ones.
    blur_sigma_px: float = 0.0
    # Part of σ by which interpolation may err: beyond that pixels are left out, or weigh less in coarse images.
    smooth: float = 0.25
    # Whether what large pixels bend counts, by little: smooth ones alone would let the camera slide. Colour holds it.
    counts_rough: bool = True
    timer: Timer = untimed
    _kernel: Kernels = field(init=False)

    def __post_init__(self) -> None:
        self._kernel = Kernels(self.e)

    @classmethod
    def of(cls, device: DeviceRig, options: Options) -> Terms:
        """The terms of a rig as a method has them."""
        return cls(
            device.e, device.device_rays, depth_image=device.sigma.depth_image, blur_sigma_px=options.blur_sigma_px,
            counts_rough=not options.photometric, timer=device.timer,
        )  # fmt: skip

    def expect(
        self, spline: Spline, images: Sequence[DepthImage | ColorImage], slopes_at: Sequence[tuple[Spline, Reference]]
    ) -> None:  # fmt: skip
        """These images are linearised next, at this spline, with slopes at others and against these references: what is
        needed of their lines is worked out together."""
        with self.timer("poses of lines"):
            prepare(spline, [image.exposure for image in images])
            times: dict[Spline, list[FloatArray]] = {}
            for image, (at, ref) in zip(images, slopes_at, strict=True):
                times.setdefault(at, []).append(_block_times(image.exposure, ref))
            for at, wanted in times.items():
                prepare_jacobians(at, wanted)

    def geometric(
        self, image: DepthImage, ref: Reference, spline: Spline, level: int, sigma: float,
        slopes_at: Spline | None = None,
    ) -> Started:  # fmt: skip
        """Depth image against the reference's depth with the pixels of a level (`strides`), or `THINNED`.

        slopes_at: spline at which the lines' poses are differentiated by control points, if not `spline`: that changes
        by no more than the increments between the two (relative), which Gauss-Newton steps do not notice.
        """
        with self.timer(f"geometric kernel, level {level}"):
            to_base = self._to_base(spline, ref.T_world_base, image.exposure)
            seen_from, shifts = self._seen_from(spline, ref), self.depth_image > 0.0
            sums = self._geometric_sums(image, ref, to_base, seen_from, level, sigma, shifts)
        slopes, floor = self._slopes(slopes_at or spline, image.exposure, ref), self._floor_depth(image, ref)

        def finish() -> Linearised:
            with self.timer(f"geometric kernel, level {level}"):
                return self._finish(sums(), slopes, sigma, floor, ref.median_depth)

        return finish

    def _geometric_sums(
        self, image: DepthImage, ref: Reference, to_base: Any, from_base: Any, level: int, sigma: float,
        shifts: bool,
    ) -> Callable[[], BlockSums]:  # fmt: skip
        e, lens = self.e, image.exposure.lens
        stride = _stride(lens, level)
        kernel = self._kernel(geometric_kernel, lens, ref.lens, stride, shifts)
        scaling = self._scaling(ref, lens, lens.camera, ref, stride, 1)
        gate = self.gate_depth[pyramid_level(level)] * max(1.0, ref.median_depth)
        if pyramid_level(level) == 0:
            gate = min(gate, max(5.0 * sigma, 10 * self._floor_depth(image, ref)))
        larger = max(1.0, _FINE_FOCAL / ref.lens.camera.fx) ** 2
        smooth = self.smooth * max(sigma, _CREDIBLE_DEPTH * larger)
        rough = min(1.0, larger - 1.0) if self.counts_rough else 0.0
        constants = e.upload(np.append(scaling.parameters(sigma, gate), [smooth, rough]))
        surface = ref.inverse_depth, ref.slope_x, ref.slope_y, ref.roughness
        raw = kernel(GeometricInput(image.z, *self.rays, to_base, *surface, from_base, constants))
        current, reference, _, _ = block_counts(lens, ref.lens)
        return lambda: scaling.unpack(raw.numpy(), current, reference, WHOLE if shifts else 0)

    def _floor_depth(self, image: DepthImage, ref: Reference) -> float:
        # A camera at rest repeats its rounding, so that depth would seem far better than it is.
        return max(self.floor_depth, image.resolution * ref.median_depth**2 / np.sqrt(12.0))

    def visible(self, depth: DepthImage, ref: Reference, spline: Spline, level: int) -> Any:
        """Which of the reference's points of a level the depth image does not hide: 1 or 0, on the device."""
        lens, points = depth.exposure.lens, ref.points[level]
        kernel = self._kernel(visibility_kernel, lens, ref.lens, _stride(ref.lens, level))
        from_base = self._from_base(spline, ref.T_world_base, depth.exposure)
        return kernel(VisibilityInput(points.x, points.y, points.z, self._ref_lines(spline, ref), depth.z, from_base))

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
            from_base = self._from_base(spline, ref.T_world_base, image.exposure)
            # Moving closer or turning packs more points into a block than its share.
            scaling = self._scaling(points, lens, ref.lens.camera, ref, stride, 4)
            constants = e.upload(np.append(scaling.parameters(sigma, self.gate_intensity), brightness))
            seen_at = self._ref_lines(spline, ref), image.levels[own_level], from_base
            shown = points.visible if visible is None else visible
            given = PhotometricInput(points.x, points.y, points.z, points.intensity, shown, *seen_at, constants)
            raw = kernel(given)
        slopes = self._slopes(slopes_at or spline, image.exposure, ref)

        def finish() -> Linearised:
            with self.timer(f"photometric kernel, level {level}"):
                current, reference, _, _ = block_counts(lens, ref.lens)
                sums = scaling.unpack(raw.numpy(), current, reference, len(brightness))
                return self._finish(
                    sums, slopes, sigma, self.floor_intensity, points.median_depth, brightness, expected
                )

        return finish

    def _slopes(self, spline: Spline, exposure: Exposure, ref: Reference) -> Slopes:
        with self.timer("poses of lines"):
            ref_per = block_counts(exposure.lens, ref.lens)[3]
            ref_times = None if ref.rolling is None else ref.rolling.block_times(ref_per)
            return Slopes.of(spline, ref.T_world_base, _block_times(exposure, ref), ref_times)

    def _to_base(self, spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> Any:
        with self.timer("poses of lines"):
            return self.e.upload(to_base_table(spline, T_world_base, exposure))

    def _from_base(self, spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> Any:
        with self.timer("poses of lines"):
            return self.e.upload(from_base_table(spline, T_world_base, exposure))

    def _ref_lines(self, spline: Spline, ref: Reference) -> Any:
        if ref.rolling is None:
            return self.e.upload(np.zeros(12))
        return self._to_base(spline, ref.T_world_base, ref.rolling)

    def _seen_from(self, spline: Spline, ref: Reference) -> Any:
        if ref.rolling is None:
            return self.e.upload(IDENTITY_FROM_BASE)
        return self._from_base(spline, ref.T_world_base, ref.rolling)

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
        brightness: FloatArray | None = None, expected: FloatArray = SAME,
    ) -> Linearised:  # fmt: skip
        # Lines that are exposed at once move alike.
        moved = sums.summed() if len(sums.H) > len(slopes.current) else sums
        with self.timer("linear algebra: chain"):
            own = moved.columns
            model, coupling = chain(moved, slopes, None if own is None else own.coupling)
        model = Quadratic(model.first, model.H / sigma**2, model.g / sigma)
        cost, eliminated, spread = sums.cost, None, np.inf
        if own is not None:
            scaled = coupling / sigma**2, own.H / sigma**2, own.g / sigma
            if brightness is None:
                prior = np.full(WHOLE, self.depth_image / whole_image_unit(median_depth))
                model, _, _ = eliminate(model, *scaled, prior, np.zeros(WHOLE))
            else:
                spread = contrast(own.H, brightness)
                model, eliminated, surprise = without_brightness(model, *scaled, brightness, expected)
                cost += surprise
        next_sigma = scale_step(sigma, sums.weighted, sums.count, floor)
        seen = seen_motions(sums, median_depth)
        counts = sums.count, sums.compared
        return Linearised(
            model, slopes.current, sigma, next_sigma, cost, *counts, floor, seen, sums, eliminated, spread
        )


def _block_times(exposure: Exposure, ref: Reference) -> FloatArray:
    """When the middles of an image's blocks of lines are exposed (n,)."""
    return exposure.block_times(block_counts(exposure.lens, ref.lens)[2])


def _stride(lens: Lens, level: int) -> int:
    return strides(lens.camera.width, lens.camera.height)[level]


def seen_motions(sums: BlockSums, median_depth: float) -> FloatArray:
    """Summed H (6, 6) per pixel, with rotations divided by `median_depth` (m); zero without pixels."""
    scale = 1.0 / np.array([1.0, 1.0, 1.0, median_depth, median_depth, median_depth])
    return sums.H.sum(axis=(0, 1)) * np.outer(scale, scale) / max(1, sums.count)


def weakest_motion(seen: FloatArray) -> float:
    """Smallest eigenvalue of `seen_motions`: how well the motion that is seen least is seen."""
    return float(np.linalg.eigvalsh(seen)[0])
