"""Reading images on the device: pixel grids, bilinear and nearest values, surfaces of inverse depth; motion blur."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr

from rsgen.device.arrays import Engine, Numbers, quotient
from rsgen.device.lens import Lens, per_focal
from rsgen.device.projection import TO_BASE, Vector, gather, move
from rsgen.geometry.camera import Camera

# Relative spread of inverse depth within 2×2 pixels from which on they lie on both sides of an edge.
EDGE = 0.03
# Metres that a point has to lie behind what is seen there to count as hidden, beside EDGE of its depth.
BEHIND = 0.02
# Largest factor by which the errors of near depth count more than those of the median depth.
NEAREST = 2.0


@dataclass(frozen=True)
class Raster(Numbers):
    """Every stride-th pixel of every stride-th row of an image.

    width: of the image. columns, count: of these pixels.
    """

    COMPILED: ClassVar[tuple[str, ...]] = ("count",)

    width: int
    stride: int
    columns: int
    count: int

    @classmethod
    def of(cls, camera: Camera, stride: int = 1) -> Raster:
        """Of a camera's images."""
        columns, rows = (-(-size // stride) for size in (camera.width, camera.height))
        return cls(camera.width, stride, columns, columns * rows)


def grid(e: Engine, raster: Raster) -> tuple[Any, Any, Any]:
    """Index, x and y of the pixels."""
    i = dr.arange(e.UInt, raster.count)
    row = quotient(i, raster.columns)
    if not isinstance(raster.columns, int):
        # Beyond four million it may be one off.
        row = dr.select(row * raster.columns > i, row - 1, row)
        row = dr.select(i - row * raster.columns >= raster.columns, row + 1, row)
    x, y = (i - row * raster.columns) * raster.stride, row * raster.stride
    return y * raster.width + x, x, y


def pinhole_ray(e: Engine, camera: Camera, x: Any, y: Any) -> tuple[Any, Any]:
    """Normalised coordinates of pixels, whose numbers are integers, of a pinhole image."""
    return per_focal(camera, e.Float(x) - camera.cx, e.Float(y) - camera.cy)


def depth_of(rho: Any) -> tuple[Any, Any]:
    """Depth where inverse depth is known, else 1, and where it is."""
    known = rho > 0.0
    return dr.rcp(dr.select(known, rho, 1.0)), known


def pinhole_points(e: Engine, camera: Camera, raster: Raster, rho: Any) -> tuple[Vector, Any]:
    """Points that a rectified image's pixels see, by inverse depth `rho`, in its camera's frame; which have any."""
    _, x, y = grid(e, raster)
    z, known = depth_of(rho)
    xn, yn = pinhole_ray(e, camera, x, y)
    return (xn * z, yn * z, z), known


def row_of_pixel(e: Engine, lens: Lens, x: Any, y: Any) -> Any:
    """Number of the line that exposes a pixel; 0 where all are exposed at once."""
    return e.UInt(lens.line_of(e.Int(x), e.Int(y))) if lens.rolls else e.UInt(0)


def moved_to_base(e: Engine, lens: Lens, to_base: Any, x: Any, y: Any, p: Vector) -> Vector:
    """Points that pixels of an image see, in the base frame, by the poses of their own lines; p if it is rectified."""
    if not lens.rolls:
        return p
    return move(gather(to_base, row_of_pixel(e, lens, x, y), TO_BASE, stride=TO_BASE), p)


def bilinear(e: Engine, image: Any, width: Any, height: Any, x: Any, y: Any, active: Any) -> tuple[Any, ...]:
    """Four neighbours (00, 10, 01, 11), the position between them, and whether all are inside."""
    active = active & (x >= 0.0) & (y >= 0.0) & (x < width - 1.0) & (y < height - 1.0)
    x0, y0 = dr.floor(x), dr.floor(y)
    index = e.UInt(e.Int(dr.select(active, y0, 0.0))) * width + e.UInt(e.Int(dr.select(active, x0, 0.0)))
    near = [dr.gather(e.Float, image, index + offset, active) for offset in (0, 1, width, width + 1)]
    return (*near, x - x0, y - y0, active)


def bilinear_value(e: Engine, image: Any, width: Any, height: Any, x: Any, y: Any, active: Any) -> tuple[Any, Any]:
    """The bilinear value at (x, y), and whether all four neighbours are inside."""
    a, b, c, d, fx, fy, active = bilinear(e, image, width, height, x, y, active)
    return dr.lerp(dr.lerp(a, b, fx), dr.lerp(c, d, fx), fy), active


def value_and_slope(
    e: Engine, image: Any, width: Any, height: Any, x: Any, y: Any, active: Any
) -> tuple[Any, Any, Any, Any]:
    """The bilinear value at (x, y), its derivatives by x and y, and whether all four neighbours are inside."""
    a, b, c, d, fx, fy, active = bilinear(e, image, width, height, x, y, active)
    top, bottom = dr.fma(b - a, fx, a), dr.fma(d - c, fx, c)
    return dr.fma(bottom - top, fy, top), dr.fma((d - c) - (b - a), fy, b - a), bottom - top, active


def cubic_value_and_slope(
    e: Engine, image: Any, width: Any, height: Any, x: Any, y: Any, active: Any
) -> tuple[Any, Any, Any, Any]:
    """`value_and_slope` by cubic convolution (Keys, IEEE Trans. ASSP 1981, a = −1/2), where all 16 pixels are inside.

    Bilinear values are blurred the more the farther from pixels, and their slopes are those half a pixel away: where
    one image is read between pixels and another one at them, the two pass for a shift of some hundredths of a pixel.
    """
    active = active & (x >= 1.0) & (y >= 1.0) & (x < width - 2.0) & (y < height - 2.0)
    x0, y0 = dr.floor(x), dr.floor(y)
    column, row = (e.UInt(e.Int(dr.select(active, v, 1.0))) for v in (x0, y0))
    first = (row - 1) * width + column - 1
    across, along = _keys(x - x0), _keys(y - y0)
    value = dx = dy = e.Float(0.0)
    for j in range(4):
        pixels = [dr.gather(e.Float, image, first + j * width + i, active) for i in range(4)]
        line, slope = (sum(w * v for w, v in zip(weights, pixels, strict=True)) for weights in across)
        value = dr.fma(along[0][j], line, value)
        dx = dr.fma(along[0][j], slope, dx)
        dy = dr.fma(along[1][j], line, dy)
    return value, dx, dy, active


def _keys(t: Any) -> tuple[list[Any], list[Any]]:
    """Weights of four neighbours at part t between the middle two, and their derivatives."""
    u = t * t
    weights = [
        t * (-0.5 + t - 0.5 * u), 1.0 + u * (1.5 * t - 2.5), t * (0.5 + 2.0 * t - 1.5 * u), u * (0.5 * t - 0.5),
    ]  # fmt: skip
    slopes = [-0.5 + 2.0 * t - 1.5 * u, t * (4.5 * t - 5.0), 0.5 + 4.0 * t - 4.5 * u, t * (1.5 * t - 1.0)]
    return weights, slopes


def nearest(e: Engine, width: Any, x: Any, y: Any, active: Any) -> Any:
    """Index of the pixel nearest to (x, y); 0 where not active."""
    column, row = (e.UInt(e.Int(dr.select(active, v + 0.5, 0.0))) for v in (x, y))
    return row * width + column


def surface(e: Engine, camera: Camera, rho: Any, x: Any, y: Any, active: Any) -> tuple[Any, Any]:
    """Inverse depth at (x, y), and whether it lies on one surface: bilinear, never across an edge or beside a hole."""
    a, b, c, d, fx, fy, active = bilinear(e, rho, camera.width, camera.height, x, y, active)
    most, least = dr.maximum(dr.maximum(a, b), dr.maximum(c, d)), dr.minimum(dr.minimum(a, b), dr.minimum(c, d))
    active &= (least > 0.0) & (most - least < EDGE * most)
    top, bottom = dr.fma(b - a, fx, a), dr.fma(d - c, fx, c)
    return dr.fma(bottom - top, fy, top), active


@dataclass(frozen=True)
class PyramidLevel(Numbers):
    """Width and height of a pyramid's level, and by what a pixel of the image is multiplied to be one of the level."""

    width: int
    height: int
    shrink: float

    @classmethod
    def of(cls, camera: Camera, level: int) -> PyramidLevel:
        """Of a camera's images, halved so many times."""
        return cls(level_size(camera.width, level), level_size(camera.height, level), 0.5**level)


def level_size(size: int, level: int) -> int:
    """Width or height of a pyramid level: halved and rounded up, as cv2.pyrDown does."""
    return -(-size // 2**level)


def blur_weight(length_px: Any, inv_sigma2: Any) -> Any:
    """Equation (13), w = exp(−‖x_t − x_{t−t_e}‖ / σ²), on the device.

    length_px: how far the point moves in the image while its line is exposed. inv_sigma2: 1/σ², σ in pixels; 0 counts
    all alike.
    """
    return dr.exp(-inv_sigma2 * length_px)


def blur_length(pixel_speed: tuple[Any, Any], lines: Any) -> Any:
    """‖x_t − x_{t−t_e}‖ in pixels of points that move by pixel_speed (px) per line delay (`project_rolling`).

    lines: line delays that a line is exposed for.
    """
    u, v = pixel_speed
    return dr.sqrt(u * u + v * v) * lines


@dataclass(frozen=True)
class Blur(Numbers):
    """`blur_length`'s lines and `blur_weight`'s 1/σ²."""

    lines: float
    inv_sigma2: float

    @classmethod
    def of(cls, lens: Lens, sigma_px: float) -> Blur:
        """Of a camera's images; sigma_px: σ of equation (13)."""
        return cls(lens.shutter.exposure_s / lens.shutter.line_delay(lens.camera), 1.0 / sigma_px**2)
