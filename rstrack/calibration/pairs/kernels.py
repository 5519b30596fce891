"""Two frames against each other, both with their own rolling shutters: depth by depth, colour by colour.

Depth: the geometric term of `alignment.residuals` against a reference that keeps its rows' times. Colour: points of the
reference's depth looked up in both colour images, each by its own lines. How the point itself was placed hardly matters
then, since both images see it move alike, and the derivative is taken half from each image (as in efficient
second-order minimisation, Benhimane and Malis, IROS 2004): the noise of one image's gradient alone would pass for
information about the extrinsics. What lenses and depth do, where they are unknown, follows from how the same unknown
moves a point in either camera (`optics.moves`); depth's own error by depth alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from rsgen.device.arrays import Engine, recorded_from
from rsgen.device.lens import Lens
from rsgen.device.projection import TO_BASE, RollingProjection, Vector, gather, move, project, project_rolling
from rstrack.alignment.block_sums import Contribution, PixelGrid, block_slot, contribution, sizes, summed
from rstrack.alignment.brightness import MID_GREY
from rstrack.alignment.residuals import GeometricInput, evened, plane_distance
from rstrack.calibration.pairs.optics import Asked, moves, traced, turned_round, unknown_columns, without_error
from rstrack.images.sampling import cubic_value_and_slope, level_size, surface


@dataclass(frozen=True)
class DepthPairInput(GeometricInput):
    """Device arrays of the depth kernel: see `GeometricInput`; camera: `camera_table`; error: `error_table`."""

    camera: Any
    error: Any


@dataclass(frozen=True)
class ColorPairInput:
    """Device arrays of the colour kernel.

    depth: z of the reference's depth image (m, 0: none); rays_*: its normalised coordinates; to_base: poses of its
    lines; error: `error_table`. image, from_base: current intensities, NaN where they are unusable, and the colour
    camera's lines; ref_*: the reference's; camera: `camera_table`. constants: those of `Scaling`, gain and offset of
    the current image against the reference's, units of the unknown lens.
    """

    depth: Any
    rays_x: Any
    rays_y: Any
    to_base: Any
    error: Any
    image: Any
    from_base: Any
    ref_image: Any
    ref_from_base: Any
    camera: Any
    constants: Any


@dataclass(frozen=True)
class Point:
    """Pixels' points, on the device: index, line and row of the pixels, ray, z (m; without its error), the point in the
    depth camera's frame (q) and in the base's (p), T_base_cam, and which there are."""

    pixel: Any
    line: Any
    row: Any
    xn: Any
    yn: Any
    z: Any
    q: Vector
    p: Vector
    T_base_cam: list[Any]
    active: Any


def _points(e: Engine, depth: Lens, pixels: PixelGrid, asked: Asked, given: DepthPairInput | ColorPairInput) -> Point:
    """Of pixels of a depth image."""
    images = given.depth, given.rays_x, given.rays_y
    z, xn, yn = (dr.gather(e.Float, image, pixels.index) for image in images)
    active = pixels.meant & (z > 0.0)
    z = without_error(e, asked, z, xn, yn, given.error)
    q = xn * z, yn * z, z
    line = e.UInt(depth.line_of(e.Int(pixels.x), e.Int(pixels.y)))
    T_base_cam = gather(given.to_base, line, TO_BASE, stride=TO_BASE)
    return Point(pixels.index, line, pixels.y, xn, yn, z, q, move(T_base_cam, q), T_base_cam, active)


@dataclass(frozen=True)
class DepthResidual:
    """Of pixels of a depth image against a surface: r (m), its derivative g by a shift in the base frame.

    seen: by the reference; lens: the depth camera with its values; even: see `evened`.
    """

    at: Point
    lens: Lens
    seen: RollingProjection
    r: Any
    g: Vector
    even: Any
    active: Any
    is_smooth: Any


def depth_residual(e: Engine, depth: Lens, pixels: PixelGrid, asked: Asked, given: DepthPairInput) -> DepthResidual:
    """Equation (6) with rows' times on both sides."""
    lens = traced(e, depth, given.camera)
    at = _points(e, depth, pixels, asked, given)
    seen = project_rolling(lens, given.from_base, at.p, e.UInt, e.Int)
    rho, active = surface(e, lens.camera, given.inverse_depth, seen.x, seen.y, at.active & seen.valid)
    if asked.corrects:
        rho = dr.rcp(without_error(e, asked, dr.rcp(rho), seen.at.xn, seen.at.yn, given.error))
    even = evened(at.z, dr.gather(e.Float, given.constants, e.UInt(2)))
    r, g, is_smooth = plane_distance(e, given, lens.camera, seen, rho, active, even)
    return DepthResidual(at, lens, seen, r, g, even, active, is_smooth)


@dataclass(frozen=True)
class ColorResidual:
    """Of pixels of the reference's depth in two colour images: r, and its derivatives own and other by a shift in the
    base frame, with the current image's gradient and with the reference's, as it is.

    here, there: where the current image and the reference's see them; gain: of the current image against the
    reference's; contrast: of the latter, from mid grey.
    """

    lens: Lens
    p: Vector
    here: RollingProjection
    there: RollingProjection
    r: Any
    own: Vector
    other: Vector
    gain: Any
    contrast: Any
    active: Any


def color_residual(
    e: Engine, color: Lens, depth: Lens, pixels: PixelGrid, level: int, asked: Asked, given: ColorPairInput
) -> ColorResidual:
    """Intensities of the level, the reference's with the gain and offset that the current image has."""
    width, height = level_size(color.camera.width, level), level_size(color.camera.height, level)
    shrink = 0.5**level

    def looked_up(image: Any, seen: RollingProjection, active: Any) -> tuple[Any, Vector, Any]:
        x, y = seen.x * shrink, seen.y * shrink
        value, dx, dy, active = cubic_value_and_slope(e, image, width, height, x, y, active & seen.valid)
        return value, seen.chain(dx * shrink, dy * shrink, 0.0), active

    lens = traced(e, color, given.camera)
    at = _points(e, depth, pixels, asked, given)
    here = project_rolling(lens, given.from_base, at.p, e.UInt, e.Int)
    there = project_rolling(lens, given.ref_from_base, at.p, e.UInt, e.Int)
    value, own, active = looked_up(given.image, here, at.active)
    ref, other, active = looked_up(given.ref_image, there, active)
    gain, offset = (dr.gather(e.Float, given.constants, e.UInt(i)) for i in (7, 8))
    contrast = ref - MID_GREY
    r = value - (ref + dr.fma(gain, contrast, offset))
    return ColorResidual(lens, at.p, here, there, r, own, other, gain, contrast, active)


def depth_pair_kernel(e: Engine, depth: Lens, stride: int, asked: Asked) -> Callable[[DepthPairInput], Any]:
    """Kernel of the depth term: sums over pairs of blocks (current, reference) of depth lines."""
    names = asked.depth

    @recorded_from(DepthPairInput)
    def kernel(given: DepthPairInput) -> Any:
        parameters = [dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(7)]

        def at(pixels: PixelGrid) -> Contribution:
            of = depth_residual(e, depth, pixels, asked, given)
            point, seen, columns = of.at, of.seen, []
            if names:
                own = project(of.lens.camera, point.q), seen.at
                here, there = (moves(names, of.lens.camera, one) for one in own)
                shifts = zip(there, here, strict=True)
                columns = unknown_columns(e, of.g, shifts, seen.M, point.T_base_cam, given.constants)
            slot = block_slot(point.line, seen.row, depth, depth, point.row, len(names))
            judged = of.is_smooth, len(names)
            return contribution(e, of.g, point.p, 1.0, of.r, of.active, parameters, slot, columns, *judged)

        return _summed(e, depth, depth, stride, len(names), at)

    return kernel


def color_pair_kernel(
    e: Engine, color: Lens, depth: Lens, stride: int, level: int, asked: Asked
) -> Callable[[ColorPairInput], Any]:
    """Kernel of the colour term: sums over pairs of blocks (current, reference) of *colour* lines.

    Its further columns: what is asked of the colour camera's lens, then gain and offset of the current image.
    """
    names = asked.color

    @recorded_from(ColorPairInput)
    def kernel(given: ColorPairInput) -> Any:
        parameters = [dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(7)]

        def at(pixels: PixelGrid) -> Contribution:
            of = color_residual(e, color, depth, pixels, level, asked, given)
            here, there, columns = of.here, of.there, []
            a, b, c = (0.5 * dr.fma(1.0 + of.gain, two, one) for one, two in zip(of.own, of.other, strict=True))
            if names:
                pairs = zip(*(moves(names, of.lens.camera, seen.at) for seen in (here, there)), strict=True)
                columns = unknown_columns(e, (a, b, c), pairs, here.M, turned_round(there.M), given.constants)
            columns += [-of.contrast, e.Float(-1.0)]
            slot = block_slot(here.row, there.row, color, color, here.y, len(columns))
            # A twist of the camera moves the point the other way.
            return contribution(e, (a, b, c), of.p, -1.0, of.r, of.active, parameters, slot, columns, True, len(names))

        return _summed(e, depth, color, stride, len(names) + 2, at)

    return kernel


def _summed(
    e: Engine, depth: Lens, lens: Lens, stride: int, columns: int, at: Callable[[PixelGrid], Contribution]
) -> Any:
    """Sums over a depth image's pixels, in blocks of a lens's lines."""
    shape = depth.camera.width, depth.camera.height, stride
    return summed(e, shape, sizes(lens, lens, columns), at, not lens.shutter.by_rows, False)
