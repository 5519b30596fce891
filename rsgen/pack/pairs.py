"""The pairs of one sequence of a pack: rolling images, their sharp global twins, flow both ways, gyroscope; and files.

Names and contents of files are those of Carla-RS and Fastec-RS (Liu, Cui, Larsson, Pollefeys, CVPR 2020). They follow
the loaders of the authors' code (DeepUnrollNet): there are no documents of the formats. Importing this module loads no
engine; rendering needs an active Mitsuba variant.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from rsgen.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from rsgen.config.config import Config
from rsgen.config.sections import GlobalTime, TruthConfig
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_png
from rsgen.motion.stretch import Drawn
from rsgen.pack.draw import Layout, camera_spline
from rsgen.produce.parts import LoadedScene
from rsgen.sensors.color import apply_color_noise
from rsgen.sensors.imu import ImuSamples, exact_imu
from rsgen.sensors.seed import noise_generator

TIMES: tuple[GlobalTime, ...] = ("first", "middle")
_FLO_MAGIC = 202021.25
_MARK = {"carla-rs": "gt_vel.log", "fastec-rs": "meta.log"}
_ROLLING = {"carla-rs": "_rs.png", "fastec-rs": "_rolling.png"}
_GLOBAL = {
    "carla-rs": {"first": "_gs_f.png", "middle": "_gs_m.png"},
    "fastec-rs": {"first": "_global_first.png", "middle": "_global_middle.png"},
}
# Of the two, Carla-RS has one flow and one mask: its loader's default is the first line's.
_SUFFIX = {"first": "", "middle": "_m"}
_GYRO_HZ = 1000.0
_GRAVITY = (0.0, -9.80665, 0.0)


@dataclass(frozen=True)
class Pair:
    """A rolling image with its global ones; by time ('first', 'middle' line): sharp images (h, w, 3) uint8.

    flow: (h, w, 2) px from the rolling image into the global one, 0 where that does not hold the point. flow_valid:
    (h, w) where it does and shows it. mask: (h, w) where what the global image shows is in the rolling one. depth:
    (h, w) planar z of the rolling image in m, 0 where there is none; None where it is not asked for.
    """

    rolling: ByteArray
    images: dict[str, ByteArray]
    flow: dict[str, Float32Array]
    flow_valid: dict[str, BoolArray]
    mask: dict[str, BoolArray]
    depth: Float32Array | None = None


@dataclass(frozen=True)
class Place:
    """What sequences share: a config, its scene and light, loaded; spline: T_world_depth(t) of its motion."""

    config: Config
    loaded: LoadedScene
    spline: Spline


def render_pairs(place: Place, drawn: Drawn, length: int, depth: bool = False) -> Iterator[Pair]:
    """The sequence's pairs, one after the other. depth: of the rolling images, too. Raises UserError."""
    from rsgen.render.images import ColorRenderer
    from rsgen.truth.renderer import TruthRenderer, global_instant

    config = place.config
    color = config.color.model_copy(update={"readout_s": drawn.readout_s, "exposure_s": drawn.exposure_s})
    still = color.model_copy(update={"readout_s": 0.0, "exposure_s": 0.0})
    truth = TruthConfig(global_shutter=TIMES, flow=("global",), spp=config.truth.spp, color_depth=depth)
    camera, shutter = color.camera, color.shutter
    rolling = ColorRenderer(place.loaded.scene, place.loaded.integrator, camera, shutter, color.spp)
    twins = TruthRenderer(place.loaded.scene, place.loaded.integrator, color, truth)
    back = TruthRenderer(place.loaded.scene, place.loaded.integrator, still, TruthConfig())
    pose = camera_spline(place.spline, drawn, T_depth_color(config)).pose
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


def gyro_samples(place: Place, drawn: Drawn, length: int) -> ImuSamples:
    """Exact angular rate and specific force in the colour camera's frame, from the first stamp to the last line.

    Before that, EuRoC's format has no sign for times.
    """
    color = place.config.color
    end = (length - 1) / color.rate_hz + drawn.readout_s
    t = np.arange(int(np.floor(end * _GYRO_HZ)) + 1) / _GYRO_HZ
    gravity = _GRAVITY if place.config.imu is None else place.config.imu.gravity
    spline = camera_spline(place.spline, drawn, T_depth_color(place.config))
    gyro, accel = exact_imu(spline, np.eye(4), gravity, t)
    return ImuSamples(t, gyro, accel, np.zeros_like(gyro), np.zeros_like(accel), stamps=t)


def mean_twist(place: Place, drawn: Drawn, length: int) -> FloatArray:
    """v, ω (6,) of the colour camera in its own frame, m/s and rad/s, averaged over the sequence's frames."""
    color = place.config.color
    t = np.linspace(0.0, (length - 1) / color.rate_hz + drawn.readout_s, 64)
    return np.asarray(camera_spline(place.spline, drawn, T_depth_color(place.config)).velocity(t).mean(axis=0))


def T_depth_color(config: Config) -> FloatArray:
    """Colour- to depth-camera coordinates (4, 4)."""
    return se3.inverse(np.asarray(config.T_color_depth, float))


def pair_files(layout: Layout, k: int, pair: Pair) -> dict[str, bytes]:
    """Files of frame k, by name."""
    stem = f"{k:04d}" if layout == "carla-rs" else f"{k:03d}"
    files = {f"{stem}{_ROLLING[layout]}": encode_png(pair.rolling)}
    if pair.depth is not None:
        files[f"{stem}{_ROLLING[layout].replace('.png', '.pdepth')}"] = pdepth_text(pair.depth)
    for time in TIMES:
        files[f"{stem}{_GLOBAL[layout][time]}"] = encode_png(pair.images[time])
        files[f"{stem}{_SUFFIX[time]}.flow"] = flo_bytes(pair.flow[time])
        files[f"{stem}_flow_mask{_SUFFIX[time]}.png"] = _mask_png(pair.flow_valid[time])
        files[f"{stem}_mask{_SUFFIX[time]}.png"] = _mask_png(pair.mask[time])
    return files


def flo_bytes(flow: Float32Array) -> bytes:
    """Middlebury's .flo: its magic number, width and height, then u v (px) row by row, little-endian."""
    height, width = flow.shape[:2]
    head = np.array([_FLO_MAGIC], "<f4").tobytes() + np.array([width, height], "<i4").tobytes()
    return head + np.ascontiguousarray(flow[..., :2], "<f4").tobytes()


def pdepth_text(z: Float32Array) -> bytes:
    """Rows of planar z (h, w) in metres to a tenth of a millimetre, as the authors wrote it; 0 for what is no depth."""
    stream = io.BytesIO()
    np.savetxt(stream, np.where(np.isfinite(z) & (z > 0), z, 0.0), "%.4f")
    return stream.getvalue()


def mark_file(layout: Layout, drawn: Drawn, twist: FloatArray, rate_hz: float) -> tuple[str, bytes]:
    """Name and text of the file by which loaders know a sequence. twist (6,): mean v, ω in the camera, m/s, rad/s."""
    if layout == "carla-rs":
        head = "# vx vy vz wx wy wz: mean over the sequence, camera frame (x right, y down, z forward), m/s and rad/s"
        return _MARK[layout], f"{head}\n{' '.join(f'{value:.9g}' for value in twist)}\n".encode()
    known = {
        "readout_s": drawn.readout_s, "exposure_s": drawn.exposure_s, "rate_hz": rate_hz, "speed": drawn.speed,
    }  # fmt: skip
    return _MARK[layout], "".join(f"{name} {value:.9g}\n" for name, value in known.items()).encode()


def _mask_png(array: BoolArray) -> bytes:
    """8-bit grey, 255 where true: what loaders take for a mask."""
    done, data = cv2.imencode(".png", np.where(array, np.uint8(255), np.uint8(0)))
    assert done
    return bytes(data)
