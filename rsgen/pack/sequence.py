"""One sequence of a pack, rendered: rolling images, their sharp global twins, flow both ways, gyroscope.

Needs an active Mitsuba variant only when called: importing this module loads no engine.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.config import Config
from rsgen.config.sections import TruthConfig
from rsgen.console.progress import Progress, no_progress
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.pack.draw import Drawn, camera_spline
from rsgen.pack.layout import TIMES, Pair
from rsgen.produce.frame_source import load_scene, make_integrator
from rsgen.sensors.color import apply_color_noise
from rsgen.sensors.imu import ImuSamples, exact_imu
from rsgen.sensors.seed import noise_generator

_GYRO_HZ = 1000.0
_GRAVITY = (0.0, -9.80665, 0.0)


@dataclass(frozen=True)
class Stage:
    """A config's scene and light, loaded, which sequences share; spline: T_world_depth(t) of its motion."""

    config: Config
    scene: Any
    integrator: Any
    spline: Spline


def load_stage(config: Config, spline: Spline, progress: Progress = no_progress) -> Stage:
    """Load the scene and its light, baked now if no cache has it. Raises UserError."""
    from rsgen.device.backend import mitsuba

    mi = mitsuba(config.backend)
    scene = load_scene(config)
    return Stage(config, scene, make_integrator(mi, scene, config, progress), spline)


def render_pairs(stage: Stage, drawn: Drawn, length: int, depth: bool = False) -> Iterator[Pair]:
    """The sequence's pairs, one after the other. depth: of the rolling images, too. Raises UserError."""
    from rsgen.render.images import ColorRenderer
    from rsgen.truth.renderer import TruthRenderer, global_instant

    config = stage.config
    color = config.color.model_copy(update={"readout_s": drawn.readout_s, "exposure_s": drawn.exposure_s})
    still = color.model_copy(update={"readout_s": 0.0, "exposure_s": 0.0})
    truth = TruthConfig(global_shutter=TIMES, flow=("global",), spp=config.truth.spp, color_depth=depth)
    camera, shutter = color.camera, color.shutter
    rolling = ColorRenderer(stage.scene, stage.integrator, camera, shutter, color.spp)
    twins = TruthRenderer(stage.scene, stage.integrator, color, truth)
    back = TruthRenderer(stage.scene, stage.integrator, still, TruthConfig())
    pose = camera_spline(stage.spline, drawn, T_depth_color(config)).pose
    for k in range(length):
        stamp = k / color.rate_hz
        seed = int(np.random.SeedSequence([drawn.seed, k]).generate_state(1)[0])
        linear = rolling.render(pose, stamp, seed) * np.float32(color.exposure_gain)
        images = twins.render(pose, stamp, None, seed)
        flow = {time: images[f"flow_global_{time}"] for time in TIMES}
        into = {
            time: back.flow_into(pose, global_instant(camera, shutter, stamp, time), shutter, stamp) for time in TIMES
        }
        yield Pair(
            apply_color_noise(linear, color.noise, noise_generator(drawn.seed, "color", k)),
            {time: images[f"global_{time}"] for time in TIMES},
            {time: np.ascontiguousarray(flow[time][..., :2]) for time in TIMES},
            {time: flow[time][..., 2] > 0.5 for time in TIMES},
            {time: into[time][..., 2] > 0.5 for time in TIMES},
            images.get("color_depth"),
        )


def gyro_samples(stage: Stage, drawn: Drawn, length: int) -> ImuSamples:
    """Exact angular rate and specific force in the colour camera's frame, from the first stamp to the last line.

    Before that, EuRoC's format has no sign for times.
    """
    color = stage.config.color
    end = (length - 1) / color.rate_hz + drawn.readout_s
    t = np.arange(int(np.floor(end * _GYRO_HZ)) + 1) / _GYRO_HZ
    gravity = _GRAVITY if stage.config.imu is None else stage.config.imu.gravity
    spline = camera_spline(stage.spline, drawn, T_depth_color(stage.config))
    gyro, accel = exact_imu(spline, np.eye(4), gravity, t)
    return ImuSamples(t, gyro, accel, np.zeros_like(gyro), np.zeros_like(accel), stamps=t)


def mean_twist(stage: Stage, drawn: Drawn, length: int) -> FloatArray:
    """v, ω (6,) of the colour camera in its own frame, m/s and rad/s, averaged over the sequence's frames."""
    color = stage.config.color
    t = np.linspace(0.0, (length - 1) / color.rate_hz + drawn.readout_s, 64)
    return np.asarray(camera_spline(stage.spline, drawn, T_depth_color(stage.config)).velocity(t).mean(axis=0))


def T_depth_color(config: Config) -> FloatArray:
    """Colour- to depth-camera coordinates (4, 4)."""
    return se3.inverse(np.asarray(config.T_color_depth, float))
