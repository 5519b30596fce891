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
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from rsgen.device.arrays import Engine, quotient, recorded_with
from rsgen.device.lens import Lens, TracedCamera
from rsgen.device.projection import TO_BASE, RollingProjection, Vector, gather, move, project, project_rolling
from rstrack.alignment.block_sums import Blocks, Contribution, PixelGrid, Runs, block_slot, contribution, sizes, summed
from rstrack.alignment.brightness import MID_GREY
from rstrack.alignment.residuals import GeometricInput, evened, plane_distance
from rstrack.calibration.pairs.images import ACROSS
from rstrack.calibration.pairs.optics import Asked, traced, turned_round, unknown_columns, without_error
from rstrack.images.sampling import PyramidLevel, Raster, cubic_value_and_slope, surface


@dataclass(frozen=True)
class PairInput:
    """Device arrays of both kernels, for all pairs of a launch.

    depth: z (m, 0: none) of the pixels that are compared, of each view; rays_* (normalised): of these; to_base: depth's
    lines, of all views. camera: `camera_table` of the one whose images points are looked up in; from_base: its lines.
    launch: the launch's first pair, and the last of all, which it repeats where there are no more. pairs: current view
    and reference of each pair. own: of each pair the reference's 1 / median depth (1/m), and gain and offset of the
    current image against it. error: as in `Optics`. constants: those of `Scaling`, two of the kernel's own, and units
    of the unknowns.
    """

    depth: Any
    camera: Any
    rays_x: Any
    rays_y: Any
    to_base: Any
    from_base: Any
    launch: Any
    pairs: Any
    own: Any
    error: Any
    constants: Any


@dataclass(frozen=True)
class DepthPairInput(GeometricInput, PairInput):
    """And what of `GeometricInput` is the reference's surface: atlases."""


@dataclass(frozen=True)
class ColorPairInput(PairInput):
    """And image: an atlas of intensities, NaN where they are unusable. depth: of what the colour camera sees."""

    image: Any


@dataclass(frozen=True)
class PairGrid:
    """Pixels of depth images that are compared: number of the pair, in the launch and of all, its current view and its
    reference, number among the pixels of an image, x, y, and which are meant."""

    launched: Any
    pair: Any
    current: Any
    reference: Any
    number: Any
    x: Any
    y: Any
    meant: Any


def pair_grid(e: Engine, depth: Lens, raster: Raster, pixels: PixelGrid, given: PairInput) -> PairGrid:
    """From pixels of depth images, one after the other in order of the pairs: below each other where they are read by
    rows, else side by side. raster: of one image."""
    stride, columns = raster.stride, raster.columns
    column, row = (quotient(v, stride) for v in (pixels.x, pixels.y))
    if depth.shutter.by_rows:
        rows = quotient(e.UInt(raster.count), columns)
        launched = quotient(row, rows)
        row = row - launched * rows
    else:
        launched = quotient(column, columns)
        column = column - launched * columns
    first, last = (dr.gather(e.UInt, given.launch, e.UInt(i)) for i in range(2))
    pair = dr.minimum(first + launched, last)
    current, reference = (dr.gather(e.UInt, given.pairs, 2 * pair + i) for i in range(2))
    return PairGrid(
        launched, pair, current, reference, row * columns + column, column * stride, row * stride, pixels.meant
    )


@dataclass(frozen=True)
class Point:
    """Pixels' points, on the device: line of the pixels, ray, z (m; without its error), the point in the depth camera's
    frame (q) and in the base's (p), T_base_cam, and which there are."""

    line: Any
    xn: Any
    yn: Any
    z: Any
    q: Vector
    p: Vector
    T_base_cam: list[Any]
    active: Any


def _points(
    e: Engine, depth: Lens, raster: Raster, pixels: PairGrid, view: Any, asked: Asked, given: PairInput
) -> Point:
    """Of pixels of a view's depth image."""
    z = dr.gather(e.Float, given.depth, view * raster.count + pixels.number)
    xn, yn = (dr.gather(e.Float, rays, pixels.number) for rays in (given.rays_x, given.rays_y))
    active = pixels.meant & (z > 0.0)
    z = without_error(e, asked, z, xn, yn, given.error)
    q = xn * z, yn * z, z
    line = e.UInt(depth.line_of(e.Int(pixels.x), e.Int(pixels.y)))
    T_base_cam = gather(given.to_base, view * depth.lines + line, TO_BASE, stride=TO_BASE)
    return Point(line, xn, yn, z, q, move(T_base_cam, q), T_base_cam, active)


def in_atlas(view: Any, width: Any, height: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Where pixels (x, y) of a view's image are in an atlas of images of that size."""
    return x + type(x)(view % ACROSS * width), y + type(y)(view // ACROSS * height)


def _inside(view: Any, width: Any, height: Any, margin: float, x: Any, y: Any) -> Any:
    """Whether all that is interpolated between at (x, y) of the atlas is of a view's image, and not of the next one.

    Not before they are in the atlas: the sum is rounded, and may lie across an image's edge, or beyond the last one's.
    """
    left, top = in_atlas(view, width, height, type(x)(0.0), type(y)(0.0))
    right, bottom = left + (width - 1.0), top + (height - 1.0)
    return (x >= left + margin) & (y >= top + margin) & (x < right - margin) & (y < bottom - margin)


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


def depth_residual(
    e: Engine, depth: Lens, raster: Raster, pixels: PairGrid, asked: Asked, given: DepthPairInput
) -> DepthResidual:
    """Equation (6) with rows' times on both sides."""
    lens = traced(e, depth, given.camera)
    width, height = depth.camera.width, depth.camera.height
    at = _points(e, depth, raster, pixels, pixels.current, asked, given)
    first = pixels.reference * depth.lines
    seen = project_rolling(lens, given.from_base, at.p, e.UInt, e.Int, first)
    x, y = in_atlas(pixels.reference, width, height, seen.x, seen.y)
    active = at.active & seen.valid & _inside(pixels.reference, width, height, 0.0, x, y)
    assert isinstance(lens.camera, TracedCamera)
    atlas = lens.camera.wider(ACROSS)
    rho, active = surface(e, atlas, given.inverse_depth, x, y, active)
    if asked.corrects:
        rho = dr.rcp(without_error(e, asked, dr.rcp(rho), seen.at.xn, seen.at.yn, given.error))
    even = evened(at.z, dr.gather(e.Float, given.own, 3 * pixels.pair))
    there = replace(seen, x=x, y=y)
    r, g, is_smooth = plane_distance(e, given, atlas, there, rho, active, even)
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
    e: Engine, color: Lens, depth: Lens, raster: Raster, pixels: PairGrid, level: PyramidLevel, asked: Asked,
    given: ColorPairInput,
) -> ColorResidual:  # fmt: skip
    """Intensities of the level, the reference's with the gain and offset that the current image has."""
    width, height, shrink = level.width, level.height, level.shrink

    def looked_up(view: Any, active: Any) -> tuple[RollingProjection, Any, Vector, Any]:
        seen = project_rolling(lens, given.from_base, at.p, e.UInt, e.Int, view * color.lines)
        x, y = in_atlas(view, width, height, seen.x * shrink, seen.y * shrink)
        active = active & seen.valid & _inside(view, width, height, 1.0, x, y)
        # As high as any: where the image ends has been looked at.
        value, dx, dy, active = cubic_value_and_slope(e, given.image, ACROSS * width, ACROSS * height, x, y, active)
        return seen, value, seen.chain(dx * shrink, dy * shrink, 0.0), active

    lens = traced(e, color, given.camera)
    at = _points(e, depth, raster, pixels, pixels.reference, asked, given)
    here, value, own, active = looked_up(pixels.current, at.active)
    there, ref, other, active = looked_up(pixels.reference, active)
    gain, offset = (dr.gather(e.Float, given.own, 3 * pixels.pair + i) for i in (1, 2))
    contrast = ref - MID_GREY
    r = value - (ref + dr.fma(gain, contrast, offset))
    return ColorResidual(lens, at.p, here, there, r, own, other, gain, contrast, active)


def _room(pairs: int, size: int) -> int:
    """Integers of so many pairs, which have `size` each, with some to spare: their number is compiled in.

    But no more than Dr.Jit may keep for each thread.
    """
    return min(1 << (pairs - 1).bit_length(), max(pairs, dr.expand_threshold() // size)) * size


def depth_pair_kernel(e: Engine, depth: Lens, stride: int, asked: Asked, pairs: int) -> Callable[[DepthPairInput], Any]:
    """Kernel of the depth term: for each pair the sums over pairs of blocks (current, reference) of depth lines."""
    names = asked.depth
    size, values = sizes(depth, depth, len(names))
    of_lens = depth, Raster.of(depth.camera, stride), Blocks.of(depth, depth), _runs(e, depth, stride, pairs)

    @recorded_with(e, DepthPairInput, *of_lens)
    def kernel(given: DepthPairInput, depth: Lens, raster: Raster, blocks: Blocks, runs: Runs) -> Any:
        parameters = [dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(7)]

        def at(pixels: PixelGrid) -> Contribution:
            grid = pair_grid(e, depth, raster, pixels, given)
            of_pixel = depth_residual(e, depth, raster, grid, asked, given)
            point, seen, camera = of_pixel.at, of_pixel.seen, of_pixel.lens.camera
            both = (seen.at, seen.M), (project(camera, point.q), point.T_base_cam)
            columns = unknown_columns(e, names, camera, of_pixel.g, *both, given.constants)
            slot = grid.launched * size + block_slot(point.line, seen.row, blocks, grid.y, len(names))
            judged = of_pixel.is_smooth, len(names)
            motion = of_pixel.g, point.p, 1.0, of_pixel.r, of_pixel.active
            return contribution(e, *motion, parameters, slot, columns, *judged)

        return summed(e, runs, (_room(pairs, size), values), at, is_steady=False)

    return kernel


def color_pair_kernel(
    e: Engine, color: Lens, depth: Lens, stride: int, level: int, asked: Asked, pairs: int
) -> Callable[[ColorPairInput], Any]:
    """Kernel of the colour term: for each pair the sums over pairs of blocks (current, reference) of *colour* lines.

    Its further columns: what is asked of the colour camera's lens, then gain and offset of the current image.
    """
    names = asked.color
    size, values = sizes(color, color, len(names) + 2)
    of_depth = depth, Raster.of(depth.camera, stride), _runs(e, depth, stride, pairs)
    of_color = color, PyramidLevel.of(color.camera, level), Blocks.of(color, color)

    @recorded_with(e, ColorPairInput, *of_depth, *of_color)
    def kernel(
        given: ColorPairInput, depth: Lens, raster: Raster, runs: Runs, color: Lens, image: PyramidLevel,
        blocks: Blocks,
    ) -> Any:  # fmt: skip
        parameters = [dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(7)]

        def at(pixels: PixelGrid) -> Contribution:
            grid = pair_grid(e, depth, raster, pixels, given)
            of = color_residual(e, color, depth, raster, grid, image, asked, given)
            here, there = of.here, of.there
            a, b, c = (0.5 * dr.fma(1.0 + of.gain, two, one) for one, two in zip(of.own, of.other, strict=True))
            both = (here.at, here.M), (there.at, turned_round(there.M))
            columns = unknown_columns(e, names, of.lens.camera, (a, b, c), *both, given.constants)
            columns += [-of.contrast, e.Float(-1.0)]
            slot = grid.launched * size + block_slot(here.row, there.row, blocks, here.y, len(columns))
            # A twist of the camera moves the point the other way.
            return contribution(e, (a, b, c), of.p, -1.0, of.r, of.active, parameters, slot, columns, True, len(names))

        return summed(e, runs, (_room(pairs, size), values), at, is_steady=False)

    return kernel


def _runs(e: Engine, depth: Lens, stride: int, pairs: int) -> Runs:
    """Depth images' pixels, the images below each other if they are read by rows, else beside each other."""
    width, height = (-(-size // stride) * stride for size in (depth.camera.width, depth.camera.height))
    by_rows = depth.shutter.by_rows
    size = (width, height * pairs) if by_rows else (width * pairs, height)
    return Runs.over(e, *size, stride, not by_rows)
