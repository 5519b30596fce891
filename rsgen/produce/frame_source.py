"""Frames of a config on demand: rendered, then seen through the sensors' noise.

Exposing a frame uses the renderer and belongs into one thread; developing it is NumPy only and may run beside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from rsgen.config.config import Config
from rsgen.console.progress import Progress, no_progress
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sensors.color import apply_color_noise
from rsgen.sensors.depth import apply_depth_noise
from rsgen.sensors.response import to_srgb8
from rsgen.sensors.seed import noise_generator
from rsgen.sequence.format import CLEAN_COLOR


@dataclass(frozen=True)
class ColorShot:
    """Colour frame `frame` before the sensor: linear radiance (h, w, 3), and what `truth` asks for beside it."""

    frame: int
    linear: Float32Array
    truth: Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class DepthShot:
    """Depth frame `frame`: exact planar z (h, w) in m, and the pixels that the projector does not light, if asked."""

    frame: int
    z: Float32Array
    shadow: BoolArray | None


class FrameSource:
    """Frames of a config's two streams, rendered on demand; with `global_shutter` all lines at once."""

    def __init__(
        self,
        config: Config,
        progress: Progress = no_progress,
        global_shutter: bool = False,
        scene: Any = None,
    ) -> None:
        """Load the scene, unless it is given, and its light (baked now if no cache has it). Raises UserError."""
        from rsgen.device.backend import mitsuba

        mi = mitsuba(config.backend)
        from rsgen.render import images as render
        from rsgen.sensors.shadow import Projector
        from rsgen.truth.renderer import TruthRenderer

        self._config = config
        self.scene = scene or load_scene(config)
        integrator = make_integrator(mi, self.scene, config, progress)
        pick = render.global_shutter if global_shutter else lambda shutter: shutter
        color, depth = config.color, config.depth
        self._color = render.ColorRenderer(self.scene, integrator, color.camera, pick(color.shutter), color.spp)
        self._depth = render.DepthRenderer(self.scene, depth.camera, pick(depth.shutter))
        self._truth = TruthRenderer(self.scene, integrator, color, config.truth) if config.truth.images else None
        lit = depth.noise.model == "kinect" and depth.noise.shadow
        self._projector = Projector(self.scene, self._depth.sensor, depth.noise.projector_baseline_m) if lit else None
        self._T_depth_color = se3.inverse(np.asarray(config.T_color_depth, float))

    def expose_color(self, spline: Spline, stamp: float, frame: int, next_stamp: float | None = None) -> ColorShot:
        """Render the colour frame at `stamp` (s) with its truth; next_stamp: of the frame after it, if there is one."""
        linear = self.linear_color(spline, stamp, frame)
        if self._truth is None:
            return ColorShot(frame, linear, {})
        truth = self._truth.render(self._pose(spline), stamp, next_stamp, self._seed(frame))
        return ColorShot(frame, linear, truth)

    def develop_color(self, shot: ColorShot) -> tuple[ByteArray, dict[str, NDArray[Any]]]:
        """8-bit RGB (h, w, 3) that the camera reports, and the images of `color_truth`."""
        color, truth = self._config.color, dict(shot.truth)
        linear = shot.linear * np.float32(color.exposure_gain)
        if color.noise.model != "none":
            truth[CLEAN_COLOR] = to_srgb8(linear)
        rng = noise_generator(self._config.seed, "color", shot.frame)
        return apply_color_noise(linear, color.noise, rng), truth

    def expose_depth(self, spline: Spline, stamp: float, frame: int) -> DepthShot:
        """Cast the depth frame at `stamp` (s)."""
        z = self.depth(spline, stamp)
        # The projector takes the depth sensor as it is now: exposed to this frame.
        shadow = None if self._projector is None else ~self._projector.lights(z, spline.pose, stamp)
        return DepthShot(frame, z, shadow)

    def develop_depth(self, shot: DepthShot) -> Float32Array:
        """Planar z (h, w) in m that the camera reports; 0 where it reports nothing."""
        depth, rng = self._config.depth, noise_generator(self._config.seed, "depth", shot.frame)
        return apply_depth_noise(shot.z, depth.camera, depth.noise, rng, shot.shadow)

    def linear_color(self, spline: Spline, stamp: float, frame: int) -> Float32Array:
        """Linear RGB (h, w, 3) of the colour frame at `stamp` (s); seeded by the config's seed and `frame`."""
        return self._color.render(self._pose(spline), stamp, self._seed(frame))

    def color(self, spline: Spline, stamp: float, frame: int) -> ByteArray:
        """8-bit RGB (h, w, 3), as the camera reports it, of the colour frame at `stamp` (s)."""
        return self.develop_color(ColorShot(frame, self.linear_color(spline, stamp, frame), {}))[0]

    def depth(self, spline: Spline, stamp: float) -> Float32Array:
        """Exact planar z (h, w) in metres of the depth frame at `stamp` (s); 0 where there is nothing."""
        return self._depth.render(spline.pose, stamp)

    def _pose(self, spline: Spline) -> Callable[[Any], FloatArray]:
        return lambda t: spline.pose(t) @ self._T_depth_color

    def _seed(self, frame: int) -> int:
        return int(np.random.SeedSequence([self._config.seed, frame]).generate_state(1)[0])


def make_integrator(mi: Any, scene: Any, config: Config, progress: Progress) -> Any:
    """Mitsuba integrator of the config's light: `path`, or `BakedIntegrator` over the scene's baked irradiance."""
    light = config.light
    if light.mode == "path":
        return mi.load_dict({"type": "path", "max_depth": light.max_depth})
    from rsgen.light.cache import baked_field, cache_folder
    from rsgen.render.baked import BakedIntegrator
    from rsgen.render.scene import content_hash

    file = config.scene.file
    return BakedIntegrator(
        baked_field(scene, content_hash(file), light, cache_folder(file), progress), glossy_spp=light.glossy_spp
    )


def load_scene(config: Config) -> Any:
    """The config's Mitsuba scene. Raises UserError."""
    from rsgen.device.backend import mitsuba

    mitsuba(config.backend)
    from rsgen.render import scene

    return scene.load_scene(config.scene.file)


def scene_hash(config: Config) -> str:
    """Content hash of the config's scene with all its files. Raises UserError."""
    from rsgen.device.backend import mitsuba

    mitsuba(config.backend)
    from rsgen.render.scene import content_hash

    return content_hash(config.scene.file)
