"""What a sequence's folder holds beside its frames: whose it is, and the text files that go with the frames."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import BoolArray, FloatArray
from rsgen.config.cameras import StreamConfig
from rsgen.config.config import Config
from rsgen.config.faults import ImuFaults, StreamFaults, moved_to
from rsgen.config.imu import ImuConfig
from rsgen.config.sections import MocapConfig
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, is_temporary, read_yaml
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
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
from rsgen.sequence.camera_yaml import Cameras
from rsgen.sequence.format import (
    CLEAN_COLOR,
    FOLDERS,
    FORMAT,
    LISTINGS,
    OBJECT_CHANNELS,
    OBJECT_IDS,
    STREAMS,
    StreamName,
    associate,
    frame_name,
    ground_truth,
    line_poses,
    pose_lines,
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
    color, depth, faults = config.declared_color, config.declared_depth, config.injected
    depth_only = {"depth_scale": depth.depth_scale} | ({"registered": True} if depth.registered else {})
    identity = {"config": config.content(), "inputs": dict(inputs), "versions": dict(versions)}
    return {
        "format": FORMAT,
        "name": config.name,
        "streams": {
            "color": _stream_yaml(color, stamps["color"], faults.color is not None),
            "depth": _stream_yaml(depth, stamps["depth"], faults.depth is not None) | depth_only,
        },
        "T_color_depth": [[float(value) for value in row] for row in config.declared_T_color_depth],
        **({} if faults.declared is None else {"declared": True}),
        "spline": {"knot_spacing_s": spline.dt, "t0_s": spline.t0, "control_points": len(spline.control_points)},
        "noise": noise_yaml(config),
        **({"objects": [thing.name for thing in config.objects]} if config.objects else {}),
        "truth": {name: list(channels) for name, channels in color_truth(config).items()},
        "seed": config.seed,
        **identity,
        "fingerprint": fingerprint(identity),
    }


def true_cameras(config: Config) -> Cameras:
    """The cameras that take the images, whatever `faults.declared` states."""
    color, depth = config.color, config.depth
    T_color_depth = np.array(config.T_color_depth, float)
    return Cameras(color.camera, color.shutter, depth.camera, depth.shutter, depth.depth_scale, T_color_depth)


def color_truth(config: Config) -> dict[str, tuple[str, ...]]:
    """Images in truth/NAME/ for each colour frame with their EXR channels; no channels: an 8-bit sRGB PNG."""
    clean: dict[str, tuple[str, ...]] = {CLEAN_COLOR: ()} if config.color.noise.model != "none" else {}
    masks = {OBJECT_IDS: OBJECT_CHANNELS} if config.objects else {}
    return clean | config.truth.images | masks


def noise_yaml(config: Config) -> dict[str, str] | None:
    """Noise models of both streams; None where both are exact."""
    models: dict[str, str] = {name: getattr(config, name).noise.model for name in STREAMS}
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
    """One stream that is written; stamps (n,): true ones of its clock; table: what each frame shows, and when."""

    camera: Camera
    shutter: Shutter
    stamps: FloatArray
    table: FrameTable
    is_delivered: BoolArray
    writes_table: bool

    @classmethod
    def of(
        cls, stream: StreamConfig, faults: StreamFaults | None, name: StreamName, stamps: npt.ArrayLike, seed: int
    ) -> ListedStream:
        stamps = round_stamps(stamps)
        came = deliver(stamps, faults, seed, name)
        ones = np.ones(len(stamps))
        table = FrameTable(
            np.arange(len(stamps)), came.shows, stamps[came.shows], came.listed, stream.exposure_s * ones,
            ones, ones, np.ones((len(stamps), 3)),
        )  # fmt: skip
        return cls(stream.camera, stream.shutter, stamps, table, came.is_delivered, stream.adapts or faults is not None)

    def line_poses(self, spline: Spline, T_cam_body: FloatArray | None = None) -> FloatArray:
        """Rows (frames, lines, 7), as in truth/rows_STREAM.npy. Raises UserError."""
        table = self.table
        return line_poses(
            spline, self.camera, self.shutter, table.taken_s, T_cam_body,
            table.exposure_s if self.writes_table else None,
        )  # fmt: skip


def write_listings(
    out: Path, name: str, listed: Mapping[StreamName, FloatArray], written: Mapping[StreamName, list[int]],
    limit_s: float,
) -> None:  # fmt: skip
    """rgb.txt, depth.txt, and the pairs at most limit_s apart. listed (n,): stamps, s; written: frames on disk."""
    entries = {s: [f"{listed[s][k]:.9f} {FOLDERS[s]}/{frame_name(k)}.png" for k in written[s]] for s in STREAMS}
    for s in STREAMS:
        write_lines(out / LISTINGS[s], [f"# {s} images of {name}", "# stamp path", *entries[s]])
    color, depth = (listed[s][written[s]] for s in STREAMS)
    pairs = [f"{entries['color'][i]} {entries['depth'][j]}" for i, j in associate(color, depth, limit_s)]
    write_lines(out / "associations.txt", pairs)


def write_ground_truth(
    out: Path, name: str, spline: Spline, stamps: Mapping[StreamName, FloatArray], T_image_depth: FloatArray | None,
    mocap: MocapConfig | None, seed: int,
) -> None:  # fmt: skip
    """groundtruth.txt: exact poses, or what a motion capture reports of them.

    T_image_depth (4, 4): of the colour camera, where depth is registered, whose poses they then are.
    """
    camera = "T_world_depth" if T_image_depth is None else "T_world_color, depth being registered"
    if mocap is None:
        rows = ground_truth(spline, stamps["color"], stamps["depth"], T_cam_body=T_image_depth)
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


def write_lines(path: Path, lines: list[str]) -> None:
    """A text file of these lines. Raises UserError if the disk refuses it."""
    atomic_write(path, "".join(f"{line}\n" for line in lines).encode())
