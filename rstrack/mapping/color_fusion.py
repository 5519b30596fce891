"""Average colour in a rectified keyframe: rolling-shutter lookup, occlusion, weights that know about motion blur.

Every pixel of the keyframe with depth is a point; a frame shows it where equation (3) puts it, at the pose of its line
at mid-exposure. Frames count by equation (13) (Kerl, Stückler, Cremers, ICCV 2015): w = exp(−‖x_t − x_{t−t_e}‖ / σ²)
with the distance in px that the point moves in the image while its line is exposed.

fusion = ColorFusion(engine())
fused = fusion.start(keyframe)
fused = fusion.add(fused, keyframe, linear_image(e, exposure, rgb), depth, spline)
image, weight = fusion.image(fused)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import numpy as np
import numpy.typing as npt

from rsgen import srgb
from rsgen.device.arrays import Engine, Kernels, recorded_with
from rsgen.device.lens import Lens
from rsgen.device.projection import RollingProjection, cross, gather, move, project, project_rolling
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.images.line_poses import Exposure, from_base, line_twists, rows_of
from rstrack.images.pyramid import DepthImage
from rstrack.images.sampling import BEHIND, EDGE, Raster, bilinear, blur_weight, pinhole_points
from rstrack.keyframes.keyframe import Reference

SIGMA_PX = 1.0
# Weight of the most blurred view: better than a hole, and gone as soon as there is any other.
_LEAST = 1e-6
# Weight of a pixel at most, in sharp views; more would let a keyframe's first errors live for ever.
_MOST = 30.0


@dataclass(frozen=True)
class LinearImage:
    """A colour image as light: linear RGB in [0, 1], interleaved, on the device."""

    exposure: Exposure
    rgb: Any


@dataclass(frozen=True)
class FusedColor:
    """Linear RGB and sums of weights of a keyframe's pixels, flat, on the device; weight 0: nothing seen yet."""

    rgb: tuple[Any, Any, Any]
    weight: Any
    shape: tuple[int, int]


_LIGHT_OF_BYTE = srgb.decode(np.arange(256, dtype=np.float32) / np.float32(255))[:, None]


def linear_image(e: Engine, exposure: Exposure, color: npt.NDArray[np.uint8]) -> LinearImage:
    """sRGB (h, w, 3) uint8 to the device. An exposure sums light, not code values, so that is what is averaged."""
    return LinearImage(exposure, e.upload(cv2.LUT(color, _LIGHT_OF_BYTE)))


def sweep_table(spline: Spline, exposure: Exposure) -> npt.NDArray[np.float64]:
    """How each line's camera moves while the line is exposed (lines, 6): twist [m; rad] in the camera's frame."""
    twist = line_twists(spline, exposure)
    return np.asarray(exposure.lens.shutter.exposure_s * twist @ se3.adjoint(exposure.T_cam_body).T)


class ColorFusion:
    """Kernels for one blur σ in px; None: constant weights."""

    def __init__(self, e: Engine, sigma_px: float | None = SIGMA_PX) -> None:
        self.e, self.sigma_px, self._kernel = e, sigma_px, Kernels(e)

    def start(self, ref: Reference) -> FusedColor:
        """Nothing but holes. `ref` is rectified."""
        assert ref.rolling is None, "colour is fused into rectified keyframes"
        camera = ref.lens.camera
        zero = self.e.upload(np.zeros(camera.height * camera.width))
        return FusedColor((zero, zero, zero), zero, (camera.height, camera.width))

    def add(
        self, fused: FusedColor, ref: Reference, image: LinearImage, depth: DepthImage, spline: Spline
    ) -> FusedColor:
        """With one more colour image averaged in where it shows the keyframe's points.

        depth: the depth image nearest in time, which shows what hides them; unknown depth hides nothing.
        spline: T_world_depth(t) in the world of `ref`, known over the lines of both images.
        """
        e = self.e
        kernel = self._kernel(_add_kernel, image.exposure.lens, depth.exposure.lens, ref.lens)
        tables = (
            from_base(e, spline, ref.T_world_base, image.exposure),
            e.upload(sweep_table(spline, image.exposure)),
            from_base(e, spline, ref.T_world_base, depth.exposure),
        )
        inv_sigma2 = 0.0 if self.sigma_px is None else self.sigma_px**-2
        constants = e.upload(np.array([inv_sigma2, _LEAST, _MOST]))
        r, g, b, weight = kernel(
            _AddInput(ref.inverse_depth, *fused.rgb, fused.weight, image.rgb, depth.z, *tables, constants)
        )
        return FusedColor((r, g, b), weight, fused.shape)

    def inherit(self, ref: Reference, older: FusedColor, older_ref: Reference) -> FusedColor:
        """What an older keyframe knows of the colours of a new one, with its weights."""
        pose = self.e.upload(rows_of(se3.inverse(older_ref.T_world_base) @ ref.T_world_base))
        kernel = self._kernel(_inherit_kernel, older_ref.lens, ref.lens)
        given = _InheritInput(ref.inverse_depth, *older.rgb, older.weight, older_ref.inverse_depth, pose)
        r, g, b, weight = kernel(given)
        return FusedColor((r, g, b), weight, (ref.lens.camera.height, ref.lens.camera.width))

    def image(self, fused: FusedColor) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
        """sRGB (h, w, 3), 0 in holes, and the sums of weights (h, w)."""
        light = np.stack([self.e.download(plane, fused.shape) for plane in fused.rgb], axis=-1)
        weight: npt.NDArray[np.float32] = self.e.download(fused.weight, fused.shape)
        return np.rint(255.0 * srgb.encode(np.clip(light, 0.0, 1.0))).astype(np.uint8), weight


def _hidden(e: Engine, lens: Lens, depth: Any, seen: RollingProjection, active: Any) -> Any:
    """Points behind the nearest of the four depths around them: a pixel next to an edge shows both sides."""
    *around, _, _, inside = bilinear(
        e, depth, lens.camera.width, lens.camera.height, seen.x, seen.y, active & seen.valid
    )
    hidden = e.Bool(False)
    for z in around:
        hidden |= inside & (z > 0.0) & (seen.z > z * (1.0 + EDGE) + BEHIND)
    return hidden


def _cubic(
    e: Engine, planes: Sequence[Any], stride: int, width: Any, height: Any, x: Any, y: Any, active: Any
) -> list[Any]:
    """Light of three planes at positions inside the image, never below zero (Keys, IEEE TASSP 29(6), 1981, a = −1/2).

    stride 3: pixel i of plane c is entry 3 i + c. Bilinear interpolation would take a third of the gradient energy of
    sharp pictures, as some milliseconds of blur do.
    """
    x0, y0 = dr.floor(x), dr.floor(y)
    taps_x, taps_y = _taps(x - x0), _taps(y - y0)
    columns, rows = (
        [e.UInt(e.Int(dr.clip(dr.select(active, first, 0.0) + k, 0.0, size - 1.0))) for k in (-1.0, 0.0, 1.0, 2.0)]
        for first, size in ((x0, width), (y0, height))
    )
    sums = [e.Float(0.0) for _ in planes]
    for row, tap_y in zip(rows, taps_y, strict=True):
        for column, tap_x in zip(columns, taps_x, strict=True):
            index, tap = (row * width + column) * stride, tap_x * tap_y
            for c, plane in enumerate(planes):
                at = index + c if stride > 1 else index
                sums[c] = dr.fma(tap, dr.gather(e.Float, plane, at, active), sums[c])
    return [dr.maximum(total, 0.0) for total in sums]


def _taps(f: Any) -> tuple[Any, ...]:
    """Weights of the four neighbours at a fraction f past the second."""
    return (
        ((1.0 - 0.5 * f) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1.0,
        ((2.0 - 1.5 * f) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    )


@dataclass(frozen=True)
class _AddInput:
    """Device arrays: the keyframe's inverse depth, fused colour and weight; the image (interleaved linear RGB).

    depth: the image that shows what is hidden. *from_base: poses of both images' lines. sweep: see `sweep_table`.
    constants: 1/σ² (0: constant weights), least weight, largest sum of weights.
    """

    inverse_depth: Any
    r: Any
    g: Any
    b: Any
    weight: Any
    image: Any
    depth: Any
    from_base: Any
    sweep: Any
    depth_from_base: Any
    constants: Any


def _add_kernel(e: Engine, lens: Lens, depth_lens: Lens, base: Lens) -> Callable[[_AddInput], Any]:
    """Kernel → (r, g, b, weight): the keyframe's colour with one more image in it, weighted by equation (13)."""

    @recorded_with(e, _AddInput, lens, depth_lens, base, Raster.of(base.camera))
    def kernel(given: _AddInput, lens: Lens, depth_lens: Lens, base: Lens, raster: Raster) -> Any:
        inv_sigma2, least, most = (dr.gather(e.Float, given.constants, e.UInt(i)) for i in range(3))
        p, active = pinhole_points(e, base.camera, raster, given.inverse_depth)
        seen = project_rolling(lens, given.from_base, p, e.UInt, e.Int)
        active &= seen.valid & ~_hidden(
            e, depth_lens, given.depth, project_rolling(depth_lens, given.depth_from_base, p, e.UInt, e.Int), active
        )
        turn = gather(given.sweep, seen.row, 6, stride=6)
        q = seen.at.q
        omega_q = cross((turn[3], turn[4], turn[5]), q)
        dx, dy = seen.at.jvp((-(turn[0] + omega_q[0]), -(turn[1] + omega_q[1]), -(turn[2] + omega_q[2])))
        w = dr.maximum(blur_weight(dr.sqrt(dx * dx + dy * dy), inv_sigma2), least)

        width, height = lens.camera.width, lens.camera.height
        active &= (seen.x >= 0.0) & (seen.y >= 0.0) & (seen.x < width - 1.0) & (seen.y < height - 1.0)
        share = dr.select(active, w / (given.weight + w), 0.0)
        values = _cubic(e, (given.image,) * 3, 3, width, height, seen.x, seen.y, active)
        fused_before = given.r, given.g, given.b
        fused = [dr.fma(share, value - before, before) for value, before in zip(values, fused_before, strict=True)]
        return *fused, dr.minimum(given.weight + dr.select(active, w, 0.0), most)

    return kernel


@dataclass(frozen=True)
class _InheritInput:
    """Device arrays: the keyframe's inverse depth; the older one's colour, weight and inverse depth; T_old_new."""

    inverse_depth: Any
    r: Any
    g: Any
    b: Any
    weight: Any
    older_inverse_depth: Any
    T_old_new: Any


def _inherit_kernel(e: Engine, older: Lens, base: Lens) -> Callable[[_InheritInput], Any]:
    """Kernel → (r, g, b, weight) in the new image.

    Both images are global-shutter pinholes. Nothing is inherited across holes, or where depths disagree.
    """

    @recorded_with(e, _InheritInput, older, base, Raster.of(base.camera))
    def kernel(given: _InheritInput, older: Lens, base: Lens, raster: Raster) -> Any:
        width, height, weight = older.camera.width, older.camera.height, given.weight
        p, active = pinhole_points(e, base.camera, raster, given.inverse_depth)
        at = project(older.camera, move(gather(given.T_old_new, e.UInt(0), 12, stride=12), p))
        *near, _, _, active = bilinear(e, given.older_inverse_depth, width, height, at.x, at.y, active & at.valid)
        for value in near:
            active &= (value > 0.0) & (dr.abs(at.q[2] * value - 1.0) < EDGE)
        *near, _, _, active = bilinear(e, weight, width, height, at.x, at.y, active)
        least = dr.minimum(dr.minimum(near[0], near[1]), dr.minimum(near[2], near[3]))
        active &= least > 0.0
        planes = given.r, given.g, given.b
        out = [dr.select(active, value, 0.0) for value in _cubic(e, planes, 1, width, height, at.x, at.y, active)]
        return *out, dr.select(active, least, 0.0)

    return kernel
