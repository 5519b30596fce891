"""Frames of all cameras on demand: rendered, then seen through their sensors' noise, and written in order.

Exposing a frame uses the renderer and belongs into one thread; developing it is NumPy only and may run beside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import BoolArray, ByteArray, Float32Array, FloatArray, UInt16Array
from rsgen.config.cameras import ColorConfig, DepthConfig
from rsgen.config.config import Config
from rsgen.config.rig import RigColorConfig, RigDepthConfig
from rsgen.config.sections import TruthConfig
from rsgen.console.progress import Progress
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.produce.writer import SequenceWriter
from rsgen.sensors.color import Meter, Reading, Setting, apply_color_noise, apply_setting, reading, to_srgb8
from rsgen.sensors.depth import apply_depth_noise, mixed_depth, register_depth, stereo_depth, with_fixed_errors
from rsgen.sensors.seed import device_seed, frame_seed, noise_generator
from rsgen.sequence.format import CLEAN_COLOR
from rsgen.sequence.truth_files import FrameTable

# Written frames that may wait for the disk: bounds memory and how much a kill can lose.
_WRITE_AHEAD = 4
# Light meters of cameras see no more than this of a picture.
_METER_WIDTH, _METER_SPP = 64, 4
# Luminance of linear RGB (ITU-R BT.709): what a camera without colours sees of visible light.
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True)
class ColorShot:
    """Frame `frame` before the sensor: linear radiance (h, w, 3), and what `truth` asks for beside it.

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
    objects seen, 0 for none; None where nothing moves. labels (h, w): of all things, if asked for. pair: the two grey
    images (h, w) that depth is computed from.
    """

    frame: int
    z: Float32Array
    shadow: BoolArray | None
    blurred: Float32Array | None = None
    ids: Float32Array | None = None
    labels: UInt16Array | None = None
    pair: tuple[ByteArray, ByteArray] | None = None


@dataclass(frozen=True)
class Stage:
    """What cameras look at: a scene, an integrator, as `load_scene` and `make_integrator` return them, and objects.

    objects: that move, of the integrator; None without. seed: of all that is chance. is_global: all lines at once.
    instances: of the scene, where labels are asked for.
    """

    scene: Any
    integrator: Any
    objects: Any
    seed: int
    is_global: bool = False
    instances: Any = None

    def shutter(self, shutter: Shutter) -> Shutter:
        """The shutter that a stream's stands for here."""
        return replace(shutter, readout_s=0.0) if self.is_global else shutter


class ColorSource:
    """Frames of a colour or grey camera. T_cam_body (4, 4): its pose; name: by which its random numbers are drawn."""

    def __init__(
        self, stage: Stage, name: str, config: ColorConfig, T_cam_body: FloatArray, truth: TruthConfig
    ) -> None:
        from rsgen.render import images as render
        from rsgen.truth.renderer import TruthRenderer

        self._render, self._stage, self._name, self.config = render, stage, name, config
        self.T_body_cam = se3.inverse(T_cam_body)
        shutter = stage.shutter(config.shutter)
        self._color = render.ColorRenderer(stage.scene, stage.integrator, config.camera, shutter, config.spp)
        wanted = bool(truth.images) or truth.labels or stage.objects is not None
        seen = stage.objects, stage.instances
        self._truth = TruthRenderer(stage.scene, stage.integrator, config, truth, *seen) if wanted else None
        self._dots = None
        if isinstance(config, RigColorConfig) and config.dots is not None:
            from rsgen.sensors.projectors import DotProjector

            self._dots = DotProjector(stage.scene, config.camera, shutter, config.dots, stage.seed)

    def expose(
        self, spline: Spline, stamp: float, frame: int, next_stamp: float | None = None,
        setting: Setting | None = None, next_setting: Setting | None = None,
    ) -> ColorShot:  # fmt: skip
        """Render the frame at `stamp` (s) with its truth; next_stamp: of the frame after it, if there is one.

        setting, next_setting: how an automatic camera takes the two.
        """
        linear = self.linear(spline, stamp, frame, None if setting is None else setting.exposure_s)
        if self._truth is None:
            return ColorShot(frame, linear, {}, setting)
        how: dict[str, Any] = {}
        if setting is not None:
            exposures = setting.exposure_s, (next_setting or setting).exposure_s
            how = {"exposure_s": exposures, "brightness": setting.brightness}
        truth = self._truth.render(self._pose(spline), stamp, next_stamp, self._seed(frame), **how)
        return ColorShot(frame, linear, truth, setting)

    def develop(self, shot: ColorShot) -> tuple[ByteArray, dict[str, NDArray[Any]]]:
        """8-bit RGB (h, w, 3) that the camera reports, and the images of `rsgen.produce.records.image_truth`."""
        config, truth = self.config, dict(shot.truth)
        linear, noise = shot.linear * np.float32(config.exposure_gain), config.noise
        if shot.setting is not None:
            linear, noise = apply_setting(linear, noise, shot.setting)
        if self._is_grey:
            noise = noise.model_copy(update={"white_balance": (1.0, 1.0, 1.0)})
        if noise.model != "none":
            truth[CLEAN_COLOR] = to_srgb8(linear)
        return apply_color_noise(linear, noise, noise_generator(self._stage.seed, self._name, shot.frame)), truth

    def linear(self, spline: Spline, stamp: float, frame: int, exposure_s: float | None = None) -> Float32Array:
        """Linear RGB (h, w, 3) of the frame at `stamp` (s); seeded by the config's seed and `frame`.

        Of a grey camera three times its luminance. exposure_s: where it is another one than the stream's.
        """
        linear = self._color.render(self._pose(spline), stamp, self._seed(frame), exposure_s)
        if self._is_grey:
            linear = np.repeat((linear @ _LUMINANCE)[..., None], 3, axis=-1)
        if self._dots is not None:
            linear = linear + self._dots.light(self._pose(spline), stamp)[..., None]
        return linear

    def light_meter(self, spline: Spline, stamps: FloatArray) -> Meter:
        """What an automatic camera sees of the frames at `stamps` (n,), s: small and sharp pictures of them."""
        config = self.config
        camera, shutter = small_camera(config.camera, _METER_WIDTH), replace(config.shutter, exposure_s=0.0)
        small = self._render.ColorRenderer(self._stage.scene, self._stage.integrator, camera, shutter, _METER_SPP)
        noiseless = config.noise.model_copy(update={"gain": 0.0, "bayer": "off"})

        def read(frame: int, setting: Setting) -> Reading:
            # A sharp picture at mid-exposure shows what the blurred one does in the mean.
            instant = float(stamps[frame]) - 0.5 * setting.exposure_s
            linear = small.render(self._pose(spline), instant, self._seed(frame)) * np.float32(config.exposure_gain)
            seen = apply_color_noise(*apply_setting(linear, noiseless, setting), np.random.default_rng(0))
            return reading(seen, linear * np.float32(setting.brightness))

        return read

    def picture(self, spline: Spline, stamp: float, frame: int, setting: Setting | None = None) -> ByteArray:
        """8-bit RGB (h, w, 3), as the camera reports it, of the frame at `stamp` (s).

        setting: how an automatic camera took it.
        """
        linear = self.linear(spline, stamp, frame, None if setting is None else setting.exposure_s)
        return self.develop(ColorShot(frame, linear, {}, setting))[0]

    @property
    def _is_grey(self) -> bool:
        return isinstance(self.config, RigColorConfig) and self.config.kind != "color"

    def _pose(self, spline: Spline) -> Callable[[Any], FloatArray]:
        return lambda t: spline.pose(t) @ self.T_body_cam

    def _seed(self, frame: int) -> int:
        return frame_seed(self._stage.seed, self._name, frame)


class DepthSource:
    """Frames of a depth camera. T_cam_body (4, 4): its pose. colors: the rig's other cameras, for stereo.

    registered_to: the camera that images are warped into, with its pose (4, 4) in the depth camera.
    """

    def __init__(
        self, stage: Stage, name: str, config: DepthConfig, T_cam_body: FloatArray, colors: Mapping[str, ColorSource],
        registered_to: tuple[Camera, FloatArray] | None = None,
    ) -> None:  # fmt: skip
        from rsgen.render import images as render
        from rsgen.sensors.projectors import Projector

        self._stage, self._name, self.config, self._registered_to = stage, name, config, registered_to
        self._T_body_cam = None if (T_cam_body == np.eye(4)).all() else se3.inverse(T_cam_body)
        shutter = stage.shutter(config.shutter)
        self._depth = render.DepthRenderer(stage.scene, config.camera, shutter, stage.objects, stage.instances)
        instant = replace(shutter, exposure_s=0.0)
        self._instant = render.DepthRenderer(stage.scene, config.camera, instant, stage.objects)
        self._rays = config.camera.unproject(config.camera.pixel_grid()) if registered_to else np.empty(0)
        lit = config.noise.model == "kinect" and config.noise.shadow
        pattern = config.noise.projector_baseline_m, config.noise.projector_width
        self._projector = Projector(stage.scene, self._depth.sensor, *pattern, stage.objects) if lit else None
        self._stereo = config.stereo if isinstance(config, RigDepthConfig) else None
        self._pair = () if self._stereo is None else (colors[self._stereo.left], colors[self._stereo.right])

    def expose(self, spline: Spline, stamp: float, frame: int) -> DepthShot:
        """Cast the frame at `stamp` (s), and render the images that it is computed from, if it is."""
        pose = self._pose(spline)
        z, ids, labels = self._depth.cast(pose, stamp)
        # The projector takes the depth sensor as it is now: exposed to this frame.
        shadow = None if self._projector is None else ~self._projector.lights(z, pose, stamp)
        pair = tuple(source.picture(spline, stamp, frame)[..., 0] for source in self._pair)
        config = self.config
        if config.blur_samples == 1 or pair:
            return DepthShot(frame, z, shadow, ids=ids, labels=labels, pair=pair or None)  # type: ignore[arg-type]
        share = (np.arange(config.blur_samples) + 0.5) / config.blur_samples
        instants = stamp - config.exposure_s * (1 - share)
        samples = [self._instant.render(pose, float(t)) for t in instants]
        return DepthShot(frame, z, shadow, mixed_depth(samples, config.noise.model == "tof"), ids, labels)

    def develop(self, shot: DepthShot) -> Float32Array:
        """Planar z (h, w) in m that the camera reports, 0 where nothing; of colour's size where registered."""
        config, seed = self.config, self._stage.seed
        if shot.pair is not None and self._stereo is not None:
            places = [source.T_body_cam[:3, 3] for source in self._pair]
            baseline_m = float(np.linalg.norm(places[1] - places[0]))
            return stereo_depth(*shot.pair, config.camera.fx * baseline_m, self._stereo)
        z = shot.z if shot.blurred is None else shot.blurred
        if config.noise.model != "none":
            z = with_fixed_errors(z, config.camera, config.noise, device_seed(seed, self._name))
        rng = noise_generator(seed, self._name, shot.frame)
        z = apply_depth_noise(z, config.camera, config.noise, rng, shot.shadow)
        return z if self._registered_to is None else register_depth(self._rays, z, *self._registered_to)

    def exact(self, spline: Spline, stamp: float) -> Float32Array:
        """Exact planar z (h, w) in metres of the frame at `stamp` (s); 0 where there is nothing."""
        return self._depth.render(self._pose(spline), stamp)

    def _pose(self, spline: Spline) -> Callable[[Any], FloatArray]:
        if self._T_body_cam is None:
            return spline.pose
        T_body_cam = self._T_body_cam
        return lambda t: spline.pose(t) @ T_body_cam


def setting_of(color: ColorConfig, table: FrameTable | None, k: int) -> Setting | None:
    """How an automatic camera took the k-th image of its frame table; None where nothing is automatic."""
    if table is None or not color.adapts:
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


class FrameSource:
    """Cameras by name, of which frames are rendered on demand; `rsgen.produce.parts.open_frames` makes one."""

    def __init__(self, stage: Stage, config: Config) -> None:
        """config: of the cameras; its scene is the stage's already."""
        self._of_view = config.view
        self.colors = {
            name: ColorSource(stage, name, stream, config.T_cam_body(name), config.truth)
            for name, stream in config.cameras.items()
            if isinstance(stream, ColorConfig)
        }
        into = (config.color.camera, np.asarray(config.T_color_depth, float)) if config.depth.registered else None
        self.depths = {
            name: DepthSource(stage, name, stream, config.T_cam_body(name), self.colors, into)
            for name, stream in config.cameras.items()
            if isinstance(stream, DepthConfig)
        }

    @property
    def color(self) -> ColorSource:
        """The colour camera: of a rig the first one."""
        return self.colors[self._of_view]

    @property
    def depth(self) -> DepthSource:
        """The depth camera: of a rig the first one."""
        return next(iter(self.depths.values()))


def render_shots(
    writer: SequenceWriter, source: FrameSource, shots: Sequence[tuple[int, str]], progress: Progress
) -> None:
    """Render images (frame, stream) in order and write them; noise and encoding go on beside. Raises UserError."""
    # However this ends, leaving the pool waits for what has been rendered to be written.
    with ThreadPoolExecutor(max_workers=2) as pool:
        pending: list[Future[None]] = []
        for done, (k, stream) in enumerate(shots, 1):
            shown = writer.shows(stream, k)
            stamp = float(writer.stamps(stream)[shown])
            if stream in source.colors:
                after = writer.next_shown(stream, k)
                next_stamp = None if after is None else float(writer.stamps(stream)[after])
                settings = (None if frame is None else writer.setting(stream, frame) for frame in (shown, after))
                shot = source.colors[stream].expose(writer.spline, stamp, shown, next_stamp, *settings)
                pending.append(pool.submit(_write_color, writer, source.colors[stream], stream, k, shot))
            else:
                measured = source.depths[stream].expose(writer.spline, stamp, shown)
                pending.append(pool.submit(_write_depth, writer, source.depths[stream], stream, k, measured))
            while len(pending) > _WRITE_AHEAD:
                pending.pop(0).result()
            progress("frames", done / len(shots), f"frame {k}")
        for write in pending:
            write.result()


def _write_color(writer: SequenceWriter, source: ColorSource, stream: str, k: int, shot: ColorShot) -> None:
    writer.write_color(k, *source.develop(shot), stream=stream)


def _write_depth(writer: SequenceWriter, source: DepthSource, stream: str, k: int, shot: DepthShot) -> None:
    writer.write_depth(k, shot.z, source.develop(shot), shot.ids, stream=stream, labels=shot.labels)
