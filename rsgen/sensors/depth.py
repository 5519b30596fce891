"""Models of depth cameras: exact planar depth to what a structured-light, time-of-flight or stereo camera reports.

Depth images are (h, w) float32, planar z in metres, 0 where nothing is measured. Disparity is that of a camera and a
projector (or second camera) at a baseline b: d = b f / z with f = fx, in px. On a plane it is affine in the pixel, so
it is what is interpolated and searched for edges. What an exposure, or a faulty device, does to depth comes before the
noise. A stereo camera's depth is computed from its images, as it does itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from rsgen.config.cameras import DepthNoiseConfig
from rsgen.config.rig import StereoConfig
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.sensors.seed import device_generator

# px. A jump of the disparity by this much within three pixels is an edge, e.g. from 2.0 to 2.05 m for a Kinect.
_EDGE_PX = 0.5
# Beyond, Nguyen's angular term grows without bound; no camera returns anything there.
_STEEPEST_RAD = np.deg2rad(89.0)


def apply_depth_noise(
    z: Float32Array, camera: Camera, config: DepthNoiseConfig, rng: np.random.Generator, shadow: BoolArray | None = None
) -> Float32Array:
    """What the depth camera reports (h, w) for exact planar depth `z` (h, w): metres, 0 = no return.

    `shadow` (h, w): where the projector's light does not reach (see `Projector`), used by the model 'kinect'.
    `rng` decides every random number of the frame.
    """
    if config.model == "none":
        return z
    if config.model == "kinect":
        noisy = _kinect(z, camera, config, rng)
        if shadow is not None:
            noisy = np.where(shadow, np.float32(0), noisy)
    elif config.model == "tof":
        noisy = _time_of_flight(z, camera, config, rng)
    else:
        noisy = z + np.float32(config.gaussian_per_m) * z * z * rng.standard_normal(z.shape, np.float32)
    reported = (z > 0) & (noisy >= np.float32(config.min_range_m)) & (noisy <= np.float32(config.max_range_m))
    return np.where(reported, noisy, np.float32(0))


def _kinect(z: Float32Array, camera: Camera, config: DepthNoiseConfig, rng: np.random.Generator) -> Float32Array:
    """Structured light: lateral shift, disparity noise and quantisation, then dropouts at edges and grazing angles."""
    focal_baseline = config.projector_baseline_m * camera.fx
    d = disparity(z, focal_baseline)
    edge = disparity_edges(d)
    noisy = shift_laterally(d, edge, config.lateral_sigma_px, rng)
    if config.region_sigma_px > 0:
        common = smooth_field(z.shape, config.region_px, rng)
        noisy = np.where(noisy > 0, np.maximum(noisy + np.float32(config.region_sigma_px) * common, 0), noisy)
    noisy = quantise_disparity(noisy, config.disparity_sigma_px, config.disparity_step_px, rng)
    lost = grazing_probability(incidence(d, camera), *config.grazing_deg)
    lost = np.where(edge, 1 - (1 - lost) * np.float32(1 - config.edge_dropout), lost)
    kept = (noisy > 0) & (rng.random(z.shape, np.float32) >= lost)
    return disparity(np.where(kept, noisy, np.float32(0)), focal_baseline)


def _time_of_flight(
    z: Float32Array, camera: Camera, config: DepthNoiseConfig, rng: np.random.Generator
) -> Float32Array:
    """Axial noise, pixels at edges that mix both sides, and dropouts at grazing angles."""
    d = disparity(z, config.projector_baseline_m * camera.fx)
    angle = incidence(d, camera)
    sigma = axial_sigma(z, angle, config.axial_base_m, config.axial_growth_per_m, config.axial_nearest_m)
    mixed = mix_edges(z, disparity_edges(d), config.flying_pixels, rng)
    kept = rng.random(z.shape, np.float32) >= grazing_probability(angle, *config.grazing_deg)
    return np.where(kept, mixed + sigma * rng.standard_normal(z.shape, np.float32), np.float32(0))


def smooth_field(shape: tuple[int, ...], length_px: float, rng: np.random.Generator) -> Float32Array:
    """Normal values (h, w) of unit variance, whose correlation falls as exp(-(distance / length_px)^2).

    White noise through a Gaussian of sigma s has that correlation for a length of 2 s, and the variance 1 / 4 pi s^2.
    """
    sigma = length_px / 2
    margin = int(np.ceil(4 * sigma))  # what the Gaussian reaches: at the border nothing is counted twice
    white = rng.standard_normal([size + 2 * margin for size in shape], np.float32)
    smooth = np.asarray(cv2.GaussianBlur(white, (2 * margin + 1, 2 * margin + 1), sigma))
    return smooth[margin:-margin, margin:-margin] * np.float32(2 * np.sqrt(np.pi) * sigma)


def disparity(z: Float32Array, focal_baseline: float | np.float32) -> Float32Array:
    """Disparity (h, w) in px of planar depth z (h, w) in m, `focal_baseline` in m·px (a Kinect's: 43); 0 of 0.

    Depth of disparity likewise.
    """
    return np.where(z > 0, np.float32(focal_baseline) / np.where(z > 0, z, 1), np.float32(0))


def shift_laterally(d: Float32Array, edge: BoolArray, sigma_px: float, rng: np.random.Generator) -> Float32Array:
    """Disparities (h, w) looked up at (u, v) + N(0, sigma_px² I): bilinear, beside an edge the nearest pixel's.

    The lateral noise of Barron, Malik (CVPR 2013) and Handa et al. (ICRA 2014), sec. IV, sigma 1/2 px. Theirs is
    bilinear everywhere, which leaves points afloat between near and far that structured light does not make.
    """
    if sigma_px == 0:
        return d
    height, width = d.shape
    shift = rng.standard_normal((2, height, width), np.float32) * np.float32(sigma_px)
    u, v = shift[0] + np.arange(width, dtype=np.float32), shift[1] + np.arange(height, dtype=np.float32)[:, None]
    wide = cv2.dilate(edge.astype(np.uint8), np.ones((3, 3), np.uint8))
    beside = cv2.remap(wide, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE).astype(bool)
    smooth, nearest = (
        cv2.remap(d, u, v, how, borderMode=cv2.BORDER_REPLICATE) for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST)
    )
    return np.where(beside, nearest, smooth)


def quantise_disparity(d: Float32Array, sigma_px: float, step_px: float, rng: np.random.Generator) -> Float32Array:
    """round((d + N(0, sigma_px²)) / step_px) · step_px of disparities (h, w) in px; 0 stays 0.

    z = b f / d then has steps of z² step_px / (b f) and sigma_z = z² / (b f) · sqrt(sigma_px² + step_px² / 12), the
    latter averaged over a step. Barron, Malik (CVPR 2013) and Handa et al. (ICRA 2014), sec. IV, write
    z = 35130 / ⌊35130 / z + N(0, σ_d²) + ½⌋ with z in cm and σ_d = 1/6: their unit of disparity is the Kinect's step of
    1/8 px, so b f = 35130 cm / 8 = 43.9 m·px and sigma_px = 1/48.
    """
    noisy = d + np.float32(sigma_px) * rng.standard_normal(d.shape, np.float32)
    if step_px > 0:
        noisy = np.rint(noisy * np.float32(1 / step_px)) * np.float32(step_px)
    return np.where(d > 0, noisy, np.float32(0))


def disparity_edges(d: Float32Array) -> BoolArray:
    """Pixels (h, w) where the second difference of the disparity, along rows or columns, is half a pixel or more.

    It is 0 on planes however steep and marks both sides of a jump. Where nothing is (0) counts as infinitely far. The
    image's outermost pixels have no second difference across its border.
    """
    edge = np.zeros(d.shape, bool)
    edge[:, 1:-1] = np.abs(d[:, :-2] - 2 * d[:, 1:-1] + d[:, 2:]) >= _EDGE_PX
    edge[1:-1] |= np.abs(d[:-2] - 2 * d[1:-1] + d[2:]) >= _EDGE_PX
    return edge


def incidence(d: Float32Array, camera: Camera) -> Float32Array:
    """Angle (h, w) in [0, π/2] rad between each pixel's ray and the surface's normal; π/2 where nothing is.

    On a plane 1/z, so d, is A x + B y + C in normalised coordinates, and (A, B, C) is along its normal; with
    C = d − A x − B y, cos θ = d / (|(A, B, C)| |(x, y, 1)|). Slopes are one-sided differences, of two the
    smaller, which keeps to one side of an edge. Rows are treated as if all had one pose.
    """
    x, y, length, u_x, u_y, v_x, v_y = _rays(camera)
    slope_u, slope_v = _slope(d, 1), _slope(d, 0)
    A = u_x * slope_u + v_x * slope_v
    B = u_y * slope_u + v_y * slope_v
    C = d - A * x - B * y
    normal = np.sqrt(A * A + B * B + C * C)
    cosine = np.where(d > 0, d / (np.where(d > 0, normal, 1) * length), 0)
    return np.arccos(np.minimum(cosine, 1, dtype=np.float32))


def grazing_probability(angle: Float32Array, start_deg: float, end_deg: float) -> Float32Array:
    """Probability (h, w) of no return at incidence angles (h, w) in rad: 0 up to start, 1 from end on, linear between.

    A ramp where Nguyen, Izadi, Lovell (3DIMPVT 2012) found a Kinect's data to fail: noise soars above 60°, and there is
    hardly a return beyond 80°.
    """
    start, end = np.deg2rad(start_deg), np.deg2rad(end_deg)
    return np.clip((angle - np.float32(start)) * np.float32(1 / max(end - start, 1e-6)), 0, 1)


def axial_sigma(
    z: Float32Array, angle: Float32Array, base_m: float, growth_per_m: float, nearest_m: float
) -> Float32Array:
    """Sigma (h, w) in m of depth along the optical axis at depths z (m) and incidence angles θ (rad); 0 of z = 0.

    base + growth (z − nearest)² + 10⁻⁴ θ² / (√z (π/2 − θ)²), the last term beyond 60° only: Nguyen, Izadi, Lovell
    (3DIMPVT 2012), with 0.0012 m, 0.0019 /m and 0.4 m for a Kinect.
    """
    theta = np.minimum(angle, np.float32(_STEEPEST_RAD))
    steep = np.float32(1e-4) * (theta / (np.float32(np.pi / 2) - theta)) ** 2 / np.sqrt(np.where(z > 0, z, 1))
    sigma = np.float32(base_m) + np.float32(growth_per_m) * (z - np.float32(nearest_m)) ** 2
    return np.where(z > 0, sigma + np.where(angle > np.float32(np.pi / 3), steep, 0), 0)


def mix_edges(z: Float32Array, edge: BoolArray, probability: float, rng: np.random.Generator) -> Float32Array:
    """z (h, w) in which pixels beside an edge fly, with `probability`: a mean, weighted at random, of both its sides.

    The other side is the depth in the 3×3 neighbourhood that is farthest from the pixel's own. A light pulse that
    returns from two surfaces at once gives time-of-flight cameras a depth in between.
    """
    where = np.flatnonzero(edge & (z > 0) & (rng.random(z.shape, np.float32) < probability))
    own, far = z.ravel()[where], np.float32(np.inf)
    highest = cv2.dilate(z, np.ones((3, 3), np.uint8)).ravel()[where]
    lowest = cv2.erode(np.where(z > 0, z, far), np.ones((3, 3), np.uint8)).ravel()[where]
    other = np.where(highest - own > own - lowest, highest, lowest)
    mixed = z.copy()
    mixed.ravel()[where] = own + rng.random(len(where), np.float32) * (other - own)
    return mixed


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> list[Float32Array]:
    """Per pixel (h, w): x, y of the ray (x, y, 1), its length, and the pixel's derivatives u_x, u_y, v_x, v_y, px."""
    rays = camera.unproject(camera.pixel_grid())
    J = camera.project_jacobian(rays)[..., :2].reshape(*rays.shape[:2], 4)
    parts = (*np.moveaxis(rays[..., :2], -1, 0), np.linalg.norm(rays, axis=-1), *np.moveaxis(J, -1, 0))
    return [np.ascontiguousarray(part, np.float32) for part in parts]


def _slope(d: Float32Array, axis: int) -> Float32Array:
    """Forward or backward difference (h, w) along `axis`, whichever is smaller in size."""
    step = np.diff(d, axis=axis)
    first, last = np.take(step, [0], axis), np.take(step, [-1], axis)
    forward, backward = np.concatenate([step, last], axis), np.concatenate([first, step], axis)
    return np.where(np.abs(forward) < np.abs(backward), forward, backward)


# Relative change of 1/z within an exposure beyond which a pixel has seen two surfaces, not one that moves.
_ONE_SURFACE = 0.03


def with_fixed_errors(z: Float32Array, camera: Camera, config: DepthNoiseConfig, seed: int) -> Float32Array:
    """Depth (h, w) in m of the faulty camera that the sequence's `seed` makes, before any noise; 0 stays 0.

    z' = (1 + scale_error) b f / (b f / z + δ), δ the fixed error of each pixel's disparity in px. What would lie
    beyond infinity is 0.
    """
    if config.scale_error == 0 and config.distortion_px == 0 and config.pattern_px == 0:
        return z
    focal_baseline = np.float32(config.projector_baseline_m * camera.fx)
    delta = disparity_error(
        camera.width, camera.height, config.distortion_px, config.distortion_period_px, config.pattern_px, seed
    )
    d = np.where(z > 0, focal_baseline / np.where(z > 0, z, 1) + delta, np.float32(0))
    return disparity(d, np.float32(1 + config.scale_error) * focal_baseline)


@lru_cache(maxsize=2)
def disparity_error(
    width: int, height: int, distortion_px: float, period_px: float, pattern_px: float, seed: int
) -> Float32Array:
    """Fixed error (h, w) of the disparity in px: smooth bends and a pattern, each of zero mean and the given RMS.

    Bends are bicubic between normal values on a grid of half a period; the pattern is white.
    """
    rng = device_generator(seed)
    shape = [max(2, int(np.ceil(2 * n / period_px)) + 1) for n in (height, width)]
    knots, white = rng.standard_normal(shape, np.float32), rng.standard_normal((height, width), np.float32)
    bends = cv2.resize(knots, (width, height), interpolation=cv2.INTER_CUBIC)
    error = np.float32(distortion_px) * _unit(np.asarray(bends)) + np.float32(pattern_px) * _unit(white)
    error.flags.writeable = False
    return error


def _unit(field: Float32Array) -> Float32Array:
    centred = field - field.mean()
    return centred / np.sqrt(np.mean(centred**2))


def mixed_depth(samples: Sequence[Float32Array], flying: bool) -> Float32Array:
    """Depth (h, w) in m that an exposure gives of the depths (h, w) at n instants of it; 0 = nothing.

    Time of flight (`flying`) mixes what returns from all of them. Structured light matches one pattern: where a pixel
    sees one surface, moving, its mean disparity; where surfaces change, that of the longer time (the median).
    """
    z = np.stack(samples)
    seen = z > 0
    if flying:
        return np.where(seen.any(0), z.sum(0) / np.maximum(seen.sum(0), 1), np.float32(0)).astype(np.float32)
    inverse = disparity(z, 1)
    middle = np.sort(inverse, axis=0)[len(samples) // 2]
    one_surface = (inverse.max(0) - inverse.min(0)) < np.float32(_ONE_SURFACE) * middle
    return disparity(np.where(one_surface, inverse.mean(0), middle), 1).astype(np.float32)


def register_depth(
    rays_depth: FloatArray, z: Float32Array, color: Camera, T_color_depth: npt.ArrayLike
) -> Float32Array:
    """Depth as the colour camera sees it: planar z (H, W) in metres of its pixels, 0 where no point falls.

    Each depth pixel's point goes to the nearest colour pixel; of several the nearest point stays (z-buffer). Depth
    coarser than colour leaves holes, as it does in drivers that do not fill.

    rays_depth (h, w, 3): rays with z = 1 of the depth camera's pixels. z (h, w): m, 0 where nothing was measured.
    """
    seen = z > 0
    p_color = se3.transform(T_color_depth, rays_depth[seen] * z[seen].astype(np.float64)[:, None])
    uv, _ = color.project(p_color)
    inside = color.contains(uv)
    u, v = np.rint(uv[inside]).astype(np.int64).T
    # A half rounds to the even number, which at the image's edge can be one too far.
    place = np.clip(v, 0, color.height - 1) * color.width + np.clip(u, 0, color.width - 1)
    buffer = np.full(color.height * color.width, np.inf, np.float32)
    np.minimum.at(buffer, place, p_color[inside, 2].astype(np.float32))
    return np.where(np.isfinite(buffer), buffer, np.float32(0)).reshape(color.height, color.width)


# OpenCV reports disparities in these parts of a pixel, and the penalties that its documentation recommends.
_PARTS, _P1, _P2 = 16, 8, 32
# Its matching cost draws disparities towards whole pixels: depth in steps. In images of twice the width these are half
# as wide, and so is the error of the disparity (docs/notebook/rigs.md).
_WIDER = 2


def stereo_depth(left: ByteArray, right: ByteArray, focal_baseline: float, config: StereoConfig) -> Float32Array:
    """Planar z (h, w) in m of the left image's pixels, 0 where no match is sure; images (h, w), rows alike.

    focal_baseline: focal length in px times the distance of the cameras in m. Left and right are checked against each
    other, so that what only one of them sees has no depth. Semi-global matching: Hirschmüller, "Stereo Processing by
    Semiglobal Matching and Mutual Information", PAMI 2008, in OpenCV's variant.
    """
    area, largest = config.block_px**2, _WIDER * config.disparities
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=largest, blockSize=config.block_px, P1=_P1 * area, P2=_P2 * area,
        disp12MaxDiff=1, uniquenessRatio=config.uniqueness_pct, speckleWindowSize=_WIDER * config.speckle_px,
        speckleRange=1 if config.speckle_px else 0, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    wide = [cv2.resize(image, None, fx=_WIDER, fy=1, interpolation=cv2.INTER_CUBIC) for image in (left, right)]
    # The leftmost pixels would have no disparity otherwise: a margin as wide as disparities are large.
    padded = [cv2.copyMakeBorder(image, 0, 0, largest, 0, cv2.BORDER_CONSTANT) for image in wide]
    d = matcher.compute(*padded)[:, largest::_WIDER].astype(np.float32) / (_PARTS * _WIDER)
    # What is matched to the margin has been matched to nothing.
    return disparity(np.where(np.arange(left.shape[1]) - d >= 0, d, np.float32(0)), focal_baseline)
