"""Make keyframes: from one frame, rolling or rectified; pass on what an older keyframe knows; fuse later frames."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine, Kernels
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.images.device_frame import MARGIN, DeviceRig, Timer, thumbnail_without, untimed
from rstrack.images.line_poses import from_base, rows_of, to_base
from rstrack.images.pyramid import ColorImage, DepthImage, thumbnail
from rstrack.images.sampling import EDGE
from rstrack.keyframes.keyframe import (
    Reference,
    depth_scaling,
    level_points,
    rectified_lens,
    strides,
)
from rstrack.keyframes.rectification import (
    ColorInput,
    FusionInput,
    RectifyInput,
    color_kernel,
    fuse_kernel,
    rectify_kernel,
)
from rstrack.keyframes.surface import FloatImage, surface_roughness, surface_slopes

Making = Generator[None, None, Reference]
"""A keyframe in six parts: the device works on what one has begun until the next one."""

# Metres at one metre: depths that differ by more show different surfaces.
_AGREE = 0.03
# Weight of a fused pixel in measurements; more would let a keyframe's first errors live for ever.
_MOST = 30.0


def at_once(making: Making) -> Reference:
    """The keyframe, all parts one after the other."""
    while True:
        try:
            next(making)
        except StopIteration as made:
            return made.value


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
        lens, t = depth.exposure.lens, depth.exposure.mid_time
        rho = self.e.download(depth.inverse_z, (lens.camera.height, lens.camera.width))
        return self._at_once(
            self._finishing(index, depth, colors, spline, t, spline.pose(t), lens, depth.inverse_z, rho, None)
        )

    def rectified(
        self, index: int, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline, older: Reference | None,
        as_now: tuple[float, float] = (1.0, 0.0),
    ) -> Reference:  # fmt: skip
        """What `rectifying` makes, at once."""
        return self._at_once(self.rectifying(index, depth, colors, spline, older, as_now))

    def rectifying(
        self, index: int, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline, older: Reference | None,
        as_now: tuple[float, float] = (1.0, 0.0),
    ) -> Making:  # fmt: skip
        """A keyframe at mid readout, in which depth that the older one has is averaged in and fills holes.

        Where something moves before it, it has the older one's intensities, times the first of as_now plus the second.
        """
        e, t = self.e, depth.exposure.mid_time
        T_world_base, base, rho = self.rectify(depth, spline)
        shape = base.camera.height, base.camera.width
        if older is None or older.rolling is not None:
            yield
            host = e.download(rho, shape)
            return (yield from self._finishing(index, depth, colors, spline, t, T_world_base, base, rho, host, None))
        yield
        host = e.download(rho, shape)
        # The older one is brought here while slopes are worked out.
        T = se3.inverse(older.T_world_base) @ T_world_base
        _, grid = self._pinhole_rays(base)
        rectify = self._kernel(rectify_kernel, older.lens, base)
        old, *at = rectify(RectifyInput(older.inverse_depth, *grid, e.upload(rows_of(se3.inverse(T)))))
        slope_x, slope_y = surface_slopes(host, base.camera.fx, base.camera.fy)
        yield
        seen_from = e.upload(np.concatenate([rows_of(T), np.zeros(6)]))
        own = rho, e.upload(host > 0), e.upload(slope_x), e.upload(slope_y)
        rho, weight = self._fuse(own, base, older.lens, older.inverse_depth, older.weight, seen_from)
        yield
        host, old_host = e.download(rho, shape), e.download(old, shape)
        holes = (host <= 0) & (old_host > 0)
        host = np.where(holes, old_host, host)
        weights = np.where(holes, 1.0, e.download(weight, shape))
        inherited = None
        if depth.whole is not None and older.intensity is not None:
            same = (old_host > 0) & (np.abs(old_host - host) < EDGE * host)
            x, y = (e.download(values, shape) for values in at)
            inherited = np.float32(as_now[0]) * _looked_up(older.intensity, x, y, same) + np.float32(as_now[1])
        on_device = e.upload(host)
        return (
            yield from self._finishing(
                index, depth, colors, spline, t, T_world_base, base, on_device, host, weights, inherited
            )
        )

    def rectify(self, depth: DepthImage, spline: Spline) -> tuple[FloatArray, Lens, Any]:
        """T_world_base (4, 4) at mid readout, the lens, and inverse depth as seen from there at once, on the device."""
        lens = depth.exposure.lens
        base = rectified_lens(lens.camera)
        T_world_base: FloatArray = spline.pose(depth.exposure.mid_time)
        seen_at = to_base(self.e, spline, T_world_base, depth.exposure)
        rectify = self._kernel(rectify_kernel, lens, base)
        rho, _, _ = rectify(RectifyInput(depth.inverse_z, *self.device_rays, seen_at))
        return T_world_base, base, rho

    def _hidden(self, depth: DepthImage, whole: DepthImage, spline: Spline) -> npt.NDArray[np.bool_]:
        """Pixels (h, w) of a rectified image before which something moves, and those about them.

        Colours are taken a little later and from beside: there they are no older depth's.
        """
        camera = depth.exposure.lens.camera
        shape = camera.height, camera.width
        rest, all_ = (self.e.download(self.rectify(image, spline)[2], shape) > 0 for image in (depth, whole))
        margin = 2 * round(MARGIN * camera.width) + 1
        return np.asarray(cv2.dilate((all_ & ~rest).astype(np.uint8), np.ones((margin, margin), np.uint8)) > 0)

    def with_depth(
        self, made: Reference, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline, rho: FloatImage,
        weight: npt.NDArray[Any],
    ) -> Reference:  # fmt: skip
        """A keyframe that `rectified` made of these images, with other inverse depth and weights (h, w)."""
        on_device = self.e.upload(rho)
        return self._at_once(
            self._finishing(
                made.index, depth, colors, spline, made.t, made.T_world_base, made.lens, on_device, rho, weight
            )
        )

    def fused(self, ref: Reference, depth: DepthImage, spline: Spline, most: float = _MOST) -> Reference:
        """The keyframe with the depth of one more frame, whose poses are known, averaged in.

        most: weight of a pixel in measurements beyond which the oldest count ever less.
        """
        with self.timer("keyframes: fuse"):
            seen_from = from_base(self.e, spline, ref.T_world_base, depth.exposure)
            own, lens = (ref.inverse_depth, ref.weight, ref.slope_x, ref.slope_y), depth.exposure.lens
            rho, weight = self._fuse(own, ref.lens, lens, depth.inverse_z, self._ones(depth), seen_from, most)
        return replace(ref, inverse_depth=rho, weight=weight)

    def _fuse(
        self, own: tuple[Any, Any, Any, Any], base: Lens, lens: Lens, source: Any, source_weight: Any, seen_from: Any,
        most: float = _MOST,
    ) -> tuple[Any, Any]:  # fmt: skip
        """own: inverse depth, weight and slopes of the keyframe, whose lens is `base`."""
        given = FusionInput(*own, source, source_weight, seen_from, self.e.upload(np.array([_AGREE, most])))
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
        return self._with_points(self._surface(small, self.e.upload(rho), rho, weight), rho)

    def _at_once(self, making: Making) -> Reference:
        with self.timer("keyframes: make"):
            return at_once(making)

    def _finishing(
        self, index: int, depth: DepthImage, colors: tuple[ColorImage, ...], spline: Spline, t: float,
        T_world_base: FloatArray, lens: Lens, device_rho: Any, rho: FloatImage, weight: npt.NDArray[Any] | None,
        inherited: FloatImage | None = None,
    ) -> Making:  # fmt: skip
        """inherited (h, w): intensities of what rests, NaN where they are not known, for where something moves."""
        e = self.e
        rolling = depth.exposure if lens is depth.exposure.lens and lens.lines > 1 else None
        color = min(colors, key=lambda c: abs(c.exposure.mid_time - t)) if colors else None
        looked_up = []
        if color is not None:
            _, grid = (self.rays, self.device_rays) if rolling else self._pinhole_rays(lens)
            seen_at = to_base(e, spline, T_world_base, rolling)
            seen_from = from_base(e, spline, T_world_base, color.exposure)
            for level in sorted({0, max(0, color.finer)}):
                kernel = self._kernel(color_kernel, color.exposure.lens, lens, level)
                looked_up.append(kernel(ColorInput(device_rho, *grid, seen_at, color.levels[level], seen_from)))
        yield
        shown = np.where(rho > 0, 1.0, 0.0) if weight is None else weight
        small = Reference(
            index, depth.exposure.stamp, t, T_world_base, lens, rolling, None, None, None, None, None, (), 1.0, 1.0, 0,
            np.zeros(2), None, thumbnail(rho, rho > 0), None,
        )  # fmt: skip
        made = self._surface(small, device_rho, rho, shown)
        if color is None:
            return made
        yield
        known = ((e.download(value, rho.shape), e.download(seen, rho.shape) > 0) for value, seen in looked_up)
        images = [np.where(seen, value, np.nan).astype(np.float32) for value, seen in known]
        if depth.whole is not None:
            hidden = self._hidden(depth, depth.whole, spline)
            for image in images:
                image[hidden] = np.nan
            if inherited is not None:
                images[0][hidden] = inherited[hidden]
        made = replace(
            made, moments=color.moments, color_thumbnail=thumbnail_without(color, depth), intensity=images[0],
            coarse_intensity=images[1] if len(images) > 1 else None,
        )  # fmt: skip
        return self._with_points(made, rho)

    def _surface(self, small: Reference, device_rho: Any, rho: FloatImage, weight: npt.NDArray[Any]) -> Reference:
        """With its inverse depth and weight (h, w), and what these show of its surfaces."""
        e, camera = self.e, small.lens.camera
        slope_x, slope_y = surface_slopes(rho, camera.fx, camera.fy)
        roughness = surface_roughness(rho, slope_x, slope_y, camera.fx, camera.fy)
        median_depth, bound = depth_scaling(rho)
        return replace(
            small, inverse_depth=device_rho, slope_x=e.upload(slope_x), slope_y=e.upload(slope_y),
            roughness=e.upload(roughness), weight=e.upload(weight), median_depth=median_depth,
            bound=bound, pixels=int(np.count_nonzero(rho)) // strides(camera.width, camera.height)[0] ** 2,
        )  # fmt: skip

    def _with_points(self, made: Reference, rho: FloatImage) -> Reference:
        """With its points, if it has colours."""
        if made.intensity is None:
            return made
        rays = self.rays if made.rolling else self._pinhole_rays(made.lens)[0]
        return replace(made, points=level_points(self.e, rho, rays, made.intensity, made.coarse_intensity))


def _looked_up(image: FloatImage, x: FloatImage, y: FloatImage, known: npt.NDArray[np.bool_]) -> FloatImage:
    """An image (h, w) at its pixels x, y (h, w); NaN where these are not known."""
    at = np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan))
    return np.where(known, at, np.float32(np.nan))
