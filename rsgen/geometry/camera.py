"""Camera models: pinhole, radial-tangential, rational, fisheye, double sphere; pixels to rays and back, with Jacobians.

Camera frame: x right, y down, z forward. Pixel centres at integer coordinates. Normalised coordinates are (x/z, y/z).
Distortion as in OpenCV: `radtan` k1 k2 p1 p2 [k3] (Brown-Conrady), `rational` k1 k2 p1 p2 k3 k4 k5 k6, in which the
radial part is divided by 1 + k4 r² + k5 r⁴ + k6 r⁶, `fisheye` k1 k2 k3 k4 (Kannala-Brandt);
`double_sphere` xi alpha as in Kalibr and Basalt.

Distortions are polynomials, or quotients of them, that may fold back at some radius, beyond which one pixel would see
two directions. A camera here is defined only inside a disc around the optical axis on which the distortion provably is
one to one; what lies outside is reported as not visible instead of being projected to a wrong place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from numpy.polynomial.polynomial import polyval

from rsgen.array_types import BoolArray, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import distortion as lens

Model = Literal["pinhole", "radtan", "rational", "fisheye", "double_sphere"]

_COEFFICIENTS: dict[str, tuple[int, ...]] = {
    "pinhole": (0,),
    "radtan": (4, 5),
    "rational": (8,),
    "fisheye": (4,),
    "double_sphere": (2,),
}
# Radii in a table of the rational distortion, from which its inverse starts.
_STARTS = 1024
# Metres. Nearer points have no direction that float64 could tell.
_MIN_DEPTH = 1e-9
# A microradian from the image plane; keeps powers of the radius finite.
_MAX_RADIUS = 1e6


@dataclass(frozen=True)
class Camera:
    """Width and height in pixels, focal lengths and principal point in pixels, distortion model and coefficients.

    Raises UserError for sizes and focal lengths that are not positive, non-finite numbers, and a wrong number of
    coefficients (pinhole 0, radtan 4 or 5, rational 8, fisheye 4, double_sphere 2, of which xi is in (-1, 1] and alpha
    in [0, 1]).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: Model = "pinhole"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if isinstance(size, bool) or not math.isfinite(size) or int(size) != size or size < 1:
                raise UserError(f"camera: {name} = {size!r} must be a positive whole number of pixels")
            object.__setattr__(self, name, int(size))
        for name in ("fx", "fy", "cx", "cy"):
            value = float(getattr(self, name))
            if not math.isfinite(value) or (name in ("fx", "fy") and value <= 0.0):
                positive = " and positive (a negative fy belongs to a y-up camera)" if name in ("fx", "fy") else ""
                raise UserError(f"camera: {name} = {value!r} must be finite{positive}")
            object.__setattr__(self, name, value)
        if self.model not in get_args(Model):
            raise UserError(f"camera: unknown model {self.model!r}; use one of {', '.join(get_args(Model))}")
        object.__setattr__(self, "distortion", tuple(float(k) for k in self.distortion))
        expected = _COEFFICIENTS[self.model]
        if len(self.distortion) not in expected or not all(map(math.isfinite, self.distortion)):
            counts = " or ".join(map(str, expected))
            raise UserError(
                f"camera: {self.model} takes {counts} finite distortion coefficients, not {self.distortion}"
            )
        if self.model == "double_sphere" and not (-1.0 < self._sphere[0] <= 1.0 and 0.0 <= self._sphere[1] <= 1.0):
            raise UserError(f"camera: double_sphere takes xi in (-1, 1] and alpha in [0, 1], not {self.distortion}")

    @property
    def K(self) -> FloatArray:
        """Camera matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def max_radius(self) -> float:
        """Radius in normalised coordinates up to which it is defined: infinite for a pinhole, otherwise 1e6 or less."""
        if self.model == "pinhole":
            return math.inf
        if self.model == "fisheye":
            theta = math.sqrt(lens.first_root(lens.odd_slope(self.distortion)))
            return math.tan(min(theta, math.atan(_MAX_RADIUS)))
        if self.model == "double_sphere":
            return min(lens.double_sphere_radius(*self._sphere), _MAX_RADIUS)
        k1, k2, p1, p2, k3 = self.brown
        # The Jacobian is symmetric; its radial part has the eigenvalues d and (r d)', the tangential part none below
        # -6 |p| r. Where both sums are positive it is positive definite, and on a disc, being convex, that makes the
        # map one to one.
        tangential = 6.0 * math.hypot(p1, p2)
        if self.model == "rational":
            return min(lens.rational_radius((k1, k2, k3), self.distortion[5:], tangential), _MAX_RADIUS)
        across = [1.0, -tangential, k1, 0.0, k2, 0.0, k3]
        along = [1.0, -tangential, 3.0 * k1, 0.0, 5.0 * k2, 0.0, 7.0 * k3]
        return min(lens.first_root(across), lens.first_root(along), _MAX_RADIUS)

    def project(self, p_cam: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Pixels uv (..., 2) of points (..., 3) in metres, and whether they are defined (...,).

        Not defined (uv is NaN): behind the camera, or outside the distortion's domain. Points outside the image are
        projected like any other: see `contains`.
        """
        xy, _, valid = self._normalise(p_cam)
        uv = self._distort(xy) * (self.fx, self.fy) + (self.cx, self.cy)
        return np.where(valid[..., None], uv, np.nan), valid

    def project_jacobian(self, p_cam: npt.ArrayLike) -> FloatArray:
        """Derivatives (..., 2, 3) of `project`, in pixels per metre; NaN where it is not defined."""
        xy, inv_z, valid = self._normalise(p_cam)
        D = self._distort_jacobian(xy) * np.array([[self.fx], [self.fy]]) * inv_z[..., None, None]
        J = np.concatenate([D, -(D @ xy[..., None])], axis=-1)
        return np.where(valid[..., None, None], J, np.nan)

    def contains(self, uv: npt.ArrayLike) -> BoolArray:
        """Whether pixels (..., 2) lie in the image: −½ ≤ u < width − ½ and −½ ≤ v < height − ½. NaN does not."""
        uv = np.asarray(uv, dtype=np.float64)
        inside = (uv >= -0.5) & (uv < np.array([self.width, self.height]) - 0.5)
        return np.asarray(inside[..., 0] & inside[..., 1])  # all(axis=-1) takes ten times as long

    def unproject(self, uv: npt.ArrayLike) -> FloatArray:
        """Rays (..., 3) with z = 1 through pixels (..., 2); NaN where no direction is seen there (see `max_radius`)."""
        uv = np.asarray(uv, dtype=np.float64)
        xy = self._undistort((uv - (self.cx, self.cy)) / (self.fx, self.fy))
        return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)

    def backproject(self, uv: npt.ArrayLike, z: npt.ArrayLike) -> FloatArray:
        """Points (..., 3) in metres at planar depths z (...,) on the rays of pixels uv (..., 2)."""
        return self.unproject(uv) * np.asarray(z, dtype=np.float64)[..., None]

    def pixel_grid(self) -> FloatArray:
        """Coordinates (height, width, 2) of all pixel centres."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return np.stack([u, v], axis=-1)

    @property
    def brown(self) -> tuple[float, float, float, float, float]:
        """k1 k2 p1 p2 k3 of a radial-tangential or rational camera."""
        k1, k2, p1, p2, k3 = (*self.distortion, 0.0)[:5]
        return k1, k2, p1, p2, k3

    @property
    def _sphere(self) -> tuple[float, float]:
        """xi and alpha of a double sphere."""
        xi, alpha = self.distortion
        return xi, alpha

    def _normalise(self, p_cam: npt.ArrayLike) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Normalised coordinates (..., 2), 1/z (...,) and whether the camera is defined there; 0 where it is not."""
        p = np.asarray(p_cam, dtype=np.float64)
        finite = np.isfinite(p)
        front = finite[..., 0] & finite[..., 1] & finite[..., 2] & (p[..., 2] > _MIN_DEPTH)
        inv_z = np.where(front, 1.0 / np.where(front, p[..., 2], 1.0), 0.0)
        xy = np.where(front[..., None], p[..., :2], 0.0) * inv_z[..., None]
        valid = front & (np.hypot(xy[..., 0], xy[..., 1]) < self.max_radius)
        return np.where(valid[..., None], xy, 0.0), inv_z, np.asarray(valid)

    def _distort(self, xy: FloatArray) -> FloatArray:
        if self.model == "pinhole":
            return xy
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        if self.model == "fisheye":
            return xy * self._fisheye_scale(r2)[0][..., None]
        if self.model == "double_sphere":
            return xy * lens.double_sphere_scale(*self._sphere, r2)[0][..., None]
        _, _, p1, p2, _ = self.brown
        d = self._radial_scale(r2)[0]
        return np.stack(
            [x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * d + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y],
            axis=-1,
        )

    def _distort_jacobian(self, xy: FloatArray) -> FloatArray:
        """(..., 2, 2), symmetric: s I + g xy xyᵀ, plus the tangential part."""
        if self.model == "pinhole":
            return np.broadcast_to(np.eye(2), (*xy.shape, 2))
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        if self.model in ("fisheye", "double_sphere"):
            s, g = self._fisheye_scale(r2) if self.model == "fisheye" else lens.double_sphere_scale(*self._sphere, r2)
            return _symmetric(s + g * x * x, g * x * y, s + g * y * y)
        _, _, p1, p2, _ = self.brown
        s, g = self._radial_scale(r2)
        return _symmetric(
            s + g * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
            g * x * y + 2.0 * (p1 * x + p2 * y),
            s + g * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
        )

    def _radial_scale(self, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The radial part's s and g = (ds/dr) / r of a radial-tangential or rational camera."""
        k1, k2, _, _, k3 = self.brown
        s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        g = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))
        if self.model != "rational":
            return s, g
        k4, k5, k6 = self.distortion[5:]
        below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        slope = 2.0 * (k4 + r2 * (2.0 * k5 + r2 * (3.0 * k6)))
        return s / below, (g * below - s * slope) / (below * below)

    def _fisheye_scale(self, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """s = θ_d / r and g = (ds/dr) / r."""
        r = np.sqrt(r2)
        theta = np.arctan(r)
        safe_r2 = np.where(r2 > 0.0, r2, 1.0)
        s = np.where(r2 > 0.0, lens.odd(self.distortion, theta) / np.sqrt(safe_r2), 1.0)
        slope = polyval(theta * theta, lens.odd_slope(self.distortion))
        # g only ever multiplies products of x and y, so what cancels here for small r does no harm.
        return s, np.where(r2 > 0.0, (slope / (1.0 + r2) - s) / safe_r2, 0.0)

    def _undistort(self, distorted: FloatArray) -> FloatArray:
        if self.model == "pinhole":
            return distorted
        if self.model == "double_sphere":
            xy = lens.undistort_double_sphere(*self._sphere, distorted)
            return np.where((np.hypot(xy[..., 0], xy[..., 1]) < self.max_radius)[..., None], xy, np.nan)
        radius = np.hypot(distorted[..., 0], distorted[..., 1])
        unit = distorted / np.where(radius > 0.0, radius, 1.0)[..., None]
        if self.model == "fisheye":
            theta = lens.invert_odd(self.distortion, radius, math.atan(self.max_radius))
            return unit * np.tan(theta)[..., None]
        if self.model == "rational":
            reach = math.atan((1.0 - 1e-9) * self.max_radius)
            radii = np.tan(np.linspace(0.0, reach, _STARTS))
            start = np.interp(radius, radii * self._radial_scale(radii * radii)[0], radii)
            return self._newton(unit * start[..., None], distorted)
        k1, k2, p1, p2, k3 = self.brown
        without_tangential = lens.invert_odd((k1, k2, k3), radius, self.max_radius)
        if p1 == p2 == 0.0:
            return unit * without_tangential[..., None]
        start = np.where(np.isnan(without_tangential), 0.5 * min(self.max_radius, 1.0), without_tangential)
        return self._newton(unit * start[..., None], distorted)

    def _newton(self, xy: FloatArray, distorted: FloatArray) -> FloatArray:
        """Solve _distort(xy) = distorted, starting at xy; NaN where there is no solution in the domain."""
        limit = (1.0 - 1e-9) * self.max_radius
        scale = 1.0 + np.abs(distorted).max(axis=-1, keepdims=True)
        residual = self._distort(xy) - distorted
        share = np.ones(xy.shape[:-1])
        for _ in range(30):
            J = self._distort_jacobian(xy)
            a, b, c = J[..., 0, 0], J[..., 0, 1], J[..., 1, 1]
            # Positive on the whole domain, which the iterates are kept in.
            determinant = a * c - b * b
            rx, ry = share * residual[..., 0] / determinant, share * residual[..., 1] / determinant
            trial = xy - np.stack([c * rx - b * ry, a * ry - b * rx], axis=-1)
            radius = np.hypot(trial[..., 0], trial[..., 1])
            trial = trial * np.minimum(1.0, limit / np.maximum(radius, 1e-300))[..., None]
            error = self._distort(trial) - distorted
            # Whole steps may go round in circles; shorter ones cannot, since they point downhill.
            size = np.abs(error).max(axis=-1)
            good = ((error**2).sum(axis=-1) <= (residual**2).sum(axis=-1)) | (size <= 1e-12 * scale[..., 0])
            xy, residual = np.where(good[..., None], trial, xy), np.where(good[..., None], error, residual)
            share = np.where(good, np.minimum(1.0, 2.0 * share), 0.5 * share)
            if not (np.abs(residual) > 1e-15 * scale).any():
                break
        solved = (np.abs(residual) <= 1e-12 * scale).all(axis=-1)
        return np.where(solved[..., None], xy, np.nan)


def _symmetric(xx: FloatArray, xy: FloatArray, yy: FloatArray) -> FloatArray:
    return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
