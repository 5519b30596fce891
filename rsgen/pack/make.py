"""A training pack: short sequences of pairs of rolling images and their sharp global twins, each whole or not at all.

Names and contents of files are those of Carla-RS and Fastec-RS (Liu, Cui, Larsson, Pollefeys, CVPR 2020). They follow
the loaders of the authors' code (DeepUnrollNet): there are no documents of the formats. Importing this module loads no
engine.

made = make_pack((config,), PackOptions(count=1000), seed=0, out=Path("packs/demo"), workers=Workers())
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rsgen.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from rsgen.config.config import Config
from rsgen.config.sections import GlobalTime, TruthConfig
from rsgen.console.progress import Progress
from rsgen.console.scheduler import Workers
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, read_yaml, whole_folder, write_error
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_png
from rsgen.motion.stretch import Drawn, along, draw_stretch
from rsgen.pack.draw import Layout, PackOptions
from rsgen.produce.generate import by_scene, for_other_processes, loaded_last
from rsgen.produce.parts import LoadedScene, engine_versions, input_hashes, load_motion, load_scene_and_light
from rsgen.produce.records import fingerprint
from rsgen.sensors.color import apply_color_noise
from rsgen.sensors.imu import ImuSamples, exact_imu, imu_csv
from rsgen.sensors.seed import noise_generator

FORMAT = "rsgen-pack/1"
PACK, DRAWN, GYRO = "pack.yaml", "sequence.json", "imu.csv"
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
class PackJob:
    """One sequence: what a worker has to know. folder: where it goes, on a disk that all share. spline:
    T_world_cam(t) of its colour camera, with stamp 0 first. key: of config and inputs, for scenes already loaded."""

    config: Config
    key: str
    spline: Spline
    drawn: Drawn
    options: PackOptions
    folder: Path


@dataclass(frozen=True)
class PackSummary:
    """What `out` holds now: sequences, pairs in them, and how many sequences were made in this run."""

    out: Path
    sequences: int
    pairs: int
    new: int


def make_pack(
    configs: Sequence[Config], options: PackOptions, seed: int, out: Path, workers: Workers, progress: Progress
) -> PackSummary:
    """Render the sequences that `out` lacks. A pack may be continued with a larger count, by nothing else.

    Raises UserError: a config that a pack cannot be made of, a folder that holds something else or cannot be written.
    """
    for config in configs:
        _check(config)
    motions = [load_motion(config) for config in configs]
    spans = [(motion.first_stamp, motion.last_stamp) for motion in motions]
    rates = [config.color.rate_hz for config in configs]
    drawn = [draw_stretch(options.ranges, seed, index, spans, rates) for index in range(options.sequences)]
    identities = [_identity(config) for config in configs]
    _open(out, identities, options, seed)
    jobs = []
    for index, one in enumerate(drawn):
        folder = out / f"{index:06d}"
        if not folder.is_dir():
            identity = identities[one.config]
            config = for_other_processes(configs[one.config], identity["versions"]["variant"])
            T_depth_color = se3.inverse(np.asarray(config.T_color_depth, float))
            spline = along(motions[one.config].spline, one.start_s, one.speed, one.turn, T_depth_color)
            jobs.append(PackJob(config, fingerprint(identity), spline, one, options, folder.resolve()))
    done = 0
    for job, _ in by_scene(make_sequence, jobs, workers, progress):
        done += 1
        if not job.folder.is_dir():
            raise UserError(f"{job.folder}: a worker has written it, but not here: choose an --out all share")
        progress("sequences", done / len(jobs), f"{done * options.length} of {len(jobs) * options.length} pairs")
    return PackSummary(out, options.sequences, options.sequences * options.length, done)


def make_sequence(job: PackJob, progress: Progress) -> None:
    """Render one sequence into its folder, which is there when all of it is. Raises UserError."""
    loaded = loaded_last(job.key, lambda: load_scene_and_light(job.config, progress))
    layout = job.options.layout
    with whole_folder(job.folder) as folder:
        for k, pair in enumerate(_pairs(job, loaded)):
            for name, data in pair_files(layout, k, pair).items():
                (folder / name).write_bytes(data)
        twist = job.spline.velocity(np.linspace(0.0, _end_s(job), 64)).mean(axis=0)
        name, text = mark_file(layout, job.drawn, twist, job.config.color.rate_hz)
        (folder / GYRO).write_bytes(imu_csv(_gyro_samples(job)).encode())
        (folder / DRAWN).write_text(json.dumps(_about(job), indent=1) + "\n")
        (folder / name).write_bytes(text)


# ---------------------------------------------------------------------------------------------------------------------


def _check(config: Config) -> None:
    """Raises UserError for what a pack does not know."""
    if config.objects:
        raise UserError(f"config {config.name}: has objects that move, which packs do not render: leave them out")
    if config.color.adapts:
        raise UserError(f"config {config.name}: packs have no automatic camera: leave auto_exposure and the like out")


def _identity(config: Config) -> dict[str, Any]:
    return {"config": config.content(), "inputs": input_hashes(config), "versions": engine_versions(config.backend)}


def _open(out: Path, identities: Sequence[dict[str, Any]], options: PackOptions, seed: int) -> None:
    """Begin or continue the pack in `out`. Raises UserError if it holds anything else."""
    content = {"format": FORMAT, "seed": seed, "options": options.content, "configs": list(identities)}
    content["fingerprint"] = fingerprint(content)
    cure = "choose another --out or delete the folder"
    if (out / PACK).is_file():
        old = read_yaml(out / PACK)
        if old.get("fingerprint") != content["fingerprint"]:
            names = [name for name in ("seed", "options", "configs") if old.get(name) != content[name]] or [
                "fingerprint"
            ]
            raise UserError(f"{out}: holds another pack, of other {' and '.join(names)}: {cure}")
        return
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise UserError(f"{out}: holds other files and no {PACK}: {cure}")
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(out, error) from None
    atomic_write(out / PACK, encode_yaml(content))


def _about(job: PackJob) -> dict[str, Any]:
    """What was drawn, and the camera; times count from the first frame's stamp."""
    color = job.config.color
    return {
        "config": job.config.name, **dataclasses.asdict(job.drawn), "frames": job.options.length,
        "rate_hz": color.rate_hz, "size": [color.width, color.height], "intrinsics": list(color.intrinsics),
        "model": color.model, "distortion": list(color.distortion), "scan": color.scan,
    }  # fmt: skip


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


def _pairs(job: PackJob, loaded: LoadedScene) -> Iterator[Pair]:
    """The sequence's pairs, one after the other. Raises UserError."""
    from rsgen.render.images import ColorRenderer
    from rsgen.truth.renderer import TruthRenderer, global_instant

    config, drawn = job.config, job.drawn
    color = config.color.model_copy(update={"readout_s": drawn.readout_s, "exposure_s": drawn.exposure_s})
    still = color.model_copy(update={"readout_s": 0.0, "exposure_s": 0.0})
    truth = TruthConfig(global_shutter=TIMES, flow=("global",), spp=config.truth.spp, color_depth=job.options.depth)
    camera, shutter, pose = color.camera, color.shutter, job.spline.pose
    rolling = ColorRenderer(loaded.scene, loaded.integrator, camera, shutter, color.spp)
    twins = TruthRenderer(loaded.scene, loaded.integrator, color, truth)
    back = TruthRenderer(loaded.scene, loaded.integrator, still, TruthConfig())
    for k in range(job.options.length):
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


def _gyro_samples(job: PackJob) -> ImuSamples:
    """Exact angular rate and specific force in the colour camera's frame, from the first stamp to the last line.

    Before that, EuRoC's format has no sign for times.
    """
    t = np.arange(int(np.floor(_end_s(job) * _GYRO_HZ)) + 1) / _GYRO_HZ
    gravity = _GRAVITY if job.config.imu is None else job.config.imu.gravity
    gyro, accel = exact_imu(job.spline, np.eye(4), gravity, t)
    return ImuSamples(t, gyro, accel, np.zeros_like(gyro), np.zeros_like(accel), stamps=t)


def _end_s(job: PackJob) -> float:
    """When the last frame's last line is read, s."""
    return (job.options.length - 1) / job.config.color.rate_hz + job.drawn.readout_s


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
