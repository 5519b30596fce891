"""What a sequence's folder holds beside its frames: whose it is, and the text files that go with the frames."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import BoolArray, FloatArray
from rsgen.config.cameras import ColorConfig, DepthConfig, StreamConfig
from rsgen.config.config import Config
from rsgen.config.faults import ImuFaults, moved_to
from rsgen.config.rig import RigColorConfig, RigDepthConfig
from rsgen.config.sections import ImuConfig
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, is_temporary, read_yaml, write_lines
from rsgen.geometry.camera import Camera
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import (
    IMU_TRUTH_CSV,
    IMU_TRUTH_YAML,
    imu_truth_csv,
    imu_truth_yaml,
    sample_clock,
    simulate_imu,
    write_imu_csv,
)
from rsgen.sensors.reports import deliver, reported_poses
from rsgen.sequence.format import (
    CLEAN_COLOR,
    FILES,
    FORMAT,
    OBJECT_CHANNELS,
    OBJECT_IDS,
    RIG_FORMAT,
    STREAMS,
    StreamFiles,
    associate,
    frame_name,
    ground_truth,
    line_poses,
    pose_lines,
    rig_files,
    round_stamps,
)
from rsgen.sequence.truth_files import FrameTable


def fingerprint(content: Mapping[str, Any]) -> str:
    """SHA-256 of canonical JSON; a number's spelling (1 or 1.0) does not matter."""
    text = json.dumps(_canonical(content), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _canonical(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _canonical(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value) + 0.0
    return value


def describe(
    config: Config,
    spline: Spline,
    stamps: Mapping[str, FloatArray],
    versions: Mapping[str, str],
    inputs: Mapping[str, str],
) -> dict[str, Any]:
    """Content of sequence.yaml. stamps: (n,) s of all frames of each stream."""
    identity = {"config": config.content(), "inputs": dict(inputs), "versions": dict(versions)}
    return {
        **(_rig_yaml(config, stamps) if config.streams else _two_cameras_yaml(config, stamps)),
        "spline": {"knot_spacing_s": spline.dt, "t0_s": spline.t0, "control_points": len(spline.control_points)},
        "noise": noise_yaml(config),
        **({"objects": [thing.name for thing in config.objects]} if config.objects else {}),
        **({} if config.streams else {"truth": _truth_yaml(config, "color")}),
        "seed": config.seed,
        **identity,
        "fingerprint": fingerprint(identity),
    }


def _two_cameras_yaml(config: Config, stamps: Mapping[str, FloatArray]) -> dict[str, Any]:
    """What sequence.yaml states of cameras in format 1."""
    color, depth, faults = config.declared_color, config.declared_depth, config.injected
    depth_only = {"depth_scale": depth.depth_scale} | ({"registered": True} if depth.registered else {})
    return {
        "format": FORMAT,
        "name": config.name,
        "streams": {
            "color": _stream_yaml(color, stamps["color"], faults.color is not None),
            "depth": _stream_yaml(depth, stamps["depth"], faults.depth is not None) | depth_only,
        },
        "T_color_depth": _rows(config.declared_T_color_depth),
        **({} if faults.declared is None else {"declared": True}),
    }


def _rig_yaml(config: Config, stamps: Mapping[str, FloatArray]) -> dict[str, Any]:
    """What sequence.yaml states of cameras in format 2."""
    streams = {}
    for name, stream in config.streams.items():
        scale = {"depth_scale": stream.depth_scale} if isinstance(stream, DepthConfig) else {}
        streams[name] = {
            "kind": stream.kind,
            **_stream_yaml(stream, stamps[name], is_faulty=False),
            **scale,
            "T_body_cam": _rows(stream.T_body_cam),
            "truth": _truth_yaml(config, name),
        }
    return {"format": RIG_FORMAT, "name": config.name, "streams": streams}


def _rows(T: Sequence[Sequence[float]]) -> list[list[float]]:
    return [[float(value) for value in row] for row in T]


def _truth_yaml(config: Config, camera: str) -> dict[str, list[str]]:
    return {name: list(channels) for name, channels in image_truth(config, camera).items()}


def image_truth(config: Config, camera: str) -> dict[str, tuple[str, ...]]:
    """Exact images of each frame of a camera, with their EXR channels; no channels: an 8-bit PNG. Depth has its own."""
    stream = config.cameras[camera]
    if isinstance(stream, DepthConfig):
        return {}
    clean: dict[str, tuple[str, ...]] = {CLEAN_COLOR: ()} if stream.noise.model != "none" else {}
    masks = {OBJECT_IDS: OBJECT_CHANNELS} if config.objects else {}
    return clean | config.truth.images | masks


def noise_yaml(config: Config) -> dict[str, str] | None:
    """Noise models of all streams; None where they are exact."""
    models: dict[str, str] = {name: stream.noise.model for name, stream in config.cameras.items()}
    models |= {name: "stereo" for name, s in config.streams.items() if isinstance(s, RigDepthConfig) and s.stereo}
    return models if set(models.values()) != {"none"} else None


def _stream_yaml(stream: StreamConfig, stamps: FloatArray, is_faulty: bool) -> dict[str, Any]:
    table = {"frame_table": True} if is_faulty or stream.adapts else {}
    return {
        "size": [stream.width, stream.height],
        "intrinsics": list(stream.intrinsics),
        "model": stream.model,
        "distortion": list(stream.distortion),
        "rate_hz": stream.rate_hz,
        "offset_s": stream.offset_s,
        "readout_s": stream.readout_s,
        "exposure_s": stream.exposure_s,
        "scan": stream.scan,
        "frames": len(stamps),
        "first_stamp_s": float(stamps[0]),
        **table,
    }


def refuse_foreign_folder(out: Path, new: Mapping[str, Any]) -> None:
    """Raises UserError if `out` holds anything but the beginning of the sequence described by `new`."""
    cure = "choose another --out or delete the folder"
    try:
        if not out.is_dir():
            if out.exists():
                raise UserError(f"{out}: is a file, not a folder: choose another --out")
            return
        names = sorted(path.name for path in out.iterdir() if not is_temporary(path))
    except OSError as error:
        raise UserError(f"{out}: cannot be read ({error.strerror}): choose another --out") from None
    if not names:
        return
    if "sequence.yaml" not in names:
        raise UserError(f"{out}: holds other files ({names[0]}, ...) and no sequence.yaml: {cure}")
    old = read_yaml(out / "sequence.yaml")
    if old.get("fingerprint") == new["fingerprint"] and old == new:
        return
    field, before, now = _first_difference(old, new) or ("fingerprint", old.get("fingerprint"), new["fingerprint"])
    field = moved_to(field) or field
    raise UserError(f"{out}: holds another sequence, {field} is {_short(before)} there and {_short(now)} now: {cure}")


def _first_difference(old: Any, new: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Name and both values of the first differing entry, what the user can change (config, inputs) before the rest."""
    if isinstance(old, dict) and isinstance(new, dict):
        first = [key for key in ("config", "inputs", "versions") if key in new and not name]
        for key in [*first, *(key for key in [*new, *old] if key not in first)]:
            inner = str(key) if name in ("", "config") else f"{name}.{key}"  # config fields as overrides name them
            if (found := _first_difference(old.get(key), new.get(key), inner)) is not None:
                return found
        return None
    return None if old == new else (name, old, new)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


@dataclass(frozen=True)
class ListedStream:
    """One stream that is written; stamps (n,): true ones of its clock; table: what each frame shows, and when.

    truth: its exact images beside depth, as `image_truth` has them. image_camera: of the images, where depth is
    registered the colour camera.
    """

    config: ColorConfig | DepthConfig
    files: StreamFiles
    T_cam_body: FloatArray
    truth: Mapping[str, tuple[str, ...]]
    image_camera: Camera
    stamps: FloatArray
    table: FrameTable
    is_delivered: BoolArray
    writes_table: bool

    @classmethod
    def of(cls, config: Config, name: str, stamps: npt.ArrayLike) -> ListedStream:
        stream, stamps = config.cameras[name], round_stamps(stamps)
        faults = None if config.streams else getattr(config.injected, name)
        came = deliver(stamps, faults, config.seed, name)
        ones = np.ones(len(stamps))
        table = FrameTable(
            np.arange(len(stamps)), came.shows, stamps[came.shows], came.listed, stream.exposure_s * ones,
            ones, ones, np.ones((len(stamps), 3)),
        )  # fmt: skip
        registered = isinstance(stream, DepthConfig) and stream.registered
        return cls(
            stream, rig_files(name) if config.streams else FILES[name], config.T_cam_body(name),
            image_truth(config, name), config.color.camera if registered else stream.camera, stamps, table,
            came.is_delivered, stream.adapts or faults is not None,
        )  # fmt: skip

    @property
    def is_grey(self) -> bool:
        """Whether its 8-bit images have one channel."""
        return isinstance(self.config, RigColorConfig) and self.config.kind != "color"

    def line_poses(self, spline: Spline) -> FloatArray:
        """Rows (frames, lines, 7), as on disk. Raises UserError."""
        table, stream = self.table, self.config
        return line_poses(
            spline, stream.camera, stream.shutter, table.taken_s,
            None if (self.T_cam_body == np.eye(4)).all() else self.T_cam_body,
            table.exposure_s if self.writes_table else None,
        )  # fmt: skip


def write_listings(out: Path, name: str, streams: Mapping[str, ListedStream], written: Mapping[str, list[int]]) -> None:
    """A listing for each stream, and of a colour and a depth camera the pairs. written: frames on disk."""
    entries = {
        s: [f"{stream.table.listed_s[k]:.9f} {stream.files.images}/{frame_name(k)}.png" for k in written[s]]
        for s, stream in streams.items()
    }
    for s, stream in streams.items():
        write_lines(out / stream.files.listing, [f"# {s} images of {name}", "# stamp path", *entries[s]])
    if tuple(streams) == STREAMS:
        color, depth = (streams[s].table.listed_s[written[s]] for s in STREAMS)
        limit_s = 0.5 / min(stream.config.rate_hz for stream in streams.values())
        pairs = [f"{entries['color'][i]} {entries['depth'][j]}" for i, j in associate(color, depth, limit_s)]
        write_lines(out / "associations.txt", pairs)


def write_ground_truth(
    out: Path, config: Config, spline: Spline, stamps: Mapping[str, FloatArray], T_image_depth: FloatArray | None
) -> None:
    """groundtruth.txt: exact poses, or what a motion capture reports of them.

    T_image_depth (4, 4): of the colour camera, where depth is registered, whose poses they then are.
    """
    name, mocap, seed = config.name, config.mocap, config.seed
    body = "T_world_body" if config.streams else "T_world_depth"
    camera = body if T_image_depth is None else "T_world_color, depth being registered"
    if mocap is None:
        rows = ground_truth(spline, *stamps.values(), T_cam_body=T_image_depth)
    else:
        rows = reported_poses(spline, mocap, seed, T_image_depth)
        camera += ", as a motion capture reports it"
    write_lines(out / "groundtruth.txt", pose_lines(f"ground truth of {name}: {camera}", rows))


def write_imu(
    out: Path, spline: Spline, imu: ImuConfig, faults: ImuFaults | None, seed: int, middle: float,
    T_image_depth: FloatArray | None,
) -> None:  # fmt: skip
    """imu.csv, and its truth where that is more than the spline's. middle: stamp of the middle depth image, s."""
    samples = simulate_imu(spline, imu, spline.t_begin, spline.t_end, seed, faults)
    write_imu_csv(out / "imu.csv", samples)
    if imu.has_truth(faults):
        start, _ = sample_clock(imu, spline.t_begin, spline.t_end)
        T = np.eye(4) if T_image_depth is None else T_image_depth
        atomic_write(out / IMU_TRUTH_CSV, imu_truth_csv(samples).encode())
        atomic_write(out / IMU_TRUTH_YAML, encode_yaml(imu_truth_yaml(imu, faults, start, middle, T)))
