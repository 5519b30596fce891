"""Make keyframes: from one frame, rolling or rectified; pass on what an older keyframe knows; fuse later frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import drjit as dr
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine, Kernels
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.images.device_frame import MARGIN, DeviceRig, Timer, thumbnail_without, untimed
from rstrack.images.line_poses import from_base, rows_of, to_base
from rstrack.images.pyramid import ColorImage, DepthImage, thumbnail_of_known
from rstrack.keyframes.keyframe import (
    FloatImage,
    Mask,
    Points,
    Reference,
    depth_scaling,
    level_points,
    rectified_lens,
    strides,
)
from rstrack.keyframes.rectification import (
    ColorInput,
    FusionInput,
    HiddenInput,
    InheritedInput,
    color_kernel,
    fuse_kernel,
    inherit_kernel,
    rectify_kernel,
    resting_kernel,
)
from rstrack.keyframes.surface import surface_roughness, surface_slopes

# Metres at one metre: depths that differ by more show different surfaces.
_AGREE = 0.03
# Weight of a fused pixel in measurements; more would let a keyframe's first errors live for ever.
_MOST = 30.0


@dataclass(frozen=True)
class _Depth:
    """Of a keyframe on the device: inverse depth, and its weight, 1 where it is known if that is None. On the host:
    before which pixels (h, w) something moves (`KeyframeMaker._hidden`), and intensities of what rests there, NaN where
    they are not known."""

    inverse_depth: Any
    weight: Any = None
    hidden: Mask | None = None
    inherited: FloatImage | None = None

    def weights(self, e: Engine) -> Any:
        """Its weight, or that of one measurement."""
        return dr.select(self.inverse_depth > 0.0, e.Float(1.0), 0.0) if self.weight is None else self.weight


@dataclass
class KeyframeMaker:
    """Kernels of one rig. rays: of the depth camera (h, w, 2)."""

    e: Engine
    rays: FloatArray
    device_rays: tuple[Any, Any]
    timer: Timer = untimed
    _kernel: Kernels = field(init=False)
    _one: Any = None
    _rays: tuple[FloatArray, tuple[Any, Any]] | None = None

    def __post_init__(self) -> None:
        self._kernel = Kernels(self.e)

    @classmethod
    def of(cls, device: DeviceRig) -> KeyframeMaker:
        """The maker for a rig."""
        return cls(device.e, device.rays, device.device_rays, device.timer)

    def rolling(self, index: int, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline) -> Reference:
        """A reference that keeps its rolling shutter, for the time until it can be rectified."""
        with self.timer("keyframes: make"):
            lens, t = depth.exposure.lens, depth.exposure.mid_time
            hidden = None if depth.whole is None else self._hidden(lens, depth.inverse_z, depth.whole.inverse_z)
            placed = t, spline.pose(t), lens
            return self._finish(index, depth, colors, spline, placed, _Depth(depth.inverse_z, None, hidden))

    def rectified(
        self, index: int, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline, older: Reference | None,
        as_now: tuple[float, float] = (1.0, 0.0),
    ) -> Reference:  # fmt: skip
        """A keyframe at mid readout, in which depth that the older one has is averaged in and fills holes.

        Where something moves before it, it has the older one's intensities, times the first of as_now plus the second.
        """
        with self.timer("keyframes: make"):
            T_world_base, base, rho, whole = self._rectified(depth, spline)
            found = _Depth(rho, None, None if whole is None else self._hidden(base, rho, whole))
            if older is not None and older.rolling is None:
                found = self._joined(found, T_world_base, base, older, as_now)
            return self._finish(index, depth, colors, spline, (depth.exposure.mid_time, T_world_base, base), found)

    def rectify(self, depth: DepthImage, spline: Spline) -> tuple[FloatArray, Lens, Any]:
        """T_world_base (4, 4) at mid readout, the lens, and inverse depth as seen from there at once, on the device."""
        T_world_base, base, rho, _ = self._rectified(depth, spline)
        return T_world_base, base, rho

    def _rectified(self, depth: DepthImage, spline: Spline) -> tuple[FloatArray, Lens, Any, Any]:
        """What `rectify` returns, and the same with what moves, None where nothing does."""
        lens = depth.exposure.lens
        base = rectified_lens(lens.camera)
        T_world_base: FloatArray = spline.pose(depth.exposure.mid_time)
        seen_at = to_base(self.e, spline, T_world_base, depth.exposure)
        rectify = self._kernel(rectify_kernel, lens, base)
        rho, x, y = rectify(depth.occluder.inverse_z, *self.device_rays, seen_at)
        if depth.whole is None:
            return T_world_base, base, rho, None
        return T_world_base, base, self._kernel(resting_kernel, lens)(rho, x, y, depth.inverse_z), rho

    def _hidden(self, lens: Lens, rest: Any, whole: Any) -> Mask:
        """Pixels (h, w) before which something moves, and those about them.

        rest, whole: inverse depth without what moves, and with it. Colours are taken a little later and from beside:
        there they are no older depth's.
        """
        shape = lens.camera.height, lens.camera.width
        moving = self.e.download(whole, shape) > self.e.download(rest, shape)
        margin = 2 * round(MARGIN * lens.camera.width) + 1
        return np.asarray(cv2.dilate(moving.astype(np.uint8), np.ones((margin, margin), np.uint8)) > 0)

    def _joined(
        self, own: _Depth, T_world_base: FloatArray, base: Lens, older: Reference, as_now: tuple[float, float]
    ) -> _Depth:  # fmt: skip
        """A keyframe's depth averaged with an older one's, and its holes filled; see `rectified`."""
        e, camera = self.e, base.camera
        T = se3.inverse(older.T_world_base) @ T_world_base
        seen_from = e.upload(np.concatenate([rows_of(T), np.zeros(6)]))
        host = e.download(own.inverse_depth, (camera.height, camera.width))
        slope_x, slope_y = surface_slopes(host, camera.fx, camera.fy)
        surface = own.inverse_depth, own.weights(e), e.upload(slope_x), e.upload(slope_y)
        rho, weight = self._fuse(surface, base, older.lens, older.inverse_depth, older.weight, seen_from)
        given = InheritedInput(rho, weight, older.inverse_depth, e.upload(rows_of(se3.inverse(T))))
        moves = own.hidden is not None and older.intensity is not None
        inherit = self._kernel(inherit_kernel, older.lens, base, moves)
        if own.hidden is None or older.intensity is None:
            rho, weight = inherit(given)
            return _Depth(rho, weight, own.hidden)
        hidden, intensity = e.upload(own.hidden), e.upload(older.intensity)
        joined = HiddenInput(**vars(given), hidden=hidden, intensity=intensity, as_now=e.upload(as_now))
        rho, weight, inherited = inherit(joined)
        return _Depth(rho, weight, own.hidden, e.download(inherited, own.hidden.shape))

    def with_depth(
        self, made: Reference, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline, rho: Any, weight: Any
    ) -> Reference:  # fmt: skip
        """A keyframe that `rectified` made of these images, with other inverse depth and weights, on the device."""
        _, base, rest, whole = self._rectified(depth, spline) if depth.whole else (None, made.lens, None, None)
        found = _Depth(rho, weight, None if whole is None else self._hidden(base, rest, whole))
        return self._finish(made.index, depth, colors, spline, (made.t, made.T_world_base, base), found)

    def fused(self, ref: Reference, depth: DepthImage, spline: Spline, most: float = _MOST) -> Reference:
        """The keyframe with the depth of one more frame, whose poses are known, averaged in.

        most: weight of a pixel in measurements beyond which the oldest count ever less.
        """
        with self.timer("keyframes: fuse"):
            seen_from = from_base(self.e, spline, ref.T_world_base, depth.exposure)
            surface = ref.inverse_depth, ref.weight, ref.slope_x, ref.slope_y
            source = depth.exposure.lens, depth.inverse_z, self._ones(depth)
            rho, weight = self._fuse(surface, ref.lens, *source, seen_from, most)
        return replace(ref, inverse_depth=rho, weight=weight)

    def _fuse(
        self, surface: tuple[Any, Any, Any, Any], base: Lens, lens: Lens, source: Any, source_weight: Any,
        seen_from: Any, most: float = _MOST,
    ) -> tuple[Any, Any]:  # fmt: skip
        """surface: inverse depth, weight and slopes of a keyframe."""
        constants = self.e.upload(np.array([_AGREE, most]))
        given = FusionInput(*surface, source, source_weight, seen_from, constants)
        fused: tuple[Any, Any] = self._kernel(fuse_kernel, lens, base)(given)
        return fused

    def _ones(self, depth: DepthImage) -> Any:
        if self._one is None:
            camera = depth.exposure.lens.camera
            self._one = self.e.upload(np.ones(camera.height * camera.width))
        return self._one

    def _pinhole_rays(self, base: Lens) -> tuple[FloatArray, tuple[Any, Any]]:
        """Normalised coordinates (h, w, 2) of a rectified image, and the same on the device."""
        if self._rays is None:
            rays = base.camera.unproject(base.camera.pixel_grid())[..., :2]
            self._rays = rays, (self.e.upload(rays[..., 0]), self.e.upload(rays[..., 1]))
        return self._rays

    def revived(self, small: Reference, rho: FloatImage, weight: npt.NDArray[Any]) -> Reference:
        """A rectified keyframe from what `Reference.emptied` left of it, its inverse depth and its weight (h, w)."""
        return self._with_surface(small, self.e.upload(rho), self.e.upload(weight))

    def _finish(
        self, index: int, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline,
        placed: tuple[float, FloatArray, Lens], found: _Depth,
    ) -> Reference:  # fmt: skip
        """placed: its time, T_world_base (4, 4), and the lens that it is seen by."""
        e, (t, T_world_base, lens) = self.e, placed
        rolling = depth.exposure if lens is depth.exposure.lens and lens.lines > 1 else None
        intensity, coarse, color_thumbnail, moments = None, None, None, np.zeros(2)
        if colors:
            color = min(colors, key=lambda c: abs(c.exposure.mid_time - t))
            moments, color_thumbnail = color.moments, thumbnail_without(color, depth)
            rays = self.device_rays if rolling else self._pinhole_rays(lens)[1]
            seen_at = to_base(e, spline, T_world_base, rolling)
            seen_from = from_base(e, spline, T_world_base, color.exposure)

            levels = (0, color.finer) if color.finer > 0 else (0,)
            images = []
            for level in levels:
                look_up = self._kernel(color_kernel, color.exposure.lens, lens, level)
                images.append(look_up(ColorInput(found.inverse_depth, *rays, seen_at, color.levels[level], seen_from)))
            intensity, *others = (e.download(image, (lens.camera.height, lens.camera.width)) for image in images)
            if found.hidden is not None:
                nothing = np.float32(np.nan)
                np.copyto(intensity, nothing if found.inherited is None else found.inherited, where=found.hidden)
                for other in others:
                    np.copyto(other, nothing, where=found.hidden)
            coarse = others[0] if others else None
        small = Reference(
            index, depth.exposure.stamp, t, T_world_base, lens, rolling, None, None, None, None, None, (), 1.0, 1.0, 0,
            moments, intensity, np.zeros((0, 0), np.float32), color_thumbnail, coarse_intensity=coarse,
        )  # fmt: skip
        return self._with_surface(small, found.inverse_depth, found.weights(e))

    def _with_surface(self, small: Reference, rho: Any, weight: Any) -> Reference:
        e, camera = self.e, small.lens.camera
        dr.eval(weight)
        host = e.download(rho, (camera.height, camera.width))
        slope_x, slope_y = surface_slopes(host, camera.fx, camera.fy)
        roughness = surface_roughness(host, slope_x, slope_y, camera.fx, camera.fy)
        points: tuple[Points, ...] = ()
        if small.intensity is not None:
            rays = self.rays if small.rolling else self._pinhole_rays(small.lens)[0]
            points = level_points(e, host, rays, small.intensity, small.coarse_intensity)
        median_depth, bound = depth_scaling(host)
        return replace(
            small, inverse_depth=rho, slope_x=e.upload(slope_x), slope_y=e.upload(slope_y),
            roughness=e.upload(roughness), weight=weight, points=points, median_depth=median_depth, bound=bound,
            pixels=cv2.countNonZero(host) // strides(camera.width, camera.height)[0] ** 2,
            depth_thumbnail=thumbnail_of_known(host),
        )  # fmt: skip
