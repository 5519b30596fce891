"""Frames of both streams on demand: rendered, then seen through the sensors' noise.

Exposing a frame uses the renderer and belongs into one thread; developing it is NumPy only and may run beside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from rsgen.config.cameras import ColorConfig, DepthConfig
from rsgen.config.sections import TruthConfig
from rsgen.console.progress import Progress
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.produce.writer import SequenceWriter
from rsgen.sensors.color import Meter, Reading, Setting, apply_color_noise, apply_setting, reading, to_srgb8
from rsgen.sensors.depth import apply_depth_noise, mixed_depth, register_depth, with_fixed_errors
from rsgen.sensors.seed import noise_generator
from rsgen.sequence.format import CLEAN_COLOR, StreamName
from rsgen.sequence.truth_files import FrameTable

# Written frames that may wait for the disk: bounds memory and how much a kill can lose.
_WRITE_AHEAD = 4

# Light meters of cameras see no more than this of a picture.
_METER_WIDTH, _METER_SPP = 64, 4


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
    """Frames of two streams, rendered on demand; `rsgen.produce.parts.open_frames` makes one of a config."""

    def __init__(
        self, scene: Any, integrator: Any, color: ColorConfig, depth: DepthConfig, T_color_depth: FloatArray,
        truth: TruthConfig, seed: int, global_shutter: bool = False, has_objects: bool = False,
    ) -> None:  # fmt: skip
        """scene, integrator: as `load_scene` and `make_integrator` return them. seed: of all that is chance.

        global_shutter: all lines of a frame at once. has_objects: whether the integrator has some that move.
        """
        from rsgen.render import images as render
        from rsgen.sensors.shadow import Projector
        from rsgen.truth.renderer import TruthRenderer

        self._render, self.scene, self._integrator = render, scene, integrator
        self._color_config, self._depth_config, self._seed = color, depth, seed
        self._T_color_depth, self._T_depth_color = T_color_depth, se3.inverse(T_color_depth)
        things = integrator.objects if has_objects else None

        def pick(shutter: Shutter) -> Shutter:
            return render.global_shutter(shutter) if global_shutter else shutter

        self._color = render.ColorRenderer(scene, integrator, color.camera, pick(color.shutter), color.spp)
        self._depth = render.DepthRenderer(scene, depth.camera, pick(depth.shutter), things)
        instant = replace(pick(depth.shutter), exposure_s=0.0)
        self._instant = render.DepthRenderer(scene, depth.camera, instant, things)
        self._rays = depth.camera.unproject(depth.camera.pixel_grid()) if depth.registered else np.empty(0)
        wanted = bool(truth.images) or things is not None
        self._truth = TruthRenderer(scene, integrator, color, truth, things) if wanted else None
        lit = depth.noise.model == "kinect" and depth.noise.shadow
        pattern = depth.noise.projector_baseline_m, depth.noise.projector_width
        self._projector = Projector(scene, self._depth.sensor, *pattern, things) if lit else None

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
        truth = self._truth.render(self._pose(spline), stamp, next_stamp, self._frame_seed(frame), **how)
        return ColorShot(frame, linear, truth, setting)

    def develop_color(self, shot: ColorShot) -> tuple[ByteArray, dict[str, NDArray[Any]]]:
        """8-bit RGB (h, w, 3) that the camera reports, and the images of `color_truth`."""
        color, truth = self._color_config, dict(shot.truth)
        linear, noise = shot.linear * np.float32(color.exposure_gain), color.noise
        if shot.setting is not None:
            linear, noise = apply_setting(linear, noise, shot.setting)
        if noise.model != "none":
            truth[CLEAN_COLOR] = to_srgb8(linear)
        rng = noise_generator(self._seed, "color", shot.frame)
        return apply_color_noise(linear, noise, rng), truth

    def expose_depth(self, spline: Spline, stamp: float, frame: int) -> DepthShot:
        """Cast the depth frame at `stamp` (s)."""
        z, ids = self._depth.cast(spline.pose, stamp)
        # The projector takes the depth sensor as it is now: exposed to this frame.
        shadow = None if self._projector is None else ~self._projector.lights(z, spline.pose, stamp)
        depth = self._depth_config
        if depth.blur_samples == 1:
            return DepthShot(frame, z, shadow, ids=ids)
        share = (np.arange(depth.blur_samples) + 0.5) / depth.blur_samples
        instants = stamp - depth.exposure_s * (1 - share)
        samples = [self._instant.render(spline.pose, float(t)) for t in instants]
        return DepthShot(frame, z, shadow, mixed_depth(samples, depth.noise.model == "tof"), ids)

    def develop_depth(self, shot: DepthShot) -> Float32Array:
        """Planar z (h, w) in m that the camera reports, 0 where nothing; of colour's size where registered."""
        depth, seed = self._depth_config, self._seed
        z = shot.z if shot.blurred is None else shot.blurred
        if depth.noise.model != "none":
            z = with_fixed_errors(z, depth.camera, depth.noise, seed)
        z = apply_depth_noise(z, depth.camera, depth.noise, noise_generator(seed, "depth", shot.frame), shot.shadow)
        if not depth.registered:
            return z
        return register_depth(self._rays, z, self._color_config.camera, self._T_color_depth)

    def linear_color(self, spline: Spline, stamp: float, frame: int, exposure_s: float | None = None) -> Float32Array:
        """Linear RGB (h, w, 3) of the colour frame at `stamp` (s); seeded by the config's seed and `frame`.

        exposure_s: where it is another one than the stream's.
        """
        return self._color.render(self._pose(spline), stamp, self._frame_seed(frame), exposure_s)

    def light_meter(self, spline: Spline, stamps: FloatArray) -> Meter:
        """What an automatic camera sees of the frames at `stamps` (n,), s: small and sharp pictures of them."""
        color = self._color_config
        camera, shutter = small_camera(color.camera, _METER_WIDTH), replace(color.shutter, exposure_s=0.0)
        small = self._render.ColorRenderer(self.scene, self._integrator, camera, shutter, _METER_SPP)
        noiseless = color.noise.model_copy(update={"gain": 0.0, "bayer": "off"})

        def read(frame: int, setting: Setting) -> Reading:
            # A sharp picture at mid-exposure shows what the blurred one does in the mean.
            instant = float(stamps[frame]) - 0.5 * setting.exposure_s
            linear = small.render(self._pose(spline), instant, self._frame_seed(frame)) * np.float32(
                color.exposure_gain
            )
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

    def _frame_seed(self, frame: int) -> int:
        return int(np.random.SeedSequence([self._seed, frame]).generate_state(1)[0])


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


def render_shots(
    writer: SequenceWriter, source: FrameSource, shots: Sequence[tuple[int, StreamName]], progress: Progress
) -> None:
    """Render images (frame, stream) in order and write them; noise and encoding go on beside. Raises UserError."""
    # However this ends, leaving the pool waits for what has been rendered to be written.
    with ThreadPoolExecutor(max_workers=2) as pool:
        pending: list[Future[None]] = []
        for done, (k, stream) in enumerate(shots, 1):
            shown = writer.shows(stream, k)
            stamp = float(writer.stamps(stream)[shown])
            if stream == "color":
                after = writer.next_color(k)
                next_stamp = None if after is None else float(writer.stamps("color")[after])
                settings = (None if frame is None else writer.setting(frame) for frame in (shown, after))
                shot = source.expose_color(writer.spline, stamp, shown, next_stamp, *settings)
                pending.append(pool.submit(_write_color, writer, source, k, shot))
            else:
                measured = source.expose_depth(writer.spline, stamp, shown)
                pending.append(pool.submit(_write_depth, writer, source, k, measured))
            while len(pending) > _WRITE_AHEAD:
                pending.pop(0).result()
            progress("frames", done / len(shots), f"frame {k}")
        for write in pending:
            write.result()


def _write_color(writer: SequenceWriter, source: FrameSource, k: int, shot: ColorShot) -> None:
    writer.write_color(k, *source.develop_color(shot))


def _write_depth(writer: SequenceWriter, source: FrameSource, k: int, shot: DepthShot) -> None:
    writer.write_depth(k, shot.z, source.develop_depth(shot), shot.ids)
