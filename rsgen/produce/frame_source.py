"""Frames of a config on demand: rendered, then seen through the sensors' noise.

Exposing a frame uses the renderer and belongs into one thread; developing it is NumPy only and may run beside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from rsgen.config.config import Config, LightConfig
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.spline import Spline
from rsgen.produce.ground_truth import lines_of_sight
from rsgen.produce.identity import fingerprint
from rsgen.produce.moving import lit_objects, load_meshes
from rsgen.sensors.color import Meter, Reading, Setting, apply_color_noise, apply_setting, reading, to_srgb8
from rsgen.sensors.depth import apply_depth_noise, mixed_depth, register_depth, with_fixed_errors
from rsgen.sensors.seed import noise_generator
from rsgen.sequence.format import CLEAN_COLOR
from rsgen.sequence.truth_files import FrameTable

# Light meters of cameras see no more than this of a picture.
_METER_WIDTH, _METER_SPP = 64, 4
_LEAST_MIRRORED = 4


@dataclass(frozen=True)
class ColorShot:
    """Colour frame `frame` before the sensor: linear radiance (h, w, 3), and what `truth` asks for beside it.

    setting: how an automatic camera takes it; None where there is none.
    """

    frame: int
    linear: Float32Array
    truth: Mapping[str, NDArray[Any]]
    setting: Setting | None = None


@dataclass(frozen=True)
class DepthShot:
    """Depth frame `frame`: exact planar z (h, w) in m, and the pixels that the projector does not light, if asked.

    blurred: z as the line's whole exposure gives it; None where its middle stands for it. ids (h, w): numbers of the
    objects seen, 0 for none; None where nothing moves.
    """

    frame: int
    z: Float32Array
    shadow: BoolArray | None
    blurred: Float32Array | None = None
    ids: Float32Array | None = None


class FrameSource:
    """Frames of a config's two streams, rendered on demand; with `global_shutter` all lines at once."""

    def __init__(
        self,
        config: Config,
        progress: Progress = no_progress,
        global_shutter: bool = False,
        scene: Any = None,
        objects: Sequence[Spline] = (),
    ) -> None:
        """Load the scene, unless it is given, and its light (baked now if no cache has it). Raises UserError.

        objects: T_world_object(t) of the config's, all of them.
        """
        from rsgen.device.backend import mitsuba

        mi = mitsuba(config.backend)
        from rsgen.render import images as render

        self._render = render
        from rsgen.sensors.shadow import Projector
        from rsgen.truth.renderer import TruthRenderer

        self._config = config
        self.scene = scene or load_scene(config)
        self._integrator = integrator = make_integrator(mi, self.scene, config, progress, objects)
        things = integrator.objects if objects else None
        pick = render.global_shutter if global_shutter else lambda shutter: shutter
        color, depth = config.color, config.depth
        self._color = render.ColorRenderer(self.scene, integrator, color.camera, pick(color.shutter), color.spp)
        self._depth = render.DepthRenderer(self.scene, depth.camera, pick(depth.shutter), things)
        instant = replace(pick(depth.shutter), exposure_s=0.0)
        self._instant = render.DepthRenderer(self.scene, depth.camera, instant, things)
        self._rays = depth.camera.unproject(depth.camera.pixel_grid()) if depth.registered else np.empty(0)
        wanted = bool(config.truth.images) or things is not None
        self._truth = TruthRenderer(self.scene, integrator, color, config.truth, things) if wanted else None
        lit = depth.noise.model == "kinect" and depth.noise.shadow
        pattern = depth.noise.projector_baseline_m, depth.noise.projector_width
        self._projector = Projector(self.scene, self._depth.sensor, *pattern, things) if lit else None
        self._T_depth_color = se3.inverse(np.asarray(config.T_color_depth, float))

    def expose_color(
        self, spline: Spline, stamp: float, frame: int, next_stamp: float | None = None,
        setting: Setting | None = None, next_setting: Setting | None = None,
    ) -> ColorShot:  # fmt: skip
        """Render the colour frame at `stamp` (s) with its truth; next_stamp: of the frame after it, if there is one.

        setting, next_setting: how an automatic camera takes the two.
        """
        linear = self.linear_color(spline, stamp, frame, None if setting is None else setting.exposure_s)
        if self._truth is None:
            return ColorShot(frame, linear, {}, setting)
        how: dict[str, Any] = {}
        if setting is not None:
            exposures = setting.exposure_s, (next_setting or setting).exposure_s
            how = {"exposure_s": exposures, "brightness": setting.brightness}
        truth = self._truth.render(self._pose(spline), stamp, next_stamp, self._seed(frame), **how)
        return ColorShot(frame, linear, truth, setting)

    def develop_color(self, shot: ColorShot) -> tuple[ByteArray, dict[str, NDArray[Any]]]:
        """8-bit RGB (h, w, 3) that the camera reports, and the images of `color_truth`."""
        color, truth = self._config.color, dict(shot.truth)
        linear, noise = shot.linear * np.float32(color.exposure_gain), color.noise
        if shot.setting is not None:
            linear, noise = apply_setting(linear, noise, shot.setting)
        if noise.model != "none":
            truth[CLEAN_COLOR] = to_srgb8(linear)
        rng = noise_generator(self._config.seed, "color", shot.frame)
        return apply_color_noise(linear, noise, rng), truth

    def expose_depth(self, spline: Spline, stamp: float, frame: int) -> DepthShot:
        """Cast the depth frame at `stamp` (s)."""
        z, ids = self._depth.cast(spline.pose, stamp)
        # The projector takes the depth sensor as it is now: exposed to this frame.
        shadow = None if self._projector is None else ~self._projector.lights(z, spline.pose, stamp)
        depth = self._config.depth
        if depth.blur_samples == 1:
            return DepthShot(frame, z, shadow, ids=ids)
        share = (np.arange(depth.blur_samples) + 0.5) / depth.blur_samples
        instants = stamp - depth.exposure_s * (1 - share)
        samples = [self._instant.render(spline.pose, float(t)) for t in instants]
        return DepthShot(frame, z, shadow, mixed_depth(samples, depth.noise.model == "tof"), ids)

    def develop_depth(self, shot: DepthShot) -> Float32Array:
        """Planar z (h, w) in m that the camera reports, 0 where nothing; of colour's size where registered."""
        depth, seed = self._config.depth, self._config.seed
        z = shot.z if shot.blurred is None else shot.blurred
        if depth.noise.model != "none":
            z = with_fixed_errors(z, depth.camera, depth.noise, seed)
        z = apply_depth_noise(z, depth.camera, depth.noise, noise_generator(seed, "depth", shot.frame), shot.shadow)
        if not depth.registered:
            return z
        return register_depth(self._rays, z, self._config.color.camera, self._config.T_color_depth)

    def linear_color(self, spline: Spline, stamp: float, frame: int, exposure_s: float | None = None) -> Float32Array:
        """Linear RGB (h, w, 3) of the colour frame at `stamp` (s); seeded by the config's seed and `frame`.

        exposure_s: where it is another one than the stream's.
        """
        return self._color.render(self._pose(spline), stamp, self._seed(frame), exposure_s)

    def light_meter(self, spline: Spline, stamps: FloatArray) -> Meter:
        """What an automatic camera sees of the frames at `stamps` (n,), s: small and sharp pictures of them."""
        color = self._config.color
        camera, shutter = small_camera(color.camera, _METER_WIDTH), replace(color.shutter, exposure_s=0.0)
        small = self._render.ColorRenderer(self.scene, self._integrator, camera, shutter, _METER_SPP)
        noiseless = color.noise.model_copy(update={"gain": 0.0, "bayer": "off"})

        def read(frame: int, setting: Setting) -> Reading:
            # A sharp picture at mid-exposure shows what the blurred one does in the mean.
            instant = float(stamps[frame]) - 0.5 * setting.exposure_s
            linear = small.render(self._pose(spline), instant, self._seed(frame)) * np.float32(color.exposure_gain)
            seen = apply_color_noise(*apply_setting(linear, noiseless, setting), np.random.default_rng(0))
            return reading(seen, linear * np.float32(setting.brightness))

        return read

    def color(self, spline: Spline, stamp: float, frame: int, setting: Setting | None = None) -> ByteArray:
        """8-bit RGB (h, w, 3), as the camera reports it, of the colour frame at `stamp` (s).

        setting: how an automatic camera took it.
        """
        linear = self.linear_color(spline, stamp, frame, None if setting is None else setting.exposure_s)
        return self.develop_color(ColorShot(frame, linear, {}, setting))[0]

    def depth(self, spline: Spline, stamp: float) -> Float32Array:
        """Exact planar z (h, w) in metres of the depth frame at `stamp` (s); 0 where there is nothing."""
        return self._depth.render(spline.pose, stamp)

    def _pose(self, spline: Spline) -> Callable[[Any], FloatArray]:
        return lambda t: spline.pose(t) @ self._T_depth_color

    def _seed(self, frame: int) -> int:
        return int(np.random.SeedSequence([self._config.seed, frame]).generate_state(1)[0])


def make_integrator(mi: Any, scene: Any, config: Config, progress: Progress, objects: Sequence[Spline] = ()) -> Any:
    """Mitsuba integrator of the config's light: `path`, or `BakedIntegrator` over the scene's baked irradiance.

    objects: T_world_object(t) of the config's objects; without any the scene alone is shown.
    """
    light = config.light
    if light.mode == "path":
        return mi.load_dict({"type": "path", "max_depth": light.max_depth})
    from rsgen.light.cache import baked_field, cache_folder
    from rsgen.render.baked import BakedIntegrator

    try:
        cache = cache_folder(config.scene.file)
        field = baked_field(scene, surfaces_hash(config), light, cache, progress, lambda: lines_of_sight(config))
    except UserError as error:
        told = str(error)
        raise UserError(told if told.startswith("scene ") else f"scene {config.scene.file}: {told}") from None
    things = lit_objects(scene, field, load_meshes(config), objects) if objects else None
    return BakedIntegrator(field, glossy_spp=mirrored_samples(light, config.color.spp), objects=things)


def mirrored_samples(light: LightConfig, spp: int) -> int:
    """Samples of what surfaces mirror, at most, of so many of a pixel."""
    return light.glossy_spp or max(_LEAST_MIRRORED, spp // 4)


def load_scene(config: Config) -> Any:
    """The config's Mitsuba scene, with its target if it has one. Raises UserError."""
    from rsgen.device.backend import mitsuba

    mitsuba(config.backend)
    from rsgen.render import scene
    from rsgen.render.board import Board

    target = config.target
    board = None if target is None else Board(target.grid, np.array(target.T_world_target, float))
    return scene.load_scene(config.scene.file, board, _mesh_options(config))


def scene_hash(config: Config) -> str:
    """Content hash of the config's scene with all its files. Raises UserError."""
    from rsgen.device.backend import mitsuba

    mitsuba(config.backend)
    from rsgen.render.scene import content_hash

    return content_hash(config.scene.file, _mesh_options(config))


def _mesh_options(config: Config) -> Any:
    from rsgen.render.placement import SceneOptions

    return SceneOptions(config.scene.scale, config.scene.up, config.scene.light)


def surfaces_hash(config: Config) -> str:
    """Hash of all that is lit: the scene, and its target if it has one. Raises UserError."""
    scene, target = scene_hash(config), config.target
    return scene if target is None else fingerprint({"scene": scene, "target": target.model_dump(mode="json")})


def setting_of(config: Config, table: FrameTable | None, k: int) -> Setting | None:
    """How an automatic camera took the k-th image of its frame table; None where nothing is automatic."""
    if table is None or not config.color.adapts:
        return None
    red, green, blue = table.balance[k].tolist()
    return Setting(float(table.exposure_s[k]), float(table.gain[k]), float(table.brightness[k]), (red, green, blue))


def small_camera(camera: Camera, width: int) -> Camera:
    """The same camera with pixels so large that there are about `width` columns; none wider than it was."""
    columns = min(width, camera.width)
    rows = max(1, round(camera.height * columns / camera.width))
    x, y = columns / camera.width, rows / camera.height
    cx, cy = (camera.cx + 0.5) * x - 0.5, (camera.cy + 0.5) * y - 0.5
    return replace(camera, width=columns, height=rows, fx=camera.fx * x, fy=camera.fy * y, cx=cx, cy=cy)
